"""Reports of the studies: Markdown from a template, CSV beside it, figures of bounded size."""

from __future__ import annotations

import csv
import datetime
import math
import platform
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.machine import load, processor
from mars_lidar._base.imports import needed
from mars_lidar.plot.style import style

if TYPE_CHECKING:
    from studies import Request

Row = Mapping[str, Any]

MAX_FIGURE_BYTES = 200_000


def make(request: Request, name: str, study: ModuleType, settings: Any = None) -> list[Path]:
    """Run a study, by its settings for the request or by others, and write its report; returns all paths.

    Of its facts ``rows`` become NAME.csv, and each of ``tables`` NAME_KEY.csv; one of no rows is removed. ``figures``
    by KEY become NAME_KEY.png, that of the empty key NAME.png; the template gets their paths.

    NAME.md is made of the Jinja template beside the module `study`: that of its name, ``report.md.jinja`` beside a
    ``run.py``. It gives the facts; `s` there are the settings, `study` is the module with its constants.
    """
    name, module, began = name.replace("-", "_"), Path(str(study.__file__)), time.monotonic()
    if settings is None:
        settings = study.QUICK if request.quick else study.FULL
    with style():
        facts = study.run(settings, request)
        drawn: Mapping[str, Figure] = facts.get("figures", {})
        figures = [save_figure(_beside(request, name, key, "png"), figure) for key, figure in drawn.items()]
    facts = {"study": study, "s": settings, "spent": time.monotonic() - began, **facts, "figures": figures}
    template = module.with_name(f"{'report' if module.stem == 'run' else module.stem}.md.jinja")
    text = _beside(request, name, "", "md")
    text.write_text(render(request, template, facts), encoding="utf-8")
    paths = [text, *figures]
    for key, rows in {"": facts.get("rows", ()), **facts.get("tables", {})}.items():
        path = _beside(request, name, key, "csv")
        if rows:
            paths.append(save_csv(path, rows))
        else:
            path.unlink(missing_ok=True)
    return paths


def _beside(request: Request, name: str, key: str, suffix: str) -> Path:
    return request.out / f"{name}{'_' * bool(key)}{key}.{suffix}"


def render(request: Request, template: Path, facts: Mapping[str, Any]) -> str:
    """The Markdown of a template, which also knows the names below."""
    jinja2 = needed("jinja2", "a study's report", "studies")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    environment.filters |= FILTERS
    environment.globals |= {
        "quick": request.quick,
        "for_looking": "_Quick run: a preview, not for citation._" if request.quick else "",
        "flag": " --quick" if request.quick else "",
        "versions": versions(),
        "machine": machine,
        "load": load,
        "table": table,
        "zip": zip,
        "len": len,
    }
    text: str = environment.get_template(template.name).render(facts)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def number(value: Any) -> str:
    """Four significant figures of a float, thousands kept whole; anything else as it is."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def table(rows: Iterable[Row]) -> str:
    """A Markdown table; all rows have the keys of the first."""
    lines = list(rows)
    if not lines:
        return ""
    keys = list(lines[0])
    head = ["| " + " | ".join(keys) + " |", "|" + "---|" * len(keys)]
    return "\n".join(head + ["| " + " | ".join(number(row[key]) for key in keys) + " |" for row in lines])


def crossed(cells: Iterable[tuple[str, str, str]], corner: str = "case") -> list[Row]:
    """Rows of a table from (row, column, text) of each cell; `corner` is the title of the first column."""
    rows: dict[str, dict[str, str]] = {}
    for row, column, text in cells:
        rows.setdefault(row, {corner: row})[column] = text
    return list(rows.values())


def marked(pair: tuple[float, float], star: bool) -> str:
    """A value with its standard error in brackets, starred or not; "-" for NaN."""
    value, error = pair
    return "-" if math.isnan(value) else f"{value:.3f} ({error:.3f}){'*' if star else ''}"


FILTERS = {
    "f": format,  # x|f(".3g")
    "n": number,
    "each": lambda values, spec="g": ", ".join(format(v, spec) for v in values),
    "mean": lambda values: float(np.mean(list(values))),
    "median": lambda values: float(np.median(list(values))),
    "quantile": lambda values, q: float(np.quantile(list(values), q)),
}


def versions() -> str:
    """Two items of a configuration: versions and the date."""
    import scipy

    from mars_lidar import __version__

    used = {"mars_lidar": __version__, "numpy": np.__version__, "scipy": scipy.__version__}
    today = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
    return "- versions: " + ", ".join(f"{name} {version}" for name, version in used.items()) + f"\n- date: {today}"


def picked(source: object, names: str) -> dict[str, Any]:
    """Columns of attributes of `source`: `names` separated by blanks, ``column=attribute`` where they differ."""
    pairs = (name.split("=") for name in names.split())
    return {pair[0]: getattr(source, pair[-1]) for pair in pairs}


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
    figure.savefig(path, metadata={"Software": None}, pil_kwargs={"optimize": True})
    size = path.stat().st_size
    if size > MAX_FIGURE_BYTES:
        raise ValueError(f"figure {path.name} has {size} bytes, at most {MAX_FIGURE_BYTES} are allowed")
    return path


def machine() -> str:
    """Processor, processors of this process, vector level and system, in one line."""
    from mars_lidar import _core
    from mars_lidar._base.resources import thread_count

    return (
        f"{processor()}, {thread_count(None)} processors used, {_core.levels()[0]}, "
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    )
