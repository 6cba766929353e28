"""A recording of one pixel: times, clock, and statistics that need no model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.instrument.tolerances import TOL
from mars_lidar.light.timestamps import Timestamps

_ON_GRID = 0.02  # units: distance from a tick of the clock that rounding of float64 times over an hour can cause
FALSE_ALARM = 0.002  # probability that an effect, drift, misfit, other period or pulse is named where there is none
LEAST_PHOTONS = 300  # of a recording or a part of it: with fewer, the counts of the cells do not have a normal law


class Clock(NamedTuple):
    """The grid of a recorder, whose nearest point it writes for a time.

    `unit_ns` its spacing, 0 for real numbers; `offset` where its points lie, in units; `locked` whether the grid
    begins anew with each laser pulse (T3), or runs through (T2).
    """

    period_ns: float
    unit_ns: float = 0.0
    offset: float = 0.0
    locked: bool = False

    @property
    def units(self) -> int:
        """Units in a laser period, if their number is whole for a thousand periods at least; else 0."""
        units = self.period_ns / self.unit_ns if self.unit_ns else 0.0
        return round(units) if abs(units - round(units)) < 1e-3 else 0


@dataclass(frozen=True, eq=False)
class Recording:
    """One pixel's times, recorded in stretches without interruption, or simulated streams.

    `pieces` sorted times (n,) of each stretch, ns from a laser pulse; `cycles` laser periods of each; `clock`;
    `laser` is False where no laser was recorded, and then the period is a unit of time alone.
    """

    pieces: tuple[FloatArray, ...]
    cycles: tuple[float, ...]
    clock: Clock
    laser: bool = True

    def __iter__(self) -> Iterator[FloatArray]:
        return iter(self.pieces)

    @property
    def times(self) -> FloatArray:
        """Times (n,) of all stretches, one after the other."""
        return np.concatenate(self.pieces)

    @property
    def period_ns(self) -> float:
        """Laser period, ns."""
        return self.clock.period_ns

    @property
    def photons(self) -> int:
        """Registrations in all stretches."""
        return sum(piece.size for piece in self.pieces)

    @property
    def exposure(self) -> float:
        """Laser periods of all stretches."""
        return float(sum(self.cycles))

    @cached_property
    def intervals(self) -> FloatArray:
        """Intervals (n,) between successive registrations, ns, of all stretches, sorted."""
        return np.sort(np.concatenate([np.diff(piece) for piece in self.pieces]))

    @cached_property
    def armed_ns(self) -> float:
        """Time after a registration from which the pixel is armed: intervals are shorter by jitter alone.

        The shortest ones scatter by the jitter, and in dim light by far more than the largest jitter of the model.
        """
        gaps = self.intervals
        low, edge = gaps[np.minimum([1, max(30, gaps.size // 500)], gaps.size - 1)]
        hold = low + 4.0 * min(edge - low, 2.0 * TOL.jitter_periods * self.period_ns) + 2.0 * self.clock.unit_ns
        return float(min(hold, np.quantile(gaps, 0.95)))  # of a saturated detector few are longer

    def counts(self, window: float) -> list[NDArray[np.int64]]:
        """Counts (windows,) of each stretch in its successive windows of `window` periods."""
        at = [(piece / (window * self.period_ns)).astype(np.int64) for piece in self.pieces]
        whole = [int(cycles / window) for cycles in self.cycles]
        return [np.bincount(k, minlength=number)[:number] for k, number in zip(at, whole, strict=True)]

    def unevenness(self, window: float) -> tuple[float, int, float]:
        """Allan variance of the count in windows of `window` periods, the number of differences, and the mean count."""
        counts = self.counts(window)
        steps = np.concatenate([np.diff(row) for row in counts])
        if not steps.size:
            return 0.0, 0, 0.0
        return 0.5 * float((steps**2.0).mean()), steps.size, float(np.concatenate(counts).mean())

    @property
    def stretches(self) -> list[Recording]:
        """Each stretch as a recording of its own."""
        return [replace(self, pieces=(t,), cycles=(n,)) for t, n in zip(self.pieces, self.cycles, strict=True)]

    def parts(self, number: int) -> list[Recording]:
        """About `number` parts of equal exposure, in order of time."""
        size = self.exposure / number
        parts: list[Recording] = []
        for piece, cycles in zip(self.pieces, self.cycles, strict=True):
            count = max(1, round(cycles / size))
            edges = np.searchsorted(piece, np.arange(1, count) * (cycles / count * self.period_ns))
            parts += [Recording((t,), (cycles / count,), self.clock, self.laser) for t in np.split(piece, edges)]
        return parts


def free_light(t: FloatArray, clock: Clock, hold: float, bins: int) -> tuple[FloatArray, FloatArray]:
    """Registrations and armed passes (bins,) over the period, counted from `hold` after each registration on.

    Their ratio is the probability of a photon in a bin, for any shape of light and any dead time below `hold`. Times
    are spread over the unit of the clock, because bins contain different numbers of its ticks, or end at one.
    """
    period = clock.period_ns
    t = t + clock.unit_ns * (np.random.default_rng(0).random(t.size) - 0.5)
    a = np.floor((t[:-1] + hold) * (bins / period)).astype(np.int64)
    b = np.floor(t[1:] * (bins / period)).astype(np.int64)
    late = b > a
    a, b = a[late], b[late]
    begun, hits = (np.bincount(x % bins, minlength=bins) for x in (a, b))
    # a bin is passed once in each whole period from a to b, and once more where it lies up to b % bins, not a % bins
    passes = (b // bins - a // bins).sum() + np.cumsum((hits - begun)[::-1])[::-1]
    return hits.astype(float), passes.astype(float)


def free_waveform(recording: Recording, most: int) -> tuple[FloatArray, FloatArray]:
    """Light (bins,) of any shape in photons per period and bin, without dead time, and its standard errors.

    A bin records one photon a pass, with the probability 1 - exp(-light). Passes are counted from beyond the shortest
    intervals on, where the pixel is armed.
    """
    clock, hold = recording.clock, recording.armed_ns
    # whole units of the clock in each bin, if possible; every number divides 0, where the period has no whole units
    bins = max((n for n in range(most // 8, most + 1) if clock.units % n == 0), default=most)
    hits, passes = np.sum([free_light(piece, clock, hold, bins) for piece in recording.pieces], axis=0)
    passes = np.maximum(passes, 1.0)
    share = np.clip(hits, 1e-3, passes - 0.5) / passes
    return -np.log1p(-share), np.sqrt((hits + 1.0) / (1.0 - share)) / passes


def brightest_window(recording: Recording, streams: Recording | None = None) -> tuple[float, float]:
    """Probability that light has a window as much brighter than the rest, and 95 % upper limit of a further signal.

    The light is constant, or that of simulated `streams`, whose scatter is part of the noise. The windows are up to a
    quarter of the period wide. The limit is the largest of all of them, so that it holds for a pulse anywhere.
    """
    from scipy.special import ndtr

    rate, error = free_waveform(recording, 512)
    made = [] if streams is None else [each for each in streams.stretches if each.photons > 1]
    drawn = np.array([free_waveform(each, rate.size)[0] for each in made] or [np.zeros(rate.size)])
    ratio = recording.exposure / streams.cycles[0] if streams is not None else 0.0
    best, limit = -np.inf, 0.0
    widths = [2**k for k in range(int(np.log2(rate.size / 4.0)) + 1)]
    for m in widths:
        share = m / (rate.size - m)

        def of(values: FloatArray, rest: float, m: int = m) -> FloatArray:
            """Sums (..., bins) in windows, and those of all else times `rest`."""
            inside = sum(np.roll(values, -k, axis=-1) for k in range(m))
            return np.asarray(inside + rest * (values.sum(-1, keepdims=True) - inside))

        excess, variance = of(rate - drawn.mean(0), -share), of(error**2, share**2)
        between = of(drawn, -share).var(0, ddof=min(1, len(made)))
        noise = np.sqrt(variance + np.maximum(between, ratio * variance) * (1.0 + 1.0 / len(drawn)))
        most = np.where(noise > 1.0, np.inf, excess + 1.645 * noise)  # hardly a pass without a photon
        best, limit = max(best, float((excess / noise).max())), max(limit, float(most.max()))
    return float(len(widths) * rate.size * ndtr(-best)), limit


def recording_of(times: Timestamps | Sequence[Timestamps], *, pooled: bool = False) -> Recording:
    """The recording of one pixel, from a stream or a sequence of streams of that pixel.

    `pooled`: the pixels of an image are recordings of one and the same pixel.
    """
    streams = [times] if isinstance(times, Timestamps) else list(times)
    first = streams[0]
    if not (first.period_ns > 0 and np.isfinite(first.period_ns)):
        raise ValueError(f"times must give the laser period, got period_ns {first.period_ns}")
    pieces: list[FloatArray] = []
    cycles: list[float] = []
    for stream in streams:
        if stream.period_ns != first.period_ns:
            raise ValueError(f"times must share a period, got {first.period_ns:g} ns and {stream.period_ns:g} ns")
        height, width = stream.shape
        if height * width > 1 and not pooled:
            raise ValueError(
                f"times must be of one pixel, got {height} x {width}: choose one with times.pixel(y, x), or give "
                "pooled=True where all are recordings of the same pixel"
            )
        for t in np.split(stream.times_ns, stream.offsets[1:-1]):
            if t.size > 1:
                pieces.append(np.ascontiguousarray(t, np.float64))
                cycles.append(max(float(stream.cycles), float(t[-1]) / stream.period_ns))
    if not pieces:
        raise ValueError("times must hold at least two registrations of a pixel")
    return Recording(tuple(pieces), tuple(cycles), clock_of(pieces[0], first))


def clock_of(t: FloatArray, stream: Timestamps, probed: int = 2000) -> Clock:
    """The clock of times (n,), by the unit that the file gives: where their grid lies, and what it is locked to.

    Times that lie on no grid of that unit are real numbers; `probed` of them are examined.
    """
    period = stream.period_ns
    probe = t[:: max(1, t.size // probed)]
    given = float(stream.info.get("unit_ns", 0.0))
    # our PTU and Photon-HDF5
    own = [period / (most // stream.bins * stream.bins) for most in (2**15, 2**16) if stream.bins <= most]
    for unit in [given] if given > 0.0 else own:
        for locked, place in ((False, probe / unit), (True, probe / period % 1.0 * period / unit)):
            first = locked & (place < 1.0)  # those of the last unit of a period may lie beyond its end
            if first.all():
                continue
            offset = _offset(place[~first])
            last = np.where(first, place + period / unit, place)
            away = np.min([np.abs((at - offset + 0.5) % 1.0 - 0.5) for at in (place, last)], axis=0)
            if float(np.quantile(away, 0.99)) < _ON_GRID:
                return Clock(period, unit, offset, locked)
    return Clock(period)


def _offset(place: FloatArray) -> float:
    """Where the points of a grid lie, in its units, by places (n,) on it."""
    offset = float(np.angle(np.exp(2j * np.pi * place).mean()) / (2 * np.pi) % 1.0)
    return 0.0 if min(offset, 1.0 - offset) < _ON_GRID else offset


def recording_of_arrivals(times_ns: ArrayLike, unit_ns: float, probed: int = 2000) -> Recording:
    """A recording without a laser: its period is the mean interval, a unit of time alone.

    The offset of the clock follows from `probed` of the times.
    """
    t = np.asarray(checks.numbers("times", times_ns))
    if t.dtype.kind not in "fiu":
        raise TypeError(f"times must be Timestamps, a sequence of them, or numbers (n,), got {type(times_ns).__name__}")
    if t.ndim != 1 or t.size < 2 or not np.isfinite(t).all():
        raise ValueError(f"times must be finite numbers (n,), n at least 2, got shape {t.shape}")
    t = np.sort(t.astype(np.float64))
    t = t - np.floor(t[0] / unit_ns) * unit_ns if unit_ns else t - t[0]
    period = float(t[-1] - t[0]) / (t.size - 1)
    if not period > 0.0:
        raise ValueError("times must contain different times, got one value only")
    clock = Clock(period, unit_ns, _offset(t[:: max(1, t.size // probed)] / unit_ns)) if unit_ns else Clock(period)
    return Recording((t,), (float(t[-1]) / period,), clock, laser=False)
