"""MATLAB v5 ``.mat`` in the layout that published depth networks load: one exposure, counts sparse.

==========  ==================  =============================================================================
variable    shape               holds
==========  ==================  =============================================================================
spad        (H W, bins) sparse  counts; pixel (y, x), from 0, is row y + H x (MATLAB's column-major order)
rates       (H, W, bins)        signal alone, before dead time, in each bin; largest bin of a pixel = 1
bin         (H, W)              bin of the return, from 1; 0 = no return
bin_hr      (8 H, 8 W)          the same as a real number, from 1, at the size of the network's colour image;
                                NaN = no return
SBR         (1, 1)              mean S / mean B
photons     (1, 1)              mean expected signal photons of a pixel in the exposure, S times cycles
mars_lidar  (1, 1) struct       ours: ``attributes`` (JSON) and the maps of `mars_lidar.io.layout`
==========  ==================  =============================================================================

All numbers are of MATLAB's class double. ``bin`` is stored as small integers, as MATLAB stores whole numbers, so that
`scipy.io.loadmat` returns it as uint16. ``rates`` is zero without a return.
"""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks, mat5
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import FileError, beside, check_target, read_mat5
from mars_lidar._base.resources import check_memory
from mars_lidar._base.sparse import is_sparse
from mars_lidar.instrument.system import System
from mars_lidar.io import layout
from mars_lidar.io.cube import Cube, copy_counts, one_exposure
from mars_lidar.io.recipe import BLOCK_BYTES, Recipe
from mars_lidar.io.store import LazyCounts, OnDisk, OpenedStore, Writer
from mars_lidar.light.flux import Flux, made
from mars_lidar.statistics.cells import photons_per_bin

UPSAMPLING = 8  # bin_hr over bin: 512 x 512 and 64 x 64 in the files that the networks were trained on
MAX_BYTES = 2**31 - 2**16  # a variable of a v5 file, before compression
_COMPRESSED, _DOUBLE_CLASS, _HEADER_BYTES = 15, 6, 128  # MAT-File Level 5: element type, array class, header


def check(recipe: Recipe) -> None:
    """Raise ValueError, before any work, for data that the format cannot contain."""
    realizations, height, width, bins = recipe.shape
    if realizations != 1:
        raise ValueError(
            f"a .mat holds one exposure, got {realizations} realizations; "
            f"write them one by one (mars-lidar convert --realization K) or use .h5"
        )
    size = 8 * height * width * bins
    if size > MAX_BYTES:
        raise ValueError(
            f"a variable of a .mat (v5) must take less than 2 GiB, and rates of {height} x {width} x {bins} takes "
            f"{size / 2**30:.3g} GiB; use .h5, which MATLAB reads with h5read, or a crop"
        )


@contextlib.contextmanager
def open_writer(path: Path, recipe: Recipe, bin_hr: NDArray[np.float64] | None = None) -> Iterator[Writer]:
    """Writes a cube; its counts stay sparse in memory until the end."""
    from scipy import sparse

    check(recipe)
    check_memory(3 * 8 * int(np.prod(recipe.shape)), f"the rates of {path}", "a .zarr or .h5 is written in parts")
    events: list[Any] = []

    def put(realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        y, x, k = np.nonzero(block[0])
        events.append((y + rows.start, x, k, block[0][y, x, k]))

    with beside(path) as unfinished, open(unfinished, "wb") as file:
        writer = Writer(recipe.chunks(BLOCK_BYTES), put)
        yield writer
        _, height, width, bins = recipe.shape
        y, x, k, counts = (np.concatenate(part) for part in zip(*events, strict=True))
        spad = sparse.csc_matrix((counts.astype(np.float64), (y + height * x, k)), shape=(height * width, bins))
        first, fine = return_bins(recipe.flux, recipe.system)
        flux = recipe.flux.detected(recipe.system)
        background = float(flux.background.mean())
        attrs: dict[str, Any] = {"complete": True, "registrations": writer.registrations}
        ours: dict[str, Any] = {v.name: v.data for v in layout.variables(recipe)}
        attrs["shapes"] = {name: list(array.shape) for name, array in ours.items()}
        variables = {
            "spad": spad,
            "SBR": float(flux.signal.mean()) / background if background > 0 else np.inf,
            "bin": first,
            "bin_hr": larger(fine) if bin_hr is None else bin_hr,
            "photons": float(flux.signal.mean()) * recipe.system.cycles,
            "rates": rates(flux, recipe.system),
            "mars_lidar": {"attributes": json.dumps(layout.attributes(recipe) | attrs), **ours},
        }
        write_variables(file, variables)


def larger(image: NDArray[Any]) -> NDArray[Any]:
    """At the size of the network's colour image."""
    return image.repeat(UPSAMPLING, axis=0).repeat(UPSAMPLING, axis=1)


def write_variables(file: BinaryIO, variables: Mapping[str, Any]) -> None:
    """A v5 file of variables, compressed one by one at the fastest level; small integers are of class double."""
    file.write(_element("", 0.0)[0])
    for name, value in variables.items():
        file.write(_element(name, value)[1])


def _element(name: str, value: Any) -> tuple[bytes, bytes]:
    """The header of a file, and one compressed variable."""
    from scipy.io import savemat

    buffer: Any = BytesIO()  # scipy's stubs know paths only
    savemat(buffer, {name: value} if name else {}, long_field_names=True)
    raw = bytearray(buffer.getvalue())
    header, variable = bytes(raw[:_HEADER_BYTES]), raw[_HEADER_BYTES:]
    if isinstance(value, np.ndarray) and value.dtype.kind == "u":
        variable[16] = _DOUBLE_CLASS  # the class in the array's flags; the stored type stays small
    packed = zlib.compress(variable, 1)  # 22.6 MB for the room of zarr_store.py; level 5: 22.0 MB
    return header, struct.pack("<II", _COMPRESSED, len(packed)) + packed


def return_bins(flux: Flux, system: System) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Bin of the strongest return from 1, (H, W) uint16 or uint32, and as a real number, (H, W).

    The centre of bin k, from 1, is the real number k. A waveform's return is its largest bin.
    """
    if flux.waveform is None:
        fine = bins_of_delay(flux.delay_ns, system)
        fine = np.where(flux.signal > 0, fine, np.nan)
    else:
        wave = np.concatenate([band.argmax(-1) for band in _rate_bands(flux, system)])
        fine = np.where(flux.signal > 0, wave + 1.0, np.nan)
    small = np.uint16 if system.bins < 2**16 else np.uint32
    whole = np.clip(np.floor(np.nan_to_num(fine) + 0.5), 0, system.bins).astype(small)
    return whole, fine


def bins_of_delay(delay_ns: ArrayLike, system: System) -> NDArray[np.float64]:
    """Delays as real bin numbers from 1; in [0.5, bins + 0.5)."""
    wrapped = np.mod(np.asarray(delay_ns, np.float64), system.period_ns)
    return np.asarray(wrapped / system.bin_ns + 0.5, np.float64)


def rates(flux: Flux, system: System) -> NDArray[np.float64]:
    """Signal in each bin (H, W, bins), largest bin 1; column-major, as MATLAB stores it."""
    out = np.empty((*flux.shape, system.bins), order="F")
    row = 0
    for band in _rate_bands(flux, system):
        peak = band.max(-1, keepdims=True)
        out[row : row + len(band)] = np.divide(band, peak, out=np.zeros_like(band), where=peak > 0)
        row += len(band)
    return out


def _rate_bands(flux: Flux, system: System) -> Iterator[NDArray[np.float64]]:
    """The signal in each bin, photons per period, row after row."""
    for y in range(flux.shape[0]):
        row = flux[y : y + 1]
        signal = made(row.returns_signal, row.returns_delay_ns, np.zeros(row.shape), row.waveform, None)
        yield photons_per_bin(signal, system.detected(), bins=system.bins)


def open_store(path: Path) -> OpenedStore:
    """Open a file for reading; its variables are read at once, its counts stay sparse until they are used."""
    if _is_hdf5(path):
        raise ValueError(
            f"{path} is not a cube written by mars-lidar: those are of MATLAB's version 5, and this is 7.3 (HDF5)"
        )
    if "mars_lidar" not in {head.name for head in mat5.variables(path)}:
        raise ValueError(
            f"{path} is not a cube written by mars-lidar (no variable 'mars_lidar'); "
            f"mars_lidar.io.foreign_cube reads the counts of other programs' files"
        )
    variables = read_variables(path)
    ours = variables["mars_lidar"][0, 0]
    attrs = json.loads(str(ours["attributes"].item()))
    layout.check_format(path, attrs)
    shapes: Mapping[str, list[int]] = attrs.pop("shapes")

    # contiguous, so that sums keep their bits
    arrays = {name: np.ascontiguousarray(np.asarray(ours[name]).reshape(shape)) for name, shape in shapes.items()}
    recipe = layout.recipe_from(attrs, arrays, 1)
    _, height, width, bins = recipe.shape
    spad = variables["spad"]
    if not is_sparse(spad) or spad.shape != (height * width, bins):
        raise ValueError(f"{path}: spad must be sparse (H W, bins) of {(height, width, bins)}, got {spad.shape}")
    most = min(recipe.system.max_bin_count, np.iinfo(recipe.dtype).max)
    with np.errstate(invalid="ignore"):
        if not ((spad.data >= 0) & (spad.data <= most) & (spad.data == np.floor(spad.data))).all():
            raise ValueError(f"{path} is damaged: spad must hold counts, whole numbers in [0, {most:g}]")

    def counts() -> NDArray[Any]:
        check_memory(2 * recipe.nbytes, f"the counts of {path}", "mars-lidar convert makes a .zarr of it elsewhere")
        dense = spad.astype(recipe.dtype).toarray(order="C")
        return np.ascontiguousarray(dense.reshape(width, height, bins).transpose(1, 0, 2))[None]

    return OpenedStore(attrs, arrays | {"histogram": OnDisk(LazyCounts(recipe.shape, recipe.dtype, counts), path)})


def read_variables(path: Path) -> dict[str, Any]:
    """All variables of a v5 file; FileError for other or damaged files."""
    if _is_hdf5(path):
        raise FileError(f"{path} is a MATLAB v7.3 file (HDF5), and a v5 .mat is needed: save it with -v7")
    return read_mat5(path)


def _is_hdf5(path: Path) -> bool:
    """Whether a .mat is of version 7.3."""
    import h5py

    return bool(h5py.is_hdf5(path))


@checked
def save_mat(
    path: str | Path, cube: Cube, *, realization: int = 0, depth_hr_m: ArrayLike | None = None, overwrite: bool = False
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
        An invalid argument, or a cube that the format cannot contain.
    OSError
        `path` exists and `overwrite` is false, or cannot be written.

    See Also
    --------
    save, foreign_cube

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
    >>> ml.io.load(folder / "spad.mat").shape
    (1, 1, 2, 128)
    """
    target = Path(path)
    checks.suffix("path", target, [".mat"])
    cube.simulation("a .mat")
    exposure = one_exposure(cube, realization)
    recipe = exposure.simulation()
    fine = None
    if depth_hr_m is not None:
        depth = np.asarray(depth_hr_m)
        if depth.ndim != 2 or depth.size == 0 or depth.dtype.kind not in "fiu":
            raise ValueError(f"depth_hr_m must be real numbers (h, w), got shape {depth.shape} of {depth.dtype}")
        with np.errstate(invalid="ignore"):
            if not (np.isnan(depth) | ((depth > 0) & (depth < np.inf))).all():
                raise ValueError("depth_hr_m must be positive, or NaN for no return")
        fine = bins_of_delay(recipe.system.delay_ns(depth), recipe.system)
    check(recipe)
    check_target(target, folder=False, overwrite=overwrite)
    with open_writer(target, recipe, fine) as writer:
        copy_counts(exposure, writer)
