"""The stream of one pixel: stretches of uninterrupted recording, their intervals and phases, the clock; in numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.light.timestamps import Timestamps

CHUNK = 2**19  # registrations at a time: some ten temporaries stay in the cache of a processor
_DITHER_SEED = 1
_OWN_UNITS = (2**15, 2**16)  # at most, in the period: our PTU and Photon-HDF5
_PROBED = 1000
SHAPE_BINS = 1024  # of a free shape, and of the histogram whose shape Rapp's method fits
_MOST_BINS = 2**15  # of the fine grid, unless the stream has more itself
_BINS_PER_SIGMA = 20  # at which the bins of the fine grid are narrow beside the pulse
_MOST_UNITS = 2**16  # of a period whose units are kept: finer ones are spread, which moves nothing


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
    than anything that matters; `units` how many of them make up the period, 0 where times are not whole units;
    `same_time` how many records are at exactly the time of the one before.
    """

    pieces: tuple[Piece, ...]
    period_ns: float
    cycles: int
    bins: int
    unit_ns: float
    units: int
    same_time: int = 0

    @property
    def registrations(self) -> int:
        """In all pieces."""
        return sum(piece.times_ns.size for piece in self.pieces)

    def intervals(self) -> Iterator[FloatArray]:
        """Times between successive registrations, ns, in bounded parts."""
        for piece in self.pieces:
            for start in range(0, piece.times_ns.size - 1, CHUNK):
                yield np.diff(piece.times_ns[start : start + CHUNK + 1])

    def histogram(self, bins: int) -> NDArray[np.int64]:
        """Registrations (bins,) over the period."""
        total = np.zeros(bins, np.int64)
        for piece in self.pieces:
            for start in range(0, piece.times_ns.size, CHUNK):
                x = piece.times_ns[start : start + CHUNK] / self.period_ns
                place = ((x - np.floor(x)) * bins).astype(np.int64)
                total += np.bincount(np.minimum(place, bins - 1), minlength=bins)
        return total


def stream_of(times: Timestamps | Sequence[Timestamps], *, pooled: bool = False) -> Stream:
    """The stream of one pixel, from a recording or a sequence of recordings of that pixel.

    `pooled`: the pixels of an image are recordings of one and the same pixel. Where the clock's unit does not
    divide the period into whole bins, times are spread evenly over their unit (seeded), which is what they are:
    otherwise some bins would hold a unit more than others.
    """
    parts = [times] if isinstance(times, Timestamps) else list(times) if isinstance(times, Sequence) else []
    if not parts or not all(isinstance(part, Timestamps) for part in parts):
        raise TypeError(f"times must be Timestamps or a sequence of them, got {type(times).__name__}")
    first = parts[0]
    if not (first.period_ns > 0 and math.isfinite(first.period_ns)):
        raise ValueError(f"times must tell the laser period, got period_ns {first.period_ns}")
    unit, units = _clock(first)
    random = np.random.default_rng(_DITHER_SEED)
    pieces: list[Piece] = []
    same = 0
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
            starts = range(0, t.size, CHUNK)
            same += sum(int((np.diff(t[start : start + CHUNK + 1]) == 0.0).sum()) for start in starts)
            if unit and not units:
                spread = unit * (random.random(t.size) - 0.5)
                t = np.sort(np.clip(t + spread, 0.0, None))
            end = max(part.cycles * part.period_ns, float(t[-1]) if t.size else 0.0)
            pieces.append(Piece(t, end, armed))
    cycles = sum(part.cycles * part.shape[0] * part.shape[1] for part in parts)
    return Stream(tuple(pieces), first.period_ns, cycles, first.bins, unit, units, same)


def fine_bins(stream: Stream, pulse: Pulse | None) -> int:
    """The stream's bins times a power of two: narrow beside the pulse, but no more than is useful."""
    wanted = 2048.0
    if isinstance(pulse, GaussianPulse):
        wanted = _BINS_PER_SIGMA * stream.period_ns / pulse.sigma_ns
    elif isinstance(pulse, SampledPulse):
        wanted = 4.0 * stream.period_ns / pulse.bin_ns
    bins = stream.bins if stream.units or stream.bins <= _MOST_BINS else SHAPE_BINS
    while bins < wanted and 2 * bins <= max(_MOST_BINS, stream.bins if stream.units else 0):
        if stream.units % (2 * bins) != 0:  # bins would hold different numbers of units
            break
        bins *= 2
    return bins


def free_bins(bins: int) -> int:
    """Bins of a free shape: the stream's, or a divisor of them near 1024."""
    if bins <= 2 * SHAPE_BINS:
        return bins
    divisors = [n for n in range(2 * SHAPE_BINS, SHAPE_BINS // 4, -1) if bins % n == 0]
    return divisors[0] if divisors else SHAPE_BINS


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
    for dt in stream.intervals():
        head = np.partition(dt, 19)[:20] if dt.size > 20 else dt
        smallest = np.sort(np.concatenate([smallest, head]))[:20]
        sample.append(dt[:: max(1, stream.registrations // 10**6)])
    kept = np.concatenate(sample) if sample else np.empty(0)
    quantiles = np.quantile(kept, (0.01, 0.5, 0.99)) if kept.size else np.full(3, math.nan)
    return Summary(
        stream.registrations,
        stream.cycles,
        stream.period_ns,
        stream.unit_ns,
        stream.bins,
        smallest,
        quantiles,
        stream.same_time,
    )


def _clock(times: Timestamps) -> tuple[float, int]:
    """Unit of the clock, ns, and the units of a period, where they are whole and whole in every bin."""
    unit = float(times.info.get("unit_ns", 0.0))
    if unit == 0.0:
        units = _own_units(times)
        return (times.period_ns / units, units) if units else (0.0, 0)
    number = times.period_ns / unit
    whole = round(number)
    kept = whole <= _MOST_UNITS and abs(number - whole) < 1e-4 and whole % times.bins == 0
    return unit, whole if kept else 0


def _own_units(times: Timestamps) -> int:
    """Units of a period of a simulated stream that was read back: its times are the middles of units, all of them."""
    x = times.times_ns[:_PROBED] / times.period_ns
    x = x - np.floor(x)
    for most in _OWN_UNITS:
        units = most // times.bins * times.bins
        if units and x.size >= 20 and (np.abs(x * units % 1.0 - 0.5) < 1e-3).all():
            return units
    return 0
