"""Tables that were built before, kept in the user's cache directory under the hash of their request.

``MARS_LIDAR_CACHE``, or ``mars-lidar`` in ``XDG_CACHE_HOME``, or in ``~/.cache``.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from pathlib import Path
from typing import Any, Self

from mars_lidar._base.files import reason
from mars_lidar.instrument.system import System
from mars_lidar.table.axes import PAPER_GRID, Grid, axis_values
from mars_lidar.table.build import Built
from mars_lidar.table.storage import KEY_LENGTH, Stored, request_key

SUFFIX = ".h5"


def directory() -> Path:
    """Where tables are kept; it need not exist yet."""
    given = os.environ.get("MARS_LIDAR_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    root = Path(base) if base and Path(base).is_absolute() else Path.home() / ".cache"
    return root / "mars-lidar"


class Cached(Built, Stored):
    """Nodes that are kept."""

    @classmethod
    def cached(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        **options: Any,
    ) -> Self:
        """`build`, or the same table from the user's cache (docs/table.md, 7), which keeps what is built.

        Where nothing can be written there, the table is built, with a warning.
        """
        own, found = _search(cls, system, signal, background, options)
        if found is None:
            table = cls.build(system.detected(), signal, background, **options)
            try:
                _keep(table, own)
            except OSError as error:
                warnings.warn(
                    f"the table cannot be kept in {own.parent} ({reason(error)}) and will be built again the next "
                    "time; MARS_LIDAR_CACHE names another folder",
                    UserWarning,
                    stacklevel=2,
                )
                return table
        return cls.load(found or own, system)


def cached_path(make: type[Cached], system: System, signal: Grid, background: Grid, **options: Any) -> Path:
    """File of the table in the cache; built and put there where it is not.

    A table made for another number of cycles is taken where every entry of it holds for those of `system`.
    """
    own, found = _search(make, system, signal, background, options)
    if found is None:
        _keep(make.build(system.detected(), signal, background, **options), own)
    return found or own


def _search(
    make: type[Cached], system: System, signal: Grid, background: Grid, options: dict[str, Any]
) -> tuple[Path, Path | None]:
    """Where the table belongs, and the file that serves, if there is one."""
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    system = system.detected()
    chosen = {"method": "exposure", "rearm": "centre", "refine": None, "tolerance": 1e-4} | options
    unknown = set(chosen) - {"method", "rearm", "refine", "tolerance", "check_law", "threads", "progress"}
    if unknown:
        raise TypeError(f"the options are those of Table.build, got {sorted(unknown)[0]!r}")
    axes = axis_values("signal", signal), axis_values("background", background)
    key = request_key(system, axes, **{name: chosen[name] for name in ("method", "rearm", "refine", "tolerance")})
    folder = directory()
    own = folder / f"{key}-{system.cycles}{SUFFIX}"
    others = sorted(folder.glob(f"{key}-*{SUFFIX}")) if folder.is_dir() else []
    for path in [own, *(other for other in others if other != own)]:
        with contextlib.suppress(OSError, ValueError):  # absent, out of reach, damaged, or of too few cycles
            law = make.load(path, system).provenance["law"]
            if law is not None or not chosen.get("check_law", False):
                return own, path
    return own, None


def _keep(table: Stored, own: Path) -> None:
    own.parent.mkdir(parents=True, exist_ok=True)
    mine = own.with_name(f"{own.stem}-{os.getpid()}{SUFFIX}")  # several processes may build the same table at once
    table.save(mine, overwrite=True)
    os.replace(mine, own)


def files(folder: Path | None = None) -> list[Path]:
    """Tables in the cache, and what unfinished writing left there."""
    where = directory() if folder is None else folder
    if not where.is_dir():
        return []
    return sorted(p for p in where.iterdir() if p.is_file() and _is_ours(p.name))


def clear(folder: Path | None = None) -> tuple[int, int]:
    """Remove them; the number of files and bytes that are gone."""
    count = freed = 0
    for path in files(folder):
        size = path.stat().st_size
        path.unlink()
        count, freed = count + 1, freed + size
    return count, freed


def _is_ours(name: str) -> bool:
    key, _, rest = name.partition("-")
    return len(key) == KEY_LENGTH and all(c in "0123456789abcdef" for c in key) and SUFFIX in rest
