"""Parameters common to all pixels of a histogram cube: dead time, pulse width or a free response, background floor.

Given the registrations before, those of a bin are binomial in the passes in which it was armed (R9), at the most likely
light of each pixel. The law of a parameter, for a flat prior, is the share of the likelihood in cells, of which likely
ones are divided until none holds much: of the dead time at the most likely width for each, and of the width at typical
dead times. Value, error and interval are its median, root mean square and quantiles, less the mean error that the
likelihood of bins, in which light and armed passes count as even, makes of simulated cubes, with the scatter of those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.display import brief
from mars_lidar._base.native import _core
from mars_lidar._base.types import ArrayLike, BoolArray, FloatArray
from mars_lidar.calibration.calibration import Estimate
from mars_lidar.engines.simulation import simulate
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS, System
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.fit_quality import tested_recordings
from mars_lidar.reconstruction.histograms import Histograms, checked
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruction.method import Estimates

_SIMULATED = 24  # cubes, whose estimates have known errors
_LARGEST_SHARE = 0.05  # of the probability that a cell of a parameter may hold, if it can be divided


@dataclass(frozen=True, eq=False)
class CubeCalibration:
    """Parameters common to the pixels of a cube, the result of `calibrate_cube`.

    Attributes
    ----------
    estimates
        ``dead_time_ns``, ``pulse_sigma_ns`` (of a Gaussian, jitter included), and ``background_floor``, photons per
        period of the darkest fitted pixel. For a single pixel also ``signal``, ``background``, ``delay_ns`` and
        ``depth_m``. Without errors where the histograms do not fit or could not be tested.
    system
        The given system with these values; with ``pulse="free"`` its pulse is a `SampledPulse` with one sample per bin.
    response_error
        Standard errors of the samples of that pulse, in units of its `values`; else None.
    counts, flux
        The fitted pixels, the brightest first: histograms (pixels, bins), and their light, an image of one row.
    p_values
        (pixels,) for each fitted pixel the probability of a histogram at least as far from its law, where it is known.
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
        """Whether pixels could be tested, and so many p below 1 % as theirs have a probability above 1 %."""
        from scipy.special import bdtrc  # of at least k of n: bdtrc(k - 1, n, 0.01)

        number = self.p_values.size
        misfits = int((self.p_values < 0.01).sum())
        if number == 1:
            return misfits == 0  # whose probability is 1 %
        return bool(number and bdtrc(misfits - 1, number, 0.01) >= 0.01)


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
        The recording system, with a nonparalyzable detector. Its dead time and pulse width are starting values of the
        fit, which tries all dead times within ten periods that the counts allow, and widths of up to eleven times more
        or less.
    pulse
        ``"gaussian"``, of unknown width; or ``"free"``: a response with one sample per bin, over ten standard
        deviations of the best Gaussian on either side, whose centroid is the delay of a pixel.
    pixels
        Largest number of fitted pixels; the brightest are taken.

    Raises
    ------
    ValueError
        A detector that is not nonparalyzable, or no pixel with 1000 registrations.
    """
    from scipy.optimize import minimize_scalar

    checks.choice("pulse", pulse, ("gaussian", "free"))
    given, _ = checked(cube, system, 1)
    if not tested_recordings(system):
        raise ValueError(
            f"system must have a nonparalyzable detector and many cycles to calibrate a cube, got mode "
            f"{system.detector.mode!r} and {system.cycles:,} cycles"
        )
    totals = given.counts.sum(1)
    chosen = np.argsort(totals)[::-1][: checks.integer("pixels", pixels, low=1, high=10**6)]
    chosen = chosen[totals[chosen] >= 1000]
    if not chosen.size:
        raise ValueError(f"cube must have a pixel of 1000 registrations, got at most {int(totals.max()):,}")
    some = np.ascontiguousarray(given.counts[chosen])
    width = float(getattr(system.pulse, "sigma_ns", np.ptp(system.pulse.support_ns()) / 8.0))
    given_dead = checks.real("dead_time_ns", system.detector.dead_time_ns)
    most = system.cycles * system.period_ns / (int(totals.max()) - 1)  # n registrations take at least n - 1 dead times

    def trial(dead: float, sigma: float) -> System:
        pulse = GaussianPulse(sigma_ns=float(np.clip(sigma, 2e-6 * system.period_ns, 0.2 * system.period_ns)))
        return system.replace(pulse=pulse, detector=replace(system.detector, dead_time_ns=float(dead)))

    def at_best_width(dead: float, near: FloatArray, counts: FloatArray) -> tuple[float, float]:
        def cost(sigma: float) -> float:
            return -_log_likelihood(counts, trial(dead, sigma))

        k = 1 + int(np.argmin([cost(sigma) for sigma in near[1:-1]]))
        within: Any = {"xatol": 1e-3 * near[k]}
        best = minimize_scalar(cost, bounds=(near[k - 1], near[k + 1]), method="bounded", options=within)
        return -float(best.fun), float(best.x)

    # at a wrong width a wrong dead time may be the most likely one, so that each dead time has its most likely width
    edges, sigmas = _graded(min(given_dead, most), most, system.period_ns), width * np.exp(np.linspace(-3.2, 3.2, 9))
    middles = 0.5 * (edges[1:] + edges[:-1])
    first = np.array([at_best_width(dead, sigmas, some[:8]) for dead in middles])
    likely = np.sort(np.argsort(first[:, 0])[-40:])
    widths = dict(zip(middles[likely], first[likely, 1], strict=True))

    def value(dead: float) -> float:
        near = widths[min(widths, key=lambda other: abs(other - dead))]
        log, widths[dead] = at_best_width(dead, near * np.array([0.65, 1.0, 1.5]), some)
        return log

    deads, share = _law(value, edges[likely], edges[likely + 1])
    # another maximum, a period away, is part of the error: a mean between the two would be neither; of several the
    # value is the one nearest to the given dead time
    mode = np.rint((deads - deads[share.argmax()]) / system.period_ns)
    modes = [mode == k for k in np.unique(mode) if share[mode == k].sum() >= 0.05]
    hold, hold_width = _estimate(deads, share, min(modes, key=lambda near: np.abs(deads[near] - given_dead).min()))
    # the law of the width is the mean of those at typical dead times; its value is that at the estimated one
    typical = deads[np.searchsorted(np.cumsum(share), np.arange(1, 12, 2) / 12.0)]

    def width_law(dead: float) -> tuple[FloatArray, FloatArray]:
        at = np.append(0.0, sigmas[:-1])
        return _law(lambda sigma: _log_likelihood(some, trial(dead, sigma)), at[:-1], at[1:])

    laws = [width_law(dead) for dead in (hold.value, *typical)]
    places, share = np.concatenate(laws, axis=1)
    sigma, sigma_width = _estimate(places, share, np.arange(places.size) < laws[0][0].size)
    at, widths_of = (hold.value, sigma.value), (hold_width, sigma_width)
    off = _errors(trial, some, at, widths_of)
    hold, sigma = (_corrected(*each) for each in zip((hold, sigma), widths_of, off, strict=True))
    estimates = {"dead_time_ns": hold, "pulse_sigma_ns": sigma}
    best, final, response_error = trial(*at), trial(hold.value, sigma.value), None
    if pulse == "free":

        def with_response(dead: float) -> tuple[System, FloatArray]:
            return _with_response(some, trial(dead, sigma.value), sigma.value)

        # a dead time just below a period looks like the tail of a pulse, so that each is tried with its own response
        edges = np.unique(np.clip(hold.value + system.period_ns * np.linspace(-1.05, 1.05, 22), 0.0, most))
        deads, share = _law(lambda dead: _log_likelihood(some, with_response(dead)[0]), edges[:-1], edges[1:])
        own = _estimate(deads, share, share >= 0.0)[0]
        estimates = {"dead_time_ns": _corrected(own, hold_width, off[0])}
        best, (final, response_error) = with_response(own.value)[0], with_response(estimates["dead_time_ns"].value)
    light = MaximumLikelihood().estimate(Histograms(some, final, 1))
    # the test has the bias of the likelihood, so that it is that of its most likely values
    p_values = np.asarray(MaximumLikelihood().estimate(Histograms(some, best, 1)).p_value)
    known = p_values[np.isfinite(p_values)]
    estimates["background_floor"] = _of_pixel(light, "background", int(np.argmin(light.background)))
    if len(given.counts) == 1:
        estimates |= {name: _of_pixel(light, name, 0) for name in ("signal", "background")}
        estimates["delay_ns"] = _of_pixel(light, "delay", 0, final.period_ns)
        estimates["depth_m"] = _of_pixel(light, "delay", 0, final.period_ns * 0.5 * SPEED_OF_LIGHT_M_PER_NS)
    result = CubeCalibration(estimates, final, known, response_error, some.astype(np.float64), _flux(light, final))
    if result.fits:
        return result
    cause = "of a model that does not fit" if known.size else "of histograms that could not be tested"
    unknown = (np.nan, np.nan, np.nan, f"{cause}: no error is stated")
    bare = {name: Estimate(each.value, *unknown) for name, each in estimates.items()}
    return replace(result, estimates=bare, response_error=None)


def _flux(light: Estimates, system: System) -> Flux:
    """The light of the pixels, an image of one row."""
    return Flux(light.signal[None], np.maximum(light.background, 0.0)[None], light.delay[None] * system.period_ns)


def _errors(
    trial: Callable[[float, float], System], cube: FloatArray, at: tuple[float, float], widths: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Errors (cubes,) of the dead time and of the pulse's width of simulated cubes, ns, of systems near the estimates.

    The likelihood takes light and armed passes as even within a bin, which biases dead time and width together, and
    where a dead time ends in a pulse several true ones have about the same estimate. So true ones lie three bins, or
    three `widths` of its law, on either side of the estimate, each with the most likely light of the `cube`, and errors
    are those of the cubes whose estimates are a third as near.
    """
    (dead, sigma), bin_ns = at, trial(*at).bin_ns
    reach = 3.0 * max(bin_ns, widths[0])
    edges = np.unique(np.maximum(dead + reach * np.linspace(-1.5, 1.5, 13), 0.0))
    off = []
    for k, true in enumerate(np.maximum(dead + reach * np.linspace(-1.0, 1.0, _SIMULATED), 0.0)):
        system = trial(float(true), sigma)
        light = MaximumLikelihood().estimate(Histograms(cube, system, 1))
        counts = np.ascontiguousarray(simulate(_flux(light, system), system, seed=k)[0, 0])

        def at_width(dead: float, counts: Any = counts) -> tuple[float, float]:
            """Largest logarithm of the likelihood, and where: of a parabola through three widths."""
            below, middle, above = (_log_likelihood(counts, trial(dead, sigma + x * widths[1])) for x in (-2, 0, 2))
            slope, bend = 0.25 * (above - below), max(0.25 * (2.0 * middle - below - above), 0.25)  # 1 of a normal law
            step = float(np.clip(slope / bend, -2.0, 2.0))
            return middle + step * (slope - 0.5 * bend * step), widths[1] * step

        def log(dead: float, of: Callable[[float], tuple[float, float]] = at_width) -> float:
            return of(dead)[0]

        places, share = _law(log, edges[:-1], edges[1:])
        estimate = _estimate(places, share, share >= 0.0)[0].value
        if abs(estimate - dead) < reach / 3.0:
            off.append((estimate - dead, true - dead, at_width(estimate)[1]))
    if len(off) < 3:
        return np.array([-reach, reach]), np.array([-widths[1], widths[1]])
    # true dead times less what the estimates explain of them (Beaumont et al., Genetics 162, 2025, 2002)
    estimated, true, wide = np.array(off).T
    slope = np.cov(estimated, true)[0, 1] / (estimated.var(ddof=1) + widths[0] ** 2)
    return slope * estimated - true, wide


def _corrected(own: Estimate, width: float, off: FloatArray) -> Estimate:
    """An estimate less the mean of the errors `off` (n,), with at least their scatter, and the largest in its interval.

    `width`: standard deviation of the law of the nearest maximum; the interval ends at another one may be as far off.
    """
    mean, largest = float(off.mean()), float(np.abs(off - off.mean()).max())
    value, error = max(own.value - mean, 0.0), float(np.sqrt(off.var(ddof=1) * (1.0 + 1.0 / off.size)))
    grown = max(largest - 1.96 * width, 0.0)
    low, high = min(own.low - mean - grown, value - largest), max(own.high - mean + grown, value + largest)
    return replace(own, value=value, error=max(own.error, error), low=low, high=high)


def _of_pixel(light: Estimates, name: str, k: int, unit: float = 1.0) -> Estimate:
    """An estimate of pixel k, with the other parameters of the cube at their estimates."""
    value, error = (unit * float(getattr(light, each)[k]) for each in (name, f"{name}_error"))
    return Estimate(value, error, value - 1.96 * error, value + 1.96 * error)


def _with_response(counts: FloatArray, system: System, sigma: float, steps: int = 60) -> tuple[System, FloatArray]:
    """The system with the most likely response in ten `sigma` on either side, and the standard errors of its samples.

    The expected registrations of bin j of pixel k are D_kj (B_k / bins + S_k sum_m a_kjm r_m): r is the response, a_kjm
    the share of its sample m that falls into the bin at the pixel's delay, and D_kj the mean number of passes in which
    the pixel is armed in the bin; delay, light and D are those of the system's own pulse. The likelihood is maximised
    by expectation maximisation (Shepp and Vardi, IEEE Trans. Med. Imaging 1, 113, 1982).
    """
    from scipy.sparse import csr_matrix

    pixels, bins = counts.shape
    reach = int(min(np.ceil(10.0 * sigma / system.bin_ns) + 2, bins // 2 - 1))
    sample = np.arange(2 * reach)
    response = np.maximum(np.diff(system.pulse.cumulative((np.arange(2 * reach + 1) - reach) * system.bin_ns)), 1e-6)
    histograms = Histograms(counts, system, 1)
    light = MaximumLikelihood().estimate(histograms)
    background = np.maximum(light.background, 1e-6)
    share, whole = np.modf(light.delay * bins - reach + bins)  # where the first sample begins, in bins
    after = np.array([0, 1])[:, None, None]  # each sample falls into two bins
    rows = np.arange(pixels)[:, None] * bins + (whole.astype(int)[:, None] + sample + after) % bins
    weight = np.where(after, share[:, None], 1.0 - share[:, None]) * light.signal[:, None] * np.ones(sample.size)
    columns = np.tile(sample, 2 * pixels)
    to_bins = csr_matrix((weight.ravel(), (rows.ravel(), columns)), (pixels * bins, sample.size))
    floor = np.repeat(background / bins, bins)
    passes = _expected(histograms, np.stack([light.signal, background, light.delay], axis=1)).ravel()
    passes = passes / (to_bins @ response + floor)
    to_bins, floor = csr_matrix(to_bins.multiply(passes[:, None])), floor * passes
    recorded, exposed = counts.ravel(), np.maximum(np.asarray(to_bins.sum(0)).ravel(), 1e-9)
    for _ in range(steps):
        expected = np.maximum(to_bins @ response + floor, 1e-9)
        response = response * (to_bins.T @ (recorded / expected)) / exposed
    information = (to_bins.T @ to_bins.multiply((1.0 / expected)[:, None])).toarray()
    curved = np.diff(response, 2, prepend=0.0, append=0.0) / 8.0  # of linear interpolation between bins
    error = np.sqrt(np.diag(np.linalg.pinv(information, rcond=1e-10, hermitian=True)) + curved**2)
    return system.replace(pulse=SampledPulse(response, bin_ns=system.bin_ns, origin="centroid")), error


def _expected(histograms: Histograms, light: FloatArray) -> FloatArray:
    """Expected registrations (pixels, bins) of light (pixels, 3), given those of the earlier bins."""
    expected = np.empty(histograms.counts.shape)
    _core.expected_registrations(histograms.recording, histograms.counts, light, expected)
    return expected


def _graded(dead: float, most: float, period: float) -> FloatArray:
    """Edges of cells within ten periods of a dead time, narrower towards whole periods.

    The likelihood has a maximum every period; that of a dead time that ends within the next pulse is as narrow as it.
    """
    low, high = max(dead - 10.0 * period, 0.0), min(dead + 10.0 * period, most)
    whole = period * np.arange(low // period, high // period + 2)
    off = 0.1 * period * np.append(np.arange(1, 6), 0.5 ** np.arange(1, 8))
    return np.unique(np.clip(np.concatenate([[low, high], *(whole + x for x in (*off, *-off))]), low, high))


def _law(value: Callable[[float], float], low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres of cells, from these to finer, and the shares of the probability that they hold, for a flat prior.

    With few counts the likelihood of the place of an edge has many maxima, whose curvatures are not its width. A cell
    is divided into three while it would hold much, if the logarithm changed within it as from it to the next one.
    """
    size, places = high - low, 0.5 * (low + high)
    log = np.array([value(x) for x in places])
    while True:
        change = np.abs(np.diff(np.pad(log, 1, mode="edge")))
        most = np.minimum(log - log.max() + np.maximum(change[1:], change[:-1]), 0.0)
        share = np.exp(log - log.max()) * size
        wide = np.exp(most) * size > _LARGEST_SHARE * share.sum()
        if not wide.any():
            return places, share / share.sum()
        size[wide] /= 3.0
        outer = np.concatenate([places[wide] - size[wide], places[wide] + size[wide]])
        log = np.append(log, [value(x) for x in outer])
        places, size = np.append(places, outer), np.append(size, np.tile(size[wide], 2))
        log, places, size = (each[np.argsort(places)] for each in (log, places, size))


def _estimate(places: FloatArray, share: FloatArray, near: BoolArray) -> tuple[Estimate, float]:
    """Median of the places `near`, error and 95 % interval by all; standard deviation of those near.

    The error is the root mean square about the median, of the central 99 %.
    """
    order = np.argsort(places)
    places, share, near = places[order], share[order] / share.sum(), near[order]
    value = float(np.interp(0.5 * share[near].sum(), np.cumsum(share * near) - 0.5 * share * near, places))
    least, low, high, most = np.interp([0.005, 0.025, 0.975, 0.995], np.cumsum(share) - 0.5 * share, places)
    square = share * (np.clip(places, least, most) - value) ** 2
    local = float(square[near].sum() / share[near].sum()) ** 0.5
    return Estimate(value, float(square.sum()) ** 0.5, float(low), float(high)), local


def _log_likelihood(counts: FloatArray, system: System) -> float:
    """Sum over the pixels of the logarithm of (R9a), for the mean of the hidden passes, at the most likely light."""
    from scipy.special import gammaln, xlogy

    histograms = Histograms(counts, system, 1)
    fit = MaximumLikelihood().estimate(histograms)
    light = np.stack([fit.signal, np.maximum(fit.background, 1e-9), fit.delay], axis=1)
    expected = np.maximum(_expected(histograms, light), 1e-9)
    if system.detector.dead_time_ns < system.bin_ns:
        return float((xlogy(counts, expected) - expected - gammaln(counts + 1)).sum())
    endless = np.stack([0.0 * fit.signal, np.full(len(light), 1e12), fit.delay], axis=1)
    passes = np.maximum(_expected(histograms, endless), counts)
    share = np.clip(expected / np.maximum(passes, 1e-9), 1e-12, 1.0 - 1e-12)
    ways = gammaln(passes + 1) - gammaln(passes - counts + 1) - gammaln(counts + 1)
    likelihood = ways + xlogy(counts, share) + xlogy(passes - counts, 1.0 - share)
    return float(likelihood.sum() - 0.5 * (_impossible(counts, system) ** 2).sum())


def _impossible(counts: FloatArray, system: System) -> FloatArray:
    """Registrations beyond the passes in which their bin was armed (pixels, bins), over the deviation of the latter.

    The native likelihood takes as many passes as a bin has registrations at least, with which such bins fit.
    """
    bins, dead, total = counts.shape[1], system.dead_time_periods, counts.sum(1, keepdims=True)
    whole, rest = divmod(dead * bins, bins)
    shift = int(rest)
    before = np.pad(np.cumsum(np.tile(counts, (1, 2)), axis=1), ((0, 0), (1, 0)))
    at = bins + np.arange(bins)
    partial = before[:, at - shift] - before[:, at - shift - 1]  # of the bin that the dead time's start shares
    lost = whole * total + before[:, at] - before[:, at - shift] + (rest - shift) * partial
    hidden = np.minimum(1.0, total * dead / system.cycles) * dead**2 / 3.0 + 1.0
    # all that the last dead time may hide counts as armed
    excess = np.maximum(counts - (system.cycles - lost + dead), 0.0)
    return np.asarray(excess / np.sqrt(hidden + 0.5 * counts.max(1, keepdims=True)))
