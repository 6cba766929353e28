"""Tables in HDF5 files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import beside, check_target, whole
from mars_lidar._base.hdf5 import ForgivingFile, open_hdf5, seal
from mars_lidar._base.types import FloatArray
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
    refine: float | None,
    tolerance: float,
) -> str:
    """Hash of all that decides a table but its cycles, which many tables do not depend on."""
    instrument = system.to_dict()
    del instrument["cycles"]
    request = {
        "format": FORMAT,
        "version": __version__,
        "system": instrument,
        "axes": [[value.hex() for value in axis.tolist()] for axis in axes],
        "method": method,
        "rearm": rearm,
        "refine": refine,
        "tolerance": tolerance,
    }
    text = json.dumps(request, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def write(path: Path, header: dict[str, Any], arrays: dict[str, NDArray[Any]], overwrite: bool) -> None:
    """Write attributes and arrays to a new HDF5 file, which appears under its name when it is complete."""
    if path.suffix not in _SUFFIXES:
        raise ValueError(f"path must end in .h5 or .hdf5, got {str(path)!r}")
    check_target(path, folder=False, overwrite=overwrite)
    with beside(path) as unfinished, ForgivingFile(unfinished).hdf5() as file:
        for name, value in ({"kind": _KIND, "format": FORMAT} | header).items():
            file.attrs[name] = value
        for name, array in arrays.items():
            file.create_dataset(name, data=array)
        seal(file)


def read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Attributes and arrays, which nobody can write to."""
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
    """Refuse another system, naming the field that differs."""
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
