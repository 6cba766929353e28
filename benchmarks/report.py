"""Tables: sections of rows with goals beside them, as Markdown and as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

Row = dict[str, Any]


@dataclass(frozen=True)
class Goal:
    """A measured value beside the value that is wanted."""

    what: str
    measured: float
    wanted: float
    unit: str
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Computed, never typed."""
        return self.measured >= self.wanted if self.at_least else self.measured <= self.wanted

    def row(self) -> Row:
        """For the table of goals."""
        sign = "≥" if self.at_least else "≤"
        return {
            "goal": self.what,
            "measured": f"{number(self.measured)} {self.unit}".strip(),
            "wanted": f"{sign} {number(self.wanted)} {self.unit}".strip(),
            "": "met" if self.met else "**not met**",
        }


@dataclass
class Section:
    """One table. All rows have the keys of the first, in its order; None prints as a dash."""

    title: str
    rows: list[Row] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def markdown(self) -> str:
        """Heading, table and notes."""
        parts = [f"## {self.title}", table(self.rows), *self.notes]
        return "\n\n".join(part for part in parts if part)


@dataclass
class Report:
    """All that one run found."""

    machine: dict[str, Any]
    configuration: dict[str, Any]
    sections: list[Section] = field(default_factory=list)

    @property
    def goals(self) -> list[Goal]:
        """Of all sections."""
        return [goal for section in self.sections for goal in section.goals]

    def markdown(self) -> str:
        """The whole report."""
        parts = [
            "# Benchmarks of mars_lidar",
            table([{"": key, "value": value} for key, value in self.machine.items()]),
            "; ".join(f"{key}: {value}" for key, value in self.configuration.items()) + ".",
        ]
        if self.goals:
            parts += ["## Goals", table([goal.row() for goal in self.goals])]
        return "\n\n".join([*parts, *(section.markdown() for section in self.sections)]) + "\n"

    def json(self) -> str:
        """The same as data."""
        data = {
            "machine": self.machine,
            "configuration": self.configuration,
            "goals": [asdict(goal) | {"met": goal.met} for goal in self.goals],
            "sections": [{"title": s.title, "rows": s.rows, "notes": s.notes} for s in self.sections],
        }
        return json.dumps(data, indent=1, ensure_ascii=False) + "\n"

    def save(self, folder: Path, stem: str) -> list[Path]:
        """Write ``stem.md`` and ``stem.json``."""
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{stem}.md", folder / f"{stem}.json"]
        for path, text in zip(paths, (self.markdown(), self.json()), strict=True):
            path.write_text(text, encoding="utf-8")
        return paths


def write_block(page: Path, command: str, made: str) -> None:
    """Write a block of a page of docs, between the comments that name its command and its end."""
    before, begin, rest = page.read_text(encoding="utf-8").partition(f"<!-- {command} -->")
    _, end, after = rest.partition("<!-- end -->")
    if not end:
        raise SystemExit(f"{page} has no block <!-- {command} -->")
    page.write_text(f"{before}{begin}\n\n{made}\n\n{end}{after}", encoding="utf-8")


def table(rows: list[Row]) -> str:
    """Markdown, columns aligned for the reader of the plain text."""
    if not rows:
        return ""
    cells = [list(rows[0]), *([_cell(row[key]) for key in rows[0]] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    texts = [isinstance(value, str) for value in rows[0].values()]
    lines = []
    for line in cells:
        padded = (
            cell.ljust(width) if text else cell.rjust(width)
            for cell, width, text in zip(line, widths, texts, strict=True)
        )
        lines.append("| " + " | ".join(padded) + " |")
    rule = ["-" * w if text else "-" * (w - 1) + ":" for w, text in zip(widths, texts, strict=True)]
    return "\n".join([lines[0], "| " + " | ".join(rule) + " |", *lines[1:]])


def number(value: float) -> str:
    """Three significant digits, large whole numbers in full."""
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:#.3g}".rstrip(".")


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return number(value) if isinstance(value, (int, float)) else str(value)
