"""Detectors and scenes that the model of one dead time does not have: validated without and with being told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom

from mars_lidar import (
    Afterpulsing,
    Calibration,
    Detector,
    Flux,
    GaussianPulse,
    Jitter,
    Timestamps,
    Validation,
    calibrate,
    simulate_timestamps,
    validate,
)
from studies import Tell
from studies.hardware.cases import (
    DEAD_NS,
    DELAY_NS,
    PIXELS,
    SIGMA_NS,
    Case,
    Settings,
    joined,
    recorded,
    stream_of,
    system_of,
)


def _afterpulses(probability: float) -> Detector:
    return replace(_PLAIN, afterpulsing=Afterpulsing(probability=probability, delay_ns=100.0))


_PLAIN = Detector(dead_time_ns=DEAD_NS)
_JITTER = replace(_PLAIN, jitter=Jitter(sigma_ns=0.2))
_AFTERPULSES = _afterpulses(0.02)
TWO_NAME = "electronics dead 85 ns, detector 50 ns"
_TWO = Detector(dead_time_ns=50.0, electronics_dead_time_ns=DEAD_NS)
_PARALYZABLE = replace(_PLAIN, mode="paralyzable")


@dataclass(frozen=True)
class Mismatch:
    """A detector, and how its stream is calibrated and validated; `fits` is what the verdict should be.

    `told`: calibration and prediction are made with this detector, effects and all; else with a dead time of
    `assumed_ns` (None: the smallest interval) and nothing more.
    """

    name: str
    fits: bool = False
    detector: Detector = _PLAIN
    told: bool = False
    engine: str = "exact"
    assumed_ns: float | None = DEAD_NS
    hold_off_ns: float | None = None
    known_pulse: bool = True
    second_return: bool = False
    drift: float = 0.0
    background: float = 0.1


MISMATCHES = (
    Mismatch("none (control)", fits=True),
    Mismatch("none, sequential engine (control)", fits=True, engine="sequential"),
    Mismatch("none, dead time and pulse not told", fits=True, assumed_ns=None, known_pulse=False),
    Mismatch("dead time set 5 ns too short", assumed_ns=80.0),  # to here the quick study
    Mismatch("dead time set 0.5 ns too short", assumed_ns=84.5),
    Mismatch("dead time set 5 ns too long", assumed_ns=90.0),
    Mismatch("paralyzable detector, B = 1", detector=_PARALYZABLE, background=1.0),
    Mismatch("paralyzable detector, B = 0.1", detector=_PARALYZABLE),
    Mismatch("paralyzable detector, B = 0.1, told", detector=_PARALYZABLE, told=True, fits=True),
    Mismatch("jitter 0.2 ns, pulse as without", detector=_JITTER),
    Mismatch("jitter 0.2 ns, all fitted", detector=_JITTER, assumed_ns=None, known_pulse=False, fits=True),
    Mismatch("jitter 0.2 ns, told", detector=_JITTER, told=True, fits=True),
    Mismatch("afterpulses 2 %", detector=_AFTERPULSES),
    Mismatch("afterpulses 2 %, hold-off 400 ns", detector=_AFTERPULSES, hold_off_ns=400.0),
    Mismatch("afterpulses 2 %, told", detector=_AFTERPULSES, told=True, fits=True),
    Mismatch(f"{TWO_NAME}, B = 1", detector=_TWO, background=1.0),
    Mismatch(f"{TWO_NAME}, B = 1, hold-off 135 ns", detector=_TWO, hold_off_ns=DEAD_NS + 50.0, background=1.0),
    Mismatch(f"{TWO_NAME}, B = 1, told", detector=_TWO, told=True, fits=True, background=1.0),
    Mismatch(f"{TWO_NAME}, B = 0.1", detector=_TWO),
    Mismatch("a second return 4 ns behind, not fitted", second_return=True),
    Mismatch("signal drifts by 10 %", drift=0.1),
)


def mismatches(settings: Settings, tell: Tell) -> list[tuple[Mismatch, Case]]:
    """Each of `MISMATCHES`: the validation should fail where the model is not told, and say where."""
    cases = []
    signal = PIXELS["bright"][0]
    cycles = settings.fault_cycles * settings.fault_realizations
    for number, one in enumerate(MISMATCHES[: settings.mismatched]):
        tell(f"hardware: {one.name}")
        background = one.background
        light = Flux(signal, background, DELAY_NS)
        if one.second_return:
            light = Flux.multi(light, Flux(0.1 * signal, 0.0, DELAY_NS + 4.0))
        seed = settings.seed + 200 + number
        if one.drift:
            parts = [Flux(signal * (1.0 + d), background, DELAY_NS) for d in np.linspace(-1, 1, 20) * one.drift / 2]
            times = joined([stream_of(part, cycles // 20, seed + k) for k, part in enumerate(parts)])
        else:
            times = stream_of(light, cycles, seed, one.detector, one.engine)
        if one.told:
            fitted = calibrate(times, system_of(cycles, one.detector))
        else:
            known = GaussianPulse(sigma_ns=SIGMA_NS) if one.known_pulse else None
            fitted = calibrate(times, pulse=known, dead_time_ns=one.assumed_ns, hold_off_ns=one.hold_off_ns)
        found = validate(times, fitted, cycles=settings.fault_cycles, detector=one.detector if one.told else None)
        cases.append((one, Case(one.name, (signal, background, DELAY_NS), found)))
    return cases


_PULSE = GaussianPulse(sigma_ns=SIGMA_NS)
ALARM_BINS = 128  # of the histogram: the laws of 1024 would take three times as long
_AT_ONCE = 50  # streams simulated

KNOWN = "pulse and dead time known"
WAYS: dict[str, Callable[[Timestamps, Timestamps], Calibration]] = {
    KNOWN: lambda times, other: calibrate(times, pulse=_PULSE, dead_time_ns=DEAD_NS),
    "width and dead time fitted": lambda times, other: calibrate(times),
    "hold-off 250 ns": lambda times, other: calibrate(times, pulse=_PULSE, dead_time_ns=DEAD_NS, hold_off_ns=250.0),
    "light of another stream": lambda times, other: calibrate(other, pulse=_PULSE, dead_time_ns=DEAD_NS),
}

WEAK = (
    Mismatch("none (control)", fits=True),
    *(Mismatch(f"afterpulses {100 * p:g} %", detector=_afterpulses(p)) for p in (0.003, 0.006, 0.01)),
    Mismatch(TWO_NAME, detector=_TWO, background=0.03),
    Mismatch(TWO_NAME, detector=_TWO),
    Mismatch("paralyzable detector", detector=_PARALYZABLE, background=0.03),
)


@dataclass(frozen=True)
class Refusals:
    """Of `streams` the `refused` at 1 %, and `by` which tests; the mean score of B, and of TV / floor."""

    name: str
    background: float
    streams: int
    refused: int
    by: Counter[str]
    score: float
    ratio: float

    @classmethod
    def of(cls, name: str, background: float, found: list[Validation]) -> Refusals:
        """From the validations of many streams of one `background`."""
        light = [one.calibration for one in found]
        return cls(
            name,
            background,
            streams=len(found),
            refused=sum(not one.consistent for one in found),
            by=Counter(check.name for one in found for check in one.failed),
            score=float(np.mean([(one.background - background) / one.errors["background"] for one in light])),
            ratio=float(np.mean([one.total_variation / one.total_variation_floor[0] for one in found])),
        )

    @property
    def p(self) -> float:
        """Probability of as many false alarms or more, at 1 %."""
        return float(binom.sf(self.refused - 1, self.streams, 0.01))


def sensitivities(settings: Settings, tell: Tell) -> list[Refusals]:
    """Each of `WEAK`, and the control, in several streams."""
    rows = []
    cycles = settings.fault_cycles * settings.fault_realizations
    for number, one in enumerate(WEAK):
        tell(f"hardware: how weak a mismatch is seen, {one.name}")
        light = Flux(PIXELS["bright"][0], one.background, DELAY_NS)
        found = []
        for k in range(settings.sensed * (2 if one.fits else 1)):
            times = stream_of(light, cycles, settings.seed + 400 + 100 * number + k, one.detector)
            found.append(validate(times, WAYS[KNOWN](times, times), cycles=settings.fault_cycles))
        rows.append(Refusals.of(one.name, one.background, found))
    return rows


def alarms(settings: Settings, tell: Tell) -> list[Refusals]:
    """How often the verdict refuses streams of its own model: the bright pixel, calibrated in each of `WAYS`."""
    rows = []
    signal, background = PIXELS["bright"]
    system = system_of(settings.replicate_cycles).replace(bins=ALARM_BINS)
    for way, fitted in WAYS.items():
        tell(f"hardware: false alarms, {way}")
        found = []
        for begin in range(0, settings.alarms, _AT_ONCE):
            size = min(_AT_ONCE, settings.alarms - begin)
            light = Flux(np.full((1, size + 1), signal), background, DELAY_NS)
            times = recorded(simulate_timestamps(light, system, seed=settings.seed + 900, realization=begin))
            for k in range(size):
                one = times.pixel(0, k)
                found.append(validate(one, fitted(one, times.pixel(0, k + 1)), cycles=settings.alarm_cycles))
        rows.append(Refusals.of(way, background, found))
    return rows
