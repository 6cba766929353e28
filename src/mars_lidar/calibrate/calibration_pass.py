"""One pass of a calibration: the light by maximum likelihood, for a dead time, a hold-off and a jitter."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import ArmedTime, Sensitivity, armed_time, fine_light
from mars_lidar.calibrate.calibration_fit import Fit, covariance, fit, initial
from mars_lidar.calibrate.calibration_light import Light
from mars_lidar.calibrate.calibration_rapp import split, total_of
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.intervals import SHAPE_BINS, Stream, Summary, fine_bins, free_bins
from mars_lidar.instrument.pulse import GaussianPulse, Pulse

_CROWDED, _FINER = 0.05, 64  # photons of a bin of a free shape above which light within it matters; parts of it
_RECOVERED = 10.0  # time constants after which no more than 5e-5 of the sensitivity are missing
_SHORT = 1e-7  # false-alarm probability of intervals shorter than the dead time
CERTAIN = 8.5  # jitters behind a dead time after which a pixel is armed for certain: 6 of a difference of two


@dataclass(frozen=True)
class Watch:
    """What a calibration takes the detector for, ns: dead time, hold-off, jitter, recovery; an error is 0 if given."""

    dead_ns: float
    hold_ns: float
    jitter_ns: float = 0.0
    jitter_error_ns: float = 0.0
    dead_error_ns: float = 0.0
    by: Literal["given", "smallest interval", "edge", "recovery"] = "given"
    recovery_ns: float = 0.0

    @property
    def sensitivity(self) -> Sensitivity | None:
        """Of ages beyond the dead time; None: at once all of it."""
        return Sensitivity(self.dead_ns, self.recovery_ns) if self.recovery_ns > 0.0 else None


def fitted(
    stream: Stream,
    counted: Summary,
    shape: Pulse | Literal["gaussian", "free"],
    watch: Watch,
    returns: int,
    near: Calibration | None = None,
    *,
    divided: bool = True,
) -> Calibration:
    """Light of the likelihood, without a bias taken off; `near`: another calibration, to begin with its light.

    `divided`: Rapp's total is divided by the shape of the histogram, which takes longer than all the rest.
    """
    from scipy.special import ndtri

    dead, hold = watch.dead_ns, watch.hold_ns
    # jitters by which the shortest of the intervals of the dead time is less than it, once in 10^7 streams
    below = math.sqrt(2.0) * float(-ndtri(_SHORT / max(stream.registrations, 1)))
    slack = 1.5 * stream.unit_ns + 1e-6 * stream.period_ns  # two roundings of the clock; of the engines' phases
    slack += below * (watch.jitter_ns + 3.0 * watch.jitter_error_ns) + 4.0 * watch.dead_error_ns
    short = 0
    if counted.smallest_ns.size and counted.smallest_ns[0] < dead - slack:
        short = sum(int((dt < dead - slack).sum()) for dt in stream.intervals())
    if shape == "free":
        seen, waveform, matrix = _free(stream, watch)
        names: tuple[str, ...] = ("signal",)
        returns, theta, recorded, converged = 0, np.zeros(1), None, True
        jitter, jitter_error = watch.jitter_ns, watch.jitter_error_ns
    else:
        seen, light, found = _pulsed(stream, shape, watch, returns, near)
        waveform, names, recorded, converged = None, light.names, light.pulse_of(found.theta), found.converged
        theta, matrix = _in_order(*light.recorded(found.theta, covariance(light, found)), returns, stream.period_ns)
        jitter = light.jitter_of(found.theta)
        jitter_error = math.sqrt(matrix[-1, -1]) if light.fit_jitter else watch.jitter_error_ns
    calibration = Calibration(
        float(theta[0]),
        theta[1 : 1 + returns],
        theta[1 + returns : 1 + 2 * returns],
        recorded,
        waveform,
        dead,
        watch.dead_error_ns,
        hold,
        short,
        names,
        matrix,
        total_of(stream, max(hold, dead + _RECOVERED * watch.recovery_ns)),
        seen,
        counted,
        converged,
        jitter,
        jitter_error,
        watch.by,
    )
    return with_division(stream, calibration) if divided and watch.sensitivity is None else calibration


def _free(stream: Stream, watch: Watch) -> tuple[ArmedTime, FloatArray, FloatArray]:
    """Light (n,) bin by bin, and the variance (1, 1) of its sum."""
    bins = free_bins(stream.bins)
    seen = armed_time(stream, watch.hold_ns, bins, watch.sensitivity)
    rate, finer, bias = seen.rate, _FINER, 0.0
    while finer > 1 and stream.units % (finer * bins) and 0 < stream.units < 4 * finer * bins:
        finer //= 2
    if (rate > _CROWDED).any() and finer > 1:  # a pulse within a bin, of which few passes see more than the start
        fine = fine_light(stream, watch.hold_ns, finer * bins, bins, watch.sensitivity)
        rate = fine.reshape(bins, finer).sum(1)
        # a registration in the middle of a cell stands for one anywhere: light l is taken for l (1 - l^2 / 12)
        bias = float((fine**3).sum()) / 12.0
    # var of h / D is h / D^2; the bins are independent given the armed time
    some = seen.passes > 0
    spread = float((seen.registrations[some] / seen.passes[some] ** 2).sum())
    return seen, rate, np.array([[spread + bias**2]])


def _pulsed(
    stream: Stream, shape: Pulse | Literal["gaussian"], watch: Watch, returns: int, near: Calibration | None
) -> tuple[ArmedTime, Light, Fit]:
    """Returns of a pulse, on bins that are narrow beside it."""
    free_width, hold, law = isinstance(shape, str), watch.hold_ns, watch.sensitivity
    pulse = GaussianPulse(sigma_ns=0.01 * stream.period_ns) if isinstance(shape, str) else shape
    known = pulse if near is None or near.pulse is None else near.pulse
    bins = fine_bins(stream, None if free_width and near is None else known)
    seen = armed_time(stream, hold, bins, law)
    joint = watch.jitter_error_ns if isinstance(pulse, GaussianPulse) else 0.0
    light = Light(stream.period_ns, bins, pulse, returns, free_width, watch.jitter_ns, joint)
    if near is not None:
        return seen, light, fit(seen, light, light.before(near.parameters, near.jitter_ns or watch.jitter_ns))
    start = initial(seen, light)
    if free_width:  # the width tells how fine the grid must be
        start = fit(seen, light, start).theta
        finer = fine_bins(stream, light.pulse_of(start))
        if finer > bins:
            seen, light = armed_time(stream, hold, finer, law), replace(light, bins=finer)
    return seen, light, fit(seen, light, start)


def with_division(stream: Stream, found: Calibration) -> Calibration:
    """With Rapp's total divided into signal and background, of a single return."""
    if found.pulse is None or found.returns_signal.size != 1:
        return found
    bins = min(SHAPE_BINS, stream.bins)
    return replace(found, rapp=split(stream, found.rapp, found.pulse, found.delay_ns, found.dead_time_ns, bins))


def _in_order(theta: FloatArray, matrix: FloatArray, k: int, period_ns: float) -> tuple[FloatArray, FloatArray]:
    """Delays within the period, the earliest return first."""
    theta = theta.copy()
    theta[1 + k : 1 + 2 * k] %= period_ns
    theta[: 1 + k][theta[: 1 + k] <= 2e-9] = 0.0  # the fit's floor stands for none
    order = np.argsort(theta[1 + k : 1 + 2 * k])
    place = np.concatenate([[0], 1 + order, 1 + k + order, np.arange(1 + 2 * k, theta.size)])
    return theta[place], matrix[np.ix_(place, place)]
