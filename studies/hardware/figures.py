"""Figures of the study of hardware."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from mars_lidar.plot.stream import draw_counts, draw_histogram, draw_recovery
from mars_lidar.plot.style import COLOURS, MUTED
from studies.common.draw import panels
from studies.hardware.cases import Case
from studies.hardware.mismatches import TWO_NAME, Mismatch


def pixels(cases: Sequence[Case]) -> Figure:
    """Count law and mean histogram of the matched pixels."""
    figure, axes = panels(4.2, len(cases), 2)
    for row, case in zip(axes, cases, strict=True):
        draw_counts(row[0], case.found)
        draw_histogram(row[1], case.found)
        row[0].set_title(f"{case.name}: {row[0].get_title(loc='left')}", loc="left")
    return figure


def dynamic_range(cases: Sequence[Case]) -> Figure:
    """Calibrated signal over the true one, and total variation over its floor, over the signal."""
    chosen = [case for case in cases if case.name.startswith("dynamic range")]
    signal = np.array([case.truth[0] for case in chosen])
    got = np.array([case.found.calibration.signal for case in chosen])
    error = np.array([case.found.calibration.errors["signal"] for case in chosen])
    rapp = np.array([case.found.calibration.rapp.signal for case in chosen])
    naive = np.array([_naive(case) for case in chosen])
    figure, axes = panels(2.4, 1, 2)
    left, right = axes[0]
    left.axhline(1.0, color=MUTED, lw=0.6)
    bars = {"fmt": ".", "ms": 4, "lw": 0.8, "color": COLOURS[0], "label": "likelihood, 3 s.e."}
    left.errorbar(signal, got / signal, 3 * error / signal, **bars)
    left.plot(signal, rapp / signal, "x", ms=4, color=COLOURS[1], label="Rapp")
    left.plot(signal, naive / signal, "v", ms=3, color=COLOURS[2], label="counts, dead time ignored")
    left.set(xscale="log", xlabel="signal S (photons per period)", ylabel="calibrated S / true S", ylim=(0, 1.25))
    left.legend(frameon=False)
    ratio = np.array([c.found.total_variation / c.found.total_variation_floor[0] for c in chosen])
    high = np.array([c.found.total_variation_floor[1] / c.found.total_variation_floor[0] for c in chosen])
    right.axhline(1.0, color=MUTED, lw=0.6)
    right.plot(signal, high, "_", ms=8, color=MUTED, label="99 % of samples of the law")
    right.plot(signal, ratio, ".", ms=5, color=COLOURS[0], label="stream")
    right.set(xscale="log", xlabel="signal S (photons per period)", ylabel="total variation / floor", ylim=(0, None))
    right.legend(frameon=False)
    return figure


def _naive(case: Case) -> float:
    """Signal as one would read it from the histogram: counts in the window, background by the rest."""
    found = case.found
    inside = found.window
    per_cycle = found.histogram / found.system.cycles
    background = per_cycle[~inside].mean()
    return float((per_cycle[inside] - background).sum())


def recoveries(faults: Sequence[tuple[Mismatch, Case]]) -> Figure:
    """Rate since the last registration of each mismatch, over that of the light."""
    faults, columns = faults[1:], 4  # the second control stands for both
    rows = -(-len(faults) // columns)
    figure, axes = panels(1.15 * rows, rows, columns)
    for ax, (_, case) in zip(axes.flat, faults, strict=False):
        draw_recovery(ax, case.found.recovery)
        drawn = case.found.prediction.recovery
        if drawn is not None:
            ax.stairs(drawn.ratio, drawn.edges_ns, baseline=None, color=COLOURS[2], lw=0.8, zorder=4)
        mark = "fits" if case.found.consistent else "does not fit"
        name = case.name.replace(", sequential engine", "").replace(TWO_NAME, "t_e 85, t_d 50")
        ax.set_title(f"{name}\n({mark})", loc="left", fontsize=5.5)
        ax.set(xlabel="", ylabel="", ylim=(0.0, 1.5))
        ax.tick_params(labelsize=5)
    for ax in list(axes.flat)[len(faults) :]:
        ax.remove()
    for ax in axes[-1]:
        if ax.figure is not None:
            ax.set_xlabel("time since the last one (ns)", fontsize=5.5)
    for ax in axes[:, 0]:
        ax.set_ylabel("rate / light", fontsize=5.5)
    return figure
