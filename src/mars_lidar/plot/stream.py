"""Figure of a calibrated photon stream."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from mars_lidar.plot.style import DPI, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mars_lidar.calibration import Calibration
    from mars_lidar.calibration.recording import Recording


_PHOTONS = 4.0  # of the model's streams, over those of the recording


class _Histogram(NamedTuple):
    """Recorded counts (cells,), and those expected by the fit, whose streams count 1 / `scale` times as many."""

    edges: FloatArray
    recorded: FloatArray
    expected: FloatArray | None = None
    scale: float = 1.0


def calibration(result: Calibration, title: str = "") -> Figure:
    """Draw the result of `calibrate`: recorded intervals, phases, recovery and light by parts, each with the fit.

    Parameters
    ----------
    result
        Of `mars_lidar.calibrate`; with ``look=True`` without a fit, recovery and parts.
    title
        Words before the verdict, such as the name of the recording.

    Returns
    -------
    matplotlib.figure.Figure
        ``figure.savefig(path)`` writes it.

    Raises
    ------
    TypeError
        `result` is not a `Calibration`.

    See Also
    --------
    mars_lidar.calibrate, pixel_histogram

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=5000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=0.3), detector=ml.Detector(dead_time_ns=50.0),
    ... )
    >>> times = ml.simulate_timestamps(ml.Flux(0.4, 0.15, 30.0), system, seed=1)
    >>> figure = ml.plot.calibration(ml.calibrate(times))
    >>> len(figure.axes)
    4
    """
    from mars_lidar.calibration import Calibration

    if not isinstance(result, Calibration):
        raise TypeError(f"result must be a Calibration, the result of calibrate, got {type(result).__name__}")
    with style():
        from matplotlib.figure import Figure

        intervals, phases, ages = _histograms(result)
        rows = 1 if result.fitted is None else 2
        figure = Figure(figsize=(10.0, 2.7 * rows), dpi=DPI, layout="constrained")
        axes = figure.subplots(rows, 2, squeeze=False)
        _intervals(axes[0, 0], intervals, result)
        _phases(axes[0, 1], phases, result)
        if ages.expected is not None:
            _recovery(axes[1, 0], ages, ages.expected)
            _parts(axes[1, 1], result)
        words = [part for part in (title, result.verdict) if part]
        figure.suptitle(" · ".join(words), fontsize=8.5, color=INK, x=0.01, ha="left")
    return figure


def _histograms(result: Calibration, intervals: int = 200, phases: int = 256, ages: int = 60) -> list[_Histogram]:
    """Histograms of the intervals, of the phases, and of the intervals near the dead time, in so many cells."""
    from mars_lidar.calibration.fit import LIGHTS, Effort

    recording, fit = result.recording, result.fitted
    period, unit = recording.period_ns, recording.clock.unit_ns

    def counted(times: Recording) -> list[FloatArray]:
        phase = times.times - np.floor(times.times / period) * period
        samples = times.intervals, phase, times.intervals
        return [np.histogram(x, at)[0].astype(float) for x, at in zip(samples, edges, strict=True)]

    low, high, top = np.quantile(recording.intervals, (0.0005, 0.5, 0.99))
    near = _edges(max(low - 0.1 * (high - low), 0.0), high + (high - low), ages, unit)
    edges = [_edges(0.0, 1.05 * top, intervals, unit), np.linspace(0.0, period, phases + 1), near]
    recorded = counted(recording)
    if fit is None:
        return [_Histogram(*each) for each in zip(edges, recorded, strict=True)]
    photons = min(_PHOTONS * recording.photons, Effort.batch)
    cycles = max(2, round(recording.exposure * photons / recording.photons / LIGHTS))
    scale = recording.exposure / (cycles * LIGHTS)
    expected = [scale * counts for counts in counted(fit.model.streams(np.tile(fit.theta, (LIGHTS, 1)), cycles, 0))]
    return [_Histogram(*each, scale) for each in zip(edges, recorded, expected, strict=True)]


def _edges(low: float, high: float, number: int, unit: float) -> FloatArray:
    """Edges of cells, between the units of a clock."""
    edges = np.linspace(low, high, number + 1)
    if unit == 0.0:
        return edges
    whole = np.unique((np.floor(edges / unit) + 0.5) * unit)
    return np.asarray(whole if whole.size > 2 else np.array([-0.5, 0.5, 1.5]) * unit)


def _intervals(ax: Axes, counts: _Histogram, result: Calibration) -> None:
    _stairs(ax, counts)
    if "dead_time_ns" in result.estimates:
        dead = result.estimates["dead_time_ns"]
        ax.axvline(dead.value, color=MUTED, lw=0.7, label=f"dead time, ns: {dead.short}")
    ax.set(yscale="log", xlabel="time between registrations (ns)", ylabel="intervals", xlim=counts.edges[[0, -1]])
    ax.set_ylim(bottom=0.5)
    ax.set_ylim(top=20.0 * ax.get_ylim()[1])  # room for the legend
    ax.set_title("Intervals", loc="left")
    ax.legend(frameon=False, loc="upper right")


def _stairs(ax: Axes, counts: _Histogram) -> None:
    ax.stairs(counts.recorded, counts.edges, color=COLOURS[0], fill=True, alpha=0.5, label="recorded")
    if counts.expected is not None:
        ax.stairs(counts.expected, counts.edges, color=COLOURS[1], lw=0.9, label="fit")


def _phases(ax: Axes, counts: _Histogram, result: Calibration) -> None:
    _stairs(ax, counts)
    if "background" in result.estimates:
        signal, background = result.estimates["signal"], result.estimates["background"]
        ax.plot([], [], " ", label=f"S {signal.short}\nB {background.short}")
    ax.set(yscale="log", xlabel="time in the laser period (ns)", ylabel="registrations", xlim=counts.edges[[0, -1]])
    ax.set_title("Phases", loc="left")
    ax.legend(frameon=False)


def _recovery(ax: Axes, counts: _Histogram, expected: FloatArray) -> None:
    used = expected >= 3.0
    residual = (counts.recorded - expected)[used] / np.sqrt(expected[used] * (1.0 + counts.scale))
    ax.axhline(0.0, color=MUTED, lw=0.6)
    ax.plot(0.5 * (counts.edges[1:] + counts.edges[:-1])[used], residual, ".", ms=3, color=COLOURS[0])
    top = max(4.5, 1.1 * float(np.abs(residual).max(initial=0.0)))
    ax.set(ylim=(-top, top), xlabel="time since the last registration (ns)", ylabel="(recorded - fit) / sd")
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
