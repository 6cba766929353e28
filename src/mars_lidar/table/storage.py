"""Tables in HDF5 files, and those in the user's cache, under the hash of their request."""

import hashlib
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.files import beside, check_target, whole
from mars_lidar._base.hdf5 import ForgivingFile, open_hdf5, seal
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar._version import __version__
from mars_lidar.instrument.system import System

FORMAT = 2
KEY_LENGTH = 24
_KIND = "mars-lidar table"
_SUFFIXES = (".h5", ".hdf5")


def request_key(
    system: System,
    axes: tuple[FloatArray, FloatArray],
    *,
    method: str,
    rearm: str,
    tolerance: float,
) -> str:
    """Hash of all settings of a table except its cycles, on which many tables do not depend."""
    instrument = system.to_dict()
    del instrument["cycles"]
    request = {
        "format": FORMAT,
        "version": __version__,
        "system": instrument,
        "axes": [[value.hex() for value in axis.tolist()] for axis in axes],
        "method": method,
        "rearm": rearm,
        "tolerance": tolerance,
    }
    text = json.dumps(request, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def write(path: Path, header: dict[str, Any], arrays: dict[str, NDArray[Any]], overwrite: bool) -> None:
    """Write attributes and arrays to a new HDF5 file, renamed to its final name when complete."""
    checks.suffix("path", path, _SUFFIXES)
    check_target(path, folder=False, overwrite=overwrite)
    with beside(path) as unfinished, ForgivingFile(unfinished).hdf5() as file:
        for name, value in ({"kind": _KIND, "format": FORMAT} | header).items():
            file.attrs[name] = value
        for name, array in arrays.items():
            file.create_dataset(name, data=array)
        seal(file)


def read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Attributes and read-only arrays."""
    if path.is_dir():
        raise ValueError(f"{path} is not a table of mars-lidar")
    with open_hdf5(path) as file:
        header = dict(file.attrs.items())
        if header.get("kind") != _KIND:
            raise ValueError(f"{path} is not a table of mars-lidar")
        if int(header["format"]) != FORMAT:
            raise ValueError(f"{path} is a table of format {header['format']}; this version reads format {FORMAT}")
        arrays = {name: _own(whole(data)) for name, data in file.items()}
    return header, arrays


def _own(array: Any) -> NDArray[Any]:
    values = np.ascontiguousarray(array)
    values.flags.writeable = False
    return values


def compare(path: Path, made_for: System, system: System) -> None:
    """Raise ValueError for a different system, naming the field that differs."""
    theirs, ours = made_for.to_dict(), system.to_dict()
    for name in ours:
        if name == "cycles" or theirs[name] == ours[name]:
            continue
        inner = [k for k in ours[name] if theirs[name].get(k) != ours[name][k]] if isinstance(ours[name], dict) else []
        at, there, here = name, theirs[name], ours[name]
        if inner and inner[0] in there:
            at, there, here = f"{name}.{inner[0]}", there[inner[0]], here[inner[0]]
        raise ValueError(f"{path} is a table of another system: {at} is {_short(there)} there and {_short(here)} here")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# --- The cache -------------------------------------------------------------------------------------------------------


def cache_folder() -> Path:
    """Folder of the cached tables, which may not exist yet.

    ``MARS_LIDAR_CACHE``, or ``mars-lidar`` in ``XDG_CACHE_HOME``, or in ``~/.cache``.
    """
    given = os.environ.get("MARS_LIDAR_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    root = Path(base) if base and Path(base).is_absolute() else Path.home() / ".cache"
    return root / "mars-lidar"


def cached_candidates(key: str, cycles: int) -> tuple[Path, list[Path]]:
    """File of a request for `cycles`, and the existing files of the same request for other numbers of cycles."""
    folder = cache_folder()
    own = folder / f"{key}-{cycles}.h5"
    others = sorted(folder.glob(f"{key}-*.h5")) if folder.is_dir() else []
    return own, [other for other in others if other != own]


def put_into_cache(save: Callable[..., None], own: Path) -> None:
    """Put a table into the cache by its method `save`."""
    own.parent.mkdir(parents=True, exist_ok=True)
    partial = own.with_name(f"{own.stem}-{os.getpid()}.h5")  # several processes may build the same table at once
    save(partial, overwrite=True)
    os.replace(partial, own)


def cached_tables() -> list[Path]:
    """Tables in the cache, and unfinished files there."""
    ours = re.compile(rf"[0-9a-f]{{{KEY_LENGTH}}}-.*\.h5")
    folder = cache_folder()
    return sorted(p for p in folder.iterdir() if p.is_file() and ours.match(p.name)) if folder.is_dir() else []
