"""Figures of photon streams: what `inspect` and `validate` found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mars_lidar.plot.style import COLOURS, DPI, INK, MUTED, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mars_lidar.calibrate import Inspection, Recovery, Validation

_SHOWN_RATIO = 4.0


def stream_figure(found: Inspection, title: str = "") -> Figure:
    """Intervals, histogram over the period beside the light that made it, and recovery after a photon."""
    with style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10.0, 3.0), dpi=DPI, layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        light = found.calibration
        edges = found.interval_edges_ns
        left.stairs(found.interval_histogram, edges, color=COLOURS[0], fill=True, alpha=0.8)
        left.axvline(light.dead_time_ns, color=COLOURS[1], lw=0.9, label=f"dead time {light.dead_time_ns:.4g} ns")
        left.set(yscale="log", xlabel="time between registrations (ns)", ylabel="intervals", xlim=(0, edges[-1]))
        left.set_title("Intervals", loc="left")
        left.legend(frameon=False)
        _phases(middle, found)
        draw_recovery(right, found.recovery, light.dead_time_ns)
        _tidy(figure, title)
    return figure


def validation_figure(found: Validation, title: str = "") -> Figure:
    """Law of the count and histogram, measured and predicted, and recovery: the picture of a validation."""
    with style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10.0, 3.0), dpi=DPI, layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        draw_counts(left, found)
        draw_histogram(middle, found)
        draw_recovery(right, found.recovery)
        failed = "; ".join(check.name for check in found.failed)
        words = "the model fits" if found.consistent else f"the model does not fit ({failed or 'short intervals'})"
        size = f"{found.realizations:,} realizations of {found.system.cycles:,} cycles"
        _tidy(figure, " · ".join(part for part in (title, size, words) if part))
    return figure


def draw_counts(ax: Axes, found: Validation) -> None:
    """Law of the count, measured and predicted."""
    measured, law = found.measured, found.predicted
    ax.stairs(
        measured.p,
        measured.first - 0.5 + np.arange(measured.p.size + 1),
        color=COLOURS[0],
        fill=True,
        alpha=0.45,
        label="measured",
    )
    shown = law.p > 1e-4 * law.p.max()
    at = law.first + np.arange(law.p.size)
    ax.plot(at[shown], law.p[shown], color=COLOURS[1], lw=1.2, label="predicted")
    low, high = at[shown][0], at[shown][-1]
    ax.set_xlim(min(low, measured.first) - 0.5, max(high, measured.last) + 0.5)
    ax.set(xlabel="registrations of a realization", ylabel="probability", ylim=(0, None))
    ax.set_title(f"Count: TV {found.total_variation:.3g}, floor {found.total_variation_floor[0]:.3g}", loc="left")
    ax.legend(frameon=False)


def draw_histogram(ax: Axes, found: Validation) -> None:
    """Mean histogram, measured and predicted."""
    time = found.system.time_ns
    rows = found.realizations
    ax.plot(time, found.histogram, ".", ms=1.8, color=COLOURS[0], label="measured")
    ax.plot(time, found.histogram_law, color=COLOURS[1], lw=0.8, label="predicted")
    floor = max(0.5 * float(found.histogram_law.min()), 0.5 / rows)
    ax.set(yscale="log", ylim=(floor, None), xlim=(0, found.system.period_ns))
    ax.set(xlabel="time in the laser period (ns)", ylabel="mean counts per bin")
    ax.set_title(f"Histogram: TV {found.shape_variation:.3g}, floor {found.shape_floor:.3g}", loc="left")
    ax.legend(frameon=False)


def draw_recovery(ax: Axes, found: Recovery, dead_time_ns: float | None = None) -> None:
    """Registrations by time since the last one, over the light that fell on the pixel at that age.

    The line is at the dead time; by default where ages are judged from, which is later behind a blurred edge.
    """
    middle = 0.5 * (found.edges_ns[1:] + found.edges_ns[:-1])
    shown = found.expected >= 10
    error = np.sqrt(np.maximum(found.expected, 1.0)) / np.maximum(found.expected, 1.0)
    ratio = np.minimum(np.nan_to_num(found.ratio), _SHOWN_RATIO)
    ax.axhline(1.0, color=MUTED, lw=0.6)
    ax.errorbar(middle[shown], ratio[shown], error[shown], fmt=".", ms=3, lw=0.7, color=COLOURS[0])
    ax.axvline(found.dead_time_ns if dead_time_ns is None else dead_time_ns, color=COLOURS[1], lw=0.9)
    top = float(np.max(ratio[shown] + error[shown], initial=1.2))
    ax.set(xlabel="time since the last registration (ns)", ylabel="rate / light")
    ax.set_ylim(0, min(1.1 * top, _SHOWN_RATIO))
    ax.set_title("Recovery", loc="left")


def _phases(ax: Axes, found: Inspection) -> None:
    light = found.calibration
    bins = found.phase_histogram.size
    period = light.summary.period_ns
    edges = np.linspace(0.0, period, bins + 1)
    width = period / bins
    seen = found.phase_histogram / max(light.summary.cycles * width, 1e-300)
    ax.stairs(seen, edges, color=COLOURS[0], lw=0.7, label="registered")
    if light.waveform is not None:
        ax.stairs(light.waveform / width, edges, color=COLOURS[1], lw=0.7, label="light (dead time removed)")
    ax.set(yscale="log", xlim=(0, period), xlabel="time in the laser period (ns)", ylabel="photons per period and ns")
    ax.set_title("Histogram over the period", loc="left")
    ax.legend(frameon=False)


def _tidy(figure: Figure, title: str) -> None:
    if title:
        figure.suptitle(title, fontsize=8.5, color=INK, x=0.01, ha="left")
