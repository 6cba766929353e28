"""Maximum likelihood of signal, background and delay from the exact likelihood of the histogram."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from mars_lidar._base import arguments, checks
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.fit_quality import COLUMNS, FALSE_ALARM, quality_of, tested_recordings
from mars_lidar.reconstruction.histogram_record import recording_of, relative_width
from mars_lidar.reconstruction.histograms import Histograms, checked
from mars_lidar.reconstruction.method import Estimates, Flags, Method
from mars_lidar.reconstruction.returns import MOST_RETURNS, RETURN_COLUMNS


@dataclass(frozen=True)
class MaximumLikelihood(Method):
    """Maximum-likelihood S, B and delay, given the armed time estimated from the histogram (R9, R10).

    Parameters
    ----------
    starts
        Number of starting delays of the maximisation, the best of a grid over the period, in [1, 8].
    false_alarm
        False-alarm probability: the approximate fraction of pixels without signal that are not flagged. A signal is
        detected if twice its gain in log likelihood exceeds the level that background reaches anywhere in the period
        with this probability.
    less_bias
        Subtract the first-order bias of the maximum (Cox and Snell, J. R. Stat. Soc. B 30, 248, 1968; R19): some
        tenths of a standard error in bright pixels of short exposures, where this also reduces the errors.
    returns
        Largest number of returns for each pixel, in [1, 8]. Returns are added as long as twice the gain of the log
        likelihood exceeds what noise reaches anywhere in the period with probability `false_alarm` (R23 of
        docs/theory_reconstruction.md, section 6). `signal` and `delay_ns` are then those of the strongest return.

    Raises
    ------
    TypeError
        Settings that are not numbers.
    ValueError
        Settings out of range; ``check``: a detector to which this method does not apply.

    See Also
    --------
    Image, log_likelihood, mars_lidar.cramer_rao, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 0.1, 40.0), system, seed=0)
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.MaximumLikelihood(false_alarm=1e-3))
    >>> bool(abs(maps.delay_ns - 40.0)[0, 0, 0] < 5 * maps.delay_error_ns[0, 0, 0])
    True
    """

    starts: int = 3
    false_alarm: float = 0.01
    less_bias: bool = True
    returns: int = 1

    name = "maximum_likelihood"
    modes = ("nonparalyzable", "synchronous", "gated")
    assumes = "one return of the known pulse over uniform background"
    windows = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "starts", checks.integer("starts", self.starts, low=1, high=8))
        object.__setattr__(self, "returns", checks.integer("returns", self.returns, low=1, high=MOST_RETURNS))
        checks.real("false_alarm", self.false_alarm, low=1e-12, high=0.5)

    def least_gain(self, system: System) -> float:
        """Twice the gain in log likelihood above which a signal of `system` counts as detected.

        At one delay it is the square of a positive normal number; a period has about 1 / sigma independent delays.
        """
        places = max(1.0, min(system.bins, 1.0 / relative_width(system)))
        return float(NormalDist().inv_cdf(1.0 - self.false_alarm / places) ** 2)

    def estimate(self, histograms: Histograms) -> Estimates:
        """Estimates, standard errors, significance of the signal, and test of fit, of each of the `histograms`."""
        from mars_lidar._base.native import _core

        pixels = len(histograms.counts)
        out = np.empty((pixels, 8))
        flags = np.empty(pixels, np.uint8)
        tests = tested_recordings(histograms.system) if self.returns == 1 else []
        statistics = np.empty((pixels if tests else 0, COLUMNS))
        _core.maximum_likelihood(
            histograms.recording,
            histograms.counts,
            starts=self.starts,
            least_gain=self.least_gain(histograms.system),
            less_bias=self.less_bias,
            out=out,
            flags=flags,
            tests=tests,
            quality=statistics,
            threads=histograms.threads,
            progress=histograms.progress,
        )
        several = self._several(histograms, out, flags) if self.returns > 1 else None
        column = np.ascontiguousarray(out.T)
        quality = quality_of(statistics) if tests else None
        if quality is not None:
            flags |= np.where(quality.p_value < FALSE_ALARM, Flags.MISFIT, 0).astype(np.uint8)
        return Estimates(
            signal=column[0],
            background=column[1],
            delay=column[2],
            flags=flags,
            signal_error=column[3],
            background_error=column[4],
            delay_error=column[5],
            significance=np.sqrt(column[6]),
            returns=several,
            p_value=None if quality is None else quality.p_value,
            longer=None if quality is None else quality.longer,
            shorter=None if quality is None else quality.shorter,
            wider=None if quality is None else quality.wider,
        )

    def _several(self, histograms: Histograms, out: FloatArray, flags: NDArray[np.uint8]) -> FloatArray:
        """Further returns of what was found: (pixels, returns, 5), and what the strongest of them changes."""
        from mars_lidar._base.native import _core

        pixels = len(histograms.counts)
        returns = np.empty((pixels, self.returns * len(RETURN_COLUMNS)))
        _core.several_returns(
            histograms.recording,
            histograms.counts,
            most=self.returns,
            starts=self.starts,
            false_alarm=self.false_alarm,
            out=out,
            flags=flags,
            returns=returns,
            threads=histograms.threads,
            progress=histograms.progress,
        )
        return returns.reshape(pixels, self.returns, len(RETURN_COLUMNS))


@arguments.checked
def log_likelihood(histogram: ArrayLike, flux: Flux, system: System) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log likelihood of one histogram, up to a constant, with gradient and Fisher information (R9).

    Parameters
    ----------
    histogram
        (bins,) counts.
    flux
        Hypotheses (...) of the light: one return and background > 0 each.
    system
        The system that recorded them.

    Returns
    -------
    tuple
        Value (...), gradient (..., 3) and information (..., 3, 3) with respect to (S, B, delay in ns).

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`; counts that are not an array of numbers.
    ValueError
        Counts with another number of bins; hypotheses without background; a detector to which this does not apply.

    See Also
    --------
    MaximumLikelihood, mars_lidar.learn.histogram_log_likelihood

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)[0, 0, 0]
    >>> value, gradient, information = ml.reconstruction.log_likelihood(counts, ml.Flux(1.0, 1.0, [39.0, 40.0]), system)
    >>> bool(value[1] > value[0]), gradient.shape, information.shape
    (True, (2, 3), (2, 3, 3))
    """
    from mars_lidar._base.native import _core

    if np.shape(histogram) != (system.bins,):
        raise ValueError(f"histogram must be ({system.bins},), of one pixel, got shape {np.shape(histogram)}")
    given, _ = checked(histogram, system, 1)
    MaximumLikelihood().check(system)
    s, b, tau = flux.signal, flux.background, flux.delay_ns
    if len(flux.returns_signal) != 1 or not ((b > 0) & np.isfinite(tau)).all():
        raise ValueError("flux must have one return of finite delay and background > 0 in each pixel")
    at = np.ascontiguousarray(np.stack([s.ravel(), b.ravel(), tau.ravel() / system.period_ns], axis=-1))
    out = np.empty((len(at), 13))
    _core.histogram_log_likelihood(recording_of(system), given.counts[0].astype(np.float64), at, out)
    unit = np.array([1.0, 1.0, 1.0 / system.period_ns])
    value = out[:, 0].reshape(s.shape)[()]
    gradient = (out[:, 1:4] * unit).reshape(*s.shape, 3)
    return value, gradient, (out[:, 4:].reshape(-1, 3, 3) * unit * unit[:, None]).reshape(*s.shape, 3, 3)
