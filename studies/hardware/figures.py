"""Figures of the study of hardware."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mars_lidar.calibration.curves import Realizations
from mars_lidar.plot.style import COLOURS, MUTED
from studies.common.draw import panels
from studies.hardware.cases import Case


def pixels(cases: Sequence[Case]) -> Figure:
    """Law of the count of the matched pixels."""
    figure, axes = panels(2.4, 1, len(cases))
    for ax, case in zip(axes[0], cases, strict=True):
        if case.counts is not None:
            _draw_counts(ax, case.counts, case.name)
    return figure


def dynamic_range(cases: Sequence[Case]) -> Figure:
    """Calibrated over true signal and background, with three stated errors, over the signal."""
    chosen = [case for case in cases if case.name.startswith("S =") and "signal" in case.result.estimates]
    figure, axes = panels(2.4, 1, 2)
    for ax, name, which in zip(axes[0], ("signal", "background"), (0, 1), strict=True):
        true = np.array([case.truth[which] for case in chosen])
        value = np.array([case.result.estimates[name].value for case in chosen])
        error = np.array([case.result.estimates[name].error for case in chosen])
        ax.axhline(1.0, color=MUTED, lw=0.6)
        ax.errorbar([case.truth[0] for case in chosen], value / true, 3 * error / true, fmt=".", ms=4, color=COLOURS[0])
        ax.set(xscale="log", xlabel="signal S (photons per period)", ylabel=f"calibrated / true {name}")
    return figure


def _draw_counts(ax: Axes, drawn: Realizations, name: str) -> None:
    measured, law = drawn.measured, drawn.predicted
    edges = measured.first - 0.5 + np.arange(measured.p.size + 1)
    ax.stairs(measured.p, edges, color=COLOURS[0], fill=True, alpha=0.45, label="recorded")
    ax.plot(law.first + np.arange(law.p.size), law.p, color=COLOURS[1], lw=1.0, label="model")
    ax.set(xlabel="registrations of a realization", ylabel="probability")
    ax.set_title(f"{name}: TV {drawn.total_variation:.3g}, floor {drawn.total_variation_floor[0]:.3g}", loc="left")
    ax.legend(frameon=False)
