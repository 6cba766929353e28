"""Conversion between file formats, and of a stored cube to its photons, with a list of data that are lost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import Progress
from mars_lidar._version import __version__
from mars_lidar.engines.simulation import simulate_timestamps
from mars_lidar.io.cube import SUFFIXES, Cube, load, one_exposure, save
from mars_lidar.io.streams import photon_hdf5, ptu
from mars_lidar.io.streams.formats import STREAM_SUFFIXES, is_stream
from mars_lidar.light.timestamps import Timestamps


@dataclass(frozen=True)
class Converted:
    """Result of `convert`.

    Attributes
    ----------
    path
        The new file.
    content
        Description of its content.
    lost
        Data of the source that the new file does not contain, one sentence each.

    See Also
    --------
    convert

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
    >>> cube.save(folder / "room.npz")
    >>> done = ml.io.convert(folder / "room.npz", folder / "room.h5")
    >>> done.path.name, done.lost
    ('room.h5', ())
    """

    path: Path
    content: str
    lost: tuple[str, ...]


@checked
def convert(
    source: str | Path,
    target: str | Path,
    *,
    realization: int | None = None,
    period_ns: float | None = None,
    bins: int | None = None,
    clock_ps: float | None = None,
    overwrite: bool = False,
) -> Converted:
    """Write a cube or a photon stream in the format given by the suffix of the target.

    Cubes: ``.zarr .h5 .hdf5 .npz .mat .ptu``; their counts and recipe are kept in all of them. Streams:
    ``.npz .ptu .h5 .hdf5`` (the last two as Photon-HDF5); times are kept to the resolution of the format. A
    cube stays a cube and a stream a stream; `photons` makes a stream of a cube.

    Parameters
    ----------
    source, target
        The two files.
    realization
        For a cube: only this exposure, counted from 0 in the file. A ``.mat`` contains one exposure.
    period_ns, bins
        For a recorded stream: see `mars_lidar.Timestamps.load`.
    clock_ps
        For a stream written as ``.ptu``: see `mars_lidar.Timestamps.save`.
    overwrite
        Replace an existing target.

    Raises
    ------
    ValueError, TypeError
        Files of another kind, damaged or incomplete files, or data that the target's format cannot contain.
    OSError
        The target exists and `overwrite` is false, or cannot be written.

    See Also
    --------
    photons, load, save

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
    >>> cube.save(folder / "room.npz")
    >>> ml.io.convert(folder / "room.npz", folder / "room.h5").content
    'cube 1 × 1 × 2 × 128 (realization, y, x, time)'
    """
    old, new = Path(source), Path(target)
    allowed = sorted({*SUFFIXES, *STREAM_SUFFIXES})
    for name, path in (("source", old), ("target", new)):
        checks.suffix(name, path, allowed)
    if new.exists() and old.exists() and new.resolve() == old.resolve():
        raise ValueError(f"target must not be the source, got {str(new)!r} for both")
    if old.is_file() and is_stream(old):
        if realization is not None:
            raise ValueError(f"realization is for cubes, and {old} holds photons of one exposure")
        return _stream(Timestamps.load(old, period_ns=period_ns, bins=bins), old, new, overwrite, clock_ps)
    for name, value in (("period_ns", period_ns), ("bins", bins), ("clock_ps", clock_ps)):
        if value is not None:
            raise ValueError(f"{name} is for photon streams, and {old} is none")
    with load(old) as cube:
        return _cube(cube, old, new, realization, overwrite)


@checked
def photons(
    cube: Cube, *, realization: int = 0, threads: int | None = None, progress: Progress | bool | None = None
) -> Timestamps:
    """The photons of one exposure of a stored cube, simulated again from its recipe.

    Parameters
    ----------
    cube
        A cube that `load` returned.
    realization
        Which exposure, counted from 0 in the file.
    threads, progress
        As for `mars_lidar.simulate_timestamps`.

    Returns
    -------
    Timestamps
        Their histogram equals the stored exposure.

    Raises
    ------
    ValueError
        The photons do not have the stored counts (another version made the cube), or the engine draws
        histograms only.
    TypeError
        Not a cube that `load` returned.

    See Also
    --------
    mars_lidar.simulate_timestamps, convert

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> path = folder / "pair.npz"
    >>> written = ml.io.simulate_to(path, ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system)
    >>> times = ml.io.photons(ml.io.load(path))
    >>> len(times) == written.registrations
    True
    """
    k = checks.integer("realization", realization, low=0, high=cube.shape[0] - 1)
    arguments = cube.simulation("the time of each photon").part(slice(k, k + 1), slice(0, cube.shape[1]))
    del arguments["realizations"]
    arguments["realization"] = arguments.pop("first_realization")
    times = simulate_timestamps(**arguments, threads=threads, progress=progress)
    if cube.recipe.source:
        times.info["source"] = cube.recipe.source
    for y in range(times.shape[0]):  # row by row: the whole image may be larger than its photons
        first, last = times.offsets[y * times.shape[1]], times.offsets[(y + 1) * times.shape[1]]
        counts = np.diff(times.offsets[y * times.shape[1] : (y + 1) * times.shape[1] + 1])
        pixel = np.repeat(np.arange(times.shape[1]), counts)
        flat = np.bincount(pixel * times.bins + times.bin[first:last], minlength=times.shape[1] * times.bins)
        if not np.array_equal(flat.reshape(times.shape[1], times.bins), np.asarray(cube.histogram[k, y])):
            raise ValueError(
                f"the photons of row {y} do not have the counts of {cube.path}: it was made by mars-lidar "
                f"{cube.version} and this is {__version__}, or it was changed since"
            )
    return times


def _cube(cube: Cube, old: Path, new: Path, realization: int | None, overwrite: bool) -> Converted:
    if new.suffix not in SUFFIXES:
        raise ValueError(f"{old} is a cube, which goes into one of {', '.join(SUFFIXES)}, not {str(new)!r}")
    lost = []
    if realization is not None:
        count, cube = cube.shape[0], one_exposure(cube, realization)
        if count > 1:
            lost.append(f"{count - 1} of {count} realizations")
    if cube.version not in ("", __version__):
        lost.append(f"that mars-lidar {cube.version} made the counts: the new file names {__version__}")
    save(new, cube, overwrite=overwrite)
    n, height, width, bins = cube.shape
    return Converted(new, f"cube {n} × {height} × {width} × {bins} (realization, y, x, time)", tuple(lost))


def _stream(times: Timestamps, old: Path, new: Path, overwrite: bool, clock_ps: float | None) -> Converted:
    if new.suffix not in STREAM_SUFFIXES:
        raise ValueError(
            f"{old} is a photon stream, which goes into one of {', '.join(STREAM_SUFFIXES)}, not {str(new)!r}"
        )
    lost = []
    if new.suffix != ".npz":
        unit_ns = resolution_ns(new, times, clock_ps)
        lost.append(f"times below {1e3 * unit_ns:.4g} ps (units of {new.suffix} here); cycles and bins are exact")
    if times.system is None:
        lost.append("header entries of the other program that wrote the source, beyond period, detectors and times")
    times.save(new, overwrite=overwrite, clock_ps=clock_ps)
    height, width = times.shape
    return Converted(new, f"{len(times):,} photons of {height} × {width} pixels", tuple(lost))


def resolution_ns(path: Path, times: Timestamps, clock_ps: float | None = None) -> float:
    """Unit of the times in the format of `path`, ns; 0 for .npz, which stores them unchanged."""
    if path.suffix == ".npz":
        return 0.0
    if path.suffix == ".ptu":
        units = ptu.units_per_bin(times.bins, times.period_ns, clock_ps)
    else:
        units = photon_hdf5.units_per_bin(times.bins)
    return float(times.period_ns / (times.bins * units))
