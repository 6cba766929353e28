"""A study in its quick form, run through the command."""

import csv
from dataclasses import dataclass
from pathlib import Path

from studies.__main__ import main
from studies.common.report import MAX_FIGURE_BYTES


@dataclass(frozen=True)
class Written:
    """What a study wrote: its report, the rows of its table, the names of its figures."""

    text: str
    rows: list[dict[str, str]]
    figures: list[str]


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a table of a study."""
    with path.open() as file:
        return list(csv.DictReader(file))


def quick_study(name: str, out: Path, *more: object) -> Written:
    """Run it; every figure is in the report once, drawn, and no larger than a figure of the docs may be."""
    assert main([name, "--quick", "--out", str(out), *map(str, more)]) == 0
    return written(name, out)


def written(name: str, out: Path) -> Written:
    """What a study that has run wrote."""
    stem = name.replace("-", "_")
    text = (out / f"{stem}.md").read_text()
    figures = sorted(path.name for path in (*out.glob(f"{stem}.png"), *out.glob(f"{stem}_*.png")))
    for figure in figures:
        assert text.count(f"({figure})") == 1
        assert 5_000 < (out / figure).stat().st_size <= MAX_FIGURE_BYTES
    return Written(text, read_csv(out / f"{stem}.csv"), figures)
