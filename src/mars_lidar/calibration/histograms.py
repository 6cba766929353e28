"""Parameters common to all pixels of a histogram cube: dead time, pulse width or a free response, background floor.

Given the registrations before, those of a bin are binomial in the passes in which it was armed (R9), at the most likely
light of each pixel. The parameters are tried together: at a wrong width a wrong dead time may be the most likely one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

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

_GRID = 20  # dead times of the first search in each period; the likelihood has a maximum every period
_PERIODS = 20  # of which it searches the ones nearest to the given dead time
_ROUNDS = 14  # of the search, each with places between the likely ones
_MAXIMA = 6  # of a likelihood, the highest, between whose neighbours the search goes on
_TRIALS = 8  # pixels, the brightest, by which pulse widths are compared in the first search


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
        The recording system, with a free-running detector. Its dead time and pulse width are starting values of the
        fit, which tries all dead times within ten periods that the counts allow.
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

    def trial(dead: float, log_sigma: float) -> System:
        sigma = float(np.clip(np.exp(log_sigma), 2e-6 * system.period_ns, 0.2 * system.period_ns))
        return _with_dead_time(system.replace(pulse=GaussianPulse(sigma_ns=sigma)), dead)

    low, high = system.pulse.support_ns()
    width = system.pulse.sigma_ns if isinstance(system.pulse, GaussianPulse) else (high - low) / 8.0
    dead = checks.real("dead_time_ns", system.detector.dead_time_ns)
    step = system.period_ns / _GRID
    # n registrations take at least n - 1 dead times
    most = system.cycles * system.period_ns / (int(totals.max()) - 1)
    dead = min(dead, most)
    nearby = dead + step * np.arange(-_GRID * _PERIODS // 2, _GRID * _PERIODS // 2 + 1)
    deads: FloatArray = np.union1d([0.0, most], nearby[(nearby >= 0.0) & (nearby <= most)])
    whole = system.period_ns * np.arange(deads[0] // system.period_ns, deads[-1] // system.period_ns + 2)

    def places(log_sigma: float) -> FloatArray:
        """Dead times of the search: one near whole periods ends within the next pulse, and its maximum is as narrow."""
        inside = (whole[:, None] + np.exp(log_sigma) * np.arange(-3.0, 4.0)).ravel()
        return np.union1d(deads, inside[(inside > deads[0]) & (inside < deads[-1])])

    # both at once: at a wrong width a wrong dead time may be the most likely one, which that width then fits
    few = some[:_TRIALS]
    widths = np.log(width) + np.linspace(-2.4, 2.4, 9)
    pairs = [(float(d), float(w)) for w in widths for d in places(float(w))]
    values = [_log_likelihood(few, trial(*pair)) for pair in pairs]
    tops: list[tuple[float, float]] = []
    for k in np.argsort(values)[::-1]:
        if all(abs(pairs[k][0] - other) > 0.5 * step for other, _ in tops):
            tops.append(pairs[k])
        if len(tops) == _MAXIMA:
            break
    climbs = []
    for d, w in tops:
        inside = np.unique(np.clip(d + np.exp(w) * np.linspace(-3.0, 3.0, 25), 0.0, most))
        close = [(float(x), w + v) for x in inside for v in (-0.6, -0.3, 0.0, 0.3, 0.6)]
        best = max(close, key=lambda pair: _log_likelihood(few, trial(*pair)))
        climbs.append(_climb(some, trial, best, step, most))
    _, dead, log_sigma = max(climbs)
    tried = np.union1d(places(log_sigma), [each[1] for each in climbs])
    hold, sigma = _joint_law(some, trial, dead, log_sigma, tried, system.detector.dead_time_ns)
    final, response_error = trial(hold.value, sigma.value), None
    if pulse == "free":
        # a dead time just below a period looks like the tail of a pulse, so that each is tried with its own response
        reach = int(min(np.ceil(10.0 * np.exp(sigma.value) / system.bin_ns) + 2, system.bins // 2 - 1))
        near = deads[np.abs(deads - hold.value) < system.period_ns][::2]
        trials = [_with_response(some, trial(d, sigma.value), reach, 1)[0] for d in (hold.value, *near)]
        final = max(trials, key=lambda each: _log_likelihood(some, each))
        for reach_ns in (step, 0.2 * step):
            around = np.clip(final.detector.dead_time_ns + reach_ns * np.linspace(-1.0, 1.0, 13), 0.0, most)
            hold, _, _ = _law(partial(_log_likelihood_at, some, final), np.unique(around))
            final, response_error = _with_response(some, _with_dead_time(final, hold.value), reach, 2)
    light = MaximumLikelihood().estimate(Histograms(some, final, 1))
    p_values = np.asarray(light.p_value)
    estimates = {"dead_time_ns": hold}
    if pulse == "gaussian":
        value, low, high = np.exp([sigma.value, sigma.low, sigma.high])
        estimates["pulse_sigma_ns"] = Estimate(float(value), float(value * sigma.error), float(low), float(high))
    estimates["background_floor"] = _of_pixel(light, "background", int(np.argmin(light.background)))
    if len(given.counts) == 1:
        estimates |= {name: _of_pixel(light, name, 0) for name in ("signal", "background")}
        estimates["delay_ns"] = _of_pixel(light, "delay", 0, final.period_ns)
        estimates["depth_m"] = _of_pixel(light, "delay", 0, final.period_ns * 0.5 * SPEED_OF_LIGHT_M_PER_NS)
    flux = Flux(light.signal[None], np.maximum(light.background, 0.0)[None], light.delay[None] * final.period_ns)
    result = CubeCalibration(
        estimates, final, p_values[np.isfinite(p_values)], response_error, np.asarray(some, np.float64), flux
    )
    if result.fits:
        return result
    words = "of a model that does not fit" if result.p_values.size else "of histograms that could not be tested"
    bare = {
        name: Estimate(each.value, np.nan, np.nan, np.nan, f"{words}: no error is stated")
        for name, each in estimates.items()
    }
    return replace(result, estimates=bare, response_error=None)


def _of_pixel(light: Estimates, name: str, k: int, unit: float = 1.0) -> Estimate:
    """An estimate of pixel k, with the other parameters of the cube at their estimates."""
    errors = getattr(light, f"{name}_error")
    return _normal(unit * float(getattr(light, name)[k]), 0.0 if errors is None else unit * float(errors[k]))


def _with_response(
    counts: FloatArray, system: System, reach: int, rounds: int, steps: int = 60
) -> tuple[System, FloatArray]:
    """The system with the most likely response in `reach` bins on either side, and the standard errors of its samples.

    The expected registrations of bin j of pixel k are D_kj (B_k / bins + S_k sum_m a_kjm r_m): r is the response, a_kjm
    the share of its sample m that falls into the bin at the pixel's delay, and D_kj the mean number of passes in which
    the pixel is armed in the bin, by the preceding response. The likelihood is maximised by expectation maximisation
    (Shepp and Vardi, IEEE Trans. Med. Imaging 1, 113, 1982), alternately with the light of each pixel.
    """
    from scipy.sparse import csr_matrix

    pixels, bins = counts.shape
    width = system.period_ns / bins
    samples = 2 * reach
    error = np.zeros(samples)
    edges = (np.arange(samples + 1) - reach) * width
    response = np.maximum(np.diff(system.pulse.cumulative(edges)), 1e-6)
    for _ in range(rounds):
        histograms = Histograms(counts, system, 1)
        light = MaximumLikelihood().estimate(histograms)
        background = np.maximum(light.background, 1e-6)
        first = light.delay * bins - reach  # where the first sample begins, in bins
        whole = np.floor(first).astype(int)
        share = first - whole  # of a sample that falls into the bin after
        sample = np.arange(samples)
        row = np.arange(pixels)[:, None] * bins
        rows = np.stack([row + (whole[:, None] + sample) % bins, row + (whole[:, None] + sample + 1) % bins])
        weight = np.stack([1.0 - share, share])[:, :, None] * np.ones(samples)
        weight = weight * light.signal[None, :, None]
        columns = np.broadcast_to(sample, rows.shape)
        to_bins = csr_matrix((weight.ravel(), (rows.ravel(), columns.ravel())), (pixels * bins, samples))
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
        system = system.replace(pulse=SampledPulse(response, bin_ns=width, origin="centroid"))
    return system, error


def _expected(histograms: Histograms, light: FloatArray) -> FloatArray:
    """Expected registrations (pixels, bins) of light (pixels, 3), given those of the earlier bins."""
    from mars_lidar._base.native import _core

    expected = np.empty(histograms.counts.shape)
    _core.expected_registrations(histograms.recording, histograms.counts, light, expected)
    return expected


def _with_dead_time(system: System, dead: float) -> System:
    return system.replace(detector=replace(system.detector, dead_time_ns=float(max(dead, 0.0))))


def _log_likelihood_at(counts: FloatArray, system: System, dead: float) -> float:
    return _log_likelihood(counts, _with_dead_time(system, dead))


def _climb(
    counts: FloatArray, trial: Callable[[float, float], System], start: tuple[float, float], step: float, most: float
) -> tuple[float, float, float]:
    """Value and place of the maximum of the likelihood next to a dead time and a logarithm of the width."""
    from scipy.optimize import minimize

    (dead, log_sigma), reach = start, min(0.5 * step, 0.5 * float(np.exp(start[1])))
    corners = np.array([[dead, log_sigma], [dead + reach, log_sigma], [dead, log_sigma + 0.1]])

    def cost(at: FloatArray) -> float:
        return -_log_likelihood(counts, trial(float(np.clip(at[0], 0.0, most)), float(at[1])))

    result = minimize(
        cost,
        corners[0],
        method="Nelder-Mead",
        options={"initial_simplex": corners, "maxfev": 80, "xatol": 1e-4, "fatol": 0.05},
    )
    return -float(result.fun), float(np.clip(result.x[0], 0.0, most)), float(result.x[1])


def _joint_law(
    counts: FloatArray,
    trial: Callable[[float, float], System],
    dead: float,
    log_sigma: float,
    places: FloatArray,
    given: float,
) -> tuple[Estimate, Estimate]:
    """Laws of the dead time, at the most likely width for each, and of the logarithm of the width.

    The variance of the width is that at a fixed dead time, and that of the most likely widths over the dead times.
    """
    alone, _, _ = _law(lambda w: _log_likelihood(counts, trial(dead, w)), log_sigma + np.linspace(-0.6, 0.6, 9))
    span = 3.0 * max(alone.error, 1e-4)
    best: dict[float, float] = {}

    def at_best_width(d: float) -> float:
        centre = alone.value
        for _ in range(_ROUNDS):
            low, middle, high = (_log_likelihood(counts, trial(d, centre + x)) for x in (-span, 0.0, span))
            curve, rise = low - 2.0 * middle + high, 0.5 * (high - low)
            move = float(np.clip(-rise / curve, -2.0, 2.0)) if curve < 0.0 else 2.0 * float(np.sign(rise))
            if abs(move) <= 1.0:
                break
            centre += move * span
        best[d] = centre + move * span
        return middle + rise * move + 0.5 * curve * move**2 if abs(move) <= 1.0 else middle

    hold, at, weight = _law(at_best_width, places, given)
    widths = np.array([best[float(d)] for d in at])
    value = float(weight @ widths)
    error = float(np.hypot(alone.error, np.sqrt(weight @ (widths - value) ** 2)))
    return hold, _normal(value, error)


def _law(
    value: Callable[[float], float], places: FloatArray, given: float | None = None
) -> tuple[Estimate, FloatArray, FloatArray]:
    """Mean, error and 95 % interval of a parameter of this log likelihood, for a flat prior; the places, their weights.

    The mean is that of the likeliest stretch between places without likelihood (of those that hold 5 % of the law the
    one nearest to a `given` value), or, if it is itself unlikely, the most likely place there; the error is the root of
    the mean square about it.

    With few counts the likelihood of the place of an edge has many maxima, whose curvatures are not its width. Places
    halfway to the neighbours are added to those that hold much of the law, and to the highest maxima, until none does.
    """
    log = np.array([value(float(x)) for x in places])
    for _ in range(_ROUNDS):
        weight = np.exp(log - log.max()) * np.gradient(places)
        if weight.max() < 0.1 * weight.sum():
            break
        padded = np.pad(log, 1, constant_values=-np.inf)
        maxima = np.flatnonzero((log >= padded[:-2]) & (log >= padded[2:]))
        near = np.union1d(np.flatnonzero(weight > 0.03 * weight.sum()), maxima[np.argsort(log[maxima])[-_MAXIMA:]])
        gaps = np.intersect1d(np.union1d(near, near - 1), np.arange(len(places) - 1))
        between = 0.5 * (places[gaps] + places[gaps + 1])
        log = np.insert(log, gaps + 1, [value(float(x)) for x in between])
        places = np.insert(places, gaps + 1, between)
    weight = np.exp(log - log.max()) * np.gradient(places)
    weight /= weight.sum()
    # another maximum, a period away, is part of the error: a mean between the two would be neither
    run = np.cumsum(np.diff(log > log.max() - 12.5, prepend=False))
    mass = np.bincount(run, weight)
    likely = np.flatnonzero(mass >= (mass.max() if given is None else 0.05))
    off = [0.0 if given is None else np.abs(places[run == k] - given).min() for k in likely]
    part = weight * (run == likely[int(np.argmin(off))])
    mean = float(part @ places / part.sum())
    top = np.where(part > 0.0, log, -np.inf)
    if value(mean) < top.max() - 2.0:
        mean = float(places[top.argmax()])
    low, high = np.interp([0.025, 0.975], np.cumsum(weight) - 0.5 * weight, places)
    return Estimate(mean, float(weight @ (places - mean) ** 2) ** 0.5, float(low), float(high)), places, weight


def _normal(value: float, error: float) -> Estimate:
    return Estimate(value, error, value - 1.96 * error, value + 1.96 * error)


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
    rest = passes - counts
    share = np.clip(expected / np.maximum(passes, 1e-9), 1e-12, 1.0 - 1e-12)
    ways = gammaln(passes + 1) - gammaln(rest + 1) - gammaln(counts + 1)
    likelihood = ways + xlogy(counts, share) + xlogy(rest, 1.0 - share)
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
