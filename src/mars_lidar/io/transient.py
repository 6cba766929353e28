"""Transients on disk: .npy and .npz, HDF5, and the HDF5 captures of tal and mitransient."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.memory import check_memory
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS
from mars_lidar.light.transient import Transient

SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".mat")
_NAME = "transient"
_T_SX_SY = 1  # tal.enums.HFormat (github.com/diegoroyo/tal)
_TAL_FORMATS = {0: "UNKNOWN", 1: "T_Sx_Sy", 2: "T_Lx_Ly_Sx_Sy", 3: "T_Si", 4: "T_Li_Si"}


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
    - ``.mat``: the variable `name` (default ``transient``), (H, W, T), with ``bin_ns`` and ``start_ns`` where it holds
      them. Version 7.3 stays on disk, older ones are read whole.
    - ``.h5``, ``.hdf5`` with a data set ``H``: a capture of tal: ``H_format`` T_Sx_Sy, so ``H`` is (T, x, y);
      ``delta_t`` and ``t_start`` are metres of optical path (time = path / c). Pixel (y, x) is H[:, x, y].
      Whether the ways from the laser and to the camera are in it, ``t_accounts_first_and_last_bounces`` tells;
      the times are taken as they are.

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
    told: dict[str, float] = {}
    suffix = source.suffix.lower()
    if suffix == ".npy":
        if name is not None:
            raise ValueError(f"{source}: a .npy has one array without a name, got name {name!r}")
        values: Any = _mapped(source)
    elif suffix == ".npz":
        values, told = _from_npz(source, name or _NAME)
    elif suffix in (".h5", ".hdf5"):
        values, told = _from_hdf5(source, name)
    elif suffix == ".mat":
        values, told = _from_mat(source, name or _NAME)
    else:
        raise ValueError(f"{source}: a transient must be one of {', '.join(SUFFIXES)}")
    width = told.get("bin_ns") if bin_ns is None else bin_ns
    if width is None:
        raise ValueError(f"{source}: does not tell the width of a time bin: give bin_ns")
    start = told.get("start_ns", 0.0) if start_ns is None else start_ns
    if len(values.shape) == 4:
        if channel is None or not 0 <= channel < values.shape[3]:
            raise ValueError(f"{source}: has {values.shape[3]} channels: give channel from 0, got {channel!r}")
        values = _Channel(values, channel)
    elif channel is not None:
        raise ValueError(f"{source}: channel is for (H, W, T, C) arrays, got shape {tuple(values.shape)}")
    try:
        return Transient(values, width, start_ns=start, source=str(source))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{source}: {error}") from error


def _mapped(path: Path) -> NDArray[Any]:
    try:
        return np.asanyarray(np.load(path, mmap_mode="r", allow_pickle=False))
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error


def _from_npz(path: Path, name: str) -> tuple[NDArray[Any], dict[str, float]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if name not in archive.files:
                raise ValueError(f"no array {name!r}, got {', '.join(archive.files) or 'none'}")
            check_memory(_stored_bytes(path, name), f"the values of {path}", "a .npy or .h5 is read in parts")
            told = {key: float(archive[key]) for key in ("bin_ns", "start_ns") if key in archive.files}
            return archive[name], told
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error


def _stored_bytes(path: Path, name: str) -> int:
    with zipfile.ZipFile(path) as archive:
        return archive.getinfo(f"{name}.npy").file_size


def _from_hdf5(path: Path, name: str | None) -> tuple[Any, dict[str, float]]:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            if name is None and "H" in file and "H_format" in file:
                return _tal(path, file)
            wanted = name or _NAME
            if not isinstance(file.get(wanted), h5py.Dataset):
                names = ", ".join(file) or "nothing"
                raise ValueError(f"no data set {wanted!r} and no capture of tal ('H', 'H_format'), got {names}")
            data = file[wanted]
            told = {key: float(data.attrs[key]) for key in ("bin_ns", "start_ns") if key in data.attrs}
            return _Rows(path, wanted, tuple(data.shape), turned=False), told
    except (ValueError, TypeError, OSError, KeyError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error


def _from_mat(path: Path, name: str) -> tuple[Any, dict[str, float]]:
    import h5py

    try:
        if h5py.is_hdf5(path):  # version 7.3; MATLAB's first axis comes last
            with h5py.File(path, "r") as file:
                if not isinstance(file.get(name), h5py.Dataset) or file[name].ndim != 3:
                    raise ValueError(f"no variable {name!r} of three axes, got {', '.join(file) or 'nothing'}")
                told = {key: float(np.ravel(file[key])[0]) for key in ("bin_ns", "start_ns") if key in file}
                bins, width, height = file[name].shape
                return _Rows(path, name, (height, width, bins), turned=True), told
        from scipy.io import loadmat, whosmat

        listed = {key: shape for key, shape, _ in whosmat(path)}
        if name not in listed:
            raise ValueError(f"no variable {name!r}, got {', '.join(listed) or 'nothing'}")
        check_memory(8 * int(np.prod(listed[name])), f"the values of {path}", "a .mat of version 7.3 is read in parts")
        wanted = [key for key in (name, "bin_ns", "start_ns") if key in listed]
        found = loadmat(path, variable_names=wanted)
    except (ValueError, TypeError, OSError, KeyError, NotImplementedError, IndexError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
    return found[name], {key: float(np.ravel(found[key])[0]) for key in wanted[1:]}


def _tal(path: Path, file: Any) -> tuple[Any, dict[str, float]]:
    form = int(np.ravel(file["H_format"][()])[0])
    shape = file["H"].shape
    if form != _T_SX_SY or len(shape) != 3:
        known = _TAL_FORMATS.get(form, str(form))
        raise ValueError(f"H must be T_Sx_Sy, an image of (T, x, y), got H_format {known} and shape {shape}")
    told = {}
    for key, label in (("delta_t", "bin_ns"), ("t_start", "start_ns")):
        if key in file and file[key].shape is not None:  # tal stores None as an empty data set
            told[label] = float(np.ravel(file[key][()])[0]) / SPEED_OF_LIGHT_M_PER_NS
    return _Rows(path, "H", (shape[2], shape[1], shape[0]), turned=True), told


class _Rows:
    """Rows of a data set (H, W, T), or of one (T, W, H) where it is turned; the file is open only while read."""

    def __init__(self, path: Path, name: str, shape: tuple[int, ...], *, turned: bool) -> None:
        self._path, self._name, self._turned = path, name, turned
        self.shape = shape

    def __getitem__(self, key: Any) -> NDArray[Any]:
        import h5py

        try:
            with h5py.File(self._path, "r") as file:
                if self._turned:
                    return np.asarray(file[self._name][:, :, key]).transpose(2, 1, 0)
                return np.asarray(file[self._name][key])
        except OSError as error:
            raise ValueError(f"{self._path}: cannot be read ({error})") from error


class _Channel:
    """One channel of (H, W, T, C)."""

    def __init__(self, values: Any, channel: int) -> None:
        self._values, self._channel = values, channel
        self.shape = tuple(values.shape[:3])

    def __getitem__(self, key: Any) -> NDArray[Any]:
        return np.asarray(self._values[key])[..., self._channel]
