"""Absolute photon times in files without a header: MATLAB ``.mat`` (v5, v7.3), ``.npz`` of other programs, and text.

A vector contains the times of one pixel; a cell array (H, W) those of an image, empty cells and scalars included.
Times count from a laser pulse, in a unit that the caller or the end of a name gives (``_ns``, ``_ps``).
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import open_npz, read_column
from mars_lidar.io.named_arrays import mat_arrays
from mars_lidar.io.streams.photons import NoLaserError, Photons, of_pixels
from mars_lidar.light.timestamps import Timestamps

_BINS = 1024  # of times that are no whole numbers of a unit, where none are asked for
_MOST_BINS = 2**20  # of a period, as `bins` may be at most
_FINEST_NS = 1e-6  # unit that times are counted in that are no whole numbers of one
_PERIODS = ("syncPeriod", "sync_period", "period")  # names under which files give the laser period, in their unit
_SUFFIX_NS = {"_ps": 1e-3, "_ns": 1.0, "_us": 1e3, "_s": 1e9}

_Cells = NDArray[Any]  # (H, W) of arrays of times


def read(
    path: Path, period_ns: float | None, bins: int | None, unit_ns: float | None, variable: str | None
) -> Timestamps:
    """Read a stream; see `Timestamps.load`."""
    variables, name, cells, unit = _times(path, unit_ns, variable)
    if period_ns is None:
        period_ns = _period(variables, unit)
    if period_ns is None:
        raise NoLaserError(f"{path} does not state the laser period: give period_ns")
    raw, pixel, clocked = _flat(path, name, cells)
    # a whole number of units is known to a unit: its middle
    times_ns = (raw + 0.5 * clocked) * unit
    if raw.size > cells.size and times_ns.max() < period_ns:
        raise ValueError(
            f"{path}: all times of {name!r} lie within one laser period of {period_ns:g} ns: these are phases, and "
            "without the period that each photon fell into there are no intervals; give absolute times"
        )
    cycle = np.floor(times_ns / period_ns)
    if bins is None:
        bins = max(1, round(period_ns / unit)) if clocked and period_ns / unit <= _MOST_BINS else _BINS
    place = np.minimum(((times_ns / period_ns - cycle) * bins).astype(np.int64), bins - 1)
    info: dict[str, Any] = {"source": str(path)}
    if clocked:
        info["unit_ns"] = unit
    if disordered := int(((np.diff(raw) < 0) & (np.diff(pixel) == 0)).sum()):
        info["disordered"] = disordered
    return of_pixels(times_ns, cycle, place, pixel, cells.shape, bins, period_ns, info)


def photons(path: Path, unit_ns: float | None, variable: str | None) -> Photons:
    """The absolute times alone, each cell a channel; clock units if they are whole numbers."""
    _, name, cells, unit = _times(path, unit_ns, variable)
    raw, channel, clocked = _flat(path, name, cells)
    tick = unit if clocked else _FINEST_NS
    if raw.size and raw.max() * unit / tick >= 2**62:
        raise ValueError(f"{path}: times of {name!r} span more than {2**62:.2g} units of {tick:g} ns")
    return Photons((raw * (unit / tick)).astype(np.int64), tick, channel, str(path))


def _flat(path: Path, name: str, cells: _Cells) -> tuple[NDArray[np.float64], NDArray[np.int64], bool]:
    """All times, the number of the cell of each, and whether they are whole numbers."""
    raw = np.concatenate([np.empty(0), *(np.asarray(cell, np.float64).ravel() for cell in cells.ravel())])
    bad = ~(np.isfinite(raw) & (raw >= 0))
    if bad.any():
        raise ValueError(f"{path}: times of {name!r} must be finite and >= 0, got {raw[int(np.argmax(bad))]}")
    cell = np.repeat(np.arange(cells.size), [cell.size for cell in cells.ravel()])
    return raw, cell, raw.size > 0 and bool((raw == np.floor(raw)).all())


def _times(path: Path, unit_ns: float | None, variable: str | None) -> tuple[dict[str, _Cells], str, _Cells, float]:
    """All variables, the name and the cells of the one that holds the times, and their unit, ns."""
    if path.suffix in (".csv", ".txt"):
        variables = {"": _single(read_column(path, alone=True))}
    elif path.suffix == ".mat":
        variables = cells_of(mat_arrays(path, deep=False))
    else:
        with open_npz(path) as archive:
            variables = cells_of({name: np.atleast_1d(archive[name]) for name in archive.files})
    name, cells = _chosen(path, variables, variable)
    unit = unit_ns
    if unit is None:
        unit = next((ns for ending, ns in _SUFFIX_NS.items() if name.endswith(ending)), None)
    if unit is None:
        raise ValueError(f"{path}: the unit of {name!r} is not stated: give unit_ns (1 if its times are in ns)")
    return variables, name, cells, unit


def _chosen(path: Path, variables: dict[str, _Cells], variable: str | None) -> tuple[str, _Cells]:
    """The variable that holds the times: the one named, the only cell array, or the only vector."""
    if variable is not None:
        if variable not in variables:
            raise ValueError(f"variable must be one of {', '.join(variables) or 'none'} in {path}, got {variable!r}")
        return variable, variables[variable]
    images = [name for name, cells in variables.items() if cells.size > 1]
    vectors = [name for name, cells in variables.items() if cells.size == 1 and cells[0, 0].size > 1]
    for names in (images, vectors):
        if len(names) == 1:
            return names[0], variables[names[0]]
    several = f"several arrays that could be times: {', '.join(images or vectors)}"
    raise ValueError(f"{path} has {several if images or vectors else 'no array of times'}; give variable")


def _period(variables: dict[str, _Cells], unit: float) -> float | None:
    for name in _PERIODS:
        if name in variables and variables[name].size == 1 and variables[name][0, 0].size == 1:
            value = float(variables[name][0, 0].ravel()[0]) * unit
            if np.isfinite(value) and value > 0:
                return value
    return None


def _single(values: NDArray[Any]) -> _Cells:
    out = np.empty((1, 1), object)
    out[0, 0] = values.ravel()
    return out


def _is_times(values: Any) -> bool:
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        return False
    return values.size in values.shape if values.size else not any(values.shape)


def cells_of(variables: dict[str, Any]) -> dict[str, _Cells]:
    """The vectors and cell arrays of a .mat by name: (H, W) of vectors, (1, 1) for a plain one."""
    out: dict[str, _Cells] = {}
    for name, values in variables.items():
        if isinstance(values, np.ndarray) and values.dtype == object:
            cells = np.atleast_2d(values)
            if all(_is_times(cell) or (isinstance(cell, np.ndarray) and cell.size == 0) for cell in cells.ravel()):
                out[name] = cells
        elif _is_times(values):
            out[name] = _single(values)
    return out
