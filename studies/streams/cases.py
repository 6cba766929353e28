"""Ideal streams over the whole range of light, jitter, pulse, dead time and clock: what is told of them, and how well.

Nothing is wrong with any of them, and nothing of them is told. Whatever `inspect` says does not fit is a false alarm;
whatever `calibrate` states a finite error of has to lie within it as often as a Gaussian number does.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, Flux, GaussianPulse, System, Timestamps, calibrate, simulate_timestamps
from mars_lidar._base.threads import thread_count
from mars_lidar.calibrate import Calibration, Inspection, inspect
from studies import Tell

ESTIMATES = ("dead time", "jitter", "background", "signal", "delay", "width", "all light, any shape")
FLAT = "flat"  # told where no signal is seen
_MOST_BINS = 2**20  # of a stream, as a file of others has them
_MOST_CYCLES = 2e8
_WHOLE_CLOCK = 0.5  # share of the clocks of which a whole number of units is a period


@dataclass(frozen=True)
class Settings:
    """Configuration: number of streams, most photons of one, seed."""

    streams: int = 500
    photons: float = 2e5
    seed: int = 17


FULL = Settings()
QUICK = Settings(streams=24, photons=1e4)


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
        share = self.dead_ns / self.period_ns
        rate = total / (1.0 + total * share)
        # of a pulse shorter than the dead time the first photon alone
        seen = (1.0 - math.exp(-self.signal)) * (1.0 + 4.0 * self.sigma_ns / self.dead_ns)
        rate = min(rate, seen + self.background / (1.0 + self.background * share))
        return int(min(max(self.photons / rate, 50.0), _MOST_CYCLES))

    @property
    def recorded_sigma_ns(self) -> float:
        """Of the pulse with the jitter, and with a clock that runs free, whose units are spread."""
        return math.hypot(self.sigma_ns, self.jitter_ns, 0.0 if self.whole else self.unit_ns / math.sqrt(6.0))


def drawn(number: int, seed: int, photons: float = 2e5) -> list[Ideal]:
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
                signal=log(1e-3, 30.0),
                background=log(1e-4, 10.0),
                period_ns=period,
                dead_ns=log(0.02, 20.0) * period,
                sigma_ns=log(1e-4, 0.1) * period,
                jitter_ns=jitter,
                unit_ns=unit,
                whole=whole,
                photons=log(1e3, photons),
                delay_ns=float(random.random()) * period,
                seed=seed * 10_000 + k,
            )
        )
    return found


def stream_of(ideal: Ideal) -> Timestamps:
    """The stream, by the sequential engine (every photon drawn, in double precision), blurred and clocked here."""
    system = System(
        period_ns=ideal.period_ns,
        cycles=ideal.cycles,
        bins=16,
        pulse=GaussianPulse(sigma_ns=ideal.sigma_ns),
        detector=Detector(dead_time_ns=ideal.dead_ns),
    )
    light = Flux(ideal.signal, ideal.background, ideal.delay_ns)
    made = simulate_timestamps(light, system, seed=ideal.seed, engine="sequential", threads=1)
    return recorded(ideal, made.times_ns, made.cycles)


def recorded(ideal: Ideal, avalanches_ns: NDArray[np.float64], cycles: int) -> Timestamps:
    """Avalanches as a laboratory has them: each with a jitter of its own, in whole units of the clock, sorted."""
    random = np.random.default_rng([ideal.seed, 1])
    # the recording begins a period before the light: no record is earlier
    times = avalanches_ns + ideal.jitter_ns * random.standard_normal(avalanches_ns.size) + ideal.period_ns
    times = np.sort(times)
    times = (np.floor(times / ideal.unit_ns) + 0.5) * ideal.unit_ns
    bins = min(max(1, round(ideal.period_ns / ideal.unit_ns)), _MOST_BINS)
    cycle = np.floor(times / ideal.period_ns)
    place = np.minimum(((times / ideal.period_ns - cycle) * bins).astype(np.int64), bins - 1)
    offsets = np.array([0, times.size], np.int64)
    return Timestamps(
        times,
        cycle.astype(np.int32),
        place.astype(np.int32),
        offsets,
        (1, 1),
        bins,
        np.dtype(np.uint32),
        ideal.period_ns,
        max(cycles + 1, int(cycle[-1]) + 1),
        {"unit_ns": ideal.unit_ns},
    )


@dataclass(frozen=True)
class Outcome:
    """What was made of an ideal stream.

    `problems` and `unknown` are what `inspect` told and what `calibrate` could not; `pulls` the differences of the
    estimates from the truth in standard errors, by name, NaN where no error is stated; `refused` an error message.
    """

    ideal: Ideal
    registrations: int
    problems: tuple[str, ...]
    unknown: tuple[str, ...]
    by: str
    pulls: dict[str, float]
    refused: str
    seconds: float

    @property
    def alarms(self) -> tuple[str, ...]:
        """Problems that there are not; that no signal is seen is not among them where it is right."""
        return tuple(text for text in self.problems if FLAT not in text or self._visible)

    @property
    def flat(self) -> bool:
        """Whether no signal was seen."""
        return any(FLAT in text for text in self.problems)

    @property
    def _visible(self) -> bool:
        """Whether the signal stands out from the background of its own width by more than 10 standard deviations."""
        ideal = self.ideal
        total = ideal.signal + ideal.background
        armed = self.registrations / total
        share = min(6.0 * max(ideal.recorded_sigma_ns, ideal.unit_ns) / ideal.period_ns, 1.0)
        if share > 0.5:
            return False
        noise = math.sqrt((ideal.signal + ideal.background * max(share, 1.0 / 64.0)) / max(armed, 1.0))
        return ideal.signal > 10.0 * noise


def outcome(ideal: Ideal) -> Outcome:
    """Made, inspected and calibrated, with nothing told."""
    began = time.process_time()
    times = stream_of(ideal)
    seen: Inspection | None = None
    light: Calibration | None = None
    refused = ""
    try:
        seen = inspect(times)
        light = calibrate(times)
    except ValueError as error:
        refused = str(error)
    return Outcome(
        ideal,
        len(times),
        () if seen is None else seen.problems,
        () if light is None else light.unknown,
        "" if light is None else light.dead_time_by,
        _pulls(ideal, seen, light),
        refused,
        time.process_time() - began,
    )


def _pulls(ideal: Ideal, seen: Inspection | None, light: Calibration | None) -> dict[str, float]:
    found = dict.fromkeys(ESTIMATES, math.nan)

    def pull(name: str, got: float, truth: float, error: float) -> None:
        if 0.0 < error < math.inf:
            found[name] = (got - truth) / error

    if light is not None:
        errors, period = light.errors, ideal.period_ns
        pull("dead time", light.dead_time_ns, ideal.dead_ns, light.dead_time_error_ns)
        pull("jitter", light.jitter_ns, ideal.jitter_ns, light.jitter_error_ns)
        pull("background", light.background, ideal.background, errors["background"])
        pull("signal", light.signal, ideal.signal, errors["signal"])
        off = (light.delay_ns - ideal.delay_ns + 0.5 * period) % period - 0.5 * period
        pull("delay", off, 0.0, errors["delay_ns"])
        if isinstance(light.pulse, GaussianPulse):
            pull("width", light.pulse.sigma_ns, ideal.recorded_sigma_ns, errors["sigma_ns"])
    if seen is not None:
        free = seen.calibration
        pull(ESTIMATES[-1], free.total, ideal.signal + ideal.background, free.total_error)
    return found


def outcomes(settings: Settings, tell: Tell) -> list[Outcome]:
    """Of all streams, one on each processor at a time."""
    found: list[Outcome] = []
    every = drawn(settings.streams, settings.seed, settings.photons)
    with ProcessPoolExecutor(thread_count(None)) as pool:
        for number, one in enumerate(pool.map(outcome, every, chunksize=2)):
            found.append(one)
            if number % 20 == 19:
                alarmed = sum(bool(one.alarms) for one in found)
                tell(f"streams: {number + 1} of {settings.streams}, {alarmed} false alarms")
    return found
