"""The verb `calibrate`: signal, background, delay and dead time of a measured stream, with standard errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mars_lidar import _validate
from mars_lidar._brief import brief
from mars_lidar.estimate.calibration_fit import Light, covariance, fit, initial
from mars_lidar.estimate.calibration_rapp import RappEstimate, split, total_of
from mars_lidar.estimate.detector_model import is_plain, pulse_of_the_light, recorded_pulse, stream_detector, watched
from mars_lidar.estimate.intervals import ArmedTime, FloatArray, Stream, Summary, armed_time, stream_of, summary_of
from mars_lidar.flux import Flux
from mars_lidar.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.system import Detector, System
from mars_lidar.timestamps import Timestamps

_MAX_RETURNS = 16
_MOST_BINS = 2**15  # of the fine grid, unless the stream has more itself
_BINS_PER_SIGMA = 20  # at which the bins of the fine grid are narrow beside the pulse
_SHAPE_BINS = 1024  # of a free shape, and of the histogram whose shape Rapp's method fits
_LEAST_REGISTRATIONS = 10


@dataclass(frozen=True, eq=False)
class Calibration:
    """What light a stream was made by, and by what detector; made by `calibrate`.

    Attributes
    ----------
    background
        B, photons per period. With a free shape 0: all light is in the waveform.
    returns_signal, returns_delay_ns
        (K,) S, photons per period, and delay, ns, of each return, the earliest first; (0,) with a free shape.
    pulse
        The pulse, with its fitted width; None with a free shape.
    waveform
        (n,) photons per period in n equal parts of the period, for a free shape; else None.
    dead_time_ns, dead_time_error_ns
        As given (error 0), or the smallest interval, less its mean excess over the dead time, and the standard error.
    hold_off_ns
        Intervals shorter than this, and the time up to it, were left out of the fit.
    too_short
        Intervals shorter than the dead time by more than a unit of the clock: the model has no place for them.
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
    simulated
        For a detector with effects: how many times longer than this one the simulated stream is by which the bias
        of the likelihood was taken off; else 0.
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
    simulated: float = 0.0

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
        """Standard error of Lambda."""
        lights = [k for k, name in enumerate(self.names) if name.startswith(("signal", "background"))]
        part = self.covariance[np.ix_(lights, lights)]
        return float(np.sqrt(np.nansum(part)))

    @property
    def rate(self) -> FloatArray:
        """Photons per period (n,) in each of the bins of `armed`."""
        bins = self.armed.passes.size
        if self.waveform is not None:
            fine = np.repeat(self.waveform / (bins // self.waveform.size), bins // self.waveform.size)
            return np.asarray(fine, dtype=np.float64)
        light = Light(self.summary.period_ns, bins, self._pulse, self.returns_signal.size, False)
        return light.rate(np.concatenate([[self.background], self.returns_signal, self.returns_delay_ns]))

    @property
    def _pulse(self) -> Pulse:
        assert self.pulse is not None
        return self.pulse

    def flux(self, pixels: int = 1) -> Flux:
        """The light of one pixel, to simulate with; or of a row of so many alike."""
        row = np.ones((1, pixels))
        if self.waveform is not None:
            return Flux(waveform=row[..., None] * self.waveform, background=0.0)
        lights = zip(self.returns_signal.tolist(), self.returns_delay_ns.tolist(), strict=True)
        each = [Flux(s * row, 0.0, tau) for s, tau in lights]
        if len(each) > 1:
            return Flux.multi(*each, Flux(0.0 * row, self.background, 0.0))
        return Flux(float(self.returns_signal[0]) * row, self.background, self.delay_ns)

    def system(self, cycles: int, bins: int, start: Literal["armed", "stationary"] = "stationary") -> System:
        """The instrument, to simulate and predict with; a stretch cut from a running stream is ``stationary``."""
        pulse = self.pulse
        if pulse is None:  # of no consequence beside a waveform
            pulse = GaussianPulse(sigma_ns=0.01 * self.summary.period_ns)
        return System(
            period_ns=self.summary.period_ns, cycles=cycles, bins=bins, pulse=pulse,
            detector=Detector(dead_time_ns=self.dead_time_ns), start=start,
        )  # fmt: skip

    def light_arguments(self) -> dict[str, Any]:
        """Signal, background and delay or waveform, as `count_law` and `joint_law` take them."""
        if self.waveform is not None:
            return {"signal": None, "background": 0.0, "waveform": self.waveform}
        if self.returns_signal.size == 1:
            return {"signal": self.signal, "background": self.background, "delay_ns": self.delay_ns}
        return {"signal": None, "background": self.background, "waveform": self.rate - self.background / self._bins}

    @property
    def _bins(self) -> int:
        return self.armed.passes.size


def calibrate(
    times: Timestamps | Sequence[Timestamps],
    system: System | None = None,
    *,
    pulse: Pulse | Literal["gaussian", "free"] | None = None,
    dead_time_ns: float | None = None,
    hold_off_ns: float | None = None,
    returns: int = 1,
    pooled: bool = False,
) -> Calibration:
    """Signal, background and delay from the timestamps of one free-running pixel, by maximum likelihood.

    The likelihood is that of the point process itself, sum log lambda(x_k) - integral of lambda over the armed time:
    no assumption on the exposure, the start, or the stationarity, and no correction of pile-up is needed.

    That is exact for a detector with one dead time. For one with effects (of `system`), and one return of a known
    pulse, the bias is taken off by simulation: the light is sought whose streams by the exact engine give the same
    estimate.

    Parameters
    ----------
    times
        The stream of one pixel (`Timestamps.load`, `Timestamps.pixel`), or a sequence of such recordings.
    system
        Where pulse (blurred by a Gaussian jitter of the detector), dead time and the hold-off of its electronics are
        taken from; default: the system that the stream tells (a simulated one).
    pulse
        - a `Pulse`: its shape is known,
        - ``"gaussian"``: a Gaussian whose sigma is fitted too; the default where no system tells the pulse,
        - ``"free"``: any light, bin by bin (h / D, the unrestricted maximum): for decays, many surfaces, haze.
    dead_time_ns
        Dead time, ns. Default: that of `system`, else the smallest interval, which is the maximum of the likelihood,
        less its mean excess.
    hold_off_ns
        Leave out what happens within this time after a registration, ns; default: the dead time, or that of the
        electronics and the pixel's where `system` has both. A longer one costs
        data but keeps out what the model does not have: afterpulses, a second dead time (t_e + t_d of electronics,
        Rapp et al. 2019), a slow recovery.
    returns
        Number of returns K, 1 to 16, each with a signal and a delay of its own.
    pooled
        All pixels of `times` are recordings of one and the same pixel.

    Returns
    -------
    Calibration

    Raises
    ------
    ValueError
        Several pixels without `pooled`, fewer than 10 registrations, or a hold-off below the dead time.
    """
    number = _validate.integer("returns", returns, low=1, high=_MAX_RETURNS)
    if system is not None and not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    stream = stream_of(times, pooled=pooled)
    told = system if system is not None else _system_of(times)
    shape = _shape(pulse, told, number, stream.period_ns)
    if stream.registrations < _LEAST_REGISTRATIONS:
        raise ValueError(
            f"times must hold at least {_LEAST_REGISTRATIONS} registrations to be calibrated, got "
            f"{stream.registrations}"
        )
    counted = summary_of(stream)
    given = dead_time_ns
    if given is None and told is not None:
        given, rest = watched(told.detector)
        hold_off_ns = rest if hold_off_ns is None else hold_off_ns
    estimated = given is None
    dead = counted.smallest_ns[0] if given is None else _validate.real("dead_time_ns", given, low=0.0)
    hold = dead if hold_off_ns is None else _validate.real("hold_off_ns", hold_off_ns, low=0.0)
    if hold < dead:
        raise ValueError(f"hold_off_ns must be at least the dead time of {dead:g} ns, got {hold:g}")
    base = _fitted(stream, counted, shape, float(dead), float(hold), number)
    if estimated:
        # the smallest of n intervals exceeds t_d by 1 / (sum of the rates at re-arming) in the mean
        excess = stream.period_ns / max(stream.registrations * _rate_after(stream, base), 1e-300)
        error = math.hypot(excess, stream.unit_ns)
        return replace(base, dead_time_ns=max(base.dead_time_ns - excess, 0.0), dead_time_error_ns=error)
    if told is None or is_plain(told.detector) or isinstance(shape, str) or number != 1:
        return base
    from mars_lidar.estimate.indirect import indirect

    detector = stream_detector(told.detector)
    model = told.replace(
        period_ns=stream.period_ns, detector=detector, pulse=pulse_of_the_light(shape, detector)
    )  # fmt: skip

    def calibrated(stream_made: Timestamps) -> Calibration:
        made = stream_of(stream_made, pooled=True)
        return _fitted(made, summary_of(made), shape, float(dead), float(hold), 1)

    return indirect(base, model, calibrated)


def _system_of(times: Timestamps | Sequence[Timestamps]) -> System | None:
    first = times if isinstance(times, Timestamps) else next(iter(times))
    return first.system


def _shape(
    pulse: Pulse | str | None, told: System | None, returns: int, period_ns: float
) -> Pulse | Literal["gaussian", "free"]:
    if pulse is None:
        return "gaussian" if told is None else recorded_pulse(told)
    if isinstance(pulse, Pulse):
        pulse.check(period_ns)
        return pulse
    if pulse == "free":
        if returns != 1:
            raise ValueError(f"returns must be 1 with pulse='free', which has no returns, got {returns}")
        return "free"
    if pulse == "gaussian":
        return "gaussian"
    raise ValueError(f"pulse must be a Pulse, 'gaussian' or 'free', got {pulse!r}")


def _fitted(
    stream: Stream,
    counted: Summary,
    shape: Pulse | Literal["gaussian", "free"],
    dead: float,
    hold: float,
    returns: int,
) -> Calibration:
    slack = 1.5 * stream.unit_ns + 1e-6 * stream.period_ns  # two roundings of the clock; of the engines' phases
    short = 0
    if counted.smallest_ns.size and counted.smallest_ns[0] < dead - slack:
        short = sum(int((dt < dead - slack).sum()) for dt in stream.intervals())
    rapp = total_of(stream, hold)
    if shape == "free":
        bins = _free_bins(stream.bins)
        seen = armed_time(stream, hold, bins)
        rate = seen.rate
        # var of h / D is h / D^2; the bins are independent given the armed time
        spread = float((seen.registrations / np.maximum(seen.passes, 1e-300) ** 2)[seen.passes > 0].sum())
        return Calibration(
            0.0, np.empty(0), np.empty(0), None, rate, dead, 0.0, hold, short, ("signal",),
            np.array([[spread]]), rapp, seen, counted, True,
        )  # fmt: skip
    free_width = shape == "gaussian"
    pulse = GaussianPulse(sigma_ns=0.01 * stream.period_ns) if isinstance(shape, str) else shape
    bins = _fine_bins(stream, None if free_width else pulse)
    seen = armed_time(stream, hold, bins)
    light = Light(stream.period_ns, bins, pulse, returns, free_width)
    start = initial(seen, light)
    if free_width:  # the width tells how fine the grid must be
        rough = fit(seen, light, start)
        finer = _fine_bins(stream, light.pulse_of(rough.theta))
        start = rough.theta
        if finer > bins:
            seen = armed_time(stream, hold, finer)
            light = replace(light, bins=finer)
    found = fit(seen, light, start)
    pulse = light.pulse_of(found.theta)
    theta, matrix = _in_order(found.theta, covariance(light, found), returns, stream.period_ns)
    if returns == 1:
        rapp = split(stream, rapp, pulse, float(theta[2]), dead, min(_SHAPE_BINS, stream.bins))
    return Calibration(
        float(theta[0]), theta[1 : 1 + returns], theta[1 + returns : 1 + 2 * returns], pulse, None, dead, 0.0, hold,
        short, light.names, matrix, rapp, seen, counted, found.converged,
    )  # fmt: skip


def _in_order(theta: FloatArray, matrix: FloatArray, k: int, period_ns: float) -> tuple[FloatArray, FloatArray]:
    """Delays within the period, the earliest return first."""
    theta = theta.copy()
    theta[1 + k : 1 + 2 * k] %= period_ns
    theta[: 1 + k][theta[: 1 + k] <= 2e-9] = 0.0  # the fit's floor stands for none
    order = np.argsort(theta[1 + k : 1 + 2 * k])
    place = np.concatenate([[0], 1 + order, 1 + k + order, np.arange(1 + 2 * k, theta.size)])
    return theta[place], matrix[np.ix_(place, place)]


def _fine_bins(stream: Stream, pulse: Pulse | None) -> int:
    """The stream's bins times a power of two: narrow beside the pulse, but no more than is useful."""
    wanted = 2048.0
    if isinstance(pulse, GaussianPulse):
        wanted = _BINS_PER_SIGMA * stream.period_ns / pulse.sigma_ns
    elif isinstance(pulse, SampledPulse):
        wanted = 4.0 * stream.period_ns / pulse.bin_ns
    bins = stream.bins
    while bins < wanted and 2 * bins <= max(_MOST_BINS, stream.bins):
        if stream.units % (2 * bins) != 0:  # bins would hold different numbers of units
            break
        bins *= 2
    return bins


def _free_bins(bins: int) -> int:
    """Bins of a free shape: the stream's, or a divisor of them near 1024."""
    if bins <= 2 * _SHAPE_BINS:
        return bins
    divisors = [n for n in range(2 * _SHAPE_BINS, _SHAPE_BINS // 4, -1) if bins % n == 0]
    return divisors[0] if divisors else _SHAPE_BINS


def _rate_after(stream: Stream, found: Calibration) -> float:
    """Mean photons per period that fall on the pixel at the moment it re-arms."""
    rate, bins = found.rate, found.armed.passes.size
    shift = found.dead_time_ns / stream.period_ns
    total = 0.0
    for phase in stream.phases():
        again = phase + shift
        again -= np.floor(again)
        total += float(rate[np.minimum((again * bins).astype(np.int64), bins - 1)].sum()) * bins
    return total / max(stream.registrations, 1)
