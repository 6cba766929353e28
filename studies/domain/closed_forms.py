"""What is known of a pixel without any recursion: Poisson, constant rate, one registration at most, one period."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from studies.domain.case import PERIOD_NS, Case

_LIGHT = {"detection_efficiency", "dark_count_hz", "jitter", "code_density"}
_MOST = 20_000  # counts of a law that is written out


@dataclass(frozen=True, eq=False)
class Known:
    """Mean and variance of the count, as far as they are known, and P(N = 0), P(N = 1), ... where it is written out."""

    name: str
    mean: float
    variance: float | None = None
    pmf: NDArray[np.float64] | None = None


def known(case: Case) -> Known | None:
    """The closed form of the count of `case`, or None."""
    system, detector = case.system, case.system.detector
    if not set(detector.effects) <= _LIGHT or case.mode == "moving gate":
        return None
    dead, cycles, photons = system.dead_time_periods, system.cycles, case.photons
    if detector.mode == "gated" and (detector.gate_width_ns or 0.0) < PERIOD_NS:
        return None
    if photons == 0.0:
        return Known("darkness", 0.0, 0.0, np.ones(1))
    if detector.mode == "synchronous":
        if dead > 0.0:
            return None
        return _of(stats.binom(cycles, -np.expm1(-photons)), "Binomial")
    if dead == 0.0:
        return _of(stats.poisson(cycles * photons), "Poisson")
    if detector.mode == "paralyzable":
        return _paralyzable(case) if _constant(case) else None
    if dead >= cycles and system.start == "armed":
        return _of(stats.bernoulli(-np.expm1(-photons * cycles)), "one at most")
    return _constant_rate(case) if _constant(case) else None


def _of(law: object, name: str) -> Known:
    mean, variance = (float(x) for x in law.stats())  # type: ignore[attr-defined]
    wide = mean + 12.0 * np.sqrt(variance) + 30.0
    pmf = law.pmf(np.arange(int(wide))) if wide < _MOST else None  # type: ignore[attr-defined]
    return Known(name, mean, variance, pmf)


def _constant(case: Case) -> bool:
    """Whether the rate does not change over the period."""
    return case.strongest == 0.0 or (case.waveform is not None and bool(np.ptp(case.waveform) == 0.0))


def _paralyzable(case: Case) -> Known:
    rate, dead, cycles = case.photons, case.system.dead_time_periods, case.system.cycles
    if case.system.start == "stationary":
        return Known("paralyzable, constant rate", cycles * rate * float(np.exp(-rate * dead)))
    early = min(dead, cycles)
    mean = -np.expm1(-rate * early) + max(0.0, cycles - dead) * rate * np.exp(-rate * dead)
    return Known("paralyzable, constant rate", float(mean))


def _constant_rate(case: Case) -> Known | None:
    """Armed: P(N >= n) = P(Gamma(n) <= rate (t - (n - 1) dead)). Stationary: its mean."""
    rate, dead, cycles = case.photons, case.system.dead_time_periods, case.system.cycles
    if case.system.start == "stationary":
        return Known("constant rate", cycles * rate / (1.0 + rate * dead))
    most = int(cycles / dead) + 1
    if most > _MOST and cycles * rate > _MOST:
        return None
    n = np.arange(1, min(most, int(cycles * rate + 12.0 * np.sqrt(cycles * rate) + 30.0)) + 1)
    remaining = cycles - (n - 1) * dead
    reach = np.where(remaining > 0.0, special.gammainc(n, np.maximum(rate * remaining, 0.0)), 0.0)
    at_least = np.concatenate([[1.0], reach, [0.0]])
    pmf = at_least[:-1] - at_least[1:]
    mean = float(reach.sum())
    second = float(((2 * n - 1) * reach).sum())
    return Known("constant rate", mean, max(second - mean**2, 0.0), np.maximum(pmf, 0.0))
