"""How often and for how long each phase of a stream was watched: all that its likelihood needs.

A free-running pixel with a fixed dead time is a point process whose intensity is known from its past: lambda(x)
while it is armed, 0 while it is blind. All that its likelihood needs are the registrations of each phase and the
time for which each phase was armed (Andersen et al., *Statistical Models Based on Counting Processes*, 1993, II.7).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.intervals import CHUNK, Stream


@dataclass(frozen=True, eq=False)
class ArmedTime:
    """Sufficient statistics of the light, whatever its shape.

    Attributes
    ----------
    registrations
        (n,) registrations that found the pixel armed for certain, by phase.
    passes
        (n,) how many times each bin of the period was passed while the pixel was armed (fractions count).
    used, left_out
        Registrations in `registrations`; others: those within the hold-off of the one before, and the first of
        a piece that begins in an unknown state.
    hold_off_ns
        After each registration the pixel is not watched for this long.
    """

    registrations: FloatArray
    passes: FloatArray
    used: int
    left_out: int
    hold_off_ns: float

    __repr__ = brief

    @property
    def rate(self) -> FloatArray:
        """Photons per period in each bin (n,), the unrestricted maximum of the likelihood; 0 where never armed.

        The generalised Coates estimate (Gupta, Ingle, Gupta, ICCV 2019) with the armed time measured.
        """
        seen = self.passes > 0
        return np.where(seen, self.registrations / np.where(seen, self.passes, 1.0), 0.0)


def armed_time(stream: Stream, hold_off_ns: float, bins: int) -> ArmedTime:
    """Registrations and armed passes by phase; the pixel is watched from `hold_off_ns` after a registration on.

    Any hold-off of at least the true dead time leaves the estimate unbiased; a longer one forgoes data. O(n).
    """
    events = np.zeros(bins)
    passes = np.zeros(bins)
    used = 0
    for opens, closes in _gathered(_waits(stream, hold_off_ns)):
        used += _watch(events, passes, opens, closes, stream.period_ns, closed_by_photon=True)
    for opens, closes in _gathered(_tails(stream, hold_off_ns)):
        _watch(events, passes, opens, closes, stream.period_ns, closed_by_photon=False)
    return ArmedTime(events, passes, used, stream.registrations - used, hold_off_ns)


def _waits(stream: Stream, hold_off_ns: float) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Stretches of watching that a registration ended."""
    for piece in stream.pieces:
        t = piece.times_ns
        if piece.armed:
            yield np.zeros(min(t.size, 1)), t[:1]
        for start in range(0, t.size - 1, CHUNK):
            part = t[start : start + CHUNK + 1]
            yield part[:-1] + hold_off_ns, part[1:]


def _tails(stream: Stream, hold_off_ns: float) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Stretches of watching that the end of a piece ended."""
    for piece in stream.pieces:
        t = piece.times_ns
        if t.size:
            yield t[-1:] + hold_off_ns, np.array([piece.end_ns])
        elif piece.armed:
            yield np.zeros(1), np.array([piece.end_ns])


def _gathered(
    parts: Iterator[tuple[FloatArray, FloatArray]],
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Small parts joined, so that thousands of short pieces cost no more than a long one."""
    first: list[FloatArray] = []
    second: list[FloatArray] = []
    size = 0
    for a, b in parts:
        first.append(a)
        second.append(b)
        size += a.size
        if size >= CHUNK:
            yield np.concatenate(first), np.concatenate(second)
            first, second, size = [], [], 0
    if size:
        yield np.concatenate(first), np.concatenate(second)


def _watch(
    events: FloatArray,
    passes: FloatArray,
    opens: FloatArray,
    closes: FloatArray,
    period_ns: float,
    *,
    closed_by_photon: bool,
) -> int:
    """Add the stretches [opens, closes) to `events` and `passes`; returns how many there were."""
    kept = closes > opens
    opens, closes = opens[kept], closes[kept]
    cycle_a, bin_a, part_a = places(opens, period_ns, passes.size)
    cycle_b, bin_b, part_b = places(closes, period_ns, passes.size)
    passes += float((cycle_b - cycle_a).sum()) + begun(bin_b, part_b, 1, passes.size)[0]
    passes -= begun(bin_a, part_a, 1, passes.size)[0]
    if closed_by_photon:
        events += np.bincount(bin_b, minlength=passes.size)
    return int(closes.size)


def places(t: FloatArray, period_ns: float, bins: int) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
    """Laser period, bin, and the part of that bin that is over."""
    x = t / period_ns
    cycle = np.floor(x)
    x -= cycle
    x *= bins
    place = np.minimum(x.astype(np.int64), bins - 1)
    return cycle, place, x - place


def begun(place: NDArray[np.int64], part: FloatArray, groups: int, bins: int) -> FloatArray:
    """How much of each bin lies before the times (place, part) of a period, added up for each group (groups, bins).

    `place` counts the bins of all groups, those of the first one first.
    """
    number = np.bincount(place, minlength=groups * bins).reshape(groups, bins)
    later = number.sum(1, keepdims=True) - np.cumsum(number, axis=1)
    within = np.bincount(place, part, minlength=groups * bins).reshape(groups, bins)
    return np.asarray(later + within, dtype=np.float64)
