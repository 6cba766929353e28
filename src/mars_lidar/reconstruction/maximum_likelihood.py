"""Maximum likelihood of signal, background and delay from the exact likelihood of the histogram."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from mars_lidar._base import arguments, checks
from mars_lidar._base.native import _core
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.fit_quality import COLUMNS, FALSE_ALARM, quality_of, tested_recordings
from mars_lidar.reconstruction.histogram_record import recording_of, relative_width
from mars_lidar.reconstruction.histograms import Histograms, checked
from mars_lidar.reconstruction.method import Estimates, Flags, Method
from mars_lidar.reconstruction.returns import MOST_RETURNS, RETURN_COLUMNS

NEGLIGIBLE = 0.5  # systematic error, in standard errors: intervals of 95 % then have a coverage of 92 %


@dataclass(frozen=True)
class MaximumLikelihood(Method):
    """Maximum-likelihood S, B and delay, given the armed time estimated from the histogram (R9, R10).

    Intervals of 95 % hold in 93 to 95 % of the pixels with a significance above 5, in 87 to 92 % of those below 4: weak
    returns are detected where noise resembles them. They hold less often in pixels that remember the start of
    the exposure, whose count has a standard deviation below one (docs/reconstruction.md, limits).

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
            delay_error=np.where(flags & np.uint8(Flags.NO_SIGNAL), np.nan, column[5]),  # it may be anywhere
            significance=np.sqrt(column[6]),
            returns=several,
            p_value=None if quality is None else quality.p_value,
            longer=None if quality is None else quality.longer,
            shorter=None if quality is None else quality.shorter,
            wider=None if quality is None else quality.wider,
        )

    def _several(self, histograms: Histograms, out: FloatArray, flags: NDArray[np.uint8]) -> FloatArray:
        """All returns (pixels, returns, 5) from the first in `out`, which becomes the strongest of each pixel."""
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
    if np.shape(histogram) != (system.bins,):
        raise ValueError(f"histogram must be ({system.bins},), of one pixel, got shape {np.shape(histogram)}")
    given, _ = checked(histogram, system, 1)
    MaximumLikelihood().check(system)
    shape = flux.signal.shape
    at = hypotheses(flux, system)
    out = np.empty((len(at), 13))
    _core.histogram_log_likelihood(recording_of(system), given.counts[0].astype(np.float64), at, out)
    unit = np.array([1.0, 1.0, 1.0 / system.period_ns])
    value = out[:, 0].reshape(shape)[()]
    gradient = (out[:, 1:4] * unit).reshape(*shape, 3)
    return value, gradient, (out[:, 4:].reshape(-1, 3, 3) * unit * unit[:, None]).reshape(*shape, 3, 3)


@arguments.checked
def systematic_error(flux: Flux, system: System) -> tuple[FloatArray, FloatArray]:
    """Systematic error of maximum likelihood in the bins of a system, beside its standard error (R28).

    The likelihood takes the light and the armed periods of a bin from its histogram and knows no effect of the detector
    beyond efficiency and dark counts. Its score at the exact mean histogram (`mars_lidar.mean_histogram`), which
    includes electronics dead time, jitter and code widths, gives the error that no exposure averages out.
    `mars_lidar.reconstruct` computes it at the estimates of three pixels, and warns of half a standard error.

    Parameters
    ----------
    flux
        Light (...) as it is estimated: one return of detectable photons and background > 0 each.
    system
        The system; its exposure counts, because standard errors decrease with it.

    Returns
    -------
    tuple
        Error and standard error, each (..., 3), of S, B and the delay in ns. The error is that of one step of Fisher
        scoring: accurate as long as the estimates are near the truth. It is 0, and the standard error infinite, for the
        delay of a pulse that lies within one bin. Both are NaN where the likelihood of the mean histogram has no
        maximum near this light.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        Several returns, no signal or no background; a detector whose mean histogram is not known, or to which maximum
        likelihood does not apply.
    ConvergenceError
        As for `mars_lidar.mean_histogram`.

    See Also
    --------
    MaximumLikelihood, mars_lidar.mean_histogram

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=10_000, bins=50,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=99.0),
    ... )
    >>> bias, error = ml.reconstruction.systematic_error(ml.Flux(2.0, 2.0, 43.4), system)
    >>> (bias / error).round(1).tolist()  # bins of 2 ns, in which the detector re-arms while the pulse passes
    [4.9, 0.1, -3.2]
    """
    from mars_lidar.statistics import mean_histogram

    MaximumLikelihood().check(system)
    at = hypotheses(flux, system)
    if not (at[:, 0] > 0).all():
        raise ValueError("flux must have a signal > 0 in each pixel")
    mean = mean_histogram(flux, system.detected()).reshape(len(at), system.bins)
    out = np.empty((len(at), 13))
    recording = recording_of(system)
    for row, histogram in enumerate(mean):
        _core.histogram_log_likelihood(
            recording, np.ascontiguousarray(histogram), at[row : row + 1], out[row : row + 1]
        )
    gradient, information = out[:, 1:4], out[:, 4:].reshape(-1, 3, 3)
    anywhere = information[:, 2, 2] <= 0.0  # within its bin
    information[anywhere, 2], information[anywhere, :, 2], information[anywhere, 2, 2] = 0.0, 0.0, 1.0
    unstable = np.linalg.eigvalsh(_scaled(information))[:, 0] <= 0.0  # no maximum is near
    information[unstable] = np.eye(3)
    inverse = np.linalg.inv(information)
    error = np.sqrt(np.einsum("kii->ki", inverse))
    gradient[anywhere, 2], error[anywhere, 2] = 0.0, np.inf
    gradient[unstable], error[unstable] = np.nan, np.nan
    unit, shape = np.array([1.0, 1.0, system.period_ns]), (*flux.signal.shape, 3)
    bias = np.einsum("kij,kj->ki", inverse, gradient)
    return (bias * unit).reshape(shape), (error * unit).reshape(shape)


def _scaled(information: FloatArray) -> FloatArray:
    """Matrices (pixels, 3, 3) scaled to a diagonal of 1 or -1, which keeps the signs of their eigenvalues."""
    size = np.sqrt(np.maximum(np.abs(np.einsum("kii->ki", information)), np.finfo(float).tiny))
    return np.asarray(information / (size[:, :, None] * size[:, None, :]))


def warn_of_bias(method: Method, system: System, estimates: Estimates) -> None:
    """Warn if one of three pixels has a systematic error above half a standard error.

    The pixels are those with the most precise signal, the most precise delay or background, and the median signal.
    There is no warning if the method states no errors of the background, or if the mean histogram of the detector is
    not known or takes too long to compute.
    """
    likelihood = isinstance(method, MaximumLikelihood)
    other_error = estimates.delay_error if likelihood else estimates.background_error
    if other_error is None or estimates.signal_error is None or estimates.returns is not None:
        return
    s, b, tau = estimates.signal, estimates.background, estimates.delay
    stated = np.isfinite(estimates.signal_error) & np.isfinite(other_error) & (s > 0) & (b > 0)
    usable = np.flatnonzero(stated & ((estimates.flags & np.uint8(Flags.EMPTY | Flags.NO_SIGNAL)) == 0))
    if usable.size == 0:
        return
    relative = estimates.signal_error[usable] / s[usable]
    median = np.argsort(s[usable])[usable.size // 2]
    pixels = usable[np.unique([relative.argmin(), other_error[usable].argmin(), median])]
    try:
        light = Flux(s[pixels], b[pixels], tau[pixels] * system.period_ns)
        if likelihood:
            bias, error = systematic_error(light, system)
        else:
            bias, error = _error_at_mean(method, light, system)
    except (ValueError, ArithmeticError):
        return
    ratio = np.nan_to_num(bias / error)
    worst = int(np.abs(ratio).max(-1).argmax())
    if not abs(ratio[worst]).max() > NEGLIGIBLE:
        return
    effects = [name for name in system.detector.effects if name not in LIGHT_EFFECTS]
    cause = " and ".join([f"the bins of {system.bin_ns:g} ns", *effects])
    each = ", ".join(
        f"{name} by {r:+.1f}" for name, r in zip(("signal", "background", "delay"), ratio[worst], strict=False)
    )
    warnings.warn(
        f"{cause} bias the estimates by {method.name.replace('_', ' ')}: {each} standard errors at "
        f"S = {s[pixels[worst]]:.3g}, B = {b[pixels[worst]]:.3g}"
        f"{' (mars_lidar.reconstruction.systematic_error)' if likelihood else ''}; narrower bins "
        "reduce the part due to bins",
        UserWarning,
        stacklevel=4,
    )


def _error_at_mean(method: Method, light: Flux, system: System) -> tuple[FloatArray, FloatArray]:
    """Error of S and B (pixels, 2) that a method makes of the exact mean histograms of `light`, and standard errors."""
    from mars_lidar.statistics import mean_histogram

    mean = method.estimate(checked(mean_histogram(light, system.detected()), system, 1)[0])
    assert mean.signal_error is not None
    assert mean.background_error is not None
    bias = np.stack([mean.signal - light.signal, mean.background - light.background], axis=-1)
    return bias, np.stack([mean.signal_error, mean.background_error], axis=-1)


def hypotheses(flux: Flux, system: System) -> FloatArray:
    """(pixels, 3) signal, background, and delay in periods, of light with one return and background."""
    s, b, tau = flux.signal, flux.background, flux.delay_ns
    if len(flux.returns_signal) != 1 or not ((b > 0) & np.isfinite(tau)).all():
        raise ValueError(
            "flux must have one return of finite delay and background > 0 in each pixel; "
            "several returns of one pixel have `returns_bound`"
        )
    return np.ascontiguousarray(np.stack([s.ravel(), b.ravel(), tau.ravel() / system.period_ns], axis=-1))
