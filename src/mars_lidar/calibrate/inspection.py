"""The verb `inspect`: what a stream tells before anything is assumed of its light, and what does not fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import armed_time
from mars_lidar.calibrate.calibration import Calibration, calibrate
from mars_lidar.calibrate.calibration_pass import CERTAIN, Watch, fitted
from mars_lidar.calibrate.intervals import Stream, stream_of
from mars_lidar.calibrate.periodicity import other_period
from mars_lidar.calibrate.recovery import Recovery, recovery_of
from mars_lidar.calibrate.same_phase import departure_of, too_coarse
from mars_lidar.calibrate.slow_recovery import SlowRecovery, slow_recovery
from mars_lidar.calibrate.unknowns import told
from mars_lidar.light.timestamps import Timestamps

_SURE = 1e-6  # false-alarm probability of what is told
_FLAT = 0.01  # probability of light as uneven, or more, by chance, above which it is called flat
_ENOUGH = 2000  # registrations that a hold-off must leave
_PARTS, _PIECES = 20, 25  # of the recording, and of each part of it
_LEAST = 10.0  # photons of a piece
_GROUPS = 64  # of the period
_INTERVAL_BINS = 400
_MOST_CELLS = 2**16  # of the period, for photons that share a unit of the clock
_TWICE = 2.0  # smallest intervals: a second dead time, of the detector, is at most that of its electronics
_NARROW = 0.1  # of the dead time: what a jitter that hides may explain
_SAME_EDGE = 5.0  # standard errors within which a given dead time is that of the edge


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
        What does not fit a free-running pixel with one dead time under periodic light, a sentence each. An ideal
        stream, of whatever light, jitter, clock and dead time, is told one with a probability of 1e-4 at most.
    unknown
        What the stream cannot tell, a sentence each.
    slow
        The exponential recovery of the sensitivity, where the rate after the dead time is below the light's and such a
        recovery fits it.
    """

    calibration: Calibration
    recovery: Recovery
    phase_histogram: FloatArray
    interval_edges_ns: FloatArray
    interval_histogram: FloatArray
    problems: tuple[str, ...]
    unknown: tuple[str, ...] = ()
    slow: SlowRecovery | None = None

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
    stream = stream_of(times)
    free = calibrate(_bare(times), pulse="free", dead_time_ns=dead_time_ns)
    if dead_time_ns is not None and free.too_short:
        free = _with_jitter(times, stream, free)
    longer, kept = 2.0 * free.dead_time_ns, free
    left = sum(int((dt > longer).sum()) for dt in stream.intervals())
    if longer > free.hold_off_ns and left >= max(_ENOUGH, 0.05 * free.armed.used):
        # so that what happens right after the dead time does not pass for light
        kept = calibrate(_bare(times), pulse="free", dead_time_ns=free.dead_time_ns, hold_off_ns=longer)
    # an edge that jitter has blurred is no recovery: ages are judged from where it is over
    edge = free.dead_time_ns if free.jitter_ns == 0.0 else free.hold_off_ns
    found = recovery_of(stream, kept.rate, edge, max(kept.hold_off_ns, edge))
    judged = None if too_coarse(stream, kept.rate) else departure_of(stream, free)
    found = replace(found, judged=judged)
    assert free.waveform is not None
    histogram = stream.histogram(free.waveform.size).astype(np.float64)
    reach = max(4.3 * stream.period_ns, free.dead_time_ns + 3.3 * stream.period_ns)
    edges = np.linspace(0.0, reach, _INTERVAL_BINS + 1)
    apart = np.zeros(_INTERVAL_BINS)
    for dt in stream.intervals():
        apart += np.histogram(dt, edges)[0]
    # a stream that registers nearly as soon as it can repeats with the dead time
    low, middle, _ = free.summary.quantiles_ns
    hurried = middle < 1.2 * max(low, free.summary.smallest_ns[0])
    slow = slow_recovery(stream, dead_time_ns) if found.judged is not None and found.departure_ends_ns else None
    if slow is not None and not free.edge_fits:  # the light as a pixel sees it that recovers so
        error = slow.dead_time_error_ns
        watch = Watch(
            slow.dead_time_ns, slow.dead_time_ns, dead_error_ns=error, by="recovery", recovery_ns=slow.recovery_ns
        )
        free = told(fitted(stream, free.summary, "free", watch, 1), edge=False)
    problems, unknown = _problems(times, stream, free, found, slow, None if hurried else other_period(stream))
    return Inspection(free, found, histogram, edges, apart, tuple(problems), tuple(unknown), slow)


def _with_jitter(times: Timestamps, stream: Stream, free: Calibration) -> Calibration:
    """With the jitter of an edge whose middle is the given dead time, where that is what makes intervals shorter."""
    edge = calibrate(_bare(times), pulse="free")
    off = abs(edge.dead_time_ns - free.dead_time_ns)
    if not off < _SAME_EDGE * edge.dead_time_error_ns + stream.unit_ns:
        return free
    if edge.jitter_ns == 0.0:  # one that hides makes some intervals shorter too
        reach = CERTAIN * edge.jitter_limit_ns
        explained = reach < _NARROW * free.dead_time_ns and edge.summary.smallest_ns[0] > free.dead_time_ns - reach
        return replace(free, too_short=0) if explained else free
    hold = free.dead_time_ns + CERTAIN * edge.jitter_ns
    watch = Watch(free.dead_time_ns, hold, edge.jitter_ns, edge.jitter_error_ns)
    return fitted(stream, free.summary, "free", watch, 1)


def _bare(times: Timestamps) -> Timestamps:
    """The stream without what it tells of its system: an inspection looks at the photons alone."""
    return replace(times, info={name: value for name, value in times.info.items() if name != "system"})


def _problems(
    times: Timestamps,
    stream: Stream,
    free: Calibration,
    found: Recovery,
    slow: SlowRecovery | None,
    period_ns: float | None,
) -> tuple[list[str], list[str]]:
    told = []
    counted = free.summary
    if "disordered" in times.info:
        told.append(f"{times.info['disordered']:,} times were smaller than the one before in the file: sorted")
    if counted.same_time > _shared(stream):
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
    if _flat(free) > _FLAT:
        told.append("the light over the period is flat: no signal is seen, or the laser period is wrong")
    parts, p = _constant(times)
    if p < _SURE:
        told.append(
            f"the rate is not constant: {parts.min():,} to {parts.max():,} photons in twentieths of the recording"
        )
    unknown = list(free.unknown)
    if found.judged is None:
        unknown.append("the recovery is not judged: light of a unit of the clock, which runs free, is too bright")
    elif slow is not None:
        told.append(str(slow))
    elif found.departure_ends_ns > _TWICE * counted.smallest_ns[0]:
        unknown.append(
            f"the rate rises slowly up to {found.departure_ends_ns:.4g} ns after a registration, the shortest of which "
            f"are {counted.smallest_ns[0]:.4g} ns apart: jitter of the size of the dead time, or a slow recovery"
        )
    else:
        told += found.findings()
    return told, unknown


def _flat(free: Calibration) -> float:
    """Probability of light as uneven over the period, or more, if it is constant: of registrations an armed pass."""
    from scipy.stats import chi2

    seen = free.armed
    groups = min(_GROUPS, seen.passes.size)
    starts = np.linspace(0, seen.passes.size, groups + 1).astype(int)[:-1]
    observed, passes = np.add.reduceat(seen.registrations, starts), np.add.reduceat(seen.passes, starts)
    expected = passes * (observed.sum() / max(float(passes.sum()), 1e-300))
    judged = (expected >= 5.0) | (observed >= 10.0)
    if int(judged.sum()) < 2:
        return 0.0
    square = float(((observed - expected)[judged] ** 2 / np.maximum(expected[judged], 1e-300)).sum())
    return float(chi2.sf(square, int(judged.sum()) - 1))


def _constant(times: Timestamps) -> tuple[FloatArray, float]:
    """Photons in twentieths of the recording, and the probability of differences as large in a constant light.

    Dead time makes counts more even than Poisson's as a rule; a pixel that is locked to the laser for a while makes
    them less so. So they are also compared with the differences within each twentieth.
    """
    from scipy.stats import chi2, f

    pieces = int(min(_PIECES, len(times) / (_PARTS * _LEAST)))
    if pieces < 1:
        return np.zeros(_PARTS, np.int64), 1.0
    number = _PARTS * max(pieces, 2)
    cycles = np.maximum(times.cycles - times.cycles % number, number)
    piece = times.cycle.astype(np.int64) * number // cycles
    counts = np.bincount(piece[piece < number], minlength=number).reshape(_PARTS, -1)
    parts = counts.sum(1)
    between = float(((parts - parts.mean()) ** 2).sum())
    p = float(chi2.sf(between / max(parts.mean(), 1e-300), _PARTS - 1))
    within = float(counts.var(axis=1, ddof=1).mean()) * counts.shape[1]
    against = float(f.sf(between / (_PARTS - 1) / max(within, 1e-300), _PARTS - 1, counts.size - _PARTS))
    return parts, max(p, against)


def _shared(stream: Stream) -> float:
    """Photons that may share a unit of the clock with the one before in a pixel without dead time, at most."""
    if stream.unit_ns == 0.0 or stream.same_time == 0:
        return 0.0
    cells = int(min(max(round(stream.period_ns / stream.unit_ns), 1), _MOST_CELLS))
    seen = armed_time(stream, 0.0, cells)
    mean = float((seen.registrations * seen.rate).sum()) * stream.unit_ns * cells / stream.period_ns
    return mean + 5.0 * math.sqrt(mean)
