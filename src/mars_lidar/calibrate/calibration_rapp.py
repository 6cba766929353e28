"""Rapp's calibration (Rapp, Ma, Dawson, Goyal, IEEE TSP 2019): the total flux from whole periods without a photon.

From the instant at which a pixel is armed for certain, whole periods pass without a registration with probability
e^-Lambda each, whatever the shape of the light and wherever in the period it begins: their number is geometric.
Signal and background are then told apart by the shape of the histogram.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mars_lidar._base import checks
from mars_lidar.calibrate.intervals import Stream, stream_of
from mars_lidar.instrument.pulse import Pulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.light.timestamps import Timestamps
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.law import registration_pdf


@dataclass(frozen=True)
class RappEstimate:
    """Flux by Rapp's method.

    Attributes
    ----------
    total, total_error
        Lambda, photons per period, and its standard error; inf where no period passed without a registration.
    signal, background
        S and B by the shape of the histogram; NaN where only the total was asked for.
    intervals
        Intervals used.
    """

    total: float
    total_error: float
    intervals: int
    signal: float = math.nan
    background: float = math.nan


def rapp_total(times: Timestamps | Sequence[Timestamps], hold_off_ns: float, *, pooled: bool = False) -> RappEstimate:
    """Total flux Lambda from intervals: needs no pulse, no delay, and no histogram.

    Parameters
    ----------
    times, pooled
        As for `calibrate`.
    hold_off_ns
        Time after a registration from which on the pixel is armed for certain, ns: the dead time t_d, or t_e + t_d
        where electronics are dead for longer, t_e, than the detector.
    """
    hold = checks.real("hold_off_ns", hold_off_ns, low=0.0)
    return total_of(stream_of(times, pooled=pooled), hold)


def total_of(stream: Stream, hold_off_ns: float) -> RappEstimate:
    """`rapp_total` of a stream that is at hand."""
    number, whole = 0, 0.0
    for dt in stream.intervals():
        rest = dt[dt > hold_off_ns] - hold_off_ns
        number += rest.size
        whole += float(np.floor(rest / stream.period_ns).sum())
    if number == 0:
        return RappEstimate(math.nan, math.inf, 0)
    empty = whole / (number + whole)  # the estimate of e^-Lambda
    if empty == 0.0:
        return RappEstimate(math.inf, math.inf, number)
    # Fisher information of a geometric law: number / (q (1 - q)^2) for q, and d Lambda = -dq / q
    return RappEstimate(-math.log(empty), (1.0 - empty) / math.sqrt(empty * number), number)


def split(
    stream: Stream, found: RappEstimate, pulse: Pulse, delay_ns: float, dead_time_ns: float, bins: int
) -> RappEstimate:
    """Divide the total into S and B so that the predicted stationary histogram fits the measured one best."""
    if not math.isfinite(found.total) or found.total == 0.0:
        return found
    from scipy.optimize import minimize_scalar

    system = System(
        period_ns=stream.period_ns,
        cycles=1,
        bins=bins,
        pulse=pulse,
        detector=Detector(dead_time_ns=dead_time_ns),
        start="stationary",
    )
    histogram = stream.histogram(bins)

    def misfit(share: float) -> float:
        back = found.total * share
        shape = registration_pdf(found.total - back, back, system, "stationary", delay_ns=delay_ns, threads=1)
        return -float(histogram @ np.log(np.maximum(shape, 1e-300))) / max(int(histogram.sum()), 1)

    try:
        best = minimize_scalar(misfit, bounds=(1e-6, 1.0 - 1e-6), method="bounded", options={"xatol": 1e-6})
    except ConvergenceError:  # far more than one photon per period: there is no law to compare with
        return found
    back = found.total * float(best.x)
    return RappEstimate(found.total, found.total_error, found.intervals, found.total - back, back)
