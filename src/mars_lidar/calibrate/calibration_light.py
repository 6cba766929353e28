"""The light that a calibration fits: background, returns, a pulse, and the jitter that blurs its records."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.jittered import Records, before_blur, normal_kernel, split_sigma
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse

LEAST = 1e-9  # photons per period that stand for none
MOST_BLURRED = 500.0  # photons per period of a jittered pixel: e^-photons is a number, and more look the same
_SPREAD = 1e-3  # step of a numerical derivative, in widths of the pulse


@dataclass(frozen=True)
class Light:
    """Background, K returns and the pulse: the parameters, in the order background, signals, delays, width, jitter.

    `pulse` is the recorded one. With `jitter_ns` it holds the jitter, and rates are those of the records
    (`Records`); with a `jitter_error_ns` the jitter is a parameter that something else, the edge of
    the recovery, knows this well. With `fit_width` the pulse is Gaussian, and the sigma that it has before the
    jitter is a parameter; `recorded` tells what it is with the jitter.
    """

    period_ns: float
    bins: int
    pulse: Pulse
    returns: int
    fit_width: bool
    jitter_ns: float = 0.0
    jitter_error_ns: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters; those of several returns are numbered from 1."""
        tails = [""] if self.returns == 1 else [f"_{k}" for k in range(1, self.returns + 1)]
        width = ("sigma_ns",) if self.fit_width else ()
        jitter = ("jitter_ns",) if self.fit_jitter else ()
        return ("background", *(f"signal{t}" for t in tails), *(f"delay_ns{t}" for t in tails), *width, *jitter)

    @property
    def fit_jitter(self) -> bool:
        """Whether the jitter is a parameter."""
        return self.jitter_error_ns > 0.0

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 1 + 2 * self.returns + self.fit_width + self.fit_jitter

    def pulse_of(self, theta: FloatArray) -> Pulse:
        """The recorded pulse, with its fitted width."""
        if not self.fit_width:
            return self.pulse
        return GaussianPulse(sigma_ns=math.hypot(float(theta[1 + 2 * self.returns]), self.jitter_of(theta)))

    def jitter_of(self, theta: FloatArray) -> float:
        """The jitter, ns."""
        return float(theta[-1]) if self.fit_jitter else self.jitter_ns

    def before_jitter(self, theta: FloatArray) -> tuple[Pulse, float]:
        """The pulse of the light, and the jitter that makes it the recorded one, ns."""
        pulse, jitter = self.pulse, self.jitter_of(theta)
        if self.fit_width:
            return GaussianPulse(sigma_ns=float(theta[1 + 2 * self.returns])), jitter
        if jitter > 0.0 and isinstance(pulse, SampledPulse):
            return before_blur(pulse, jitter)[0], jitter
        if jitter == 0.0 or not isinstance(pulse, GaussianPulse):
            return pulse, 0.0
        sigma, jitter = split_sigma(pulse.sigma_ns, jitter)
        return GaussianPulse(sigma_ns=sigma), jitter

    @property
    def shift_ns(self) -> float:
        """What the pulse before the jitter is further away than the recorded one: its delay is that of its centroid."""
        if self.jitter_ns > 0.0 and isinstance(self.pulse, SampledPulse):
            return before_blur(self.pulse, self.jitter_ns)[1]
        return 0.0

    def arriving(self, theta: FloatArray) -> FloatArray:
        """Photons per period in each bin (n,), as they arrive."""
        k = self.returns
        delay = theta[1 + k : 1 + 2 * k] + self.shift_ns
        energy = self.before_jitter(theta)[0].bin_energy(delay, self.period_ns, self.bins)
        return np.asarray(theta[0] / self.bins + theta[1 : 1 + k] @ energy)

    def rate(self, theta: FloatArray) -> FloatArray:
        """Photons per period in each bin (n,), as they are recorded."""
        jitter = self.before_jitter(theta)[1]
        rate = self.arriving(theta)
        return rate if jitter == 0.0 else self._records(rate, jitter).rate

    def jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rate (n,) and its derivatives (n, parameters)."""
        k = self.returns
        signal, delay = theta[1 : 1 + k], theta[1 + k : 1 + 2 * k] + self.shift_ns
        pulse, jitter = self.before_jitter(theta)
        step = 0.5 * pulse.bin_ns if isinstance(pulse, SampledPulse) else _SPREAD * getattr(pulse, "sigma_ns", 0.0)
        energy = pulse.bin_energy(delay, self.period_ns, self.bins)
        later = pulse.bin_energy(delay + step, self.period_ns, self.bins)
        earlier = pulse.bin_energy(delay - step, self.period_ns, self.bins)
        rate = theta[0] / self.bins + signal @ energy
        columns = [np.full((1, self.bins), 1.0 / self.bins), energy, signal[:, None] * (later - earlier) / (2 * step)]
        if jitter > 0.0:
            records = self._records(rate, jitter)
            rate = records.rate
            columns = [np.stack([records.slope(row) for row in part]) for part in columns]
        for place in range(1 + 2 * k, self.size):  # width and jitter
            change = np.zeros(self.size)
            change[place] = _SPREAD * theta[place]
            difference = self.rate(theta + change) - self.rate(theta - change)
            columns.append((difference / (2.0 * change[place]))[None])
        return rate, np.concatenate(columns).T

    def known(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """What is known beside the stream of the parameters: log likelihood, score (p,) and information (p, p)."""
        score, information = np.zeros(self.size), np.zeros((self.size, self.size))
        if not self.fit_jitter:
            return 0.0, score, information
        off = (self.jitter_ns - theta[-1]) / self.jitter_error_ns
        score[-1], information[-1, -1] = off / self.jitter_error_ns, self.jitter_error_ns**-2
        return -0.5 * off * off, score, information

    def bounded(self, theta: FloatArray) -> FloatArray:
        """Parameters within their ranges."""
        k = self.returns
        out = theta.copy()
        out[: 1 + k] = np.maximum(out[: 1 + k], LEAST)
        if self.jitter_ns > 0.0:
            out[: 1 + k] *= min(1.0, MOST_BLURRED / float(out[: 1 + k].sum()))
        if self.fit_width:
            out[1 + 2 * k] = np.clip(out[1 + 2 * k], self.least_sigma_ns, 0.5 * self.period_ns)
        if self.fit_jitter:
            out[-1] = np.clip(out[-1], 0.05 * self.jitter_ns, 4.0 * self.jitter_ns)
        return out

    def is_brightest(self, theta: FloatArray) -> bool:
        """Whether there is as much light as a jittered pixel may have: its likelihood grows, if at all, for ever."""
        return self.jitter_ns > 0.0 and float(theta[: 1 + self.returns].sum()) > 0.99 * MOST_BLURRED

    @property
    def least_sigma_ns(self) -> float:
        """The narrowest pulse that is told from a narrower one: a tenth of the jitter, of 20 bins or so."""
        return max(2e-6 * self.period_ns, 0.1 * self.jitter_ns)

    def before(self, recorded: FloatArray, jitter_ns: float) -> FloatArray:
        """Parameters from background, signals, delays and, with a fitted width, the recorded sigma; and a jitter."""
        place = 1 + 2 * self.returns
        width, jitter = [], [jitter_ns] if self.fit_jitter else []
        if self.fit_width:
            width = [math.sqrt(max(float(recorded[place]) ** 2 - jitter_ns**2, self.least_sigma_ns**2))]
        return np.array([*recorded[:place], *width, *jitter])

    def recorded(self, theta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Parameters and their covariance with the recorded sigma in place of the one before the jitter."""
        jitter = self.jitter_of(theta)
        if not self.fit_width or jitter == 0.0:
            return theta, covariance
        out, slopes = theta.copy(), self._slopes_of_recorded(theta)
        out[1 + 2 * self.returns] = math.hypot(theta[1 + 2 * self.returns], jitter)
        known = np.where(np.isfinite(covariance), covariance, 0.0)
        return out, np.where(np.isfinite(covariance), slopes @ known @ slopes.T, covariance)

    def recorded_jacobian(self, recorded: FloatArray) -> FloatArray:
        """Derivatives (n, parameters) of the rate by what `recorded` gives."""
        theta = self.before(recorded, float(recorded[-1]) if self.fit_jitter else self.jitter_ns)
        return np.asarray(np.linalg.solve(self._slopes_of_recorded(theta).T, self.jacobian(theta)[1].T).T)

    def _slopes_of_recorded(self, theta: FloatArray) -> FloatArray:
        """Derivatives of the parameters with the recorded sigma by those with the one before the jitter."""
        slopes, jitter = np.eye(self.size), self.jitter_of(theta)
        if self.fit_width and jitter > 0.0:
            place = 1 + 2 * self.returns
            recorded = math.hypot(theta[place], jitter)
            slopes[place, place] = theta[place] / recorded
            if self.fit_jitter:
                slopes[place, -1] = jitter / recorded
        return slopes

    def _records(self, rate: FloatArray, jitter_ns: float) -> Records:
        return Records(rate, normal_kernel(jitter_ns, self.period_ns, self.bins))
