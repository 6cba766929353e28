"""Figures of the count-law study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mars_lidar import Flux, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS, INK, MUTED
from mars_lidar.statistics import exposure_moments
from studies.common.draw import legend_below, panels
from studies.common.sample import PERIOD_NS
from studies.count_law.cells import FIGURES, SHAPES, Cell, Settings
from studies.neural.simulators import arrival_shape

PANELS = ((0.07, 0.07, 25.0), (0.5, 0.5, 50.0), (4.0, 0.5, 75.0), (10.0, 10.0, 100.0))  # nearest cells are drawn
HISTOGRAM = (2.0, 1.0, 0.6375)  # S, B in photons per period, dead time in periods
HISTOGRAM_CYCLES = 20_000
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


def dead_time(settings: Settings, truth: str) -> Figure:
    """One exposure of one pixel before and after dead time, with the expectations."""
    signal, background, dead = HISTOGRAM
    system = settings.system(PERIOD_NS, dead * PERIOD_NS).replace(cycles=HISTOGRAM_CYCLES)
    flux = Flux(signal, background, 0.5 * PERIOD_NS)
    seed = settings.seed << 16
    before = simulate(flux, system, engine="poisson", seed=seed)[0, 0, 0]
    after = simulate(flux, system, engine=truth, seed=seed + 1)[0, 0, 0]
    arrivals = system.cycles * (signal + background) * arrival_shape(flux, system)
    registered = exposure_moments(flux, system).histogram
    time_ns = (np.arange(system.bins) + 0.5) * (PERIOD_NS / system.bins)
    figure, axes = panels(2.6, 1, 2, sharex=True)
    for ax, counts, mean, words in (
        (axes[0, 0], before, arrivals, "before: arrivals"),
        (axes[0, 1], after, registered, f"after, $t_d$ = {dead:g} $t_r$: registrations"),
    ):
        ax.step(time_ns, counts, where="mid", color=MUTED, lw=0.5, label="one exposure")
        ax.plot(time_ns, mean, color=COLOURS[1], lw=0.8, label="expectation")
        ax.set(yscale="log", xlabel="time in the period, ns", ylim=(0.3, 3.0 * float(before.max())))
        ax.set_title(f"{words}, N = {int(counts.sum())}", loc="left")
    axes[0, 0].set_ylabel("counts per bin")
    axes[0, 0].legend(frameon=False, loc="upper left")
    return figure
