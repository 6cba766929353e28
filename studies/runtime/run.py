"""Study "runtime", T2 and T3 of the MaRS paper: time of a cube by stages, and of every simulator along four axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from benchmarks.machine import load
from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies import Facts, Request
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.common.sample import PERIOD_NS
from studies.runtime.timing import (
    DEAD_TIME_NS,
    FLUX,
    FULL,
    NUMPY,
    QUICK,
    SIGMA_NS,
    TABLED,
    Point,
    Settings,
    along,
    cube_stages,
    teaser,
)

__all__ = ["DEAD_TIME_NS", "FLUX", "SIGMA_NS", "crossover", "run"]

PAPER_TEASER = {"poisson": 0.2, TABLED: 0.3, "sequential": 16.1}  # seconds, of another workload
_COLOURS = {
    "exact": INK,
    "sequential": COLOURS[1],
    "poisson": COLOURS[0],
    "renewal": COLOURS[2],
    "mars": COLOURS[4],
    TABLED: COLOURS[3],
    "feedback": COLOURS[5],
    NUMPY: MUTED,
}
_OTHER = ("#8c564b", "#7f7f00", "#17607f")  # engines that came later


def _colour(name: str, names: Sequence[str]) -> str:
    unknown = [n for n in names if n not in _COLOURS]
    return _COLOURS[name] if name in _COLOURS else _OTHER[unknown.index(name) % len(_OTHER)]


def along_axes(settings: Settings, points: Sequence[Point]) -> Figure:
    """Seconds against cycles, flux, realizations and pixels; a line ends where the next point was left out."""
    figure, axes = panels(5.2, 2, 2, sharey=True)
    names = list(dict.fromkeys(p.contender for p in points))
    for ax, axis in zip(axes.flat, settings.axes, strict=True):
        for name in names:
            here = [p for p in points if p.axis == axis.name and p.contender == name and p.seconds is not None]
            ax.plot(
                [p.value for p in here],
                [float(p.seconds or 0.0) for p in here],
                marker="o",
                ms=2.4,
                lw=1.0,
                color=_colour(name, names),
                ls="--" if name == NUMPY else "-",
                label=name,
            )
        ax.set(xscale="log", yscale="log", xlabel=axis.words)
        others = {"cycles": f"{axis.pixels} pixels", "flux": f"{axis.pixels} pixels, {axis.cycles} cycles"}
        ax.set_title(others.get(axis.name, f"{axis.cycles} cycles"), loc="left")
    for row in axes:
        row[0].set_ylabel("seconds")
    legend_below(figure, axes[0, :1], min(len(names), 6))
    return figure


def single_pixel(settings: Settings, single: Sequence[Point]) -> Figure:
    """Bars of the single pixel, here and in the paper."""
    figure, axes = panels(2.4, 1, 2, gridspec_kw={"width_ratios": (2, 1)})
    cycles, realizations = settings.teaser
    names = [p.contender for p in single]
    here = {p.contender: float(p.seconds or 0.0) for p in single}
    bars = {f"here: {cycles} cycles x {realizations} realizations": here, "paper: another workload": PAPER_TEASER}
    for ax, (words, seconds) in zip(axes[0], bars.items(), strict=True):
        order = [name for _, name in sorted((s, name) for name, s in seconds.items())]
        at = np.arange(len(order))
        ax.barh(at, [seconds[name] for name in order], color=[_colour(name, names) for name in order], height=0.7)
        for y, name in zip(at, order, strict=True):
            ax.text(seconds[name] * 1.1, y, f"{seconds[name]:.3g} s", va="center", fontsize=6.5)
        ax.set_yticks(at, ["mars" if name == TABLED and seconds is PAPER_TEASER else name for name in order])
        ax.set(xscale="log", xlabel="seconds")
        low, high = ax.get_xlim()
        ax.set_xlim(low, high * 4.0)
        ax.set_title(words, loc="left")
        ax.invert_yaxis()
    return figure


# T2 and T3 of arXiv 2512.04924; NumPy on a Ryzen 7 9700X
PAPER_STAGES = {"lookup": 0.020, "alignment": 0.144, "sampling": 0.849}
PAPER_TOTAL, PAPER_SEQUENTIAL = 1.013, 40.831
PAPER_GRID = (256, 100, 1024)  # points in S and B, bins
PAPER_TABLE_MB, PAPER_DELAYS_GB = 105, 108
_BYTES = 4  # float32


def crossover(points: Sequence[Point], axis: str, fast: str, other: str) -> tuple[float | None, str]:
    """Registrations per pixel from which `other` is faster than `fast` along an axis, and the rule in words.

    Interpolated in the logarithms between the points at which both were timed.
    """
    results = {
        name: {p.value: p for p in points if p.axis == axis and p.contender == name and p.seconds is not None}
        for name in (fast, other)
    }
    shared = sorted(set(results[fast]) & set(results[other]))
    if not shared:
        return None, f"{fast} and {other} were not timed together along {axis}"
    hits = [results[fast][v].registrations for v in shared]
    ratio = [float(results[other][v].seconds or 0.0) / float(results[fast][v].seconds or 1.0) for v in shared]
    ahead = np.array(ratio) > 1.0
    if ahead.all() or not ahead.any():
        first, second = (fast, other) if ahead.all() else (other, fast)
        span = f"at {hits[0]:.3g}" if len(hits) == 1 else f"from {min(hits):.3g} to {max(hits):.3g}"
        return None, f"{first} is faster than {second} {span} registrations per pixel, wherever both were timed"
    last = int(np.flatnonzero(ahead)[-1])  # from the next point on, `other` is faster to the end
    if last == len(shared) - 1:
        return None, f"{fast} is faster than {other} at {hits[-1]:.3g} registrations per pixel, not everywhere below"
    a, b = np.log(ratio[last]), np.log(ratio[last + 1])
    place = np.log(hits[last]) + a / (a - b) * np.log(hits[last + 1] / hits[last])
    least = float(np.exp(place))
    return least, f"{fast} is faster than {other} below {least:.3g} registrations per pixel, slower above"


def run(request: Request) -> Facts:
    """Stages of a cube, four axes, and a single pixel, timed."""
    settings = QUICK if request.quick else FULL
    before = load()
    cubes, held = cube_stages(settings, request.tell)
    single = teaser(settings, request.tell)
    points = [point for axis in settings.axes for point in along(settings, axis, request.tell)]
    others = [
        other for other in dict.fromkeys(p.contender for p in points) if other not in ("exact", "sequential", "poisson")
    ]
    axes = (("cycles", "exposure grows"), ("flux", "flux grows"))
    return {
        "s": settings,
        "period_ns": PERIOD_NS,
        "before": before,
        "cubes": cubes,
        "engines": [cube for cube in cubes if cube["contender"] != NUMPY],
        "base": next(cube["seconds"] for cube in cubes if cube["contender"] == NUMPY),
        "rules": [(words, *crossover(points, axis, "exact", other)) for other in others for axis, words in axes],
        "pixels": next(axis.pixels for axis in settings.axes if axis.name == "cycles"),
        "axes": {axis.words: _axis_rows(points, axis.name) for axis in settings.axes},
        "single": single,
        "held": held,
        "size": PAPER_GRID[0] * PAPER_GRID[1] * (PAPER_GRID[2] + 2) * _BYTES,
        "rows": [vars(p) | {"seconds": "" if p.seconds is None else p.seconds} for p in [*points, *single]],
        "figures": {"axes": along_axes(settings, points), "teaser": single_pixel(settings, single)},
    }


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
