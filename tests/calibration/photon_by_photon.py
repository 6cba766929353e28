"""Streams of one pixel drawn photon by photon in plain NumPy: every arrival, every afterpulse, in the order of time.

It shares nothing with the engines of the package. Definitions are those of docs/detectors.md; the times returned are
what a recorder with a clock of `unit` writes (the middles of its units).
"""

from __future__ import annotations

import heapq
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

import mars_lidar as ml


@dataclass(frozen=True, kw_only=True)
class Truth:
    """A pixel under pulsed light: photons per period, times in ns."""

    signal: float
    background: float
    delay: float
    sigma: float
    dead: float
    period: float
    jitter: float = 0.0
    unit: float = 0.0
    afterpulses: float = 0.0  # carriers that outlive the dead time, a registration
    afterpulse_delay: float = 100.0
    twilight: float = 0.0
    recovery: float = 0.0
    electronics: float = 0.0
    paralyzable: bool = False
    drift: float = 0.0  # relative change of all light from the first photon to the last
    flicker: float = 0.0  # standard deviation of the logarithm of all light, from one stretch to the next
    flicker_periods: int = 1000  # of a stretch
    locked: bool = True  # the recorder's clock begins anew with each laser pulse

    @property
    def width(self) -> float:
        """Sigma of the recorded pulse."""
        return float(np.hypot(self.sigma, self.jitter))


def photon_by_photon(truth: Truth, photons: int, seed: int) -> tuple[np.ndarray, int]:
    """Recorded times (n,) of about so many photons, sorted, and the laser periods they were recorded in."""
    random = np.random.default_rng(seed)
    total = truth.signal + truth.background
    blind = max(truth.dead, truth.electronics) / truth.period
    cycles = max(2, int(photons * (1.0 / total + blind)))
    block = max(1, int(4e5 / total))
    pixel = _Pixel(truth, random)
    first = 0
    while pixel.recorded < photons and first < 4 * cycles:
        count = min(block, 4 * cycles - first)
        pixel.watch(_arrivals(truth, first, count, cycles, random))
        first += count
    t = np.array(pixel.records)[:photons]
    used = int(np.ceil(t[-1] / truth.period)) if t.size else first
    t = t + truth.jitter * random.standard_normal(t.size)
    return np.sort(clocked(np.abs(t), truth)), used + 1


def clocked(t: np.ndarray, truth: Truth) -> np.ndarray:
    """The middles of the clock's units: of a clock that runs through, or begins anew with each laser pulse."""
    if truth.unit == 0.0:
        return t
    if not truth.locked:
        return (np.floor(t / truth.unit) + 0.5) * truth.unit
    cycle = np.floor(t / truth.period)
    return cycle * truth.period + (np.floor((t - cycle * truth.period) / truth.unit) + 0.5) * truth.unit


def _arrivals(truth: Truth, first: int, count: int, cycles: int, random: np.random.Generator) -> np.ndarray:
    level = 1.0 + truth.drift * (np.arange(first, first + count) / cycles - 0.5)
    if truth.flicker:
        stretches = np.random.default_rng(7).standard_normal(4 * cycles // truth.flicker_periods + 1)
        level = level * np.exp(truth.flicker * stretches[np.arange(first, first + count) // truth.flicker_periods])
    signals = random.poisson(truth.signal * level)
    backgrounds = random.poisson(truth.background * level)
    number = np.arange(first, first + count)
    pulse = truth.delay + truth.sigma * random.standard_normal(signals.sum())
    t = np.repeat(number, signals) * truth.period + pulse % truth.period
    flat = (np.repeat(number, backgrounds) + random.random(backgrounds.sum())) * truth.period
    return np.sort(np.concatenate([t, flat]))


class _Pixel:
    def __init__(self, truth: Truth, random: np.random.Generator) -> None:
        self.truth, self.random = truth, random
        self.ready = -np.inf
        self.carriers: list[float] = []
        self.records: list[float] = []
        p = truth.afterpulses
        self.mean = p * np.exp(truth.dead / truth.afterpulse_delay) if p else 0.0

    @property
    def recorded(self) -> int:
        return len(self.records)

    def fire(self, t: float) -> None:
        """An avalanche: blind for the dead time, carriers in traps, a record where the electronics are ready."""
        truth = self.truth
        if not self.records or t - self.records[-1] >= truth.electronics:
            self.records.append(t)
        self.ready = t + truth.dead
        if self.mean:
            for _ in range(self.random.poisson(self.mean)):
                heapq.heappush(self.carriers, t + self.random.exponential(truth.afterpulse_delay))

    def watch(self, arrivals: np.ndarray) -> None:
        """What the pixel makes of the photons (n,)."""
        truth = self.truth
        if not (truth.paralyzable or truth.recovery or truth.twilight or self.mean):
            times = arrivals.tolist()  # every photon of a blind pixel is lost: the next one that matters by bisection
            k = bisect_left(times, self.ready)
            while k < len(times):
                self.fire(times[k])
                k = bisect_left(times, self.ready, k + 1)
            return
        for photon in arrivals.tolist():
            while self.carriers and self.carriers[0] < photon:
                self.arrive(heapq.heappop(self.carriers))
            self.arrive(photon)

    def arrive(self, t: float) -> None:
        """A photon or a released carrier at time t."""
        truth = self.truth
        if t < self.ready:
            if truth.paralyzable:
                self.ready = t + truth.dead
            elif truth.twilight and t > self.ready - truth.twilight:
                self.fire(self.ready)  # a twilight pulse, at the end of the dead time
            return
        if truth.recovery and self.random.random() < np.exp(-(t - self.ready) / truth.recovery):
            return
        self.fire(t)


def as_timestamps(t: np.ndarray, truth: Truth, cycles: int) -> ml.Timestamps:
    """The stream as a file of others gives it: times, period and unit, nothing of the system."""
    cycle = np.minimum(np.floor(t / truth.period), cycles - 1).astype(np.int32)
    bins = 256
    place = np.clip(((t / truth.period - cycle) * bins).astype(np.int32), 0, bins - 1)
    info = {"unit_ns": truth.unit} if truth.unit else {}
    offsets = np.array([0, t.size])
    return ml.Timestamps(t, cycle, place, offsets, (1, 1), bins, np.dtype(np.uint16), truth.period, int(cycles), info)
