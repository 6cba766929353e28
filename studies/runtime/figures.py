"""Figures of the runtime study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.common.draw import legend_below, panels
from studies.runtime.contenders import NUMPY, TABLED
from studies.runtime.timing import Point, Settings

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
