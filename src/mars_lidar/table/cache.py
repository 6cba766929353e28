"""Tables that were built before, kept in the user's cache directory under the hash of their request.

``MARS_LIDAR_CACHE``, or ``mars-lidar`` in ``XDG_CACHE_HOME``, or in ``~/.cache``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from mars_lidar.table.storage import KEY_LENGTH

SUFFIX = ".h5"


def directory() -> Path:
    """Folder of the cached tables, which need not exist."""
    given = os.environ.get("MARS_LIDAR_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    root = Path(base) if base and Path(base).is_absolute() else Path.home() / ".cache"
    return root / "mars-lidar"


def candidates(key: str, cycles: int) -> tuple[Path, list[Path]]:
    """File of a request for `cycles`, and the existing files of the same request for other numbers of cycles."""
    folder = directory()
    own = folder / f"{key}-{cycles}{SUFFIX}"
    others = sorted(folder.glob(f"{key}-*{SUFFIX}")) if folder.is_dir() else []
    return own, [other for other in others if other != own]


def keep(save: Callable[..., None], own: Path) -> None:
    """Put a table into the cache by its method `save`."""
    own.parent.mkdir(parents=True, exist_ok=True)
    mine = own.with_name(f"{own.stem}-{os.getpid()}{SUFFIX}")  # several processes may build the same table at once
    save(mine, overwrite=True)
    os.replace(mine, own)


def files(folder: Path | None = None) -> list[Path]:
    """Tables in the cache, and unfinished files there."""
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
