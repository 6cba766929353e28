"""Parameters common to all pixels of a histogram cube: dead time, pulse width or a free response, background floor.

Registrations h_j of a bin are expected to be e_j = l_j D_j, the light times the passes for which the pixel was armed,
and differ from it by a martingale of variance e_j. So sum_j h_j log e_j - e_j is a quasi-likelihood (Wedderburn,
Biometrika 61, 439, 1974) of what all pixels share, at the most likely light of each; its curvature gives the errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.display import brief
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.calibration.calibration import Estimate
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS, System
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.fit_quality import tested_recordings
from mars_lidar.reconstruction.histograms import Histograms, checked
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruction.method import Estimates

_GRID = 13  # dead times of the first search, over a period
_DECREASE = 1e-2  # of the log likelihood, at which the maximisation ends


@dataclass(frozen=True, eq=False)
class CubeCalibration:
    """Parameters common to the pixels of a cube, the result of `calibrate_cube`.

    Attributes
    ----------
    estimates
        ``dead_time_ns``, ``pulse_sigma_ns`` (of a Gaussian, jitter included), and ``background_floor``, photons per
        period of the darkest fitted pixel. For a single pixel also ``signal``, ``background``, ``delay_ns`` and
        ``depth_m``.
    system
        The given system with these values; with ``pulse="free"`` its pulse is a `SampledPulse` with one sample per bin.
    response_error
        Standard errors of the samples of that pulse, in units of its `values`; else None.
    counts, flux
        The fitted pixels, the brightest first: histograms (pixels, bins), and their light, an image of one row.
    p_values
        (pixels,) for each fitted pixel the probability of a histogram at least as far from its law.
    """

    estimates: dict[str, Estimate]
    system: System
    p_values: FloatArray
    response_error: FloatArray | None
    counts: FloatArray
    flux: Flux

    __repr__ = brief

    @property
    def misfits(self) -> float:
        """Share of the fitted pixels with p below 1 %."""
        return float((self.p_values < 0.01).mean()) if self.p_values.size else float("nan")

    @property
    def fits(self) -> bool:
        """Whether no more pixels than by chance (four standard deviations) have p below 1 %."""
        expected = 0.01 * self.p_values.size
        return bool((self.p_values < 0.01).sum() <= expected + 4.0 * expected**0.5 + 1.0)


def calibrate_cube(
    cube: ArrayLike, system: System, *, pulse: Literal["gaussian", "free"] = "gaussian", pixels: int = 32
) -> CubeCalibration:
    """Estimate the dead time and pulse common to all pixels of a cube (..., bins), with errors.

    An offset of the histograms from the laser pulse cannot be distinguished from depth and is not estimated.

    Parameters
    ----------
    cube
        (..., bins) counts.
    system
        The recording system, with a free-running detector. Its dead time and pulse width are starting values of the
        fit.
    pulse
        ``"gaussian"``, of unknown width; or ``"free"``: a response with one sample per bin, over ten standard
        deviations of the best Gaussian on either side, whose centroid is the delay of a pixel.
    pixels
        Largest number of fitted pixels; the brightest are taken.

    Raises
    ------
    ValueError
        A detector that is not free-running, or no pixel with 1000 registrations.
    """
    from scipy.optimize import minimize

    checks.choice("pulse", pulse, ("gaussian", "free"))
    given, _ = checked(cube, system, 1)
    if not tested_recordings(system):
        raise ValueError(
            f"system must have a free-running detector and many cycles to calibrate a cube, got mode "
            f"{system.detector.mode!r} and {system.cycles:,} cycles"
        )
    totals = given.counts.sum(1)
    chosen = np.argsort(totals)[::-1][: checks.integer("pixels", pixels, low=1, high=10**6)]
    chosen = chosen[totals[chosen] >= 1000]
    if not chosen.size:
        raise ValueError(f"cube must have a pixel of 1000 registrations, got at most {int(totals.max()):,}")
    some = np.ascontiguousarray(given.counts[chosen])

    def trial(at: FloatArray) -> System:
        sigma = float(np.clip(np.exp(at[1]), 2e-6 * system.period_ns, 0.2 * system.period_ns))
        dead = float(max(at[0], 0.0))
        return system.replace(pulse=GaussianPulse(sigma_ns=sigma), detector=replace(system.detector, dead_time_ns=dead))

    def loss(at: FloatArray) -> float:
        return -_log_likelihood(some, trial(at))

    low, high = system.pulse.support_ns()
    width = system.pulse.sigma_ns if isinstance(system.pulse, GaussianPulse) else (high - low) / 8.0
    widths = np.log(width) + np.array([-2.5, -1.2, 0.0, 1.2, 2.5])
    dead = checks.real("dead_time_ns", system.detector.dead_time_ns)
    most = max(1.5 * dead, 0.95 * system.period_ns)
    grid = np.r_[dead, np.linspace(0.0, most, _GRID)]
    start = min(([dead, w] for w in widths), key=lambda at: loss(np.array(at)))
    start = min(([d, start[1]] for d in grid), key=lambda at: loss(np.array(at)))
    simplex = np.array([start, [start[0] + most / _GRID, start[1]], [start[0], start[1] + 0.4]])
    options: Any = {"initial_simplex": simplex, "fatol": _DECREASE, "xatol": 1e-4, "maxiter": 80}
    best = minimize(loss, np.array(start), method="Nelder-Mead", options=options)
    at = np.asarray(best.x, np.float64)
    errors = np.array([_half_width(loss, at, k, float(best.fun)) for k in range(2)])
    final, response_error = trial(at), None
    if pulse == "free":
        # a dead time just below a period looks like the tail of a pulse, so that each is tried with its own response
        reach = int(min(np.ceil(10.0 * np.exp(at[1]) / system.bin_ns) + 2, system.bins // 2 - 1))
        trials = [_with_response(some, trial(np.array([d, at[1]])), reach, 1)[0] for d in (at[0], *grid)]
        final = max(trials, key=lambda each: _log_likelihood(some, each))
        for near in (most / _GRID, 0.2 * most / _GRID):
            dead, errors[0] = _dead_time(some, final, near)
            final = final.replace(detector=replace(final.detector, dead_time_ns=dead))
            final, response_error = _with_response(some, final, reach, 2)
    light = MaximumLikelihood().estimate(Histograms(some, final, 1))
    p_values = np.asarray(light.p_value)
    sigma = float(np.exp(at[1]))
    estimates = {"dead_time_ns": _normal(final.detector.dead_time_ns, errors[0])}
    if pulse == "gaussian":
        estimates["pulse_sigma_ns"] = _normal(sigma, sigma * errors[1])
    estimates["background_floor"] = _of_pixel(light, "background", int(np.argmin(light.background)))
    if len(given.counts) == 1:
        estimates |= {name: _of_pixel(light, name, 0) for name in ("signal", "background")}
        estimates["delay_ns"] = _of_pixel(light, "delay", 0, final.period_ns)
        estimates["depth_m"] = _of_pixel(light, "delay", 0, final.period_ns * 0.5 * SPEED_OF_LIGHT_M_PER_NS)
    flux = Flux(light.signal[None], np.maximum(light.background, 0.0)[None], light.delay[None] * final.period_ns)
    return CubeCalibration(
        estimates, final, p_values[np.isfinite(p_values)], response_error, np.asarray(some, np.float64), flux
    )


def _of_pixel(light: Estimates, name: str, k: int, unit: float = 1.0) -> Estimate:
    """An estimate of pixel k, with the other parameters of the cube at their estimates."""
    errors = getattr(light, f"{name}_error")
    return _normal(unit * float(getattr(light, name)[k]), 0.0 if errors is None else unit * float(errors[k]))


def _with_response(
    counts: FloatArray, system: System, reach: int, rounds: int, steps: int = 60
) -> tuple[System, FloatArray]:
    """The system with the most likely response in `reach` bins on either side, and the standard errors of its samples.

    A bin j of pixel k expects D_kj (B_k / bins + S_k sum_m a_kjm r_m), with r the response, a the share of its sample
    m that falls into the bin at the pixel's delay, and D the armed passes. The likelihood is maximised by expectation
    and maximisation (Shepp and Vardi, IEEE Trans. Med. Imaging 1, 113, 1982), in turn with the light of each pixel.
    """
    from scipy.sparse import csr_matrix

    pixels, bins = counts.shape
    width = system.period_ns / bins
    samples = 2 * reach
    error = np.zeros(samples)
    edges = (np.arange(samples + 1) - reach) * width
    response = np.maximum(np.diff(system.pulse.cumulative(edges)), 1e-6)
    for _ in range(rounds):
        light = MaximumLikelihood().estimate(Histograms(counts, system, 1))
        passes = _armed_passes(counts, system)
        first = light.delay * bins - reach  # where the first sample begins, in bins
        whole = np.floor(first).astype(int)
        share = first - whole  # of a sample that falls into the bin after
        sample = np.arange(samples)
        row = np.arange(pixels)[:, None] * bins
        rows = np.stack([row + (whole[:, None] + sample) % bins, row + (whole[:, None] + sample + 1) % bins])
        weight = np.stack([1.0 - share, share])[:, :, None] * np.ones(samples)
        weight = weight * light.signal[None, :, None] * passes.ravel()[rows]
        columns = np.broadcast_to(sample, rows.shape)
        to_bins = csr_matrix((weight.ravel(), (rows.ravel(), columns.ravel())), (pixels * bins, samples))
        floor = (passes * light.background[:, None] / bins).ravel()
        recorded, exposed = counts.ravel(), np.maximum(np.asarray(to_bins.sum(0)).ravel(), 1e-9)
        for _ in range(steps):
            expected = np.maximum(to_bins @ response + floor, 1e-9)
            response = response * (to_bins.T @ (recorded / expected)) / exposed
        information = (to_bins.T @ to_bins.multiply((1.0 / expected)[:, None])).toarray()
        error = np.sqrt(np.diag(np.linalg.pinv(information, rcond=1e-10, hermitian=True)))
        system = system.replace(pulse=SampledPulse(response, bin_ns=width, origin="centroid"))
    return system, error


def _armed_passes(counts: FloatArray, system: System) -> FloatArray:
    """Armed passes (pixels, bins) of each bin: the registrations for light of one photon per bin."""
    return _expected(Histograms(counts, system, 1), np.tile([0.0, float(counts.shape[1]), 0.0], (len(counts), 1)))


def _expected(histograms: Histograms, light: FloatArray) -> FloatArray:
    """Expected registrations (pixels, bins) of light (pixels, 3), given those of the earlier bins."""
    from mars_lidar._base.native import _core

    expected = np.empty(histograms.counts.shape)
    _core.expected_registrations(histograms.recording, histograms.counts, light, expected)
    return expected


def _dead_time(counts: FloatArray, system: System, reach: float) -> tuple[float, float]:
    """The most likely dead time within `reach` of that of the system, and its standard error, with its pulse."""
    from scipy.optimize import minimize_scalar

    def loss(at: FloatArray) -> float:
        detector = replace(system.detector, dead_time_ns=float(max(at[0], 0.0)))
        return -_log_likelihood(counts, system.replace(detector=detector))

    dead = system.detector.dead_time_ns
    best = minimize_scalar(
        lambda d: loss(np.array([d])), bounds=(max(dead - reach, 0.0), dead + reach), method="bounded"
    )
    return float(best.x), _half_width(loss, np.array([best.x]), 0, float(best.fun))


def _normal(value: float, error: float) -> Estimate:
    return Estimate(value, error, value - 1.96 * error, value + 1.96 * error)


def _half_width(loss: Callable[[FloatArray], float], at: FloatArray, k: int, least: float) -> float:
    """Distance at which the loss is 1/2 above its minimum, the mean of both sides: one standard error."""
    sides = []
    for sign in (-1.0, 1.0):
        step = 1e-4 * max(abs(at[k]), 1.0)
        for _ in range(40):
            moved = at.copy()
            moved[k] += sign * step
            rise = loss(moved) - least
            if rise > 0.5:
                break
            step *= 1.5
        sides.append(step * (0.5 / max(rise, 0.5)) ** 0.5)
    return float(np.mean(sides))


def _log_likelihood(counts: FloatArray, system: System) -> float:
    """Sum over the pixels of the quasi-likelihood at the most likely light of each."""
    histograms = Histograms(counts, system, 1)
    fit = MaximumLikelihood().estimate(histograms)
    expected = _expected(histograms, np.stack([fit.signal, np.maximum(fit.background, 1e-9), fit.delay], axis=1))
    return float((counts * np.log(np.maximum(expected, 1e-9))).sum() - expected.sum())
