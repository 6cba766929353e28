"""Ideal streams over the whole range of light, jitter, pulse, dead time and clock: what is told of them, and how well.

Nothing is wrong with any of them, and nothing of them is told. Whatever `inspect` says does not fit is a false alarm;
whatever `calibrate` states a finite error of has to lie within it as often as a Gaussian number does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mars_lidar.detector import Detector
from mars_lidar.flux import Flux
from mars_lidar.pulse import GaussianPulse
from mars_lidar.simulate import simulate_timestamps
from mars_lidar.system import System
from mars_lidar.timestamps import Timestamps

_MOST_BINS = 2**20  # of a stream, as a file of others has them
_MOST_CYCLES = 2e8
_WHOLE_CLOCK = 0.5  # share of the clocks of which a whole number of units is a period


@dataclass(frozen=True)
class Ideal:
    """What makes an ideal stream; times in ns, light in photons per period, jitter as its sigma.

    `whole`: whether the clock runs with the laser, a whole number of units a period (else it runs free).
    """

    signal: float
    background: float
    period_ns: float
    dead_ns: float
    sigma_ns: float
    jitter_ns: float
    unit_ns: float
    whole: bool
    photons: float
    delay_ns: float
    seed: int

    @property
    def cycles(self) -> int:
        """Laser periods for about so many photons."""
        total = self.signal + self.background
        rate = total / (1.0 + total * self.dead_ns / self.period_ns)
        return int(min(max(self.photons / rate, 50.0), _MOST_CYCLES))

    @property
    def recorded_sigma_ns(self) -> float:
        """Of the pulse with the jitter."""
        return math.hypot(self.sigma_ns, self.jitter_ns)


def drawn(number: int, seed: int) -> list[Ideal]:
    """So many of them, log-uniform over the range; one in five without jitter."""
    random = np.random.default_rng(seed)

    def log(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    found = []
    for k in range(number):
        period = log(10.0, 1000.0)
        jitter = 0.0 if random.random() < 0.2 else log(1e-5, 0.1) * period
        unit, whole = log(1e-3, 1.0), bool(random.random() < _WHOLE_CLOCK)
        if whole:
            unit = period / max(round(period / unit), 1)
        found.append(
            Ideal(
                signal=log(1e-3, 30.0), background=log(1e-4, 10.0), period_ns=period, dead_ns=log(0.02, 20.0) * period,
                sigma_ns=log(1e-4, 0.1) * period, jitter_ns=jitter, unit_ns=unit, whole=whole, photons=log(1e3, 2e5),
                delay_ns=float(random.random()) * period, seed=seed * 10_000 + k,
            )
        )  # fmt: skip
    return found


def stream_of(ideal: Ideal) -> Timestamps:
    """The stream, by the sequential engine (every photon drawn, in double precision), blurred and clocked here."""
    system = System(
        period_ns=ideal.period_ns, cycles=ideal.cycles, bins=16, pulse=GaussianPulse(sigma_ns=ideal.sigma_ns),
        detector=Detector(dead_time_ns=ideal.dead_ns),
    )  # fmt: skip
    light = Flux(ideal.signal, ideal.background, ideal.delay_ns)
    made = simulate_timestamps(light, system, seed=ideal.seed, engine="sequential", threads=1)
    return recorded(ideal, made.times_ns, made.cycles)


def recorded(ideal: Ideal, avalanches_ns: np.ndarray, cycles: int) -> Timestamps:
    """Avalanches as a laboratory has them: each with a jitter of its own, in whole units of the clock, sorted."""
    random = np.random.default_rng([ideal.seed, 1])
    times = avalanches_ns + ideal.jitter_ns * random.standard_normal(avalanches_ns.size)
    times = np.sort(times % (cycles * ideal.period_ns))
    times = (np.floor(times / ideal.unit_ns) + 0.5) * ideal.unit_ns
    bins = min(max(1, round(ideal.period_ns / ideal.unit_ns)), _MOST_BINS)
    cycle = np.floor(times / ideal.period_ns)
    place = np.minimum(((times / ideal.period_ns - cycle) * bins).astype(np.int64), bins - 1)
    offsets = np.array([0, times.size], np.int64)
    return Timestamps(
        times, cycle.astype(np.int32), place.astype(np.int32), offsets, (1, 1), bins, np.dtype(np.uint32),
        ideal.period_ns, max(cycles, int(cycle[-1]) + 1), {"unit_ns": ideal.unit_ns},
    )  # fmt: skip
