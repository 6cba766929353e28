"""The report on runtime: T2 and T3 of the MaRS paper, the paper's figures beside it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from mars_lidar.table import Table
from studies import Request
from studies.contenders import NUMPY
from studies.machine import load, machine
from studies.report import Row, configuration, save_csv, save_text, table
from studies.runtime import (
    DEAD_TIME_NS,
    FLUX,
    FULL,
    PERIOD_NS,
    QUICK,
    SIGMA_NS,
    Cube,
    Point,
    Settings,
    along,
    crossover,
    cube_stages,
    teaser,
)
from studies.runtime_figures import draw_all

# T2 and T3 of arXiv 2512.04924; NumPy on a Ryzen 7 9700X
PAPER_STAGES = {"lookup": 0.020, "alignment": 0.144, "sampling": 0.849}
PAPER_TOTAL, PAPER_SEQUENTIAL = 1.013, 40.831
PAPER_GRID = (256, 100, 1024)  # points in S and B, bins
PAPER_TABLE_MB, PAPER_DELAYS_GB = 105, 108
_BYTES = 4  # float32


def run(request: Request) -> list[Path]:
    """Time, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    busy = [load()]
    cubes, held = cube_stages(settings, request.tell)
    single = teaser(settings, request.tell)
    points = [point for axis in settings.axes for point in along(settings, axis, request.tell)]
    busy.append(load())
    figures = draw_all(request.out, settings, points, single)
    rules = _rules(points, settings)
    for line in rules:
        request.tell(line)
    spent = time.monotonic() - began
    text = _text(settings, cubes, held, single, points, rules, request.quick, busy, spent)
    rows = [vars(p) | {"seconds": "" if p.seconds is None else p.seconds} for p in [*points, *single]]
    return [
        save_text(request.out / "runtime.md", text),
        *figures,
        save_csv(request.out / "runtime.csv", rows),
    ]


def _text(
    settings: Settings,
    cubes: Sequence[Cube],
    held: Table,
    single: Sequence[Point],
    points: Sequence[Point],
    rules: Sequence[str],
    quick: bool,
    busy: Sequence[str],
    spent: float,
) -> list[str]:
    side, bins = settings.side, settings.bins
    return [
        "# Runtime (T2, T3)",
        "_Quick form: a look, not for citing._" if quick else "",
        "Every engine, and the paper's pipeline in NumPy (`studies/numpy_pipeline.py`), on the same fluxes. Figures "
        "of this machine; the paper's are of another.",
        "## Configuration",
        f"Command: `python -m studies runtime{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "laser": f"t_r = {PERIOD_NS:.6g} ns, t_d = {DEAD_TIME_NS:g} ns, armed start, {bins} bins",
                "pulse": f"Gaussian, sigma = {SIGMA_NS:g} ns",
                "flux": f"S and B uniform on [{FLUX[0]:g}, {FLUX[1]:g}] photons per period, another delay in every "
                f"pixel",
                "timing": f"least of at most {settings.repeats} repeats, contenders in turn, output memory touched "
                f"before; repeats end after {settings.enough_s:g} s",
                "left out": f"points predicted from the ones before to take over {settings.limit_s:g} s",
                "threads": "all processors for the engines, one for NumPy",
                "machine": machine(),
                "load": f"{busy[0]} at the start, {busy[1]} at the end",
                "run time": f"{spent:.0f} s",
            }
        ),
        f"## One cube of {side} x {side} x {bins}, 1000 cycles",
        table([_cube_row(cube) for cube in cubes] + _paper_rows()),
        "Stages in seconds, as each simulator reports them. *before*: preparing a table "
        f"({settings.cube_table[0]} x {settings.cube_table[1]} entries) or nothing. *predicted*: "
        f"over {settings.cube_limit_s:g} s by a part of the pixels, scaled, and not run.",
        _speed(cubes),
        "## Rules",
        "\n".join(rules),
        "## Along four axes",
        "![Runtime along four axes](runtime_axes.png)",
        *[part for axis in settings.axes for part in (f"### {axis.words}", table(_axis_rows(points, axis.name)))],
        f"Seconds. *-*: left out, predicted to take over {settings.limit_s:g} s. *outside*: flux beyond the table.",
        "## One pixel",
        "![One pixel](runtime_teaser.png)",
        table([{"simulator": p.contender, "seconds": f"{p.seconds:.3g}"} for p in single]),
        "Paper, another workload: Poisson 0.2 s, MaRS 0.3 s, sequential 16.1 s.",
        "## Size of the table (T3)",
        table(_sizes(held)),
    ]


def _cube_row(cube: Cube) -> Row:
    stages = ", ".join(f"{name} {seconds:.3f}" for name, seconds in cube.stages.items())
    return {
        "simulator": cube.words,
        "seconds": f"{cube.seconds:.3g} (predicted)" if cube.predicted else f"{cube.seconds:.4f}",
        "stages": stages or "-",
        "before, s": f"{cube.prepared:.2f}",
    }


def _paper_rows() -> list[Row]:
    stages = ", ".join(f"{name} {seconds:.3f}" for name, seconds in PAPER_STAGES.items())
    return [
        {"simulator": "_paper: MaRS, NumPy_", "seconds": PAPER_TOTAL, "stages": stages, "before, s": "-"},
        {"simulator": "_paper: sequential_", "seconds": PAPER_SEQUENTIAL, "stages": "-", "before, s": "-"},
    ]


def _speed(cubes: Sequence[Cube]) -> str:
    seconds = {cube.contender: cube.seconds for cube in cubes}
    words = {cube.contender: cube.words for cube in cubes}
    base = seconds[NUMPY]
    told = ", ".join(f"{words[name]} {base / s:.3g}" for name, s in seconds.items() if name != NUMPY)
    return f"Times faster than the NumPy pipeline on this machine: {told}."


def _rules(points: Sequence[Point], settings: Settings) -> list[str]:
    """Who is the faster from how many registrations on, along exposure and flux."""
    names = list(dict.fromkeys(p.contender for p in points))
    others = [name for name in names if name not in ("exact", "sequential", "poisson")]
    cycles = next(axis for axis in settings.axes if axis.name == "cycles")
    lines = []
    for other in others:
        for axis, words in (("cycles", "exposure grows"), ("flux", "flux grows")):
            at, rule = crossover(points, axis, "exact", other)
            bins = "" if at is None else f" ({at / settings.bins:.2g} registrations per bin)"
            lines.append(f"- As the {words}, {cycles.pixels} pixels, {settings.bins} bins: {rule}{bins}.")
    return lines


def _axis_rows(points: Sequence[Point], axis: str) -> list[Row]:
    here = [p for p in points if p.axis == axis]
    names = list(dict.fromkeys(p.contender for p in points))
    rows: list[Row] = []
    for value in dict.fromkeys(p.value for p in here):
        at = [p for p in here if p.value == value]
        row: dict[str, object] = {axis: f"{value:.6g}", "registrations per pixel": f"{at[0].registrations:.3g}"}
        for p in sorted(at, key=lambda p: names.index(p.contender)):
            left_out = "outside" if p.why.startswith("flux") else "-"
            row[p.contender] = left_out if p.seconds is None else f"{p.seconds:.3g}"
        rows.append(row)
    return rows


def _sizes(held: Table) -> list[Row]:
    signal, background, bins = PAPER_GRID
    without = signal * background * (bins + 2) * _BYTES
    grid = f"{signal} x {background} entries of {bins} bins and 2 moments, float32"
    return [
        {"table": grid, "computed": f"{without / 1e6:.1f} MB", "paper": f"{PAPER_TABLE_MB} MB"},
        {
            "table": f"the same at each of {bins} delays",
            "computed": f"{without * bins / 1e9:.1f} GB",
            "paper": f"{PAPER_DELAYS_GB} GB",
        },
        {
            "table": f"`Table` of this run, {held.signal.size} x {held.background.size} entries of any exposure",
            "computed": f"{held.nbytes / 1e6:.1f} MB",
            "paper": "-",
        },
    ]
