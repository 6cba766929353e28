"""What a calibration found: light, dead time and jitter, their errors, and the system to simulate with."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import ArmedTime
from mars_lidar.calibrate.calibration_light import Light
from mars_lidar.calibrate.calibration_rapp import RappEstimate
from mars_lidar.calibrate.intervals import Summary
from mars_lidar.calibrate.jittered import normal_kernel, unblurred
from mars_lidar.instrument.effects import Jitter
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.light.flux import Flux


@dataclass(frozen=True, eq=False)
class Calibration:
    """What light made a stream, and what detector recorded it; made by `calibrate`.

    Attributes
    ----------
    background
        B, photons per period. With a free shape 0: all light is in the waveform.
    returns_signal, returns_delay_ns
        (K,) S, photons per period, and delay, ns, of each return, the earliest first; (0,) with a free shape.
    pulse
        The pulse as it is recorded, jitter and all, with its fitted width; None with a free shape.
    waveform
        (n,) photons per period in n equal parts of the period as they are recorded, for a free shape; else None.
    dead_time_ns, dead_time_error_ns
        As given (error 0), or estimated, and the standard error: see `dead_time_by`.
    hold_off_ns
        Intervals shorter than this, and the time up to it, were left out of the fit.
    too_short
        Intervals shorter than the dead time by more than a unit of the clock, or more than the jitter can make them:
        the model has no place for them.
    names, covariance
        Parameters of the fit and their covariance (inverse Fisher information); NaN for what the data cannot tell.
    rapp
        Rapp's estimate of the same.
    armed
        Registrations and armed passes by phase, from which the fit was made.
    summary
        The stream in numbers.
    converged
        Whether the likelihood was maximised.
    jitter_ns, jitter_error_ns
        Sigma of the Gaussian jitter of each record, which `pulse` holds: as given (error 0), or by the edge of the
        recovery; 0 where there is none, or none is seen.
    jitter_limit_ns
        Where none is seen, or none fits: jitters up to this leave the shortest intervals as likely, to a factor of
        e^4. What one that hides does to dead time and light is in their errors. Else 0.
    edge_fits
        False where the dead time was to be estimated from an edge that is neither sharp nor one that a Gaussian jitter
        makes: a slow quench, a second dead time, a clock too coarse.
    dead_time_by
        ``"given"``; ``"smallest interval"``, less its mean excess over the dead time, where the edge of the recovery is
        sharp; ``"edge"``, the middle of an edge that jitter has blurred; ``"recovery"`` (of `inspect`), with the time
        constant of a slow one.
    simulated
        For a detector with effects: how many times longer than this one the simulated stream is by which the bias
        of the likelihood was taken off; else 0.
    unknown
        What the stream cannot tell, a sentence each; the errors of that are NaN.
    """

    background: float
    returns_signal: FloatArray
    returns_delay_ns: FloatArray
    pulse: Pulse | None
    waveform: FloatArray | None
    dead_time_ns: float
    dead_time_error_ns: float
    hold_off_ns: float
    too_short: int
    names: tuple[str, ...]
    covariance: FloatArray
    rapp: RappEstimate
    armed: ArmedTime
    summary: Summary
    converged: bool
    jitter_ns: float = 0.0
    jitter_error_ns: float = 0.0
    dead_time_by: Literal["given", "smallest interval", "edge", "recovery"] = "given"
    jitter_limit_ns: float = 0.0
    edge_fits: bool = True
    simulated: float = 0.0
    unknown: tuple[str, ...] = ()

    __repr__ = brief

    @property
    def signal(self) -> float:
        """S of all returns, photons per period (of all light, with a free shape)."""
        if self.waveform is not None:
            return float(self.waveform.sum())
        return float(self.returns_signal.sum())

    @property
    def delay_ns(self) -> float:
        """Delay of the strongest return, ns; NaN with a free shape."""
        if self.returns_signal.size == 0:
            return math.nan
        return float(self.returns_delay_ns[int(self.returns_signal.argmax())])

    @property
    def total(self) -> float:
        """Lambda = S + B, photons per period."""
        return self.signal + self.background

    @property
    def errors(self) -> dict[str, float]:
        """Standard error of each parameter; NaN for what the data cannot tell (the delay of no light, say)."""
        with np.errstate(invalid="ignore"):
            return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def total_error(self) -> float:
        """Standard error of Lambda; NaN where a part of it is not known."""
        lights = [k for k, name in enumerate(self.names) if name.startswith(("signal", "background"))]
        part = self.covariance[np.ix_(lights, lights)]
        return float(np.sqrt(max(float(part.sum()), 0.0))) if np.isfinite(part).all() else math.nan

    @property
    def disagreement(self) -> float:
        """How far Rapp's total is from this one, in standard errors; NaN where there is none to compare.

        The likelihood is as sure as can be, so that the variance of the difference is that of Rapp's less its own.
        """
        rapp, mine = self.rapp.total_error, self.total_error
        if self.simulated or not (math.isfinite(self.rapp.total) and 0.0 < rapp < math.inf):
            return math.nan
        if math.isnan(mine):  # by the number of photons alone
            mine = self.total / math.sqrt(max(self.armed.used, 1))
        spread = max(rapp**2 - mine**2, 0.25 * rapp**2)
        return (self.rapp.total - self.total) / math.sqrt(spread)

    @property
    def rate(self) -> FloatArray:
        """Photons per period (n,) in each of the bins of `armed`, as they are recorded."""
        if self.waveform is not None:
            return self._even(self.waveform)
        return self._light.rate(self._parameters)

    @property
    def slopes(self) -> FloatArray:
        """Derivatives (n, parameters) of `rate` by `parameters`; not of a free shape."""
        error = self.jitter_error_ns if "jitter_ns" in self.names else 0.0
        light = replace(self._light, fit_width="sigma_ns" in self.names, jitter_error_ns=error)
        return light.recorded_jacobian(self.parameters)

    @property
    def arriving(self) -> FloatArray:
        """Photons per period (n,) in each of the bins of `armed`, as they arrive: without the jitter of the records."""
        if self.waveform is not None:
            return self._even(self._sharp_waveform)
        return self._light.arriving(self._parameters)

    def arriving_in(self, bins: int) -> FloatArray:
        """`arriving` in so many equal parts of the period; not of a free shape."""
        return replace(self._light, bins=bins).arriving(self._parameters)

    @property
    def parameters(self) -> FloatArray:
        """What was fitted, in the order of `names`; the waveform (n,) of a free shape."""
        if self.waveform is not None:
            return self.waveform
        width = [self.pulse.sigma_ns] if "sigma_ns" in self.names and isinstance(self.pulse, GaussianPulse) else []
        jitter = [self.jitter_ns] if "jitter_ns" in self.names else []
        return np.concatenate([self._parameters, width, jitter])

    def moved(self, step: FloatArray) -> Calibration:
        """This calibration with other `parameters`; no light is negative, and no width changes by more than half."""
        if self.waveform is not None:
            return replace(self, waveform=np.maximum(self.waveform + step, 0.0))
        k, period = self.returns_signal.size, self.summary.period_ns
        pulse, jitter = self.pulse, self.jitter_ns
        if "sigma_ns" in self.names and isinstance(pulse, GaussianPulse):
            sigma = pulse.sigma_ns
            pulse = GaussianPulse(sigma_ns=float(np.clip(sigma + step[1 + 2 * k], 0.5 * sigma, 1.5 * sigma)))
        if "jitter_ns" in self.names:
            jitter = float(np.clip(jitter + step[-1], 0.5 * jitter, 1.5 * jitter))
        return replace(
            self,
            background=float(max(self.background + step[0], 0.0)),
            returns_signal=np.maximum(self.returns_signal + step[1 : 1 + k], 0.0),
            returns_delay_ns=(self.returns_delay_ns + step[1 + k : 1 + 2 * k]) % period,
            pulse=pulse,
            jitter_ns=jitter,
        )

    @property
    def _light(self) -> Light:
        assert self.pulse is not None
        period, bins = self.summary.period_ns, self.armed.passes.size
        return Light(period, bins, self.pulse, self.returns_signal.size, False, self.jitter_ns)

    @property
    def _parameters(self) -> FloatArray:
        return np.concatenate([[self.background], self.returns_signal, self.returns_delay_ns])

    @property
    def _sharp_waveform(self) -> FloatArray:
        assert self.waveform is not None
        if self.jitter_ns == 0.0:
            return self.waveform
        kernel = normal_kernel(self.jitter_ns, self.summary.period_ns, self.waveform.size)
        return unblurred(self.waveform, kernel)

    def _even(self, waveform: FloatArray) -> FloatArray:
        """A waveform in the bins of `armed`."""
        each = self.armed.passes.size // waveform.size
        return np.asarray(np.repeat(waveform / each, each), dtype=np.float64)

    def flux(self, pixels: int = 1) -> Flux:
        """The light of one pixel, to simulate with `system`; or of a row of so many alike.

        Delays are those of the pulse of `system`: of a measured pulse with jitter, of the centroid.
        """
        row = np.ones((1, pixels))
        if self.waveform is not None:
            return Flux(waveform=row[..., None] * self._sharp_waveform, background=0.0)
        delays = (self.returns_delay_ns + self._light.shift_ns) % self.summary.period_ns
        lights = zip(self.returns_signal.tolist(), delays.tolist(), strict=True)
        each = [Flux(s * row, 0.0, tau) for s, tau in lights]
        if len(each) > 1:
            return Flux.multi(*each, Flux(0.0 * row, self.background, 0.0))
        return Flux(float(self.returns_signal[0]) * row, self.background, float(delays[0]))

    def system(self, cycles: int, bins: int, start: Literal["armed", "stationary"] = "stationary") -> System:
        """The instrument, to simulate and predict with; a stretch cut from a running stream is ``stationary``."""
        if self.pulse is None:  # of no consequence beside a waveform
            pulse: Pulse = GaussianPulse(sigma_ns=0.01 * self.summary.period_ns)
            sigma = self.jitter_ns
        else:
            pulse, sigma = self._light.before_jitter(self._parameters)
        jitter = Jitter(sigma_ns=sigma) if sigma else None
        return System(
            period_ns=self.summary.period_ns,
            cycles=cycles,
            bins=bins,
            pulse=pulse,
            detector=Detector(dead_time_ns=self.dead_time_ns, jitter=jitter),
            start=start,
        )

    def light_arguments(self) -> dict[str, Any]:
        """Signal, background and delay or waveform, as `count_law` and `joint_law` take them."""
        if self.waveform is not None:
            return {"signal": None, "background": 0.0, "waveform": self._sharp_waveform}
        if self.returns_signal.size == 1:
            delay = self.delay_ns + self._light.shift_ns
            return {"signal": self.signal, "background": self.background, "delay_ns": delay}
        return {
            "signal": None,
            "background": self.background,
            "waveform": self.arriving - self.background / self.armed.passes.size,
        }


def nearest(found: Calibration, step: FloatArray) -> FloatArray:
    """A step whose delays do not go around the period."""
    if found.waveform is not None:
        return step
    k, period = found.returns_signal.size, found.summary.period_ns
    out = step.copy()
    out[1 + k : 1 + 2 * k] = (step[1 + k : 1 + 2 * k] + 0.5 * period) % period - 0.5 * period
    return out
