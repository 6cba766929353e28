"""Transients on disk, optionally with depth and reflectivity: NumPy, HDF5, MATLAB, captures of tal and mitransient."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base.arguments import checked
from mars_lidar._base.files import NpyFile, UnchangedFile, check_data, reading
from mars_lidar._base.hdf5 import open_hdf5
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.io.capture import CAPTURE_SUFFIXES, Capture, capture_in
from mars_lidar.io.named_arrays import NamedArrays, open_arrays
from mars_lidar.io.store import OnDisk, values
from mars_lidar.light.transient import Rows
from mars_lidar.light.transient import Transient as Transient

SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".mat")
_NAME = "transient"
_TIMES: tuple[str, ...] = ("bin_ns", "start_ns")
_TRUTH = ("depth", "reflectivity")
_CONFOCAL = ("rect_data", "meas")  # of a .mat, in place of "transient": O'Toole 2018; Lindell 2019


@checked
def read_transient(
    path: str | Path,
    *,
    bin_ns: float | None = None,
    start_ns: float | None = None,
    name: str | None = None,
    channel: int | None = None,
) -> Transient:
    """Open a transient image; its values stay on disk (.npy, .h5) until rows of them are needed.

    - ``.npy``: (H, W, T), or (H, W, T, C) with `channel`, as mitransient's ``numpy.save`` of its result gives.
    - ``.npz``: the array `name` (default ``transient``, or the only one); ``bin_ns``, ``start_ns`` if present.
    - ``.h5``, ``.hdf5``: the data set `name` (default ``transient``), with attributes ``bin_ns`` and
      ``start_ns`` if present.
    - ``.mat``: the variable `name` (default ``transient``, or ``rect_data`` or ``meas`` of confocal scans), (H, W, T),
      with ``bin_ns`` and ``start_ns`` if present. Version 7.3 stays on disk, older versions are read as a whole.
    - ``.h5``, ``.hdf5`` with ``H`` and ``H_format``, captures of tal and mitransient, or with ``data`` and ``deltaT``,
      of the Zaragoza data set, whose colours and bounces are added up (`mars_lidar.io.capture`). Times are metres of
      optical path (time = path / c). In confocal and single captures pixel (y, x) is that of the sensor grid; in
      exhaustive captures each laser point is a row of the image and each sensor point a column. Times are used as
      stored; ``t_accounts_first_and_last_bounces`` states whether they include the paths from laser and to camera.

    Parameters
    ----------
    path
        The file.
    bin_ns, start_ns
        Width of a bin and travel time at the start of bin 0, ns, in place of those of the file. A ``.npy`` contains
        neither: `bin_ns` is required, the default of `start_ns` is 0.
    name
        Name of the array in an ``.npz``, ``.h5`` or ``.mat``.
    channel
        Index of a channel of a 4-D array (colours of a renderer).

    Raises
    ------
    ValueError
        A file that is missing, damaged, of another kind, or without a bin width: the message starts
        with the file.
    TypeError
        An argument of another kind.

    See Also
    --------
    Transient, mars_lidar.Flux.from_transient

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import numpy as np
    >>> from mars_lidar import io
    >>> np.save(folder / "render.npy", np.ones((4, 6, 50)))
    >>> io.read_transient(folder / "render.npy", bin_ns=0.1).bin_ns
    0.1
    """
    source = Path(path)
    if not source.is_file():
        raise ValueError(f"{source}: no such file")
    with reading(source, "a transient"):
        return _read(source, bin_ns, start_ns, name, channel)


def _read(
    source: Path, bin_ns: float | None, start_ns: float | None, name: str | None, channel: int | None
) -> Transient:
    stated: dict[str, float] = {}
    suffix = source.suffix.lower()
    if suffix == ".npy":
        if name is not None:
            raise ValueError(f"{source}: a .npy has one array without a name, got name {name!r}")
        light: Any = NpyFile(source)
    elif suffix in CAPTURE_SUFFIXES and name is None and (capture := _capture(source)) is not None:
        light = Rows(capture.image, capture.read)
        times = {"bin_ns": capture.bin_ns, "start_ns": capture.start_ns}
        stated = {key: value for key, value in times.items() if value is not None}
    elif suffix in SUFFIXES:
        light, stated = _named(source, name)
    else:
        raise ValueError(f"{source}: a transient must be one of {', '.join(SUFFIXES)}")
    width = stated.get("bin_ns") if bin_ns is None else bin_ns
    if width is None:
        raise ValueError(f"{source}: does not state the width of a time bin: give bin_ns")
    start = stated.get("start_ns", 0.0) if start_ns is None else start_ns
    if len(light.shape) == 4:
        if channel is None or not 0 <= channel < light.shape[3]:
            raise ValueError(f"{source}: has {light.shape[3]} channels: give channel from 0, got {channel!r}")
        every, place = light, channel
        light = Rows(tuple(every.shape[:3]), lambda rows: np.asarray(every[rows])[..., place])
    elif channel is not None:
        raise ValueError(f"{source}: channel is for (H, W, T, C) arrays, got shape {tuple(light.shape)}")
    return Transient(light, width, start_ns=start, source=str(source))


def _named(path: Path, name: str | None) -> tuple[Any, dict[str, float]]:
    """An array of a file, of HDF5 with its rows on disk, and the times that stand beside it."""
    opened = UnchangedFile(path)
    with open_arrays(path) as file:
        name = name or next((each for each in (_NAME, *_CONFOCAL) if each in file.names), _only(file))
        if name not in file.names:
            raise ValueError(f"{path}: cannot be read (no array {name!r}, got {', '.join(file.names) or 'nothing'})")
        arrays = file.read((name, *_TIMES))
        stored = arrays.pop(name)
        stated = {key: float(np.ravel(values(each))[0]) for key, each in arrays.items()}
        if not isinstance(stored, OnDisk):
            return stored, stated
        check_data(path, stored, name, in_parts=True)
        stated |= {key: float(stored.attrs[key]) for key in _TIMES if key in stored.attrs}

    def read(rows: slice) -> NDArray[Any]:  # the file is open only here
        with opened.unchanged(), open_hdf5(path) as again:
            data = again[name]
            return np.asarray(data[..., rows]).T if file.turned else np.asarray(data[rows])

    return Rows(tuple(stored.shape[::-1] if file.turned else stored.shape), read), stated


def _only(file: NamedArrays) -> str:
    """The array that a file has beside times and truth, if it is one alone, else the usual name."""
    names = [name for name in file.names if name not in (*_TIMES, *_TRUTH, "attributes")]
    return names[0] if len(names) == 1 else _NAME


def _capture(path: Path) -> Capture | None:
    opened = UnchangedFile(path)
    with open_hdf5(path) as file:
        return capture_in(opened, file)


def read_truth(path: str | Path, shape: tuple[int, int]) -> dict[str, FloatArray]:
    """Depth and reflectivity stored with a transient of `shape` (H, W), float64, if present.

    Arrays ``depth`` (m; 0, NaN and inf mean "no return", which becomes NaN) and ``reflectivity`` ([0, 1]), (H, W), of
    ``.npz``, ``.h5``, ``.hdf5`` and ``.mat`` (turned, as the transient is). A ValueError begins with the file.
    """
    with reading(path, "a transient with depth and reflectivity") as source:
        truth: dict[str, FloatArray] = {}
        for name, stored in _truth(source).items():
            if stored.shape != shape or stored.dtype.kind not in "fiu":
                raise ValueError(f"{source}: {name} must be real numbers {shape}, got {stored.dtype} {stored.shape}")
            truth[name] = stored.astype(np.float64)
        if "depth" in truth:
            depth = truth["depth"]
            if (depth < 0.0).any():
                raise ValueError(f"{source}: depth must not be negative, got {np.nanmin(depth):g} m")
            truth["depth"] = np.where((depth > 0.0) & (depth < np.inf), depth, np.nan)
        if "reflectivity" in truth and not ((truth["reflectivity"] >= 0.0) & (truth["reflectivity"] <= 1.0)).all():
            raise ValueError(f"{source}: reflectivity must lie in [0, 1]")
        return truth


def _truth(path: Path) -> dict[str, NDArray[Any]]:
    if path.suffix.lower() == ".npy":
        return {}
    with open_arrays(path) as file:
        arrays = {name: values(array) for name, array in file.read(_TRUTH).items()}
        return {name: array.T if file.turned else array for name, array in arrays.items()}
