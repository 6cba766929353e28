"""What a stream tells without a model: its intervals, and how often and for how long each phase was watched.

A free-running pixel with a fixed dead time is a point process whose intensity is known from its past: lambda(x)
while it is armed, 0 while it is blind. All that its likelihood needs are the registrations of each phase and the
time for which each phase was armed (Andersen et al., *Statistical Models Based on Counting Processes*, 1993, II.7).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._brief import brief
from mars_lidar.timestamps import Timestamps

FloatArray = NDArray[np.float64]

_CHUNK = 2**19  # registrations at a time: some ten temporaries stay in the cache of a processor
_DITHER_SEED = 1
_OWN_UNITS = (2**15, 2**16)  # at most, in the period: our PTU and Photon-HDF5
_PROBED = 1000


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of uninterrupted recording of one pixel.

    `times_ns` (n,) sorted, from 0 at a laser pulse to `end_ns`; `armed` tells that the pixel was ready at 0.
    """

    times_ns: FloatArray
    end_ns: float
    armed: bool


@dataclass(frozen=True, eq=False)
class Stream:
    """Pieces of the stream of one pixel, and its clock.

    `bins` the stream's own bins per period; `unit_ns` the resolution of its clock, 0 where it is not known or finer
    than anything that matters; `units` how many of them make up the period, 0 where times are not whole units.
    """

    pieces: tuple[Piece, ...]
    period_ns: float
    cycles: int
    bins: int
    unit_ns: float
    units: int

    @property
    def registrations(self) -> int:
        """In all pieces."""
        return sum(piece.times_ns.size for piece in self.pieces)

    def intervals(self) -> Iterator[FloatArray]:
        """Times between successive registrations, ns, in bounded parts."""
        for piece in self.pieces:
            for start in range(0, piece.times_ns.size - 1, _CHUNK):
                yield np.diff(piece.times_ns[start : start + _CHUNK + 1])

    def phases(self) -> Iterator[FloatArray]:
        """Times since the laser pulse in periods, in bounded parts."""
        for piece in self.pieces:
            for start in range(0, piece.times_ns.size, _CHUNK):
                x = piece.times_ns[start : start + _CHUNK] / self.period_ns
                yield x - np.floor(x)

    def histogram(self, bins: int) -> NDArray[np.int64]:
        """Registrations (bins,) over the period."""
        total = np.zeros(bins, np.int64)
        for phase in self.phases():
            total += np.bincount(np.minimum((phase * bins).astype(np.int64), bins - 1), minlength=bins)
        return total


def stream_of(times: Timestamps | Sequence[Timestamps], *, pooled: bool = False) -> Stream:
    """The stream of one pixel, from a recording or a sequence of recordings of that pixel.

    `pooled`: the pixels of an image are recordings of one and the same pixel. Where the clock's unit does not
    divide the period into whole bins, times are spread evenly over their unit (seeded), which is what they are:
    otherwise some bins would hold a unit more than others.
    """
    parts = [times] if isinstance(times, Timestamps) else list(times)
    if not parts or not all(isinstance(part, Timestamps) for part in parts):
        raise TypeError(f"times must be Timestamps or a sequence of them, got {type(times).__name__}")
    first = parts[0]
    if not (first.period_ns > 0 and math.isfinite(first.period_ns)):
        raise ValueError(f"times must tell the laser period, got period_ns {first.period_ns}")
    unit, units = _clock(first)
    random = np.random.default_rng(_DITHER_SEED)
    pieces: list[Piece] = []
    for part in parts:
        if part.period_ns != first.period_ns or part.bins != first.bins:
            raise ValueError(
                f"times must share period and bins, got {first.period_ns:g} ns with {first.bins} and "
                f"{part.period_ns:g} ns with {part.bins}"
            )
        pixels = part.shape[0] * part.shape[1]
        if pixels > 1 and not pooled:
            raise ValueError(
                f"times must be of one pixel, got {part.shape[0]} x {part.shape[1]}: choose one with "
                "times.pixel(y, x), or give pooled=True where all are recordings of the same pixel"
            )
        armed = part.system is not None and part.system.start == "armed"
        for k in range(pixels):
            t = part.times_ns[part.offsets[k] : part.offsets[k + 1]]
            if unit and not units:
                spread = unit * (random.random(t.size) - 0.5)
                t = np.sort(np.clip(t + spread, 0.0, None))
            end = max(part.cycles * part.period_ns, float(t[-1]) if t.size else 0.0)
            pieces.append(Piece(t, end, armed))
    cycles = sum(part.cycles * part.shape[0] * part.shape[1] for part in parts)
    return Stream(tuple(pieces), first.period_ns, cycles, first.bins, unit, units)


def _clock(times: Timestamps) -> tuple[float, int]:
    """Unit of the clock, ns, and the units of a period, where they are whole and whole in every bin."""
    unit = float(times.info.get("unit_ns", 0.0))
    if unit == 0.0:
        units = _own_units(times)
        return (times.period_ns / units, units) if units else (0.0, 0)
    number = times.period_ns / unit
    whole = round(number)
    return unit, whole if abs(number - whole) < 1e-4 and whole % times.bins == 0 else 0


def _own_units(times: Timestamps) -> int:
    """Units of a period of a simulated stream that was read back: its times are the middles of units, all of them."""
    x = times.times_ns[:_PROBED] / times.period_ns
    x = x - np.floor(x)
    for most in _OWN_UNITS:
        units = most // times.bins * times.bins
        if units and x.size >= 20 and (np.abs(x * units % 1.0 - 0.5) < 1e-3).all():
            return units
    return 0


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
        for start in range(0, t.size - 1, _CHUNK):
            part = t[start : start + _CHUNK + 1]
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
        if size >= _CHUNK:
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
    passes += float((cycle_b - cycle_a).sum()) + _begun(bin_b, part_b, passes.size)
    passes -= _begun(bin_a, part_a, passes.size)
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


def _begun(place: NDArray[np.int64], part: FloatArray, bins: int) -> FloatArray:
    """How much of each bin lies before the times (place, part) of a period, added up (bins,)."""
    number = np.bincount(place, minlength=bins)
    later = number.sum() - np.cumsum(number)
    return np.asarray(later + np.bincount(place, part, minlength=bins), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Summary:
    """A stream in numbers, without any model of the light.

    Attributes
    ----------
    registrations, cycles, period_ns, unit_ns, bins
        Sizes and clock; `unit_ns` is 0 where the file does not tell its resolution.
    smallest_ns
        The smallest intervals (up to 20) in ascending order, ns.
    quantiles_ns
        Intervals at 1, 50 and 99 %.
    same_time
        Intervals of 0: two records at one time, which no detector makes.
    """

    registrations: int
    cycles: int
    period_ns: float
    unit_ns: float
    bins: int
    smallest_ns: FloatArray
    quantiles_ns: FloatArray
    same_time: int

    __repr__ = brief

    @property
    def rate_per_s(self) -> float:
        """Registrations per second."""
        return self.registrations / (1e-9 * self.period_ns * self.cycles)

    @property
    def per_period(self) -> float:
        """Registrations per laser period."""
        return self.registrations / self.cycles


def summary(times: Timestamps | Sequence[Timestamps], *, pooled: bool = False) -> Summary:
    """Rates and intervals of a stream of one pixel (see `calibrate` for the arguments)."""
    return summary_of(stream_of(times, pooled=pooled))


def summary_of(stream: Stream) -> Summary:
    """`summary` of a stream that is at hand."""
    smallest = np.empty(0)
    sample = []
    same = 0
    for dt in stream.intervals():
        same += int((dt == 0.0).sum())
        head = np.partition(dt, 19)[:20] if dt.size > 20 else dt
        smallest = np.sort(np.concatenate([smallest, head]))[:20]
        sample.append(dt[:: max(1, stream.registrations // 10**6)])
    kept = np.concatenate(sample) if sample else np.empty(0)
    quantiles = np.quantile(kept, (0.01, 0.5, 0.99)) if kept.size else np.full(3, math.nan)
    return Summary(
        stream.registrations, stream.cycles, stream.period_ns, stream.unit_ns, stream.bins, smallest, quantiles, same
    )
