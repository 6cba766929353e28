"""Figure of a calibrated photon stream."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from mars_lidar.plot.style import DPI, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mars_lidar.calibration import Calibration
    from mars_lidar.calibration.curves import Curves


def calibration_figure(result: Calibration, title: str = "") -> Figure:
    """Intervals, phases, recovery after a registration, and light by parts of the recording, each with the fit."""
    with style():
        from matplotlib.figure import Figure

        curves = result.curves()
        figure = Figure(figsize=(10.0, 5.4), dpi=DPI, layout="constrained")
        axes = figure.subplots(2, 2)
        _intervals(axes[0, 0], curves, result)
        _phases(axes[0, 1], curves, result)
        _recovery(axes[1, 0], curves, result)
        _parts(axes[1, 1], result)
        words = [part for part in (title, result.verdict) if part]
        figure.suptitle(" · ".join(words), fontsize=8.5, color=INK, x=0.01, ha="left")
    return figure


def _intervals(ax: Axes, curves: Curves, result: Calibration) -> None:
    edges = curves.interval_edges_ns
    _recorded(ax, edges, curves.intervals, curves.fitted_intervals)
    if "dead_time_ns" in result.estimates:
        dead = result.estimates["dead_time_ns"]
        ax.axvline(dead.value, color=MUTED, lw=0.7, label=f"dead time {dead} ns")
    ax.set(yscale="log", xlabel="time between registrations (ns)", ylabel="intervals", xlim=(edges[0], edges[-1]))
    ax.set_ylim(bottom=0.5)
    ax.set_ylim(top=20.0 * ax.get_ylim()[1])  # room for the legend
    ax.set_title("Intervals", loc="left")
    ax.legend(frameon=False, loc="upper right")


def _recorded(ax: Axes, edges: FloatArray, counts: FloatArray, fit: FloatArray | None) -> None:
    ax.stairs(counts, edges, color=COLOURS[0], fill=True, alpha=0.5, label="recorded")
    if fit is not None:
        ax.stairs(fit, edges, color=COLOURS[1], lw=0.9, label="fit")


def _phases(ax: Axes, curves: Curves, result: Calibration) -> None:
    edges = curves.phase_edges_ns
    _recorded(ax, edges, curves.phases, curves.fitted_phases)
    if "background" in result.estimates:
        signal, background = result.estimates["signal"], result.estimates["background"]
        ax.plot([], [], " ", label=f"S {signal}\nB {background}")
    ax.set(yscale="log", xlabel="time in the laser period (ns)", ylabel="registrations", xlim=(0.0, edges[-1]))
    ax.set_title("Phases", loc="left")
    ax.legend(frameon=False)


def _recovery(ax: Axes, curves: Curves, result: Calibration) -> None:
    edges = curves.recovery_edges_ns
    middle = 0.5 * (edges[1:] + edges[:-1])
    ax.axhline(0.0, color=MUTED, lw=0.6)
    if curves.recovery is not None:
        used = np.isfinite(curves.recovery)
        ax.plot(middle[used], curves.recovery[used], ".", ms=3, color=COLOURS[0])
        top = max(4.5, 1.1 * float(np.abs(curves.recovery[used]).max(initial=0.0)))
        ax.set_ylim(-top, top)
    ax.set(xlabel="time since the last registration (ns)", ylabel="(recorded - fit) / sd")
    ax.set_title("Recovery: residuals of the intervals", loc="left")


def _parts(ax: Axes, result: Calibration) -> None:
    drift = result.drift
    ax.set(xlabel="time (s)", ylabel="light (photons per period)")
    ax.set_title("Light by parts of the recording", loc="left")
    if drift is None:
        ax.text(
            0.5, 0.5, "recording too short for parts", ha="center", va="center", color=MUTED, transform=ax.transAxes
        )
        return
    ax.errorbar(drift.times_s, drift.values[:, 0], drift.errors[0], fmt=".", ms=4, lw=0.7, color=COLOURS[0])
    ax.axhline(float(drift.values[:, 0].mean()), color=COLOURS[1], lw=0.9)
