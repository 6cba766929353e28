"""Histograms and photon times in files of other programs: NumPy, MATLAB, HDF5, TIFF, text, photon counters."""

from __future__ import annotations

import math
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import files, mat5
from mars_lidar._base.arguments import checked
from mars_lidar._base.hdf5 import CELLS, open_hdf5
from mars_lidar._base.sparse import check_sparse, check_stored, dense_bytes, is_sparse
from mars_lidar.instrument.system import System
from mars_lidar.io.cube import Cube
from mars_lidar.io.measured import from_histograms, from_photon_times, in_order
from mars_lidar.io.named_arrays import cell_arrays, hdf5_arrays, mat_arrays
from mars_lidar.io.pixels import decoded
from mars_lidar.io.streams.bare_stream import cells_of
from mars_lidar.io.streams.formats import RECORDER_SUFFIXES
from mars_lidar.io.streams.recorders import Recorded, recorded

FOREIGN_SUFFIXES = (".npy", ".npz", ".mat", ".h5", ".hdf5", ".tif", ".tiff", ".csv", ".txt", *RECORDER_SUFFIXES)


@dataclass(frozen=True, eq=False)
class ForeignCounts:
    """Result of `read_counts`."""

    path: Path
    name: str  # of the array in the file; "" where the format has no names
    counts: NDArray[Any] | None  # (exposures, H, W, T), or None where the file holds photon times
    cells: NDArray[Any] | None  # (H, W) of arrays of photon times, or None
    axes: str  # meaning of the dimensions of the array
    recorder: Recorded | None = None  # settings of the histograms in a file of a photon counter
    times: NDArray[np.float64] | None = None  # of the bins of a .csv or .txt, in a unit that it does not state

    def cube(
        self,
        system: System,
        *,
        start_ns: float = 0.0,
        unit_ns: float | None = None,
        window_ns: tuple[float, float] | None = None,
    ) -> Cube:
        """The cube, see `foreign_cube`."""
        source = f"{self.path}" + (f", {self.name}" if self.name else "") + (f", axes {self.axes}" if self.axes else "")
        try:
            if self.counts is not None:
                if unit_ns is not None:
                    raise ValueError("unit_ns is for photon times, and this array holds histograms")
                if window_ns is not None:
                    raise ValueError("window_ns is for photon times, and this array holds histograms")
                if self.times is not None and self.times.size > 1:
                    _check_times(self.times, system.bin_ns, start_ns)
                return from_histograms(self.counts, system, start_ns=start_ns, source=source)
            if unit_ns is None:
                raise ValueError(f"{self.name} holds photon times of an unknown unit: give unit_ns (1 for ns)")
            return from_photon_times(
                self.cells, system, unit_ns=unit_ns, start_ns=start_ns, window_ns=window_ns, source=source
            )
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error


@checked
def foreign_cube(
    path: str | Path,
    system: System,
    *,
    variable: str | None = None,
    axes: str | None = None,
    image: tuple[int, int] | None = None,
    start_ns: float = 0.0,
    unit_ns: float | None = None,
    window_ns: tuple[float, float] | None = None,
) -> Cube:
    """A cube from a file that another program wrote.

    Parameters
    ----------
    path
        ``.ptu``, ``.pt3``, ``.ht3``, ``.t3r``, ``.spc`` and ``.sdt`` of photon counters (scanned images, or a histogram
        for each channel), ``.npy``, ``.npz`` (SciPy's sparse matrices as well), ``.mat`` (v5, v7.3; dense, sparse, or
        cells of photon times), ``.h5``, ``.hdf5``, ``.tif`` (a page for each time bin), ``.csv`` or ``.txt`` (one
        histogram: a column of counts, or times and counts).
    system, axes, image, start_ns
        As for `mars_lidar.io.from_histograms`. Default of `axes`: time is the dimension whose length is the number of
        bins of the system, else the last; in a TIFF the pages. It must be given if two are so long. A dimension of
        pixels is ordered by columns in files of MATLAB, else by rows.
    variable
        Name of the array in a file with several; ``name[3]`` is the third array of a MATLAB cell.
    unit_ns
        Unit of photon times, ns.
    window_ns
        (start, stop) of photon times, as for `mars_lidar.io.from_photon_times`.

    Raises
    ------
    FileNotFoundError, ValueError
        A file that is missing, unreadable, or does not match the arguments; the message names it.
    TypeError
        An argument of another kind.

    See Also
    --------
    from_histograms, from_photon_times, load

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import numpy as np
    >>> np.save(folder / "counts.npy", np.ones((4, 6, 128), int))
    >>> ml.io.foreign_cube(folder / "counts.npy", system).shape
    (1, 4, 6, 128)
    """
    contents = read_counts(path, variable=variable, axes=axes, image=image, bins=system.bins)
    return contents.cube(system, start_ns=start_ns, unit_ns=unit_ns, window_ns=window_ns)


_TEXT = (".csv", ".txt")


def read_counts(
    path: str | Path,
    *,
    variable: str | None = None,
    axes: str | None = None,
    image: tuple[int, int] | None = None,
    bins: int | None = None,
) -> ForeignCounts:
    """The array of a file, its axes in order; `bins`, if known, identifies the time axis by its length."""
    source = Path(path)
    recording = recorded(source) if source.suffix.lower() in RECORDER_SUFFIXES else None
    times = None
    if recording is not None:
        by_name = recording.arrays
    elif source.suffix.lower() in _TEXT:
        with files.reading(source, "arrays of histograms"):
            times, column = files.read_times(source)
        by_name = {"": column}
    else:
        by_name = arrays(source)
    name, array = _chosen(source, by_name, variable)
    if isinstance(array, np.ndarray) and array.dtype == object:
        return ForeignCounts(source, name, None, array, "")
    order = _guessed(source, array.shape, bins) if axes is None else axes
    if is_sparse(array):
        files.check_claim(source, dense_bytes(array), f"the counts of {name or 'its matrix'}")
    try:
        return ForeignCounts(source, name, in_order(array, order, image), None, order, recording, times)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{source}: {name or 'the array'}: {error}") from error


_UNITS = {"s": 1e9, "us": 1e3, "ns": 1.0, "ps": 1e-3}


def _check_times(times: NDArray[np.float64], bin_ns: float, start_ns: float) -> None:
    """Raise ValueError where the times beside the counts contradict the bins of the system or `start_ns`."""
    step = float(times[-1] - times[0]) / (times.size - 1)
    fits = [scale for scale in _UNITS.values() if abs(step * scale / bin_ns - 1.0) < 1e-3]
    if not fits:
        raise ValueError(
            f"its times ascend by {step:g}, which is not the bin width of {bin_ns:g} ns in {', '.join(_UNITS)}: "
            "correct the number of bins or the period"
        )
    begin = float(times[0]) * fits[0]
    if start_ns == 0.0 and not -0.01 < begin / bin_ns < 0.99:  # the first bin's edge or its middle
        raise ValueError(
            f"its times begin at {begin:g} ns: give the laser period and start_ns (--period-ns, --start-ns) where the "
            "histogram begins that late after the laser pulse, or the counts alone where its first bin is at the pulse"
        )


def arrays(path: Path) -> dict[str, Any]:
    """Every array of a file that could be histograms or photon times, by name: dense, sparse, or cells of times."""
    if path.suffix.lower() not in FOREIGN_SUFFIXES:
        raise ValueError(f"{path}: histograms of other programs are read from {', '.join(FOREIGN_SUFFIXES)}")
    with files.reading(path, "arrays of histograms"):
        if path.suffix.lower() in RECORDER_SUFFIXES:
            return dict(recorded(path).arrays)
        by_name: dict[str, Any] = _READERS[path.suffix.lower()](path)
    return {name: array for name, array in by_name.items() if len(array.shape)}


_MOST_LISTED = 64  # most cells of a variable that are opened to describe their contents


def listed(path: Path) -> dict[str, str]:
    """Descriptions of the arrays in a file by name; for .mat, .npz and HDF5 without reading the values."""
    import h5py

    suffix = path.suffix.lower()
    with files.reading(path, "arrays of histograms"):
        if suffix == ".mat" and not h5py.is_hdf5(path):
            return _listed_mat(path)
        if suffix in (".mat", ".h5", ".hdf5"):
            return _listed_hdf5(path, suffix == ".mat")
        if suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                heads = {name.removesuffix(".npy"): files.npy_header(archive.open(name)) for name in archive.namelist()}
            if {"format", "shape", "data"} <= heads.keys():
                return {"": f"sparse, {heads['data'][0][0]} values {heads['data'][1]}"}
            return {name: _in_words(shape, dtype) for name, (shape, dtype, _) in heads.items() if shape}
        if suffix == ".npy":
            head = files.NpyFile(path)
            return {"": _in_words(head.shape, head.dtype)}
    return {name: _in_words(array.shape, array.dtype) for name, array in arrays(path).items()}


def _in_words(shape: tuple[int, ...], kind: Any) -> str:
    size = " × ".join(map(str, shape))
    return f"photon times of {size} pixels" if str(kind) == "object" else f"{size} {kind}"


def _listed_mat(path: Path) -> dict[str, str]:
    words: dict[str, str] = {}
    for head in mat5.variables(path):
        if head.kind == "cell" and math.prod(head.shape) <= _MOST_LISTED:
            inside = _mat(path, [head.name])
            words |= {name: _in_words(array.shape, _kind(array)) for name, array in inside.items()}
            if not inside:
                words[head.name] = f"cells {_in_words(head.shape, '')}".strip()
        elif head.kind == "cell":
            words[head.name] = f"{_in_words(head.shape, 'cells')}: arrays of photon times, or of one array each"
        elif head.kind in ("numbers", "sparse"):
            words[head.name] = _in_words(head.shape, head.kind)
    return words


def _kind(array: Any) -> Any:
    return f"sparse {array.dtype}" if is_sparse(array) else array.dtype


def _listed_hdf5(path: Path, of_matlab: bool) -> dict[str, str]:
    import h5py

    words: dict[str, str] = {}
    with open_hdf5(path) as file:

        def visit(name: str, item: Any) -> None:
            if name.partition("/")[0] == CELLS or any(name.startswith(f"{each}/") for each in words):
                return
            if isinstance(item, h5py.Group) and "MATLAB_sparse" in item.attrs:
                words[name] = _in_words((int(item.attrs["MATLAB_sparse"]), item["jc"].size - 1), "sparse")
            elif isinstance(item, h5py.Dataset) and item.dtype == h5py.ref_dtype:
                shape = tuple(item.shape[::-1])
                cells = enumerate((item.file[each] for each in np.ravel(files.whole(item)[:_MOST_LISTED])), start=1)
                deep = {
                    f"{name}[{k}]": _in_words(tuple(part.shape[::-1]), part.dtype)
                    for k, part in cells
                    if isinstance(part, h5py.Dataset) and min(part.shape, default=0) > 1
                }
                words.update(deep or {name: _in_words(shape, "cells: arrays of photon times, or of one array each")})
            elif isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf" and item.ndim:
                words[name] = _in_words(tuple(item.shape[::-1] if of_matlab else item.shape), item.dtype)

        file.visititems(visit)
    return words


def _chosen(path: Path, by_name: dict[str, Any], variable: str | None) -> tuple[str, Any]:
    names = ", ".join(f"{name} {tuple(array.shape)}" for name, array in by_name.items())
    if variable is not None:
        if variable not in by_name:
            raise ValueError(f"{path}: variable must be one of {names or 'none'}, got {variable!r}")
        return variable, by_name[variable]
    for least in (3, 2, 1):  # an image before a list of pixels before a vector
        deep = [name for name, array in by_name.items() if len(array.shape) >= least and np.prod(array.shape) > 1]
        if len(deep) == 1:
            return deep[0], by_name[deep[0]]
        if deep:
            raise ValueError(f"{path} holds several arrays, give variable: {names}")
    raise ValueError(f"{path} holds no array of counts" + (f", only {names}" if names else ""))


def _guessed(path: Path, shape: tuple[int, ...], bins: int | None) -> str:
    kind = path.suffix.lower()
    if kind in (".tif", ".tiff"):
        return "tyx"
    pixels = "(xy)" if kind == ".mat" else "(yx)"
    image = {1: [], 2: [pixels], 3: ["y", "x"], 4: ["n", "y", "x"]}.get(len(shape))
    if image is None:
        raise ValueError(f"{path}: an array of shape {shape} is not a cube of histograms")
    fitting = [k for k, size in enumerate(shape) if size == bins]
    outer = [k for k in fitting if k != len(shape) - 2 or len(shape) == 2]  # time lies before the image or behind it
    readings = ["".join([*image[:k], "t", *image[k:]]) for k in outer or fitting or [len(shape) - 1]]
    if len(readings) > 1:
        raise ValueError(
            f"{path}: an array of shape {shape} has {len(readings)} dimensions of {bins} bins: give axes (--axes), "
            f"{' or '.join(map(repr, readings))}"
        )
    axes = readings[0]
    if not fitting and axes == "yxt" and _uneven(*shape[:2]) > 2.0 * _uneven(*shape[1:]):
        height, width, length = shape
        warnings.warn(
            f"{path}: an array of shape {shape} was taken for {height} x {width} pixels of {length} bins; where time "
            f"is its first dimension, axes (--axes) is 'tyx'",
            stacklevel=2,
        )
    return axes


def _uneven(height: int, width: int) -> float:
    """Aspect ratio of an image, at least 1."""
    return max(height, width) / max(min(height, width), 1)


def _npz(path: Path) -> dict[str, Any]:
    with files.open_npz(path) as archive:
        if {"format", "shape", "data"} <= set(archive.files):
            from scipy import sparse

            matrix = sparse.load_npz(path)
            check_stored(archive)
            check_sparse("", matrix)
            return {"": matrix}
        return {name: archive[name] for name in archive.files if archive[name].dtype.kind in "iuf"}


def _mat(path: Path, names: list[str] | None = None) -> dict[str, Any]:
    variables = mat_arrays(path, names)
    arrays: dict[str, Any] = {}
    for name, array in variables.items():
        if is_sparse(array):
            arrays[name] = array
        elif isinstance(array, np.ndarray) and array.dtype.kind in "iuf":
            arrays[name] = np.squeeze(array)
    times = {name: cells for name, cells in cells_of(variables).items() if cells.size > 1}
    return arrays | times | {name: array for name, array in cell_arrays(variables).items() if len(array.shape) > 1}


def _tiff(path: Path) -> dict[str, Any]:
    from PIL import Image, ImageSequence

    with Image.open(path) as image:
        pixel = np.array(Image.new(image.mode, (1, 1))).nbytes
        claimed = sum(pixel * math.prod(page.size) for page in ImageSequence.Iterator(image))
        files.check_claim(path, claimed, "its pages")
        return {"": np.stack([decoded(page) for page in ImageSequence.Iterator(image)])}


def _table(path: Path) -> dict[str, Any]:
    return {"": files.read_column(path)}


_READERS = {
    ".npy": lambda path: {"": files.read_npy(path)},
    ".npz": _npz,
    ".mat": _mat,
    ".h5": hdf5_arrays,
    ".hdf5": hdf5_arrays,
    ".tif": _tiff,
    ".tiff": _tiff,
    ".csv": _table,
    ".txt": _table,
}
