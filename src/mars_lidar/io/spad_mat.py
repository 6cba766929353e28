"""The `.mat` files of depth networks (layout: `mars_lidar.io.mat`), whoever wrote them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.files import check_target, reading
from mars_lidar._base.resources import check_memory
from mars_lidar._base.sparse import dense_counts, is_sparse
from mars_lidar.io import mat
from mars_lidar.io.cube import Cube, copy_counts, one_exposure


@dataclass(frozen=True, eq=False)
class SpadMat:
    """What such a file holds.

    Attributes
    ----------
    histogram
        (H, W, bins) uint16 or uint32, counts.
    rates
        (H, W, bins), signal before dead time; of a unit of its own.
    bin
        (H, W), bin of the return, from 1.
    bin_hr
        (h, w), the same at a finer size, real numbers from 1.
    sbr
        Signal over background.
    photons
        Mean signal photons of a pixel.

    See Also
    --------
    read_mat, save_mat

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> cube = ml.Cube(ml.simulate(flux, system), system, flux)
    >>> ml.io.save_mat(folder / "spad.mat", cube)
    >>> ml.io.read_mat(folder / "spad.mat").histogram.shape
    (1, 2, 128)
    """

    histogram: NDArray[Any]
    rates: NDArray[np.float64]
    bin: NDArray[Any]
    bin_hr: NDArray[np.float64]
    sbr: float
    photons: float


@checked
def read_mat(path: str | Path) -> SpadMat:
    """Read a file of this layout, of mars-lidar or of others.

    Parameters
    ----------
    path
        The ``.mat``.

    Raises
    ------
    ValueError
        Not such a file, or damaged; the message starts with the file.

    See Also
    --------
    save_mat, SpadMat

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> cube = ml.Cube(ml.simulate(flux, system), system, flux)
    >>> ml.io.save_mat(folder / "spad.mat", cube)
    >>> ml.io.read_mat(folder / "spad.mat").bin.shape
    (1, 2)
    """
    with reading(path, "a .mat of counts") as source:
        return _spad(source, mat.read_variables(source))


def _spad(source: Path, found: dict[str, Any]) -> SpadMat:
    missing = [name for name in ("spad", "rates", "bin", "bin_hr", "SBR", "photons") if name not in found]
    if missing:
        raise ValueError(f"{source}: has no variable {', '.join(missing)}")
    spad, rates = found["spad"], found["rates"]
    height, width = found["bin"].shape
    bins = rates.shape[-1]
    if rates.shape != (height, width, bins) or spad.shape != (height * width, bins):
        raise ValueError(
            f"{source}: rates must be (H, W, bins) and spad (H W, bins) for bin {(height, width)}, "
            f"got {rates.shape} and {spad.shape}"
        )
    check_memory(16 * height * width * bins, f"the counts of {source}", "read it on a larger machine")
    dense = dense_counts("spad", spad) if is_sparse(spad) else np.asarray(spad)
    if not ((dense >= 0) & (dense == np.round(dense)) & (dense < 2**32)).all():
        raise ValueError(f"{source}: spad must hold counts, whole numbers from 0")
    kind = np.uint16 if dense.max(initial=0) < 2**16 else np.uint32
    histogram = dense.astype(kind).reshape(width, height, bins).transpose(1, 0, 2)
    return SpadMat(
        np.ascontiguousarray(histogram),
        np.ascontiguousarray(rates, np.float64),
        found["bin"],
        np.asarray(found["bin_hr"], np.float64),
        float(np.ravel(found["SBR"])[0]),
        float(np.ravel(found["photons"])[0]),
    )


@checked
def save_mat(
    path: str | Path,
    cube: Cube,
    *,
    realization: int = 0,
    depth_hr_m: ArrayLike | None = None,
    overwrite: bool = False,
) -> None:
    """Write one exposure of a cube, with a finer depth map for the training of upsampling networks.

    Parameters
    ----------
    path
        ``.mat``.
    cube
        What `load` returned, or a cube in memory.
    realization
        Which exposure, counted from 0 in the cube.
    depth_hr_m
        Depth (8 H, 8 W) in m, or any other size, for ``bin_hr``; NaN = no return. None: the cube's own bins,
        each repeated 8 x 8 times, which adds no detail.
    overwrite
        Replace an existing file.

    Raises
    ------
    ValueError, TypeError
        A bad argument, or a cube that the format cannot hold.
    OSError
        `path` exists and `overwrite` is false, or cannot be written.

    See Also
    --------
    read_mat, save

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> cube = ml.Cube(ml.simulate(flux, system), system, flux)
    >>> ml.io.save_mat(folder / "spad.mat", cube)
    >>> round(ml.io.read_mat(folder / "spad.mat").sbr, 2)
    1.25
    """
    target = Path(path)
    if target.suffix != ".mat":
        raise ValueError(f"path must end in .mat, got {str(path)!r}")
    cube.simulation("a .mat")
    one = one_exposure(cube, realization)
    recipe = one.simulation()
    fine = None
    if depth_hr_m is not None:
        depth = np.asarray(depth_hr_m)
        if depth.ndim != 2 or depth.size == 0 or depth.dtype.kind not in "fiu":
            raise ValueError(f"depth_hr_m must be real numbers (h, w), got shape {depth.shape} of {depth.dtype}")
        with np.errstate(invalid="ignore"):
            if not (np.isnan(depth) | ((depth > 0) & (depth < np.inf))).all():
                raise ValueError("depth_hr_m must be positive, or NaN for no return")
        fine = mat.bins_of_delay(recipe.system.delay_ns(depth), recipe.system)
    mat.check(recipe)
    check_target(target, folder=False, overwrite=overwrite)
    with mat.open_writer(target, recipe, fine) as writer:
        copy_counts(one, writer)
