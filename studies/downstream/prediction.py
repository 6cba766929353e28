"""What the joint law says about estimates that were learned from histograms with another covariance.

Near a pixel's light theta = (S, B, delay) the features are f = m + J (theta' - theta) + noise. A network that is
trained under the covariance C learns the estimate that is best there, theta + F^-1 J' C^-1 (f - m) with F = J' C^-1 J,
and its variance F^-1. Under the true covariance C* the error has F^-1 J' C^-1 C* C^-1 J F^-1 instead. Features are the
sums that the networks see (`studies/downstream/windows.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats

from mars_lidar import Flux, System, joint_law
from mars_lidar._base.types import FloatArray
from mars_lidar.learn import expected_histogram
from studies.downstream.windows import WINDOW, starts

_STEP = 1e-3  # of S and B, relative, and of the delay in ns: central differences of a function that is known to 1e-12
_LEAST = 0.02  # photons per period: a dimmer return says nothing of its delay


@dataclass(frozen=True)
class Predicted:
    """Of S at one light, photons per period: standard deviations of count x multinomial (`mars`) and of the exact law.

    `claimed` what the estimate for MaRS data says of itself, `real` what it has on exact data, `best` that of the
    estimate for exact data.
    """

    signal: float
    background: float
    claimed: float
    real: float
    best: float

    def coverage(self, level: float) -> float:
        """Share of exact data inside the `level` intervals of the estimate for MaRS data."""
        return float(2.0 * stats.norm.cdf(stats.norm.ppf(0.5 + 0.5 * level) * self.claimed / self.real) - 1.0)


def at(signal: float, background: float, system: System, *, summed: bool = True) -> Predicted:
    """The prediction at one light, the return in the middle of the period; of all bins where they are not `summed`."""
    law = joint_law(Flux(signal, background, 0.5 * system.period_ns), system)
    exact, mean = law.covariance(), law.mean
    total = mean.sum()
    mars = np.diag(mean) + np.outer(mean, mean) * (law.count_variance / total**2 - 1.0 / total)
    moved = _jacobian(signal, background, system)
    if summed:
        sums = _sums(system)
        exact, mars, moved = sums @ exact @ sums.T, sums @ mars @ sums.T, sums @ moved
    weights = {name: np.linalg.solve(slopes, moved) for name, slopes in (("mars", mars), ("exact", exact))}
    inverse = np.linalg.inv(moved.T @ weights["mars"])
    real = inverse @ weights["mars"].T @ exact @ weights["mars"] @ inverse
    best = np.linalg.inv(moved.T @ weights["exact"])
    claimed, error, least = (float(np.sqrt(covariance[0, 0])) for covariance in (inverse, real, best))
    return Predicted(signal, background, claimed, error, least)


def _sums(system: System) -> FloatArray:
    """Sums (features, bins) that a network sees of a histogram whose return is in the middle."""
    first = starts(system.bins, system.dead_time_periods)
    place = (np.arange(system.bins) - (system.bins - WINDOW) // 2) % system.bins
    return np.asarray(np.searchsorted(first, place, side="right") - 1 == np.arange(len(first))[:, None], np.float64)


def _jacobian(signal: float, background: float, system: System) -> FloatArray:
    """Derivatives (bins, 3) of the mean histogram in S, B and the delay in ns."""
    size = _STEP * np.array([signal, background, 1.0])
    light = np.array([signal, background, 0.5 * system.period_ns]) + np.concatenate([np.diag(size), -np.diag(size)])
    s, b, tau = (torch.from_numpy(np.ascontiguousarray(values)) for values in light.T)
    mean = expected_histogram(s, b, tau, system).numpy()
    return np.asarray((mean[:3] - mean[3:]).T / (2.0 * size))


def of_scenes(fluxes: Sequence[Flux], system: System, lights: int) -> dict[str, float]:
    """Of the pixels of scenes, by `lights` of them: dB that MaRS-trained estimates of S lose, and 90 % coverage.

    The lights stand in the middles of equal parts of the pixels in the order of their signal.
    """
    signal, background = (
        np.concatenate([getattr(flux, name).ravel() for flux in fluxes]) for name in ("signal", "background")
    )
    order = np.argsort(signal, kind="stable")
    some = order[((np.arange(lights) + 0.5) * len(order) / lights).astype(int)]
    predictions = [at(max(float(signal[k]), _LEAST), float(background[k]), system) for k in some]
    real, best = (float(np.mean([getattr(p, name) ** 2 for p in predictions])) for name in ("real", "best"))
    covered = float(np.mean([p.coverage(0.9) for p in predictions]))
    return {"lost": 10.0 * float(np.log10(real / best)), "covered": covered}
