"""Tables in HDF5 files: contiguous and uncompressed, so that the shapes can be mapped into memory."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.files import beside, check_target, reading, whole
from mars_lidar._base.hdf5 import ForgivingFile, open_hdf5, seal
from mars_lidar._base.types import FloatArray
from mars_lidar._version import __version__
from mars_lidar.instrument.system import System
from mars_lidar.table.entries import Entries
from mars_lidar.table.node_laws import NodeLaws
from mars_lidar.table.nodes import N, Nodes
from mars_lidar.table.start_phase import StartPhases

FORMAT = 2
KEY_LENGTH = 24
_KIND = "mars-lidar table"
_SUFFIXES = (".h5", ".hdf5")
_MAPPED = ("shape", "startup")
_READABLE = (1, FORMAT)  # the first kept no laws of entries


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


class Stored(Nodes):
    """Nodes in files."""

    @checked
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write to an HDF5 file (.h5, .hdf5), which appears under its name when it is complete."""
        path = Path(path)
        if path.suffix not in _SUFFIXES:
            raise ValueError(f"path must end in .h5 or .hdf5, got {str(path)!r}")
        check_target(path, folder=False, overwrite=overwrite)
        with beside(path) as unfinished, ForgivingFile(unfinished).hdf5() as file:
            for name, value in _header(self).items():
                file.attrs[name] = value
            for name, array in _arrays(self).items():
                file.create_dataset(name, data=array)
            seal(file)

    @classmethod
    @checked
    def load(cls, path: str | Path, system: System | None = None) -> Self:
        """The table of a file, for `system` (None: for the one it was made for); shapes stay in the file, mapped.

        Raises
        ------
        ValueError
            Where the table is of another system, naming the field that differs. Another number of cycles is no
            difference where every entry holds for it.
        """
        if system is not None and not isinstance(system, System):
            raise TypeError(f"system must be a System, got {type(system).__name__}")
        with reading(path, "a table of mars-lidar") as source:
            return _loaded(cls, source, system)


def _loaded(make: type[N], path: Path, system: System | None) -> N:
    header, arrays = _read(path)
    made_for = System.from_json(header["system"])
    system = made_for if system is None else system.detected()
    _compare(path, made_for, system)
    own = {each.name: arrays[each.name] for each in fields(Entries) if each.name not in ("cycles", "startup")}
    entries = Entries(cycles=made_for.cycles, **own, startup=arrays.get("startup"))
    phases = StartPhases(**{each.name: arrays["phase_" + each.name] for each in fields(StartPhases)})
    laws = NodeLaws(**{each.name: arrays["law_" + each.name] for each in fields(NodeLaws)})
    table = make(
        system,
        header["method"],
        arrays["signal"],
        arrays["background"],
        header["rearm"],
        float(header["tolerance"]),
        json.loads(header["provenance"]),
        entries,
        phases,
        laws,
    )
    if not table.serves(system.cycles):
        raise ValueError(
            f"{path} is a table of another system: cycles is {made_for.cycles} there and {system.cycles} here, "
            "and not every entry holds for other cycles"
        )
    return table


def _header(table: Nodes) -> dict[str, Any]:
    made_for = table.system.replace(cycles=table.entries.cycles)
    return {
        "kind": _KIND,
        "format": FORMAT,
        "system": made_for.to_json(),
        "method": table.method,
        "rearm": table.rearm,
        "tolerance": table.tolerance,
        "provenance": json.dumps(table.provenance),
    }


def _arrays(table: Nodes) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {"signal": table.signal, "background": table.background}
    for prefix, part in (("", table.entries), ("phase_", table.start_phases), ("law_", table.laws)):
        arrays |= {prefix + name: each for name, each in vars(part).items() if isinstance(each, np.ndarray)}
    return arrays | {"phase_settled": arrays["phase_settled"].astype(np.uint8)}


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Attributes and arrays; the large ones are mapped, the others read."""
    if path.is_dir():
        raise ValueError(f"{path} is not a table of mars-lidar")
    with open_hdf5(path) as file:
        header = dict(file.attrs.items())
        if header.get("kind") != _KIND:
            raise ValueError(f"{path} is not a table of mars-lidar")
        if int(header["format"]) not in _READABLE:
            raise ValueError(
                f"{path} is a table of format {header['format']}; this version reads "
                f"{' and '.join(map(str, _READABLE))}"
            )
        arrays = {name: _mapped(path, data) if name in _MAPPED else _own(whole(data)) for name, data in file.items()}
    arrays["phase_settled"] = arrays["phase_settled"].astype(bool)
    if "law_row" not in arrays:
        arrays |= {f"law_{name}": each for name, each in vars(NodeLaws.none()).items()}
    return header, arrays


def _own(array: Any) -> NDArray[Any]:
    values = np.ascontiguousarray(array)
    values.flags.writeable = False
    return values


def _mapped(path: Path, data: Any) -> NDArray[Any]:
    offset = data.id.get_offset()
    if offset is None:
        raise ValueError(f"{path} has no contiguous {data.name}: it was not written by mars-lidar")
    return np.memmap(path, dtype=data.dtype, mode="r", offset=offset, shape=data.shape)


def _compare(path: Path, made_for: System, system: System) -> None:
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
