"""Reports of the studies: Markdown with tables, CSV beside it, figures of bounded size."""

from __future__ import annotations

import csv
import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = Mapping[str, Any]

MAX_FIGURE_BYTES = 200_000


def number(value: Any) -> str:
    """Four significant figures of a float, thousands kept whole; anything else as it is."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def table(rows: Sequence[Row]) -> str:
    """A Markdown table; all rows have the keys of the first."""
    if not rows:
        return ""
    keys = list(rows[0])
    lines = ["| " + " | ".join(keys) + " |", "|" + "---|" * len(keys)]
    lines += ["| " + " | ".join(number(row[key]) for key in keys) + " |" for row in rows]
    return "\n".join(lines)


def configuration(settings: Mapping[str, Any]) -> str:
    """What was run: settings, versions and the date, one line each."""
    import numpy
    import scipy

    from mars_lidar._version import __version__

    lines = [f"- {name}: {value}" for name, value in settings.items()]
    versions = {"mars_lidar": __version__, "numpy": numpy.__version__, "scipy": scipy.__version__}
    lines.append("- versions: " + ", ".join(f"{name} {version}" for name, version in versions.items()))
    lines.append(f"- date: {datetime.datetime.now(datetime.UTC):%Y-%m-%d}")
    return "\n".join(lines)


def save_text(path: Path, parts: Sequence[str]) -> Path:
    """Write paragraphs as one Markdown file; returns `path`."""
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return path


def save_csv(path: Path, rows: Sequence[Row]) -> Path:
    """Write rows that share their keys; floats with six significant figures. Returns `path`."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0])
        for row in rows:
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in row.values()])
    return path


def save_figure(path: Path, figure: Figure) -> Path:
    """Write a PNG; raises ValueError where it is too large to keep beside the text. Returns `path`."""
    figure.savefig(path, metadata={"Software": None})
    size = path.stat().st_size
    if size > MAX_FIGURE_BYTES:
        raise ValueError(f"figure {path.name} has {size} bytes, at most {MAX_FIGURE_BYTES} are allowed")
    return path
