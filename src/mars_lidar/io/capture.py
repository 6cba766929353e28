"""Reading and writing HDF5 captures of non-line-of-sight imaging: tal, mitransient, and the Zaragoza NLOS data set.

tal (github.com/diegoroyo/tal, ``tal/io``): ``H`` with the time first and ``H_format``; ``delta_t``, ``t_start``. The
Zaragoza data set (graphics.unizar.es/nlos_dataset): ``data`` with colours and bounces, ``deltaT``, ``t0``, in the order
of MATLAB or of HDF5, distinguished as in tal. Times are metres of optical path, time = path / c.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.files import UnchangedFile, beside, check_data, check_target, whole
from mars_lidar._base.hdf5 import ForgivingFile, open_hdf5, with_checksums
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS
from mars_lidar.io.cube import Cube

CAPTURE_SUFFIXES = (".h5", ".hdf5")
# What the axes are: T time, x and y of the sensor grid, X and Y of the laser's, i and l without a grid, c colours and
# b bounces, which are added up. tal.enums.HFormat has the numbers.
_TAL = {1: "Txy", 2: "TXYxy", 3: "Ti", 4: "Tli"}
_TAL_NAMES = {0: "UNKNOWN", 1: "T_Sx_Sy", 2: "T_Lx_Ly_Sx_Sy", 3: "T_Si", 4: "T_Li_Si"}
_ZARAGOZA = {5: ("xybTc", "cTbyx"), 7: ("YXyxbTc", "cTbyxYX")}  # as ``tal/io/format.py`` moves them
_TIMES = {"H": ("delta_t", "t_start"), "data": ("deltaT", "t0")}
_BAND_BYTES = 64 * 2**20


@dataclass(frozen=True)
class Capture:
    """Location of the light in a capture, and its axes as an image."""

    file: UnchangedFile
    name: str  # of its data set
    axes: str  # a letter for each
    shape: tuple[int, ...]
    bin_ns: float | None  # width of a time bin; None if not stated in the file
    start_ns: float | None  # travel time at the first one

    @property
    def rows(self) -> str:
        """Axes of the image's rows: the laser points if there are several, else y of the sensor points."""
        several = math.prod(self._size.get(axis, 1) for axis in "XYl") > 1
        return "".join(axis for axis in ("XYl" if several else "y") if axis in self.axes)

    @property
    def columns(self) -> str:
        """Axes of the image's columns."""
        return "".join(axis for axis in "xyi" if axis in self.axes and axis not in self.rows)

    @property
    def image(self) -> tuple[int, int, int]:
        """(H, W, T)."""
        height, width = (math.prod(self._size[axis] for axis in axes) for axes in (self.rows, self.columns))
        return height, width, self._size["T"]

    @property
    def _size(self) -> dict[str, int]:
        return dict(zip(self.axes, self.shape, strict=True))

    def read(self, rows: slice) -> NDArray[Any]:
        """Light of some rows (rows, W, T)."""
        first, last, _ = rows.indices(self.image[0])
        slab, skipped = self._slab(first, last)
        with self.file.unchanged() as path, open_hdf5(path) as file:
            stored = np.asarray(file[self.name][slab])
        order, rest = self._order
        image = stored.transpose(*order, *rest).reshape(
            -1, self.image[1], self.image[2], *(stored.shape[k] for k in rest)
        )
        return np.asarray(image[skipped : skipped + last - first].sum(axis=tuple(range(3, image.ndim))))

    def write(self, data: Any, first: int, counts: NDArray[Any]) -> None:
        """Put whole steps of the first axis of the rows, from row `first` on, into a data set of the same shape."""
        slab, _ = self._slab(first, first + len(counts))
        order, rest = self._order
        place = tuple(0 if k in rest else part for k, part in enumerate(slab))  # the first colour and bounce
        used = [k for k in range(len(self.axes)) if k not in rest]
        sizes = [len(range(*slab[k].indices(self.shape[k]))) for k in order]
        data[place] = counts.reshape(sizes).transpose([order.index(k) for k in used])

    @property
    def _order(self) -> tuple[list[int], list[int]]:
        """Places of the axes of the image, in its order, and of those that are added up."""
        order = [self.axes.index(axis) for axis in self.rows + self.columns + "T"]
        return order, [k for k in range(len(self.axes)) if k not in order]

    def _slab(self, first: int, last: int) -> tuple[tuple[slice, ...], int]:
        """Part of the data set that holds some rows, and how many rows of it come before the first."""
        slab = [slice(None)] * len(self.axes)
        if not self.rows:
            return tuple(slab), first
        low, high = first // self.step, -(-last // self.step)
        slab[self.axes.index(self.rows[0])] = slice(low, high)
        return tuple(slab), first - low * self.step

    @property
    def step(self) -> int:
        """Rows that belong to one step of their first axis."""
        return self.image[0] // self._size[self.rows[0]] if self.rows else self.image[0]

    def bands(self) -> Iterator[slice]:
        """Rows that are written together: whole steps."""
        height, width, bins = self.image
        many = max(1, _BAND_BYTES // (4 * width * bins * self.step)) * self.step
        for first in range(0, height, many):
            yield slice(first, min(first + many, height))


def capture_in(opened: UnchangedFile, file: Any) -> Capture | None:
    """The capture in an open HDF5 file, or None for other files."""
    if "H" in file and "H_format" in file:
        name, axes = "H", _tal_axes(file)
    elif "data" in file and "deltaT" in file:
        name, axes = "data", _zaragoza_axes(file["data"].shape)
    else:
        return None
    data = file[name]
    check_data(opened.path, data, name, in_parts=True)
    if data.dtype.kind not in "fiu":
        raise ValueError(f"{opened.path}: {name} must be real numbers, got {data.dtype}")
    times = [_metres(file, key) for key in _TIMES[name]]
    width, start = (None if time is None else time / SPEED_OF_LIGHT_M_PER_NS for time in times)
    return Capture(opened, name, axes, tuple(data.shape), width, start)


def read_capture(path: str | Path) -> Capture:
    """The capture in a file; ValueError for other files, or if its time bins are not stated."""
    source = Path(path)
    if source.suffix.lower() not in CAPTURE_SUFFIXES:
        raise ValueError(f"{source}: a capture must be one of {', '.join(CAPTURE_SUFFIXES)}")
    opened = UnchangedFile(source)
    with open_hdf5(source, "a capture") as file:
        capture = capture_in(opened, file)
        if capture is None:
            raise ValueError(f"{source}: no capture of tal ('H', 'H_format') or Zaragoza's ('data', 'deltaT')")
    if capture.bin_ns is None or not capture.bin_ns > 0.0:
        raise ValueError(f"{source}: does not state the width of a time bin ({_TIMES[capture.name][0]})")
    return capture


@checked
def save_capture(path: str | Path, cube: Cube, like: str | Path, *, overwrite: bool = False) -> None:
    """Write the counts of a cube as a capture with the layout of another capture.

    Parameters
    ----------
    path
        The new ``.hdf5``.
    cube
        A cube of one exposure with the image size and bin width of `like` and at least as many bins; later bins are
        dropped.
    like
        A capture of tal, mitransient, or the Zaragoza data set: everything but the light is copied from it: grids of
        laser and sensor, ``t_start``, ``scene_info``. The counts are written to the first colour and bounce, and the
        recipe to the attribute ``mars_lidar`` of the file, which other programs ignore.
    overwrite
        Replace an existing file.

    Raises
    ------
    ValueError
        Sizes or bin widths that differ.
    TypeError
        Not a `Cube`, or a path that is neither text nor Path.

    See Also
    --------
    read_transient, mars_lidar.Flux.from_transient
    """
    target, source = Path(path), read_capture(like)
    if target.suffix.lower() not in CAPTURE_SUFFIXES:
        raise ValueError(f"path of a capture must end in one of {', '.join(CAPTURE_SUFFIXES)}, got {str(path)!r}")
    exposures, height, width, bins = cube.shape
    if exposures != 1 or (height, width) != source.image[:2] or bins < source.image[2]:
        size = " x ".join(map(str, source.image))
        raise ValueError(f"cube must be one exposure of {size} (H, W, T) as {like} is, got {cube.shape}")
    if abs(cube.system.bin_ns / float(source.bin_ns or 0.0) - 1.0) > 1e-6:
        raise ValueError(f"cube must have bins of {source.bin_ns:g} ns as {like} has, got {cube.system.bin_ns:g}")
    check_target(target, folder=False, overwrite=overwrite)
    with beside(target) as unfinished, open_hdf5(source.file.path) as old, ForgivingFile(unfinished).hdf5() as new:
        for name in old:
            if name != source.name:
                old.copy(name, new)
        data = new.create_dataset(
            source.name, source.shape, np.float32, fillvalue=0.0, **with_checksums(source.shape, np.float32)
        )
        for rows in source.bands():
            counts = np.asarray(cube.histogram[0, rows])[..., : source.image[2]]
            source.write(data, rows.start, counts.astype(np.float32))
        recipe: dict[str, Any] = {"system": cube.system.to_dict(), "engine": cube.engine, "like": str(like)}
        if not cube.measured:
            recipe["seed"] = cube.seed
        new.attrs["mars_lidar"] = json.dumps(recipe)


def _tal_axes(file: Any) -> str:
    form, shape = int(np.ravel(whole(file["H_format"]))[0]), file["H"].shape
    axes = _TAL.get(form, "")
    if len(axes) != len(shape):
        known = _TAL_NAMES.get(form, str(form))
        raise ValueError(f"H must be one of {', '.join(list(_TAL_NAMES.values())[1:])}, got {known} and shape {shape}")
    return axes


def _zaragoza_axes(shape: tuple[int, ...]) -> str:
    if len(shape) not in _ZARAGOZA:
        raise ValueError(f"data must have 5 axes (confocal) or 7, as Zaragoza's captures have, got shape {shape}")
    return max(_ZARAGOZA[len(shape)], key=lambda axes: shape[axes.index("T")])  # time is the long one


def _metres(file: Any, key: str) -> float | None:
    if key not in file or file[key].shape is None:  # tal stores None as an empty data set
        return None
    return float(np.ravel(whole(file[key]))[0])
