"""How often the verdict refuses streams of its own model: the false alarms of a validation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mars_lidar import Calibration, Flux, GaussianPulse, Timestamps, calibrate, simulate_timestamps, validate
from studies import Tell
from studies.hardware.cases import DEAD_NS, DELAY_NS, PIXELS, SIGMA_NS, Settings, recorded, system_of

_PULSE = GaussianPulse(sigma_ns=SIGMA_NS)
ALARM_BINS = 128  # of the histogram: the laws of 1024 would take three times as long
_AT_ONCE = 50  # streams simulated

WAYS: dict[str, Callable[[Timestamps, Timestamps], Calibration]] = {
    "pulse and dead time known": lambda times, other: calibrate(times, pulse=_PULSE, dead_time_ns=DEAD_NS),
    "width and dead time fitted": lambda times, other: calibrate(times),
    "hold-off 250 ns": lambda times, other: calibrate(times, pulse=_PULSE, dead_time_ns=DEAD_NS, hold_off_ns=250.0),
    "light of another stream": lambda times, other: calibrate(other, pulse=_PULSE, dead_time_ns=DEAD_NS),
}


@dataclass(frozen=True)
class Alarms:
    """Of `streams` of the model, calibrated in one `way`: `refused` at 1 %, by which tests, and the mean TV / floor."""

    way: str
    streams: int
    refused: int
    by: dict[str, int]
    ratio: float

    @property
    def p(self) -> float:
        """Probability of as many false alarms or more, at 1 %."""
        from scipy.stats import binom

        return float(binom.sf(self.refused - 1, self.streams, 0.01))


def alarms(settings: Settings, tell: Tell) -> list[Alarms]:
    """The bright pixel, each way."""
    found = []
    signal, background = PIXELS["bright"]
    system = system_of(settings.replicate_cycles).replace(bins=ALARM_BINS)
    for way, fitted in WAYS.items():
        tell(f"hardware: false alarms, {way}")
        by: Counter[str] = Counter()
        refused, ratios = 0, []
        for begin in range(0, settings.alarms, _AT_ONCE):
            size = min(_AT_ONCE, settings.alarms - begin)
            light = Flux(np.full((1, size + 1), signal), background, DELAY_NS)
            times = recorded(simulate_timestamps(light, system, seed=settings.seed + 900, realization=begin))
            for k in range(size):
                one = times.pixel(0, k)
                result = validate(one, fitted(one, times.pixel(0, k + 1)), cycles=settings.alarm_cycles)
                refused += not result.consistent
                by.update(check.name for check in result.failed)
                ratios.append(result.total_variation / result.total_variation_floor[0])
        found.append(Alarms(way, settings.alarms, refused, dict(by), float(np.mean(ratios))))
    return found
