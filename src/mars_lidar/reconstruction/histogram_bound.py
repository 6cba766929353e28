"""Bounds on the accuracy of depth and flux: the Cramer-Rao bound, and the errors of linear window estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.display import as_html, brief
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.instrument.detector import require_effects
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.histogram_record import core_ns, open_bins, relative_width
from mars_lidar.statistics.cells import one_pixel
from mars_lidar.statistics.histogram import mean_histogram
from mars_lidar.statistics.joint import joint_law

_SINGULAR = 1e-11  # of the largest eigenvalue, all of size 1 to 3: rounding of the sums over the bins is 1e-15 of it
_WAVEFORM_PARTS = 8  # of a bin, in which the light of several returns is taken as even


@dataclass(frozen=True, eq=False)
class HistogramBound:
    """Cramer-Rao bound of (S, B, delay) for pixels of shape (...).

    Attributes
    ----------
    information
        (..., 3, 3) Fisher information of (S, B, delay in ns); for several returns (2 K + 1, 2 K + 1) of (all S, B, all
        delays).
    signal, background, delay_ns, depth_m
        (...) smallest standard deviations of unbiased estimates; inf without information. For several returns
        (K,), except the background.

    See Also
    --------
    mars_lidar.cramer_rao, returns_bound

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> bound = ml.cramer_rao(ml.Flux(1.0, 1.0, 40.0), system)
    >>> bound.information.shape, round(float(bound.signal), 2)
    ((3, 3), 0.05)
    """

    information: FloatArray
    signal: FloatArray
    background: FloatArray
    delay_ns: FloatArray
    depth_m: FloatArray

    __repr__ = brief

    def _repr_html_(self) -> str:
        return as_html(self, {"least error of depth (m)": self.depth_m} if self.depth_m.ndim == 2 else {})


@checked
def cramer_rao(flux: Flux, system: System, *, threads: int | None = None) -> HistogramBound:
    """Smallest standard errors of S, B and depth that any unbiased estimate from a histogram can have.

    The information of registrations at the rate l_j in the armed time of bin j is that of a Poisson process,
    ``I = sum_j E[D_j] (dl_j)(dl_j)' / l_j``, with E[D_j] = E[h_j] / l_j the mean armed time; a bin, which does
    not resolve times within it, has the fraction (x / sinh x)^2 of it, x = l_j / 2 (R18). The armed time is assumed
    known: information lost at the ends of the exposure is not subtracted (docs/theory_reconstruction.md, section 3).

    It cannot be reached for a `SampledPulse` with an edge that is sharp within a bin: the light of the edge's bin has a
    kink in the delay, and the bound, the curvature at one delay, depends on where in the bin the edge lies. With a
    decay over 20 bins, its edge at the edge of a bin, it was half of the error of the best estimate.

    Parameters
    ----------
    flux
        One return and background > 0 in each pixel (...).
    system
        Detectors of mode nonparalyzable, synchronous, or gated with a fixed gate, without effects beyond detection
        efficiency and dark counts.
    threads
        As for `exposure_moments`.

    Returns
    -------
    HistogramBound
        Standard deviations (...), and the information: of S and B of `flux`, which are photons on the pixel.
        `mars_lidar.reconstruct` estimates detectable photons; their standard deviations are those times
        `Detector.detection_efficiency`.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        Several returns, no background, or a detector to which this bound does not apply.
    ConvergenceError
        The mean histogram did not converge; the message names the pixel.

    See Also
    --------
    reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> bound = ml.cramer_rao(ml.Flux(signal=1.0, background=1.0, delay_ns=40.0), system)
    >>> round(1000 * float(bound.depth_m), 1)  # mm
    8.2
    """
    from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood, hypotheses

    MaximumLikelihood().check(system)
    require_effects("cramer_rao", system.detector, LIGHT_EFFECTS, _simulate_instead)
    hypotheses(flux, system)
    s, b, tau = flux.signal, flux.background, flux.delay_ns
    mean = mean_histogram(flux, system, threads=threads)
    energy, slope, share = _pulse_bins(system, tau)
    information = _information(system, mean, s[..., None, None], b, energy[..., None, :], slope[..., None, :], share)
    deviation = np.sqrt(_inverse_diagonal(information))
    of_signal, of_background, of_delay = np.moveaxis(deviation, -1, 0)
    return HistogramBound(information, of_signal, of_background, of_delay, system.depth_m(of_delay))


@checked
def returns_bound(flux: Flux, system: System, *, threads: int | None = None) -> HistogramBound:
    """Smallest standard errors of all returns of one pixel, each with unknown S and delay.

    As `cramer_rao`, for the K returns of a pixel (`Flux.multi`); overlapping returns have larger errors.

    Parameters
    ----------
    flux
        One pixel with K returns and background > 0, as `Flux.multi` makes it.
    system
        As for `mars_lidar.cramer_rao`.
    threads
        Threads to run on; default: all processors that this process may use.

    Returns
    -------
    HistogramBound
        Standard deviations (K,) of every return, and of the background.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        Several pixels, no background, or a detector to which this bound does not apply.

    See Also
    --------
    mars_lidar.cramer_rao, Returns

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux.multi(ml.Flux(1.0, 0.5, 30.0), ml.Flux(0.5, 0.0, 33.0))
    >>> bound = ml.reconstruction.returns_bound(flux, system)
    >>> (1000 * bound.depth_m).round(0)  # mm
    array([ 9., 21.])
    """
    from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood

    MaximumLikelihood().check(system)
    require_effects("returns_bound", system.detector, LIGHT_EFFECTS, _simulate_instead)
    pixel = one_pixel(flux)
    s, tau, back = pixel.returns_signal, pixel.returns_delay_ns, pixel.background
    if not (s.size and np.isfinite(tau).all() and back > 0):
        raise ValueError("flux must have returns with delays, and background > 0")
    edges = np.linspace(0.0, system.period_ns, system.bins * _WAVEFORM_PARTS + 1)
    waves = [np.diff(system.pulse.wrapped_cumulative(edges - at, system.period_ns)) for at in tau]
    wave = np.maximum(np.tensordot(s, np.array(waves), 1), 0.0)
    mean = mean_histogram(Flux(waveform=wave, background=back), system, threads=threads)
    energy, slope, share = _pulse_bins(system, tau)
    information = _information(system, mean, s[:, None], back, energy, slope, share)
    deviation = np.sqrt(_inverse_diagonal(information))
    count = s.size
    of_delay = deviation[count + 1 :]
    return HistogramBound(information, deviation[:count], deviation[count], of_delay, system.depth_m(of_delay))


def _information(
    system: System,
    mean: FloatArray,
    signal: FloatArray,
    background: FloatArray,
    energy: FloatArray,
    slope: FloatArray,
    share: FloatArray,
) -> FloatArray:
    """(R18) of (all S, B, all delays) from S (..., K, 1), B (...), and energy and its slope (..., K, bins)."""
    efficiency = system.detector.detection_efficiency  # of the photons; dark counts come on top of them
    dark = 1e-9 * system.detector.dark_count_hz * system.period_ns
    flat = share / system.bins
    rate = efficiency * (signal * energy).sum(-2) + (efficiency * background[..., None] + dark) * flat
    by_background = np.broadcast_to(flat, rate.shape)[..., None, :]
    gradient = efficiency * np.concatenate([energy, by_background, signal * slope], axis=-2)
    weight = np.where(rate > 0, mean / np.where(rate > 0, rate, 1.0) ** 2, 0.0)  # E[D] / l = E[h] / l^2
    if system.detector.mode == "synchronous" or system.detector.dead_time_ns >= system.bin_ns:
        x = np.clip(0.5 * rate, 1e-6, 300.0)
        weight = weight * (x / np.sinh(x)) ** 2
    return np.asarray(np.einsum("...j,...aj,...bj->...ab", weight, gradient, gradient))


@checked
def window_error(weights: ArrayLike, flux: Flux, system: System) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of linear estimates ``weights @ h`` under dead time.

    Exact, by `joint_law`: bins of one histogram are not independent, so that the Poisson error of a window is wrong
    (docs/joint_law.md). Applies, for example, to the signal estimates of `MatchedFilter` and `Peak`.

    Parameters
    ----------
    weights
        (..., bins) real numbers.
    flux, system
        The light of one pixel, photons per period, and the system.

    Returns
    -------
    tuple
        Mean and standard deviation, each (...).

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`; weights that are not an array of numbers.
    ValueError
        Weights of another number of bins; several pixels.
    ConvergenceError
        As for `mars_lidar.joint_law`.

    See Also
    --------
    window_weights, mars_lidar.joint_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> weights = ml.reconstruction.window_weights(system, 40.0)
    >>> mean, error = ml.reconstruction.window_error(weights, ml.Flux(0.1, 0.1, 40.0), system)
    >>> round(float(mean), 3), round(float(error), 3)  # of S = 0.1: dead time is not corrected
    (0.089, 0.009)
    """
    mean, variance = joint_law(flux, system).window(weights)
    return mean, np.sqrt(variance)


@checked
def window_weights(system: System, delay_ns: float) -> FloatArray:
    """Weights for which ``weights @ h`` is the signal estimate from a window around a delay (R16).

    Parameters
    ----------
    system
        The system that recorded the histogram.
    delay_ns
        Centre of the window, ns.

    Returns
    -------
    NDArray
        (bins,) weights.

    Raises
    ------
    TypeError
        Not a `System`, or a delay that is not a number.
    ValueError
        A delay that is not finite; a pulse too wide for a background window in the period or outside of the gate.

    See Also
    --------
    window_error, MatchedFilter

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> weights = ml.reconstruction.window_weights(system, 40.0)
    >>> counts = ml.simulate(ml.Flux(0.02, 0.02, 40.0), system, seed=0)[0, 0, 0]
    >>> round(float(weights @ counts), 2)  # S = 0.02
    0.02
    """
    tau = checks.real("delay_ns", delay_ns)
    energy, _, share = _pulse_bins(system, np.asarray(tau))
    low, high = core_ns(system)
    first, last = np.floor((tau + low) / system.bin_ns), np.ceil((tau + high) / system.bin_ns)
    inside = np.zeros(system.bins, bool)
    inside[np.arange(int(first), max(int(last), int(first) + 1)) % system.bins] = True
    inside &= share > 0
    outside = ~inside & (share > 0)
    pulse = energy[inside].sum(), energy[outside].sum()
    open_share = share[inside].sum(), share[outside].sum()
    weights = np.where(inside, open_share[1], np.where(outside, -open_share[0], 0.0))
    scale = pulse[0] * open_share[1] - pulse[1] * open_share[0]
    if not scale > 0.0:
        raise ValueError(f"the window at {tau:g} ns does not separate the pulse from the background of the open bins")
    return np.asarray(weights / (scale * system.cycles), dtype=np.float64)


def _pulse_bins(system: System, delay_ns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Energy of the pulse in the open part of each bin (..., bins), its derivative by the delay (1/ns), open shares."""
    low, high = open_bins(system)
    if low.size == 0:
        edges = np.arange(system.bins + 1) / system.bins
        low, high = edges[:-1], edges[1:]
    period, step = system.period_ns, 1e-4 * min(system.bin_ns, relative_width(system) * system.period_ns)

    def energy_at(delay: FloatArray) -> FloatArray:
        at = delay[..., None]
        before = system.pulse.wrapped_cumulative(low * period - at, period)
        return np.asarray(system.pulse.wrapped_cumulative(high * period - at, period) - before)

    slope = (energy_at(delay_ns + step) - energy_at(delay_ns - step)) / (2.0 * step)
    return np.maximum(energy_at(delay_ns), 0.0), slope, (high - low) * system.bins


def _simulate_instead(_: str) -> str:
    return ", and neither do the estimators: reconstruct simulated cubes (engine 'exact') to see their errors"


def _inverse_diagonal(information: FloatArray) -> FloatArray:
    """Diagonal of the inverse (..., n); parameters without information are inf and excluded from the rest.

    So are parameters that cannot be distinguished, such as signal and background in a single bin.
    """
    size = information.shape[-1]
    flat = information.reshape(-1, size, size)
    out = np.full((len(flat), size), np.inf)
    for row, matrix in zip(out, flat, strict=True):
        known = np.diag(matrix) > 0
        if known.any():
            row[known] = _variances(matrix[np.ix_(known, known)])
    return out.reshape(information.shape[:-1])


def _variances(information: FloatArray) -> FloatArray:
    """Diagonal of the inverse of a matrix of positive diagonal, inf where a direction without information reaches."""
    size = np.sqrt(np.diag(information))
    value, vector = np.linalg.eigh(information / np.outer(size, size))
    blank = value <= _SINGULAR * value[-1]
    if not blank.any():
        return np.asarray(np.diag(np.linalg.inv(information)))
    variances = (vector[:, ~blank] ** 2 / value[~blank]).sum(-1) / size**2
    return np.asarray(np.where((vector[:, blank] ** 2).sum(-1) > _SINGULAR, np.inf, variances))
