"""How often and for how long each phase of a stream was watched: all that its likelihood needs.

A free-running pixel with a fixed dead time is a point process whose intensity is known from its past: lambda(x)
while it is armed, 0 while it is blind. All that its likelihood needs are the registrations of each phase and the
time for which each phase was armed (Andersen et al., *Statistical Models Based on Counting Processes*, 1993, II.7).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.intervals import CHUNK, Stream

_COARSE = 1024  # bins of the coarsest light
_ENOUGH = 32  # registrations of a bin that is halved


@dataclass(frozen=True)
class Sensitivity:
    """A sensitivity 1 - e^(-u / r) at a time u after the end of the dead time: `Detector.recovery_ns`.

    The rate is lambda times that (Krause and Walenta, arXiv 2507.10361), so that the likelihood of the light stays the
    same with every pass of a phase weighted by it. A stretch of watching from phase x to phase y, of length L, loses

        int_0^L e^(-u / r) 1{x + u in bin j} du = W_j(x) - e^(-L / r) W_j(y)

    of the bin j, with W_j that of an endless stretch, a geometric sum over periods. So all stretches together cost
    O(n), and a convolution over the bins.
    """

    dead_ns: float
    recovery_ns: float

    def at(self, age_ns: FloatArray) -> FloatArray:
        """Of ages since a registration, beyond the dead time."""
        return np.asarray(-np.expm1((self.dead_ns - age_ns) / self.recovery_ns), dtype=np.float64)

    def lost(
        self, opens: FloatArray, closes: FloatArray, hold_off_ns: float, period_ns: float, bins: int
    ) -> FloatArray:
        """Passes (bins,) that stretches from `hold_off_ns` after a registration on lose."""
        r, width = self.recovery_ns, period_ns / bins
        begin = math.exp((self.dead_ns - hold_off_ns) / r)
        number, faded = np.zeros(bins), np.zeros(bins)  # weights of phases; as they have faded at the end of their bin
        for times, weight in ((opens, np.full(opens.size, begin)), (closes, -begin * np.exp((opens - closes) / r))):
            _, place, part = places(times, period_ns, bins)
            number += np.bincount(place, weight, bins)
            faded += np.bincount(place, weight * np.exp((part - 1.0) * (width / r)), bins)
        # a bin that begins m bins after that of the phase; its own one again after all others
        later = np.exp(-np.roll(np.arange(bins), 1) * (width / r))
        later *= r * math.expm1(-width / r) / math.expm1(-period_ns / r)
        spread = np.fft.irfft(np.fft.rfft(later) * np.fft.rfft(faded), bins)
        return np.asarray((spread + r * (number - faded)) / width, dtype=np.float64)


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
    sensitivity
        By which the passes are weighted, or None.
    """

    registrations: FloatArray
    passes: FloatArray
    used: int
    left_out: int
    hold_off_ns: float
    sensitivity: Sensitivity | None = None

    __repr__ = brief

    @property
    def rate(self) -> FloatArray:
        """Photons per period in each bin (n,), the unrestricted maximum of the likelihood; 0 where never armed.

        The generalised Coates estimate (Gupta, Ingle, Gupta, ICCV 2019) with the armed time measured.
        """
        return np.divide(self.registrations, self.passes, out=np.zeros(self.passes.size), where=self.passes > 0)


def armed_time(stream: Stream, hold_off_ns: float, bins: int, sensitivity: Sensitivity | None = None) -> ArmedTime:
    """Registrations and armed passes by phase; the pixel is watched from `hold_off_ns` after a registration on.

    Any hold-off of at least the true dead time leaves the estimate unbiased; a longer one forgoes data. O(n).
    With `sensitivity` passes count by it; a piece that begins armed begins with all of it.
    """
    events = np.zeros(bins)
    passes = np.zeros(bins)
    used = 0
    for photon, stretches in ((True, _waits(stream, hold_off_ns)), (False, _tails(stream, hold_off_ns))):
        for opens, closes in _gathered(stretches):
            kept = closes > opens
            cycle_a, bin_a, part_a = places(opens[kept], stream.period_ns, bins)
            cycle_b, bin_b, part_b = places(closes[kept], stream.period_ns, bins)
            passes += float((cycle_b - cycle_a).sum()) + begun(bin_b, part_b, 1, bins)[0]
            passes -= begun(bin_a, part_a, 1, bins)[0]
            if sensitivity is not None:
                slow = kept & (opens > 0.0)  # those from 0 on have no registration before
                passes -= sensitivity.lost(opens[slow], closes[slow], hold_off_ns, stream.period_ns, bins)
            if photon:
                events += np.bincount(bin_b, minlength=bins)
                used += bin_b.size
    return ArmedTime(events, passes, used, stream.registrations - used, hold_off_ns, sensitivity)


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


def _gathered(parts: Iterator[tuple[FloatArray, FloatArray]]) -> Iterator[FloatArray]:
    """Small parts joined, so that thousands of short pieces cost no more than a long one."""
    held: list[FloatArray] = []  # (2, n): where they open and close
    size = 0
    for part in parts:
        held.append(np.stack(part))
        size += part[0].size
        if size >= CHUNK:
            yield np.concatenate(held, axis=1)
            held, size = [], 0
    if size:
        yield np.concatenate(held, axis=1)


def fine_light(
    stream: Stream, hold_off_ns: float, bins: int, coarse: int = _COARSE, sensitivity: Sensitivity | None = None
) -> FloatArray:
    """Photons per period (bins,): h / D of `coarse` (1024) bins that are halved where photons abound.

    `bins` are a power of two times `coarse`. A pulse much narrower than a bin of the coarsest grid is seen as it is,
    and faint light does not fall apart into single photons.
    """
    seen = armed_time(stream, hold_off_ns, bins, sensitivity)
    number = min(coarse, bins)
    rate, photons = np.zeros(bins), np.full(number, np.inf)
    while True:
        each = bins // number
        h, passes = seen.registrations.reshape(number, each).sum(1), seen.passes.reshape(number, each).mean(1)
        finer = np.divide(h, passes, out=np.zeros(number), where=passes > 0.0) / each
        kept = np.repeat(photons >= _ENOUGH, number // photons.size)
        rate = np.where(np.repeat(kept, each), np.repeat(finer, each), rate)
        if number == bins:
            return rate
        # what was not halved stays as it is
        photons = np.where(kept, h, 0.0)
        number *= 2


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
