"""The verb `inspect`: what a stream tells before anything is assumed of its light, and what does not fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._brief import brief
from mars_lidar.estimate.calibration import Calibration, calibrate
from mars_lidar.estimate.intervals import FloatArray, stream_of
from mars_lidar.estimate.periodicity import other_period
from mars_lidar.estimate.recovery import Recovery, recovery_of
from mars_lidar.timestamps import Timestamps

_SURE = 1e-6  # false-alarm probability of what is told
_ENOUGH = 2000  # registrations that a hold-off must leave
_PARTS = 20
_INTERVAL_BINS = 400


@dataclass(frozen=True, eq=False)
class Inspection:
    """A stream of one pixel, looked at without a model of its light; made by `inspect`.

    Attributes
    ----------
    calibration
        With a free shape: light bin by bin, dead time and jitter by the edge of the recovery (or as given), `Summary`.
    recovery
        Registrations by time since the last one: whether there is more than one dead time. Its `dead_time_ns` is the
        end of the edge, where jitter has blurred it.
    phase_histogram
        (bins,) registrations over the period.
    interval_edges_ns, interval_histogram
        (m + 1,) and (m,): intervals up to a few periods and dead times.
    problems
        What does not fit a free-running pixel with one dead time under periodic light, a sentence each.
    """

    calibration: Calibration
    recovery: Recovery
    phase_histogram: FloatArray
    interval_edges_ns: FloatArray
    interval_histogram: FloatArray
    problems: tuple[str, ...]

    __repr__ = brief


def inspect(times: Timestamps, *, dead_time_ns: float | None = None) -> Inspection:
    """Rates, intervals, dead time and recovery of the stream of one pixel, and what does not fit.

    Parameters
    ----------
    times
        The stream of one pixel: see `calibrate`.
    dead_time_ns
        The dead time, ns, where it is known; default: estimated, even where the stream tells its system.
    """
    if not isinstance(times, Timestamps):
        raise TypeError(f"times must be Timestamps, got {type(times).__name__}")
    free = calibrate(_bare(times), pulse="free", dead_time_ns=dead_time_ns)
    stream = stream_of(times)
    longer, kept = 2.0 * free.dead_time_ns, free
    left = sum(int((dt > longer).sum()) for dt in stream.intervals())
    if longer > free.hold_off_ns and left >= max(_ENOUGH, 0.05 * free.armed.used):
        # so that what happens right after the dead time does not pass for light
        kept = calibrate(_bare(times), pulse="free", dead_time_ns=free.dead_time_ns, hold_off_ns=longer)
    # an edge that jitter has blurred is no recovery: ages are judged from where it is over
    edge = free.dead_time_ns if free.jitter_ns == 0.0 else free.hold_off_ns
    found = recovery_of(stream, kept.rate, edge, max(kept.hold_off_ns, edge))
    assert free.waveform is not None
    histogram = stream.histogram(free.waveform.size).astype(np.float64)
    reach = max(4.3 * stream.period_ns, free.dead_time_ns + 3.3 * stream.period_ns)
    edges = np.linspace(0.0, reach, _INTERVAL_BINS + 1)
    apart = np.zeros(_INTERVAL_BINS)
    for dt in stream.intervals():
        apart += np.histogram(dt, edges)[0]
    # a stream that registers nearly as soon as it can repeats with the dead time
    hurried = free.summary.quantiles_ns[1] < 1.2 * free.summary.smallest_ns[0]
    problems = _problems(times, free, found, histogram, None if hurried else other_period(stream))
    return Inspection(free, found, histogram, edges, apart, tuple(problems))


def _bare(times: Timestamps) -> Timestamps:
    """The stream without what it tells of its system: an inspection looks at the photons alone."""
    from dataclasses import replace

    return replace(times, info={name: value for name, value in times.info.items() if name != "system"})


def _problems(
    times: Timestamps, free: Calibration, found: Recovery, histogram: FloatArray, period_ns: float | None
) -> list[str]:
    from scipy.stats import chi2

    told = []
    counted = free.summary
    if "disordered" in times.info:
        told.append(f"{times.info['disordered']:,} times were smaller than the one before in the file: sorted")
    if counted.same_time:
        told.append(
            f"{counted.same_time:,} photons at exactly the time of the one before: several detectors in one channel, "
            "or records that are no photons"
        )
    if free.too_short:
        told.append(
            f"{free.too_short:,} of {counted.registrations:,} intervals are shorter than the dead time of "
            f"{free.dead_time_ns:.5g} ns, the smallest {counted.smallest_ns[0]:.5g} ns: crosstalk, jitter, or a "
            "shorter dead time"
        )
    if period_ns is not None:
        told.append(
            f"the photons repeat every {period_ns:.6g} ns, not every {free.summary.period_ns:.7g} ns: a wrong laser "
            "period, and what else is told follows from it"
        )
    coarse = _coarse(histogram)
    flat = float(((coarse - coarse.mean()) ** 2).sum() / coarse.mean())
    if chi2.sf(flat, coarse.size - 1) > 0.01:
        told.append("the histogram over the period is flat: no signal, or a wrong laser period")
    parts = np.bincount((times.cycle.astype(np.int64) * _PARTS // times.cycles), minlength=_PARTS)[:_PARTS]
    if parts.mean() > 5:
        spread = float(((parts - parts.mean()) ** 2).sum() / parts.mean())
        if chi2.sf(spread, _PARTS - 1) < _SURE:  # dead time makes counts more even than Poisson, never less
            told.append(
                f"the rate is not constant: {parts.min():,} to {parts.max():,} photons in twentieths of the recording"
            )
    told += found.findings()
    blind = float(free.armed.registrations[free.armed.passes <= 0].sum())
    if blind:
        told.append(f"{blind:.0f} photons at phases at which the pixel was never armed")
    return told


def _coarse(histogram: FloatArray) -> FloatArray:
    """At most 64 sums of neighbouring bins of (nearly) equal width."""
    groups = min(64, histogram.size)
    edges = np.linspace(0, histogram.size, groups + 1).astype(int)
    sums = np.add.reduceat(histogram, edges[:-1])
    return np.asarray(sums / np.diff(edges) * (histogram.size / groups), dtype=np.float64)
