"""Several returns of a pixel: estimates of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base.display import brief
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.system import System

MOST_RETURNS = 8
RETURN_COLUMNS = ("delay", "signal", "delay_error", "signal_error", "false_alarm")  # as the native core writes them


@dataclass(frozen=True, eq=False)
class Returns:
    """The returns of each pixel of a reconstruction (...), nearest first, NaN beyond the last.

    Attributes
    ----------
    count
        (...) uint8, number of detected returns, 0 to K.
    delay_ns, depth_m
        (..., K) delay in [0, period), ns, and depth, m.
    signal
        (..., K) S, detectable photons per laser period.
    delay_error_ns, depth_error_m, signal_error
        (..., K) standard errors from the observed information; NaN if it does not determine them.
    false_alarm
        (..., K) probability that noise would gain as much likelihood anywhere in the period without a return
        (docs/theory_reconstruction.md, section 6). For method ``"image"`` the probability that the return has another
        delay.

    See Also
    --------
    MaximumLikelihood, returns_bound, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux.multi(ml.Flux(1.0, 0.1, 30.0), ml.Flux(0.5, 0.0, 60.0))
    >>> maps = ml.reconstruct(ml.simulate(flux, system, seed=0), system, returns=2)
    >>> int(maps.returns.count[0, 0, 0]), maps.returns.depth_m[0, 0, 0].round(1)
    (2, array([4.5, 9. ]))
    """

    count: NDArray[np.uint8]
    delay_ns: FloatArray
    depth_m: FloatArray
    signal: FloatArray
    delay_error_ns: FloatArray
    depth_error_m: FloatArray
    signal_error: FloatArray
    false_alarm: FloatArray

    __repr__ = brief


def returns_of(values: FloatArray | None, system: System, shape: tuple[int, ...]) -> Returns | None:
    """The returns (..., K) from the estimates (pixels, K, columns) of a method; None for a single return."""
    if values is None:
        return None
    columns = values.reshape(*shape, *values.shape[1:])
    delay, signal, delay_error, signal_error, false_alarm = np.moveaxis(columns, -1, 0)
    period = system.period_ns
    delay = np.where(delay >= 1.0, 0.0, delay) * period
    return Returns(
        count=np.isfinite(delay).sum(-1).astype(np.uint8),
        delay_ns=delay,
        depth_m=system.depth_m(delay),
        signal=signal,
        delay_error_ns=delay_error * period,
        depth_error_m=system.depth_m(delay_error * period),
        signal_error=signal_error,
        false_alarm=false_alarm,
    )
