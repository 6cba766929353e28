"""The verb `calibrate`: signal, background, delay and dead time of a measured stream, with standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from mars_lidar._base import checks
from mars_lidar.calibrate.calibration_pass import CERTAIN, Watch, fitted, with_division
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.dead_time import Unknown
from mars_lidar.calibrate.detector_model import jitter_sigma, needs_simulation, recorded_pulse, stream_detector, watched
from mars_lidar.calibrate.indirect import indirect
from mars_lidar.calibrate.intervals import Stream, stream_of, summary_of
from mars_lidar.calibrate.unknowns import told as told_of
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.pulse import Pulse
from mars_lidar.instrument.system import System
from mars_lidar.light.timestamps import Timestamps

__all__ = ["Calibration", "calibrate"]

_MAX_RETURNS = 16
_LEAST_REGISTRATIONS = 10
_LEAST_USED = 3
_MOST_LIGHT = 1e6  # photons per period: what a `Flux` may have


def calibrate(
    times: Timestamps | Sequence[Timestamps],
    system: System | None = None,
    *,
    pulse: Pulse | Literal["gaussian", "free"] | None = None,
    dead_time_ns: float | None = None,
    hold_off_ns: float | None = None,
    returns: int = 1,
    jitter_ns: float | None = None,
    pooled: bool = False,
) -> Calibration:
    """Signal, background and delay from the timestamps of one free-running pixel, by maximum likelihood.

    The likelihood is that of the point process itself, sum log lambda(x_k) - integral of lambda over the armed time:
    no assumption on the exposure, the start, or the stationarity, and no correction of pile-up is needed.

    That is exact for a detector with one dead time, with Gaussian jitter or with a slow recovery
    (`calibrate.armed_time.Sensitivity`). For one with other effects (of `system`) the bias is taken off by simulation:
    the light is sought whose streams by the exact engine give the same estimate.

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
        Dead time, ns. Default: that of `system`, else estimated from the edge of the recovery. Where it is sharp, by
        the smallest interval, which is the maximum of the likelihood, less its mean excess; where jitter has blurred
        it, the middle of the edge, and the jitter by its width (`Calibration.dead_time_by`).
    hold_off_ns
        Leave out what happens within this time after a registration, ns; default, and the least: the dead time, or
        that of the electronics and the pixel's where `system` has both, and 8.5 sigma of a jitter more. A longer one
        costs data but keeps out what the model does not have: afterpulses, a second dead time (t_e + t_d of
        electronics, Rapp et al. 2019), a slow recovery.
    returns
        Number of returns K, 1 to 16, each with a signal and a delay of its own.
    jitter_ns
        Sigma of the Gaussian jitter of each record, ns, which the recorded pulse holds. Default: that of `system`, else
        estimated with the dead time, or 0 where the dead time is given.
    pooled
        All pixels of `times` are recordings of one and the same pixel.

    Returns
    -------
    Calibration
        An error of NaN stands for what the stream cannot tell: `Calibration.unknown` says why.

    Raises
    ------
    ValueError
        Several pixels without `pooled`, fewer than 10 registrations, or a hold-off below the dead time.
    """
    number = checks.integer("returns", returns, low=1, high=_MAX_RETURNS)
    if system is not None and not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    stream = stream_of(times, pooled=pooled)
    most = 0.05 * stream.period_ns
    jitter = None if jitter_ns is None else checks.real("jitter_ns", jitter_ns, low=0.0, high=most)
    dead = None if dead_time_ns is None else checks.real("dead_time_ns", dead_time_ns, low=0.0)
    hold = None if hold_off_ns is None else checks.real("hold_off_ns", hold_off_ns, low=0.0)
    told = system if system is not None else _system_of(times)
    detector = None if told is None else stream_detector(told.detector)
    shape = _shape(pulse, told, number, stream.period_ns)
    if stream.registrations < _LEAST_REGISTRATIONS:
        raise ValueError(
            f"times must hold at least {_LEAST_REGISTRATIONS} registrations to be calibrated, got "
            f"{stream.registrations}"
        )
    counted = summary_of(stream)
    if 2 * counted.same_time > stream.registrations:
        raise ValueError(
            f"times must be of photons one after the other, got {counted.same_time:,} of {stream.registrations:,} at "
            "exactly the time of the one before"
        )
    if detector is None and dead is None:
        estimated = _bounded(Unknown(stream, counted, shape, hold, number, jitter).calibrated())
        return told_of(with_division(stream, estimated), edge=True)
    watch = _watch(detector, dead, hold, jitter)

    found = _bounded(fitted(stream, counted, shape, watch, number))
    if told is None or detector is None or not needs_simulation(detector):
        return told_of(found, edge=False)
    model = told.replace(period_ns=stream.period_ns, detector=detector)

    def once(seen: Stream) -> Calibration:
        return fitted(seen, summary_of(seen), shape, watch, number, found)

    return told_of(indirect(found, model, once), edge=False)


def _bounded(found: Calibration) -> Calibration:
    """Raise ValueError where hardly a registration is left, or where all come as soon as they can."""
    seen, counted = found.armed, found.summary
    if seen.used < _LEAST_USED:
        raise ValueError(
            f"dead_time_ns and hold_off_ns must leave at least {_LEAST_USED} registrations, got {seen.used} of "
            f"{counted.registrations:,} later than {found.hold_off_ns:.6g} ns after the one before; half of the "
            f"intervals are shorter than {counted.quantiles_ns[1]:.5g} ns"
        )
    if not found.total <= _MOST_LIGHT or float(seen.passes.mean()) * _MOST_LIGHT < seen.used:
        raise ValueError(
            f"times must leave the pixel armed for some time between registrations, got a saturated stream: nearly all "
            f"of its intervals are the dead time of {found.dead_time_ns:.6g} ns, which {_MOST_LIGHT:g} photons per "
            "period would make, or more"
        )
    return found


def _watch(detector: Detector | None, dead: float | None, hold: float | None, jitter: float | None) -> Watch:
    """Dead time, hold-off and jitter: as given, else those of the detector."""
    rest = 0.0
    recovery = 0.0 if detector is None else detector.recovery_ns
    if jitter is None:
        jitter = 0.0 if detector is None else jitter_sigma(detector)
    if dead is None:
        assert detector is not None
        dead, rest = watched(detector)
    if hold is not None and hold < dead:
        raise ValueError(f"hold_off_ns must be at least the dead time of {dead:g} ns, got {hold:g}")
    least = dead + CERTAIN * jitter
    hold = max(least, rest + CERTAIN * jitter) if hold is None else max(least, hold)
    return Watch(dead, hold, jitter, recovery_ns=recovery)


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
