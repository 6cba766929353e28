"""Study "detectors": what each mode of a detector does to the same flux, simulated and in closed form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mars_lidar import Flux, GaussianPulse, System, count_law, simulate_timestamps
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.effects import AVALANCHE_EFFECTS
from mars_lidar.statistics import mean_histogram
from mars_lidar.statistics.count_pmf import Pmf
from studies import Facts, Request
from studies.common.distance import g_test
from studies.common.sample import settings_of
from studies.detectors.settings import BACKGROUND, DELAY_NS, EXAMPLES, LIGHT, REACH, SEED, SIGNAL, Example, Outcome

_BINS_OF_INTERVALS = 150
_SIMULATED_ONLY = (*AVALANCHE_EFFECTS, "max_events_per_period", "max_events_per_exposure")


def run(request: Request) -> Facts:
    """Every mode; a figure for each."""
    from studies.detectors.figures import draw_all

    exposures = 400 if request.quick else 40_000
    outcomes = []
    for example in EXAMPLES:
        request.tell(f"detectors: {example.name}")
        outcomes.append(outcome(example, exposures))
    rows = [row(each) for each in outcomes]
    return {
        "settings": settings_of(outcomes[0].system, LIGHT, exposures, SEED),
        "rows": rows,
        "figures": draw_all(outcomes),
    }


def outcome(example: Example, exposures: int) -> Outcome:
    """Simulate one detector, and predict what is known of it."""
    pulse = GaussianPulse(sigma_ns=1.0)
    system = System(period_ns=100.0, cycles=500, bins=200, pulse=pulse, detector=example.detector)
    coupled = example.detector.crosstalk is not None  # the exposures are then the pixels of one square image
    side = round(math.sqrt(exposures))
    flux = Flux(np.full((side, side) if coupled else (1, exposures), SIGNAL), BACKGROUND, DELAY_NS)
    times = simulate_timestamps(flux, system, engine="sequential" if coupled else "exact", seed=SEED)
    counts = times.counts.ravel()
    exposures = counts.size
    each = np.bincount(times.bin, minlength=system.bins) / exposures
    item = np.repeat(np.arange(exposures), counts)
    place, number = np.unique(item * system.bins + times.bin, return_counts=True)
    second = np.bincount(place % system.bins, number.astype(np.float64) ** 2, minlength=system.bins) / exposures
    apart = np.diff(times.times_ns)[item[1:] == item[:-1]] / system.period_ns
    intervals = np.histogram(apart, _BINS_OF_INTERVALS, (0.0, REACH))[0] / exposures
    expected, moments, law = _predicted(system)
    error = np.sqrt(np.maximum(second - each**2, 0.0) / exposures)
    return Outcome(example, system, counts, each, error, intervals, expected, moments, law)


def _predicted(system: System) -> tuple[FloatArray | None, tuple[float, float] | None, FloatArray | None]:
    if system.detector.gate_moves or set(system.detector.effects) & set(_SIMULATED_ONLY):
        return None, None, None
    expected = mean_histogram(Flux(SIGNAL, BACKGROUND, DELAY_NS), system)
    law = count_law(Flux(SIGNAL, BACKGROUND, DELAY_NS), system)
    pmf = np.zeros(int(law.support[-1]) + 1)
    pmf[law.support] = law.pmf
    return expected, (float(law.mean), float(law.variance)), pmf


def row(each: Outcome) -> dict[str, Any]:
    """One line of the table."""
    n = each.counts.size
    mean, variance = float(each.counts.mean()), float(each.counts.var(ddof=1))
    line: dict[str, Any] = {"detector": each.example.name, "simulated mean": mean, "simulated variance": variance}
    if each.moments is None or each.expected is None or each.law is None:
        words = ("predicted mean", "predicted variance", "z mean", "z variance", "worst z of a bin", "p of the law")
        return line | dict.fromkeys(words, "-")
    fourth = float(np.mean((each.counts - mean) ** 4))
    selected = each.histogram_error > 0
    z = (each.histogram[selected] - each.expected[selected]) / each.histogram_error[selected]
    return line | {
        "predicted mean": each.moments[0],
        "predicted variance": each.moments[1],
        "z mean": (mean - each.moments[0]) / math.sqrt(each.moments[1] / n),
        "z variance": (variance - each.moments[1]) / math.sqrt((fourth - variance**2) / n),
        "worst z of a bin": float(np.abs(z).max()),
        "p of the law": g_test(Pmf(0, each.law), Pmf.of_counts(each.counts), n),
    }
