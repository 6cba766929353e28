"""Maximum likelihood of the light from registrations and armed passes, by Fisher scoring.

log L = sum_j h_j log l_j - sum_j l_j D_j with h_j registrations, D_j armed passes and l_j photons per period in bin
j: the exact likelihood of a free-running pixel, for bins that are narrow beside the pulse. The armed passes take the
place of the exposure, so that the dead time needs no further thought: score J'(h / l - D), information J' (D / l) J.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import ArmedTime
from mars_lidar.calibrate.calibration_light import LEAST, Light
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse

_STEPS = 200
_CONVERGED = 1e-8  # Newton decrement: twice what log L could still gain
_DIGITS, _CORNERS = 1e-3, 0.5  # the same where no step gains: half a standard error, with corners
_LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e8  # of a step, in parts of the information of each parameter
_SLOW, _GAIN = 5, 1e-5  # so many damped steps in turn that gain less than this are on a ridge without end
_FEW = 20.0  # photons of the background
_WIDTHS = 24  # pulse widths tried to begin with, where it is not known


@dataclass(frozen=True, eq=False)
class Fit:
    """The maximum: parameters, their information matrix, log L, and whether the scoring converged."""

    theta: FloatArray
    information: FloatArray
    log_likelihood: float
    converged: bool


def log_likelihood(seen: ArmedTime, rate: FloatArray) -> float:
    """log L up to a constant; -inf where something registered in a bin without light."""
    some = seen.registrations > 0
    if (rate[some] <= 0).any():
        return -np.inf
    # sums, not products of vectors: BLAS starts threads for these, and waits for them on a busy machine
    return float((seen.registrations[some] * np.log(rate[some])).sum() - (rate * seen.passes).sum())


def fit(seen: ArmedTime, light: Light, theta: FloatArray) -> Fit:
    """Fisher scoring from `theta`, damped (Levenberg, Marquardt) where a full step gains nothing.

    Parameters at 0 that want to be negative stay there. Damped steps, unlike shorter ones, still move what is well
    known where a combination of others is not: a bright pulse behind a wide jitter tells little of signal and width.
    """
    theta = light.bounded(theta)
    best = log_likelihood(seen, light.rate(theta)) + light.known(theta)[0]
    converged, slow, damping = False, 0, 0.0
    information = np.zeros((theta.size, theta.size))
    for _ in range(_STEPS):
        rate, slopes = light.jacobian(theta)
        rate = np.maximum(rate, 1e-300)
        _, pull, stiff = light.known(theta)
        score = slopes.T @ (seen.registrations / rate - seen.passes) + pull
        information = slopes.T @ ((seen.passes / rate)[:, None] * slopes) + stiff
        free = _free(light, theta, score, information)
        decrement = float(_step(information, score, free, 0.0) @ score)
        if decrement < _CONVERGED:
            converged = True
            break
        damping = damping / 100.0 if damping > 100.0 * _LEAST_DAMPING else 0.0
        while damping < _MOST_DAMPING:
            trial = light.bounded(theta + _step(information, score, free, damping))
            found = log_likelihood(seen, light.rate(trial)) + light.known(trial)[0]
            if found > best:
                break
            damping = max(10.0 * damping, _LEAST_DAMPING)
        else:  # log L is at the end of its digits, or has the corners of a sampled pulse
            converged = decrement < (_CORNERS if isinstance(light.pulse, SampledPulse) else _DIGITS)
            break
        slow = slow + 1 if damping > 0.0 and found - best < _GAIN else 0
        theta, best = trial, found
        if light.is_brightest(theta):
            break
        if slow == _SLOW:
            converged = decrement < _DIGITS
            break
    return Fit(theta, _not_sure(seen, light, theta, information), best, converged)


def _not_sure(seen: ArmedTime, light: Light, theta: FloatArray, information: FloatArray) -> FloatArray:
    """The information with one photon more of a background that is made of few, or that of none would be infinite."""
    one = 1.0 / max(float(seen.passes.mean()), 1e-300)
    if theta[0] > _FEW * one:
        return information
    more = theta.copy()
    more[0] += one
    rate, slopes = light.jacobian(more)
    return np.asarray(slopes.T @ ((seen.passes / np.maximum(rate, 1e-300))[:, None] * slopes) + light.known(more)[2])


def _free(light: Light, theta: FloatArray, score: FloatArray, information: FloatArray) -> NDArray[np.bool_]:
    """Which parameters may move: none beyond the range of its light, and no delay of a return without light."""
    k = light.returns
    free = np.ones(theta.size, bool)
    at_zero = (theta[: 1 + k] <= LEAST) & (score[: 1 + k] <= 0)
    free[: 1 + k] = ~at_zero
    free[1 + k : 1 + 2 * k] = ~at_zero[1:]
    if light.fit_width and at_zero[1:].all():
        free[1 + 2 * k] = False
    if light.fit_width and theta[1 + 2 * k] <= light.least_sigma_ns and score[1 + 2 * k] <= 0:
        free[1 + 2 * k] = False
    free &= np.diag(information) > 0
    return free


def _step(information: FloatArray, score: FloatArray, free: NDArray[np.bool_], damping: float) -> FloatArray:
    """Scoring step (p,) of the free parameters; by least squares where the information has lost rank."""
    matrix = information[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.diag(matrix))
    scaled = matrix * scale * scale[:, None] + damping * np.eye(scale.size)
    step = np.zeros(score.size)
    step[free] = scale * np.linalg.lstsq(scaled, scale * score[free], rcond=1e-12)[0]
    return step


def covariance(light: Light, found: Fit) -> FloatArray:
    """Inverse of the information (parameters, parameters); NaN for what cannot be told (a delay without light)."""
    k = light.returns
    told = np.diag(found.information) > 0
    dark = found.theta[1 : 1 + k] <= 2 * LEAST
    told[1 + k : 1 + 2 * k] &= ~dark
    if light.fit_width and dark.all():
        told[1 + 2 * k] = False
    out = np.full(found.information.shape, np.nan)
    matrix = found.information[np.ix_(told, told)]
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.pinv(matrix * scale * scale[:, None], rcond=1e-12, hermitian=True)
    out[np.ix_(told, told)] = inverse * scale * scale[:, None]
    return out


def initial(seen: ArmedTime, light: Light) -> FloatArray:
    """Where to begin: the returns one after the other by a matched filter on the unrestricted rates."""
    total = float(seen.registrations.sum()) / max(float(seen.passes.mean()), 1e-300)
    rate = seen.rate
    weight = np.minimum(seen.passes / max(float(seen.passes.mean()), 1e-300), 1.0)  # noisy where hardly armed
    level = float(np.median(rate))
    left = (rate - level) * weight
    pulse, sigma = light.pulse, 0.0
    if light.fit_width:
        widths = np.geomspace(1.0 / light.bins, 0.15, _WIDTHS) * light.period_ns
        gains = [float(_matched(left, GaussianPulse(sigma_ns=float(w)), light)[0].max()) for w in widths]
        sigma = float(widths[int(np.argmax(gains))])
        pulse = GaussianPulse(sigma_ns=sigma)
    signals, delays = [], []
    for _ in range(light.returns):
        gain, norm = _matched(left, pulse, light)
        place = int(np.argmax(gain))
        delay = place * light.period_ns / light.bins
        strength = max(float(gain[place]) / norm, 1e-3 * total / light.returns)
        signals.append(strength)
        delays.append(delay)
        left = left - strength * pulse.bin_energy(delay, light.period_ns, light.bins) * weight
    background = max(float(rate.sum()) - sum(signals), 1e-2 * total, 1e-6)
    jitter = light.jitter_ns
    if light.fit_jitter:  # well within the pulse: at its width the likelihood is flat
        jitter = min(jitter, 0.7 * (sigma if light.fit_width else getattr(pulse, "sigma_ns", jitter)))
    return light.before(np.array([background, *signals, *delays, sigma]), jitter)


def _matched(rate: FloatArray, pulse: Pulse, light: Light) -> tuple[FloatArray, float]:
    """Correlation (n,) of the rates with the unit-norm pulse at each delay, and that norm."""
    template = pulse.bin_energy(0.0, light.period_ns, light.bins)
    norm = float(np.sqrt((template**2).sum()))
    spectrum = np.fft.rfft(rate) * np.conj(np.fft.rfft(template))
    return np.fft.irfft(spectrum, light.bins) / norm, norm
