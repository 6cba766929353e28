"""Figures of the study of detector modes: histogram, count law and inter-registration times, one figure per mode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.common.draw import legend_below, panels
from studies.detectors.settings import BACKGROUND, DELAY_NS, REACH, SIGNAL, Outcome


def draw_all(outcomes: Sequence[Outcome]) -> dict[str, Figure]:
    """A figure for each group of detectors, the free-running pixel in all of them."""
    groups = dict.fromkeys(each.example.figure for each in outcomes if each.example.figure)
    return {name: _group([each for each in outcomes if each.example.figure in ("", name)]) for name in groups}


def _group(examples: Sequence[Outcome]) -> Figure:
    figure, axes = panels(2.5, 1, 3)
    left_axes, middle, right = axes[0]
    system = examples[0].system
    energy = SIGNAL * system.pulse.bin_energy(DELAY_NS, system.period_ns, system.bins) + BACKGROUND / system.bins
    left_axes.plot(system.time_ns, energy / system.bin_ns, color=INK, lw=0.6, ls=":", label="arrivals")
    for each, colour in zip(examples, [MUTED, *COLOURS], strict=False):
        _histogram(left_axes, each, colour)
        number = np.bincount(each.counts) / each.counts.size
        n = np.flatnonzero(number)
        middle.plot(n, number[n], ".", ms=2.0, color=colour)
        if each.law is not None:
            middle.plot(n, np.pad(each.law, (0, max(0, number.size - each.law.size)))[n], color=colour, lw=0.9)
        edges = np.linspace(0.0, REACH, each.intervals.size + 1)
        right.stairs(np.where(each.intervals > 0, each.intervals, np.nan), edges, color=colour, lw=0.8)
    left_axes.set(xlabel="time in the period, ns", ylabel="registrations per period and ns", yscale="log")
    left_axes.set_title("mean histogram")
    middle.set(xlabel="registrations N in an exposure", ylabel="P(N)")
    middle.set_title("count law")
    right.set(xlabel="periods between registrations", ylabel="intervals per exposure", yscale="log")
    right.set_title("inter-registration times")
    right.set_xlim(0, REACH)
    legend_below(figure, axes.flat, 4)
    return figure


def _histogram(ax: Axes, each: Outcome, colour: str) -> None:
    system = each.system
    scale = 1.0 / (system.cycles * system.bin_ns)
    selected = each.histogram > 0
    ax.plot(system.time_ns[selected][::2], each.histogram[selected][::2] * scale, ".", ms=1.6, color=colour)
    label = each.example.name
    if each.expected is None:
        ax.plot([], [], color=colour, lw=0.9, label=f"{label} (simulated only)")
        return
    inside = each.expected > 1e-9
    gaps = np.where(inside, each.expected * scale, np.nan)
    ax.plot(system.time_ns, gaps, color=colour, lw=0.9, label=label)
