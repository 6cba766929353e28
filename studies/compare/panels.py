"""Panels of the comparison that show one number for each engine and pixel."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.compare.sample import Distance, Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from studies.compare.comparison import Comparison

_MORE = ("#8c564b", "#999933", "#332288", "#aa4499")


def engine_colours(engines: Iterable[str]) -> dict[str, str]:
    """A colour for each engine, the same throughout a figure."""
    palette = (*COLOURS, *_MORE)
    return {engine: palette[k % len(palette)] for k, engine in enumerate(engines)}


def draw_points(
    ax: Axes,
    rows: Mapping[str, Mapping[str, Estimate | Distance]],
    colours: dict[str, str],
    goal: float | None,
    always: str,
    known: Mapping[str, float] | None = None,
) -> None:
    """One point for each engine at each pixel, `rows[pixel][engine]`.

    Estimates have a bar of two standard errors and a line at `goal`; distances are on a log axis, each
    with a dash at what sampling alone makes of it. `known[pixel]` is a line across its engines. A value that
    would flatten the rest is written at the edge, but never that of engine `always`.
    """
    engines = list(next(iter(rows.values())))
    step = 0.8 / len(engines)
    finite = [v.value for row in rows.values() for v in row.values() if math.isfinite(v.value)]
    low, high = _range(rows, goal, always) if goal is not None else (0.0, math.inf)
    for column, (pixel, row) in enumerate(rows.items()):
        if known is not None and math.isfinite(known.get(pixel, math.nan)):
            ax.plot([column - 0.45, column + 0.45], [known[pixel]] * 2, color=INK, lw=0.9, ls=(0, (4, 1.5)))
        placed = {True: 0, False: 0}  # off the scale, above and below
        for k, (engine, result) in enumerate(row.items()):
            at = column + (k - 0.5 * (len(engines) - 1)) * step
            colour = colours[engine]
            if isinstance(result, Distance):
                if result.value > 0:
                    ax.plot(at, result.value, "o", ms=3.5, color=colour)
                    ax.plot([at - 0.45 * step, at + 0.45 * step], [result.floor] * 2, color=INK, lw=0.9)
            elif low <= result.value <= high:
                ax.errorbar(at, result.value, 2.0 * result.error, fmt="o", ms=3.5, lw=1.0, color=colour)
            elif math.isfinite(result.value):
                above = result.value > high
                edge, within = (0.96, "top") if above else (0.04, "bottom")
                frame = ax.get_xaxis_transform()
                ax.plot(at, edge, "^" if above else "v", ms=4, color=colour, transform=frame)
                away = 5 + 7 * placed[above]  # one below the other: neighbours are narrower than their numbers
                placed[above] += 1
                ax.annotate(
                    f"{result.value:.2g}",
                    (at, edge),
                    (0, -away if above else away),
                    xycoords=frame,
                    textcoords="offset points",
                    ha="center",
                    va=within,
                    fontsize=6.0,
                    color=colour,
                )
    if goal is None:
        if any(v > 0 for v in finite):
            ax.set_yscale("log")
            low, high = ax.get_ylim()
            ax.set_ylim(min(low, 0.3 * high), max(high, 3.0 * low))
    else:
        ax.axhline(goal, color=MUTED, lw=0.7, ls=(0, (3, 2)), zorder=0)
        ax.set_ylim(low, high)
    ax.set_xticks(range(len(rows)), list(rows))
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-0.5, len(rows) - 0.5)
    for column in range(1, len(rows)):
        ax.axvline(column - 0.5, color=MUTED, lw=0.3, zorder=0)


def draw_times(ax: Axes, result: Comparison, colours: dict[str, str]) -> None:
    """Median wall time of a cube by engine, on a log axis."""
    names = list(result.scenes)
    times = [1e3 * scene.median_s for scene in result.scenes.values()]
    ax.barh(range(len(names)), times, color=[colours[n] for n in names], height=0.65)
    ax.set_xscale("log")
    ax.set_xlim(0.3 * min(times), 12.0 * max(times))
    for k, t in enumerate(times):
        ax.text(1.1 * t, k, f"{t:,.0f}" if t >= 99.5 else f"{t:.3g}", va="center", fontsize=6.5)
    ax.set_yticks(range(len(names)), names)
    ax.tick_params(axis="y", length=0)
    ax.invert_yaxis()
    ax.set_title(f"Time of one cube (ms), threads: {result.threads}", loc="left")


def _range(rows: Mapping[str, Mapping[str, Estimate | Distance]], goal: float, always: str) -> tuple[float, float]:
    """Limits that keep small deviations visible: four times the median deviation, and all of engine `always`."""
    reach = {
        (pixel, engine): abs(v.value - goal) + 2.0 * v.error
        for pixel, row in rows.items()
        for engine, v in row.items()
        if isinstance(v, Estimate) and math.isfinite(v.value) and math.isfinite(v.error)
    }
    if not reach:
        return goal - 1.0, goal + 1.0
    middle = sorted(reach.values())[(len(reach) - 1) // 2]
    most = 1.3 * max(r for (_, engine), r in reach.items() if engine == always or r <= 4.0 * middle) or 1.0
    return goal - most, goal + most
