"""The Cramer-Rao bound of a calibration: how well any unbiased estimator could do, before anything is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.calibration_light import Light
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import default_bins
from mars_lidar.statistics.histogram import mean_histogram


@dataclass(frozen=True, eq=False)
class Bound:
    """Least standard errors, and the Fisher information behind them.

    Attributes
    ----------
    names
        Of the parameters: background, signal, delay_ns, and sigma_ns where it is fitted.
    information
        (parameters, parameters) of the whole exposure.
    """

    names: tuple[str, ...]
    information: FloatArray

    __repr__ = brief

    @property
    def covariance(self) -> FloatArray:
        """Inverse of the information."""
        scale = 1.0 / np.sqrt(np.diag(self.information))
        return np.asarray(np.linalg.inv(self.information * scale * scale[:, None]) * scale * scale[:, None])

    @property
    def errors(self) -> dict[str, float]:
        """Standard error of each parameter that no unbiased estimator can undercut."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@checked
def calibration_bound(
    signal: float, background: float, system: System, *, delay_ns: float | None = None, fit_width: bool = False
) -> Bound:
    """Cramer-Rao bound on B, S and delay (and the pulse's sigma) of one exposure of `System.cycles` periods.

    The information is N_r sum_j A_j (dl_j)(dl_j)' / l_j with A_j the mean armed fraction of the exposure in bin j,
    which is the exact mean histogram divided by the light. For a timestamp stream or its histogram alike: the
    armed time follows from either up to the two ends of the exposure.

    Parameters
    ----------
    signal, background, delay_ns
        S > 0 and B > 0 in detected photons per period, as `calibrate` finds them (the detector's efficiency and dark
        counts are in them already), delay in ns (None: half the period): scalars.
    system
        Laser, detector (non-paralyzable) and exposure.
    fit_width
        Whether the sigma of a Gaussian pulse is unknown too.
    """
    s = checks.real("signal", signal, low=0.0, high=1e6, strict_low=True)
    b = checks.real("background", background, low=0.0, high=1e6, strict_low=True)
    tau = 0.5 * system.period_ns if delay_ns is None else checks.real("delay_ns", delay_ns)
    if system.detector.mode != "nonparalyzable":
        raise ValueError(f"system must have a detector of mode 'nonparalyzable', got {system.detector.mode!r}")
    system = system.detected()
    theta = [b, s, tau]
    if fit_width:
        if not isinstance(system.pulse, GaussianPulse):
            raise ValueError(f"fit_width needs a GaussianPulse, got {system.pulse!r}")
        theta.append(system.pulse.sigma_ns)
    bins = 2 * default_bins(system)
    light = Light(system.period_ns, bins, system.pulse, 1, fit_width)
    rate, slopes = light.jacobian(np.array(theta))
    armed = mean_histogram(s, b, system.replace(bins=bins), delay_ns=tau) / rate
    return Bound(light.names, slopes.T @ ((armed / rate)[:, None] * slopes))
