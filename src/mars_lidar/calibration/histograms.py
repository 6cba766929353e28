"""What all pixels of a histogram cube share: dead time, pulse width, offset of the period, background floor.

Registrations h_j of a bin are expected to be e_j = l_j D_j, the light times the passes for which the pixel was armed,
and differ from it by a martingale of variance e_j. So sum_j h_j log e_j - e_j is a quasi-likelihood (Wedderburn,
Biometrika 61, 439, 1974) of what all pixels share, at the most likely light of each; its curvature gives the errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.calibration import Estimate
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.fit_quality import tested_recordings
from mars_lidar.reconstruction.histograms import Histograms, checked
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood

_PIXELS = 32  # that are fitted, the brightest
_GRID = 13  # dead times of the first search, over a period
_DECREASE = 1e-2  # of the log likelihood, to which it is climbed


@dataclass(frozen=True, eq=False)
class CubeCalibration:
    """What the pixels of a cube share, made by `calibrate_cube`.

    Attributes
    ----------
    estimates
        ``dead_time_ns``, ``pulse_sigma_ns`` (of a Gaussian, jitter included), and ``background_floor``, photons per
        period of the darkest fitted pixel, which none of them is below.
    system
        The system given, with these.
    p_values
        (pixels,) of the fitted pixels: probability of a histogram as far from its own law.
    """

    estimates: dict[str, Estimate]
    system: System
    p_values: FloatArray

    __repr__ = brief

    @property
    def misfits(self) -> float:
        """Share of the fitted pixels with p below 1 %."""
        return float((self.p_values < 0.01).mean()) if self.p_values.size else float("nan")

    @property
    def fits(self) -> bool:
        """Whether no more pixels than by chance (four standard deviations) have p below 1 %."""
        expected = 0.01 * self.p_values.size
        return bool((self.p_values < 0.01).sum() <= expected + 4.0 * expected**0.5 + 1.0)


def calibrate_cube(cube: ArrayLike, system: System) -> CubeCalibration:
    """Dead time and pulse width that all pixels of a cube (..., bins) share, with errors.

    Parameters
    ----------
    cube
        (..., bins) counts.
    system
        How they were recorded, with a free-running detector: its dead time and the width of its pulse are where the
        search begins, and are replaced by estimates.

    Raises
    ------
    ValueError
        A detector that is not free-running, or no pixel with 1000 registrations.
    """
    from scipy.optimize import minimize

    given, _ = checked(cube, system, 1)
    if not tested_recordings(system):
        raise ValueError(
            f"system must have a free-running detector and many cycles to calibrate a cube, got mode "
            f"{system.detector.mode!r} and {system.cycles:,} cycles"
        )
    totals = given.counts.sum(1)
    chosen = np.argsort(totals)[::-1][:_PIXELS]
    chosen = chosen[totals[chosen] >= 1000]
    if not chosen.size:
        raise ValueError(f"cube must have a pixel of 1000 registrations, got at most {int(totals.max()):,}")
    some = np.ascontiguousarray(given.counts[chosen])

    def trial(at: FloatArray) -> System:
        sigma = float(np.clip(np.exp(at[1]), 2e-6 * system.period_ns, 0.2 * system.period_ns))
        dead = float(max(at[0], 0.0))
        return system.replace(pulse=GaussianPulse(sigma_ns=sigma), detector=replace(system.detector, dead_time_ns=dead))

    def loss(at: FloatArray) -> float:
        return -_log_likelihood(some, trial(at))

    low, high = system.pulse.support_ns()
    width = system.pulse.sigma_ns if isinstance(system.pulse, GaussianPulse) else (high - low) / 8.0
    widths = np.log(width) + np.array([-2.5, -1.2, 0.0, 1.2, 2.5])
    dead = checks.real("dead_time_ns", system.detector.dead_time_ns)
    most = max(1.5 * dead, 0.95 * system.period_ns)
    grid = np.r_[dead, np.linspace(0.0, most, _GRID)]
    start = min(([dead, w] for w in widths), key=lambda at: loss(np.array(at)))
    start = min(([d, start[1]] for d in grid), key=lambda at: loss(np.array(at)))
    simplex = np.array([start, [start[0] + most / _GRID, start[1]], [start[0], start[1] + 0.4]])
    options: Any = {"initial_simplex": simplex, "fatol": _DECREASE, "xatol": 1e-4, "maxiter": 80}
    best = minimize(loss, np.array(start), method="Nelder-Mead", options=options)
    at = np.asarray(best.x, np.float64)
    errors = np.array([_half_width(loss, at, k, float(best.fun)) for k in range(2)])
    final = trial(at)
    light = MaximumLikelihood().estimate(Histograms(some, final, 1))
    p_values = np.asarray(light.p_value)
    darkest = int(np.argmin(light.background))
    floor = float(light.background[darkest])
    floor_error = 0.0 if light.background_error is None else float(np.nan_to_num(light.background_error[darkest]))
    sigma = float(np.exp(at[1]))
    estimates = {
        "dead_time_ns": _normal(final.detector.dead_time_ns, errors[0]),
        "pulse_sigma_ns": _normal(sigma, sigma * errors[1]),
        "background_floor": _normal(floor, floor_error),
    }
    return CubeCalibration(estimates, final, p_values[np.isfinite(p_values)])


def _normal(value: float, error: float) -> Estimate:
    return Estimate(value, error, value - 1.96 * error, value + 1.96 * error)


def _half_width(loss: Callable[[FloatArray], float], at: FloatArray, k: int, least: float) -> float:
    """Distance at which the loss is a half above its least, the mean of both sides: one standard error."""
    sides = []
    for sign in (-1.0, 1.0):
        step = 1e-4 * max(abs(at[k]), 1.0)
        for _ in range(40):
            moved = at.copy()
            moved[k] += sign * step
            rise = loss(moved) - least
            if rise > 0.5:
                break
            step *= 1.5
        sides.append(step * (0.5 / max(rise, 0.5)) ** 0.5)
    return float(np.mean(sides))


def _log_likelihood(counts: FloatArray, system: System) -> float:
    """Sum over the pixels of the quasi-likelihood at the most likely light of each."""
    from mars_lidar._base.native import _core

    histograms = Histograms(counts, system, 1)
    fit = MaximumLikelihood().estimate(histograms)
    light = np.stack([fit.signal, np.maximum(fit.background, 1e-9), fit.delay], axis=1)
    expected = np.empty(counts.shape)
    _core.expected_registrations(histograms.recording, counts, light, expected)
    return float((counts * np.log(np.maximum(expected, 1e-9))).sum() - expected.sum())
