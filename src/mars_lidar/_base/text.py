"""Numbers in text files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import check_claim


def read_column(path: Path) -> NDArray[np.float64]:
    """The last of one or two columns of numbers in a text file, below lines of words; else a ValueError."""
    check_claim(path, 64 * path.stat().st_size)
    rows: list[list[float]] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            rows.append([float(part) for part in line.replace(",", " ").replace(";", " ").split()])
        except ValueError:
            like_numbers = all(part[0] in "+-.0123456789" for part in line.replace(",", " ").replace(";", " ").split())
            if rows or like_numbers:  # lines of words are only above the numbers
                raise ValueError(f"line {line[:40]!r} holds no numbers") from None
    rows = [row for row in rows if row]
    if not rows or {len(row) for row in rows} not in ({1}, {2}):
        raise ValueError("numbers as text are one column, or times and values")
    return np.asarray(rows)[:, -1]
