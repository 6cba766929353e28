"""Figures of the study of validity."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.common.draw import legend_below, maps, panels
from studies.count_law.settings import LAWS, Cell, Settings

_LOW, _HIGH = 3e-3, 1.0  # total variation on the colour scales
_LOW_EXACT = 1e-3  # where there is no sampling noise
# law: colour, dash, width; drawn in this order, those that may coincide thick under thin
_LINES = {
    "gaussian": (COLOURS[5], "-", 2.4),
    "mars": (COLOURS[1], "-", 0.9),
    "renewal": (COLOURS[2], ":", 1.0),
}
Value = Callable[[Cell], float]


def _row(
    settings: Settings, cells: Sequence[Cell], kind: str, value: Value
) -> tuple[Sequence[float], list[list[list[float]]]]:
    """Maps of a value for each dead time: S along x; B or cycles along y, whose points come first."""
    y = settings.background if kind == "flux" else settings.cycles
    by = {(c.dead, c.signal, c.background if kind == "flux" else c.cycles): value(c) for c in cells}
    return y, [[[by[dead, s, b] for s in settings.signal] for b in y] for dead in settings.dead]


def _titles(settings: Settings) -> list[str]:
    return [f"$t_d$ = {dead:g} $t_r$" for dead in settings.dead]


def rows(settings: Settings, cells: Sequence[Cell], kind: str) -> Figure:
    """Total variation to simulation: rows for the sampling floor and each law, columns for dead times."""
    lines: list[tuple[str, Value]] = [("sampling floor", lambda cell: cell.floor)]
    lines += [(words, lambda cell, name=name: cell.to_simulation[name]) for name, words in LAWS.items()]  # type: ignore[misc]
    name = "B" if kind == "flux" else "cycles"
    images = {f"{words}\n{name}": _row(settings, cells, kind, value) for words, value in lines}
    label = "total variation to simulation"
    return maps(8.4, settings.signal, images, _titles(settings), LogNorm(_LOW, _HIGH), label)[0]


def gaussian(settings: Settings, flux: Sequence[Cell], exposure: Sequence[Cell]) -> Figure:
    """Where the Gaussian breaks: its distance to the exact law, without noise, and why."""
    kinds = {"B": ("flux", flux), "cycles": ("exposure", exposure)}
    images = {
        name: _row(settings, cells, kind, lambda cell: cell.to_exact["gaussian"])
        for name, (kind, cells) in kinds.items()
    }
    norm, label = LogNorm(_LOW_EXACT, _HIGH), "total variation,\nbest Gaussian to exact law"
    figure, axes, _ = maps(3.3, settings.signal, images, _titles(settings), norm, label)
    for row, (kind, cells) in zip(axes, kinds.values(), strict=True):
        for cell in cells:
            y = cell.background if kind == "flux" else cell.cycles
            mark = "." if cell.cumulants[0] < 10.0 else "_" if cell.cumulants[1] < 1.0 else ""
            if mark:
                # dark on pale, pale on dark
                colour = COLOURS[0] if cell.to_exact["gaussian"] < 0.05 else COLOURS[5]
                ax = row[settings.dead.index(cell.dead)]
                ax.plot(cell.signal, y, mark, ms=2.4, color=colour, mew=0.8)
    for mark, words in ((".", "E N < 10"), ("_", "E N at least 10, Var N < 1")):
        axes[0, 0].plot([], [], mark, ms=4, color=COLOURS[0], label=words)
    legend_below(figure, axes[0, :1], 2)
    return figure


def examples(cells: Sequence[Cell]) -> Figure:
    """Count laws of a few cells beside the simulated frequencies."""
    figure, axes = panels(3.9, 2, len(cells) // 2)
    for ax, cell in zip(axes.flat, cells, strict=False):
        # around the mean: what holds the law, at least two counts
        reach = max(4.5 * float(cell.cumulants[1]) ** 0.5, 2.5)
        low = max(0, int(np.floor(cell.cumulants[0] - reach)))
        high = int(np.ceil(cell.cumulants[0] + reach))
        counts = np.arange(low, high + 1)
        ax.bar(counts, cell.sample.on(low, high), width=1.0, color="#d9d9d9", label="simulation")
        ax.plot(counts, cell.laws["exact"].on(low, high), "o-", ms=2.2, lw=0.8, color=INK, label="exact")
        for name, (colour, dash, width) in _LINES.items():
            ax.plot(counts, cell.laws[name].on(low, high), ls=dash, lw=width, color=colour, label=LAWS[name])
        ax.set_xlim(low - 0.7, high + 0.7)
        ax.set_ylim(0.0, 1.12 * float(max(cell.laws["exact"].p.max(), cell.sample.p.max())))
        ax.xaxis.get_major_locator().set_params(integer=True, nbins=5)
        ax.ticklabel_format(axis="x", useOffset=False)
        ax.set_title(
            f"S = {cell.signal:.3g}, B = {cell.background:.3g}, $t_d$ = {cell.dead:g} $t_r$\n"
            f"{cell.cycles} cycles, TV of the Gaussian {cell.to_exact['gaussian']:.3f}",
            loc="left",
            fontsize=6.5,
        )
    for ax in axes[-1]:
        ax.set_xlabel("registrations N")
    for row in axes:
        row[0].set_ylabel("P(N)")
    legend_below(figure, axes[0, :1], 5)
    return figure


def floors(cells: Sequence[Cell]) -> Figure:
    """Distance to simulation over the sampling floor, against the spread of the count."""
    figure, axes = panels(2.3, 1, 4, sharex=True, sharey=True)
    spread = np.array([np.sqrt(cell.cumulants[1]) for cell in cells])
    floor = np.array([max(cell.floor, 1e-12) for cell in cells])
    limit = np.array([cell.limit for cell in cells])
    for k, (ax, name) in enumerate(zip(axes[0], ("exact", "gaussian", "mars", "mars_edge"), strict=True)):
        ratio = np.array([cell.to_simulation[name] for cell in cells]) / floor
        selected = floor > 1e-6
        ax.plot(
            spread[selected], limit[selected] / floor[selected], ".", ms=2, color=MUTED, mew=0, label="99.9 % limit"
        )
        ax.plot(spread[selected], ratio[selected], "o", ms=2.2, color=COLOURS[k], mew=0, alpha=0.7)
        ax.axhline(1.0, color=INK, lw=0.6)
        ax.set(xscale="log", yscale="log", xlabel="sd of N", ylim=(0.2, 300))
        ax.set_title(LAWS[name], loc="left")
    axes[0, 0].set_ylabel("total variation / floor")
    axes[0, 0].legend(frameon=False, loc="upper left", markerscale=4, handletextpad=0.2)
    return figure
