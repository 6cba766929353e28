"""What the joint law says about intervals that were learned from histograms with another covariance.

Near a pixel's light theta = (log S, log B, delay) the histogram is H = m + J (theta' - theta) + noise. A network that
is trained under the covariance C learns the estimate that is best there, theta + F^-1 J' C^-1 (H - m) with
F = J' C^-1 J, and its variance F^-1. Under the true covariance C* the error has F^-1 J' C^-1 C* C^-1 J F^-1 instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats

from mars_lidar import Flux, GaussianPulse, System, joint_law
from mars_lidar._base.types import FloatArray
from mars_lidar.learn import expected_histogram
from studies.uncertainty.data import BACKGROUND, SIGNAL

_STEP = 1e-4  # of the logarithms, and in ns: central differences of a function that is known to 1e-12


@dataclass(frozen=True)
class Predicted:
    """Of log S at one light: standard deviations of count x multinomial (`mars`) and of the exact law.

    `claimed` what the estimate for MaRS data says of itself, `real` what it has on exact data, `best` that of the
    estimate for exact data; `window` the variance of the +-3 sigma window of MaRS over the exact one's.
    """

    signal: float
    background: float
    claimed: float
    real: float
    best: float
    window: float

    def coverage(self, level: float) -> float:
        """Share of exact data inside the `level` intervals of the estimate for MaRS data."""
        return float(2.0 * stats.norm.cdf(stats.norm.ppf(0.5 + 0.5 * level) * self.claimed / self.real) - 1.0)

    @property
    def loss(self) -> float:
        """By which the negative log-likelihood of the MaRS estimate exceeds the exact one's, nats."""
        return float(np.log(self.claimed / self.best) + 0.5 * (self.real / self.claimed) ** 2 - 0.5)


def centres(ends: tuple[float, float], cells: int) -> FloatArray:
    """Middles (cells,) of equal parts of a logarithmic axis."""
    low, high = np.log(ends)
    return np.asarray(np.exp(low + (high - low) * (np.arange(cells) + 0.5) / cells))


def predict(system: System, cells: int) -> list[Predicted]:
    """At the middle of each cell of the map, the background fastest."""
    light = [(s, b) for s in centres(SIGNAL, cells) for b in centres(BACKGROUND, cells)]
    return [at(float(s), float(b), system) for s, b in light]


def at(signal: float, background: float, system: System) -> Predicted:
    """The prediction at one light; the return is in the middle of the period."""
    law = joint_law(Flux(signal, background, 0.5 * system.period_ns), system)
    exact, mean = law.covariance(), law.mean
    total = mean.sum()
    mars = np.diag(mean) + np.outer(mean, mean) * (law.count_variance / total**2 - 1.0 / total)
    moved = _jacobian(signal, background, system)
    weights = {name: np.linalg.solve(one, moved) for name, one in (("mars", mars), ("exact", exact))}
    inverse = np.linalg.inv(moved.T @ weights["mars"])
    real = inverse @ weights["mars"].T @ exact @ weights["mars"] @ inverse
    best = np.linalg.inv(moved.T @ weights["exact"])
    assert isinstance(system.pulse, GaussianPulse)
    away = (np.arange(system.bins) + 0.5) * system.bin_ns - 0.5 * system.period_ns
    window = (np.abs(away) <= 3.0 * system.pulse.sigma_ns).astype(float)
    ratio = float(window @ mars @ window / (window @ exact @ window))
    claimed, error, least = (float(np.sqrt(one[0, 0])) for one in (inverse, real, best))
    return Predicted(signal, background, claimed, error, least, ratio)


def _jacobian(signal: float, background: float, system: System) -> FloatArray:
    """Derivatives (bins, 3) of the mean histogram in log S, log B and the delay in ns."""
    steps = _STEP * np.concatenate([np.eye(3), -np.eye(3)])
    light = np.array([signal, background, 1.0]) * np.exp(steps * [1.0, 1.0, 0.0])
    delay = 0.5 * system.period_ns + steps[:, 2]
    s, b, tau = (torch.from_numpy(np.ascontiguousarray(one)) for one in (light[:, 0], light[:, 1], delay))
    mean = expected_histogram(s, b, tau, system).numpy()
    return np.asarray((mean[:3] - mean[3:]).T / (2.0 * _STEP))
