"""Study "count-law", T1 of the MaRS paper: every simulator's count law and shape against simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS, INK, MUTED
from mars_lidar.statistics.tolerances import TOL
from studies import Facts, Request
from studies.common.draw import legend_below, panels
from studies.common.report import Row, picked
from studies.common.sample import PERIOD_NS
from studies.count_law.cells import FIGURES, FULL, QUICK, SHAPES, Cell, Settings, compute, shape_sweep
from studies.neural.simulators import simulators

PANELS = ((0.07, 0.07, 25.0), (0.5, 0.5, 50.0), (4.0, 0.5, 75.0), (10.0, 10.0, 100.0))  # nearest cells are drawn
_LINES = {
    "mars_exact": (INK, "-", 2.0),
    "mars_matched": (COLOURS[1], ":", 1.4),
    "mars_centre": (COLOURS[4], "-", 1.0),
    "mars_edge": (COLOURS[3], "--", 1.0),
    "renewal": (COLOURS[2], "-", 1.0),
    "neural": (COLOURS[5], "-", 1.4),
    "poisson": (COLOURS[0], "-", 1.0),
}
_LEGEND = {
    "poisson": "Poisson",
    "renewal": "renewal",
    "mars_centre": "MaRS, paper's, centre",
    "mars_edge": "MaRS, paper's, edge",
    "mars_exact": "MaRS, ours, exact",
    "mars_matched": "MaRS, ours, four cumulants",
    "neural": "neural, stand-in",
}
_REACH = 30.0  # standard deviations beyond which a law is named at the panel's side instead of drawn


def _colour(name: str) -> tuple[str, str, float]:
    return _LINES.get(name, (MUTED, "-.", 1.0))  # engines whose law is known by sampling


def law_panels(cells: Sequence[Cell]) -> Figure:
    """Four count laws beside the simulated frequencies; the inset compares KL with its floor."""
    grid = [cell for cell in cells if cell.grid == "wide"]
    figure, axes = panels(5.0, 2, 2)
    for ax, target in zip(axes.flat, PANELS, strict=True):
        near = (np.abs(np.log([c.signal / target[0], c.background / target[1]])).sum() for c in grid)
        apart = [float(flux) + abs(c.dead_ns - target[2]) / 25.0 for flux, c in zip(near, grid, strict=True)]
        _panel(ax, grid[int(np.argmin(apart))])
    for ax in axes[-1]:
        ax.set_xlabel("registrations N")
    for row in axes:
        row[0].set_ylabel("P(N)")
    handles = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if sampled := [name for name in grid[0].laws if name not in _LINES]:
        handles[f"{', '.join(sampled)}: KL only"] = Patch(color=MUTED)
    figure.legend(handles.values(), handles.keys(), frameon=False, loc="outside lower center", ncols=4)
    return figure


def _panel(ax: Axes, cell: Cell) -> None:
    spread = max(float(cell.exact[1]) ** 0.5, 0.5)
    low, high = cell.mean - 5.0 * spread, cell.mean + 5.0 * spread
    beyond = []
    drawn = {name: law for name, law in cell.laws.items() if name in _LINES}  # a sampled law is mostly noise
    for name, law in drawn.items():
        at = law.first + np.arange(law.p.size)
        centre = float((law.p * at).sum())
        own = float((law.p * (at - centre) ** 2).sum()) ** 0.5
        if abs(centre - cell.mean) > _REACH * spread:
            beyond.append(f"{_LEGEND.get(name, name)}: mean {centre:.0f} \N{RIGHTWARDS ARROW}")
            continue
        low, high = min(low, centre - 3.5 * own), max(high, centre + 3.5 * own)
    first, last = max(0, int(np.floor(low))), int(np.ceil(high))
    counts = np.arange(first, last + 1)
    ax.fill_between(
        counts, cell.truth.on(first, last), step="mid", color="#d0d0d0", lw=0.0, label="simulation", zorder=0
    )
    for name, law in drawn.items():
        colour, dash, width = _colour(name)
        above = 1 if name == "mars_exact" else 2  # thin lines over the thick one
        here = law.on(first, last)
        ax.plot(counts, here, ls=dash, lw=width, color=colour, label=_LEGEND.get(name, name), zorder=above)
    top = 1.15 * max(float(pmf.on(first, last).max()) for pmf in (cell.truth, *drawn.values()))
    # room at the right for the inset
    ax.set(xlim=(first, last + 0.55 * (last - first)), ylim=(0.0, top))
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.set_title(f"S = {cell.signal:.3g}, B = {cell.background:.3g}, $t_d$ = {cell.dead_ns:g} ns", loc="left")
    if beyond:
        ax.text(0.63, 0.08, "\n".join(beyond), transform=ax.transAxes, fontsize=6.0, color=MUTED)
    _inset(ax, cell)


def _inset(ax: Axes, cell: Cell) -> None:
    """Bars of KL(simulation || law), the sampling floor as a line."""
    names = list(cell.scores)
    at = FIGURES.index("kl")
    inset = ax.inset_axes((0.72, 0.42, 0.28, 0.52))
    values = [max(float(cell.scores[name].figures[at]), 1e-5) for name in names]
    inset.bar(np.arange(len(names)), values, color=[_colour(name)[0] for name in names], width=0.75)
    inset.axhline(float(cell.scores["mars_exact"].floors[:, at].mean()), color=INK, lw=0.6, ls=":")
    inset.set(yscale="log", ylim=(1e-5, 100.0), xticks=[], yticks=[1e-4, 1e-2, 1.0])
    inset.minorticks_off()
    inset.tick_params(labelsize=5.5)
    inset.set_title("KL, nats (dots: floor)", fontsize=6.0)


def shapes(settings: Settings, cells: Sequence[Cell], sweep: dict[str, FloatArray]) -> Figure:
    """Total variation of the shape over the dead time: lines to the exact law, dots to the simulation."""
    figure, axes = panels(2.9, 1, 2, sharey=True)
    dead = np.array(settings.dead_sweep)
    grid = [cell for cell in cells if cell.grid == "wide"]
    ticks = sorted({cell.dead_ns for cell in grid})
    for ax, quantile, words in zip(axes[0], (0.5, 0.95), ("median of the cells", "95 % of the cells"), strict=True):
        for name in SHAPES:
            colour, dash, _ = _colour(name)
            ax.plot(dead, np.quantile(sweep[name], quantile, axis=1), dash, color=colour, lw=1.0, label=SHAPES[name])
        sampled = [name for name in grid[0].scores if name not in _LINES]
        labels = {"mars_exact": "MaRS, ours, to simulation", "neural": "neural, to simulation"}
        labels |= {name: f"{', '.join(sampled)}: samples" for name in sampled[:1]}
        for name in grid[0].scores:
            at = [[c.scores[name].shape for c in grid if c.dead_ns == d] for d in ticks]
            here = [float(np.quantile(values, quantile)) for values in at]
            marker = "s" if name == "mars_exact" else "o"
            size = 4.5 if name == "mars_exact" else 2.8
            ax.plot(
                np.array(ticks) / PERIOD_NS,
                here,
                marker,
                ms=size,
                color=_colour(name)[0],
                label=labels.get(name),
                mfc="none" if name == "mars_exact" else None,
                mew=0.8,
            )
        noise = [[c.scores["mars_exact"].shape_floor for c in grid if c.dead_ns == d] for d in ticks]
        ax.plot(
            np.array(ticks) / PERIOD_NS,
            [float(np.quantile(v, quantile)) for v in noise],
            "_",
            ms=9,
            color=MUTED,
            label="sampling floor",
        )
        ax.set(yscale="log", xlabel="$t_d / t_r$", ylim=(1e-6, 1.0))
        ax.set_title(words, loc="left")
    axes[0, 0].set_ylabel("total variation of the shape")
    legend_below(figure, axes[0, :1], 3)
    return figure


PAPER = {  # T1 of arXiv 2512.04924: Wasserstein, KL, mean difference, variance difference
    "poisson": (7966.130, 24.208, 7966.130, 9257.464),
    "renewal": (207.565, 18.821, 207.564, 45.927),
    "neural": (2.337, 0.409, 0.282, 64.558),
    "mars_centre": (0.309, 0.013, 0.269, 1.588),
    "mars_edge": (0.309, 0.013, 0.269, 1.588),
}
PAPER_ROWS = {"Poisson": "poisson", "renewal": "renewal", "Zhang et al.": "neural", "MaRS": "mars_centre"}
OURS = ("mars_exact", "mars_matched")
KL_ABOVE_FLOOR = 0.001  # what ours may have
_ONE_IN_1000 = 3.09  # standard deviations of the average's own noise

# right: in at least RIGHT_CELLS of the cells off by at most this, or by SCORES of the simulation's own errors
RIGHT_MEAN, RIGHT_VARIANCE, RIGHT_SHAPE = 0.01, 0.05, 0.01
RIGHT_CELLS, SCORES = 0.95, 4.0


def average(cells: Sequence[Cell], name: str) -> tuple[list[float], list[float], list[float]]:
    """Of one simulator over cells: figures, their sampling floors, and limits that chance exceeds once in 1000."""
    figures = np.mean([c.scores[name].figures for c in cells], axis=0)
    floors = np.mean([c.scores[name].floors for c in cells], axis=0)  # (resamplings, 4)
    floor = floors.mean(0)
    limit = floor + _ONE_IN_1000 * floors.std(0, ddof=1)
    return figures.tolist(), floor.tolist(), limit.tolist()


def right(cell: Cell, name: str) -> dict[str, bool]:
    """Whether a simulator has the cell's mean, variance and shape right, to the stated thresholds."""
    score = cell.scores[name]
    errors = SCORES * score.noise
    mean, variance = (float(score.figures[FIGURES.index(key)]) for key in ("mean", "variance"))
    return {
        "mean": mean <= max(RIGHT_MEAN * float(cell.exact[0]), errors * cell.mean_error),
        "variance": variance <= max(RIGHT_VARIANCE * float(cell.exact[1]), errors * cell.variance_error),
        "shape": score.shape <= max(RIGHT_SHAPE, 2.0 * score.shape_floor),
    }


def _row(name: str, words: str, cells: Sequence[Cell]) -> dict[str, Any]:
    """What the report says of one simulator on one grid."""
    figures, floor, limit = average(cells, name)
    judged = [right(cell, name) for cell in cells]
    kl, paper = FIGURES.index("kl"), PAPER.get(name, ())
    return {
        "name": name,
        "words": words,
        "figures": figures,
        "floor": floor,
        "limit": limit,
        "shape": float(np.mean([c.scores[name].shape for c in cells])),
        "shape_floor": float(np.mean([c.scores[name].shape_floor for c in cells])),
        "paper": paper,
        "worse": [key for key, own, his in zip(FIGURES, figures, paper, strict=False) if own > his],
        "ours": name in OURS,
        "excess": figures[kl] - floor[kl],
        "allowed": max(KL_ABOVE_FLOOR, limit[kl] - floor[kl]),
        "right": {key: float(np.mean([item[key] for item in judged])) for key in ("mean", "variance", "shape")},
    }


def run(request: Request) -> Facts:
    """All cells, the sweep of shapes, and the figures."""

    settings = QUICK if request.quick else FULL
    cells = compute(settings, request.truth, request.tell)
    sweep = shape_sweep(settings, request.tell)
    first = cells[0].scores
    words = {simulator.name: simulator.words for simulator in simulators(1, 0) if simulator.name in first}
    by_grid = {grid.name: [cell for cell in cells if cell.grid == grid.name] for grid in settings.grids}
    return {
        "s": settings,
        "truth": request.truth,
        "kl_floor": TOL.tail,
        "sampled": [name for name in first if first[name].noise > 1.0],
        "grids": {
            name: [_row(simulator, said, here) for simulator, said in words.items()] for name, here in by_grid.items()
        },
        "keys": FIGURES,
        "rows": [_csv_row(cell) for cell in cells],
        "figures": {
            "panels": law_panels(cells),
            "shape": shapes(settings, cells, sweep),
        },
    }


def _csv_row(cell: Cell) -> Row:
    row: dict[str, object] = {
        **picked(cell, "grid period_ns signal background dead_time_ns=dead_ns"),
        **picked(cell, "simulated_mean=mean simulated_variance=variance"),
        "exact_mean": float(cell.exact[0]),
        "exact_variance": float(cell.exact[1]),
    }
    floor = cell.scores["mars_exact"].floors.mean(0)
    row |= {f"floor_{key}": float(v) for key, v in zip(FIGURES, floor, strict=True)}
    row["floor_shape"] = cell.scores["mars_exact"].shape_floor
    for name, score in cell.scores.items():
        row |= {f"{name}_{key}": float(v) for key, v in zip(FIGURES, score.figures, strict=True)}
        row[f"{name}_shape"] = score.shape
    return row
