"""Transients on disk: .npy and .npz, HDF5, and the HDF5 captures of tal and mitransient."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.files import check_data, open_npz, read_mat5, read_npy, reading, whole
from mars_lidar._base.hdf5 import open_hdf5
from mars_lidar.io.capture import capture_in
from mars_lidar.light.rate_parts import Rows
from mars_lidar.light.transient import Transient

SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".mat")
_NAME = "transient"
_TIMES: tuple[str, ...] = ("bin_ns", "start_ns")
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
    - ``.npz``: the array `name` (default ``transient``); ``bin_ns`` and ``start_ns`` where it holds them.
    - ``.h5``, ``.hdf5``: the data set `name` (default ``transient``), with attributes ``bin_ns`` and
      ``start_ns`` where it has them.
    - ``.mat``: the variable `name` (default ``transient``, or ``rect_data`` or ``meas`` of confocal scans), (H, W, T),
      with ``bin_ns`` and ``start_ns`` where it holds them. Version 7.3 stays on disk, older ones are read whole.
    - ``.h5``, ``.hdf5`` with ``H`` and ``H_format``, captures of tal and mitransient, or with ``data`` and ``deltaT``,
      of the Zaragoza data set, whose colours and bounces are added up (`mars_lidar.io.capture`). Times are metres of
      optical path (time = path / c). Pixel (y, x) is that of the sensor's grid, of a confocal or single capture; of an
      exhaustive one each laser point is a row of the image and each sensor point a column. Whether the ways from the
      laser and to the camera are in it, ``t_accounts_first_and_last_bounces`` tells; the times are taken as they are.

    Parameters
    ----------
    path
        The file.
    bin_ns, start_ns
        Width of a bin and travel time at the start of bin 0, ns; where given they take the place of the
        file's. A ``.npy`` tells neither: `bin_ns` is needed, `start_ns` is 0.
    name
        Which array of an ``.npz``, ``.h5`` or ``.mat``.
    channel
        Which of the C channels of a 4-D array (colours of a renderer).

    Raises
    ------
    ValueError
        A file that is missing, damaged or of the wrong kind, or does not tell its bin width: the message starts
        with the file.
    """
    source = Path(path)
    if not source.is_file():
        raise ValueError(f"{source}: no such file")
    with reading(source, "a transient"):
        return _read(source, bin_ns, start_ns, name, channel)


def _read(
    source: Path, bin_ns: float | None, start_ns: float | None, name: str | None, channel: int | None
) -> Transient:
    told: dict[str, float] = {}
    suffix = source.suffix.lower()
    if suffix == ".npy":
        if name is not None:
            raise ValueError(f"{source}: a .npy has one array without a name, got name {name!r}")
        values: Any = read_npy(source)
    elif suffix == ".npz":
        values, told = _from_npz(source, name or _NAME)
    elif suffix in (".h5", ".hdf5"):
        values, told = _from_hdf5(source, name)
    elif suffix == ".mat":
        values, told = _from_mat(source, name)
    else:
        raise ValueError(f"{source}: a transient must be one of {', '.join(SUFFIXES)}")
    width = told.get("bin_ns") if bin_ns is None else bin_ns
    if width is None:
        raise ValueError(f"{source}: does not tell the width of a time bin: give bin_ns")
    start = told.get("start_ns", 0.0) if start_ns is None else start_ns
    if len(values.shape) == 4:
        if channel is None or not 0 <= channel < values.shape[3]:
            raise ValueError(f"{source}: has {values.shape[3]} channels: give channel from 0, got {channel!r}")
        every, place = values, channel
        values = Rows(tuple(every.shape[:3]), lambda rows: np.asarray(every[rows])[..., place])
    elif channel is not None:
        raise ValueError(f"{source}: channel is for (H, W, T, C) arrays, got shape {tuple(values.shape)}")
    return Transient(values, width, start_ns=start, source=str(source))


def _from_npz(path: Path, name: str) -> tuple[NDArray[Any], dict[str, float]]:
    with open_npz(path) as archive:
        if name not in archive.files:
            raise ValueError(f"{path}: cannot be read (no array {name!r}, got {', '.join(archive.files) or 'none'})")
        told = {key: float(archive[key]) for key in _TIMES if key in archive.files}
        return archive[name], told


def _from_hdf5(path: Path, name: str | None) -> tuple[Any, dict[str, float]]:
    import h5py

    with open_hdf5(path) as file:
        capture = capture_in(path, file) if name is None else None
        if capture is not None:
            times = {"bin_ns": capture.bin_ns, "start_ns": capture.start_ns}
            return Rows(capture.image, capture.read), {key: value for key, value in times.items() if value is not None}
        wanted = name or _NAME
        if not isinstance(file.get(wanted), h5py.Dataset):
            names = ", ".join(file) or "nothing"
            raise ValueError(
                f"{path}: no data set {wanted!r} and no capture ('H' and 'H_format', 'data' and 'deltaT'), got {names}"
            )
        data = file[wanted]
        check_data(path, data, wanted, in_parts=True)
        told = {key: float(data.attrs[key]) for key in _TIMES if key in data.attrs}
        return _rows(path, wanted, tuple(data.shape), turned=False), told


def _from_mat(path: Path, name: str | None) -> tuple[Any, dict[str, float]]:
    import h5py
    from scipy.io import whosmat

    turned = h5py.is_hdf5(path)  # version 7.3; MATLAB's first axis comes last
    if turned:
        with open_hdf5(path) as file:
            there = list(file)
    else:
        there = [each for each, _, _ in whosmat(path)]
    name = name or next((one for one in (_NAME, *_CONFOCAL) if one in there), _NAME)
    if name not in there:
        raise ValueError(f"{path}: cannot be read (no variable {name!r}, got {', '.join(there) or 'nothing'})")
    if not turned:
        found = read_mat5(path, (name, *_TIMES))
        return found[name], {key: float(np.ravel(found[key])[0]) for key in _TIMES if key in found}
    with open_hdf5(path) as file:
        data = file[name]
        if not isinstance(data, h5py.Dataset) or data.ndim != 3:
            raise ValueError(f"{path}: no variable {name!r} of three axes, got {', '.join(there)}")
        check_data(path, data, name, in_parts=True)
        told = {key: float(np.ravel(whole(file[key]))[0]) for key in _TIMES if key in file}
        return _rows(path, name, data.shape[::-1], turned=True), told


def _rows(path: Path, name: str, shape: tuple[int, ...], *, turned: bool) -> Rows:
    """A data set (H, W, T), or one (T, W, H) where it is turned; the file is open only while rows are read."""

    def read(rows: slice) -> NDArray[Any]:
        with open_hdf5(path) as file:
            data = file[name]
            return np.asarray(data[:, :, rows]).transpose(2, 1, 0) if turned else np.asarray(data[rows])

    return Rows(shape, read)
