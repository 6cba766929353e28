"""Deviations of a recording from its model: detector effects, by a score and then a refit; drift, by parts."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.calibration.fit import LIGHTS, Fit, Fitted, Guess, counted, draws, root_of
from mars_lidar.calibration.model import Effect, Model, effects
from mars_lidar.calibration.recording import FALSE_ALARM, LEAST_PHOTONS, Recording
from mars_lidar.calibration.start import with_edge

MISFIT = 1e-3  # ratio of p-values of two fits of one model (at most 1) below which the lesser is a local minimum


@dataclass(frozen=True)
class Score:
    """Size of an effect from the residual counts, its standard deviation, and the shift of the parameters.

    `noise`: share of noise in the square of the simulated change, which lowers the score.
    """

    effect: Effect
    size: float
    error: float
    noise: float
    shift: FloatArray  # (free,) of the estimates, by an effect of size 1 that the model does not have

    @property
    def z(self) -> float:
        """Standard deviations above zero; the size of an effect that is on or off counts as 1 at most."""
        return min(self.size, 1.0 if self.effect.onoff else np.inf) / max(self.error, 1e-300)


def counts_of(
    fit: Fit, fitted: Fitted, model: Model, theta: FloatArray, times: float = 1.0
) -> tuple[FloatArray, float]:
    """Counts that a model expects in the cells of a fit, by `times` a batch; ratio of their variance to them."""
    photons = float(fit.recording.photons)
    simulated = times * min(fit.effort.share * photons, fit.effort.batch)
    exposure = max(2, round(fit.exposure(simulated / LIGHTS)))
    ratio = fit.exposure(photons) / exposure
    rows = np.tile(model.bounded(theta), (LIGHTS, 1))
    return counted(model, fitted.batch.cells, rows, exposure, fit.next_seed()).total.mean(0) * ratio, ratio / LIGHTS


def _score(
    fit: Fit, fitted: Fitted, plain: FloatArray, model: Model, theta: FloatArray, effect: Effect, times: float = 1.0
) -> Score:
    """Size of an effect by generalised least squares: residual counts along the change that it makes at `theta`.

    From that change the part is removed that the other parameters of the fit can absorb. The noise of the simulated
    counts, of `times` a batch as those of `plain`, makes the size too small on average, and no false score.
    """
    made, share = counts_of(fit, fitted, model, theta, times)
    size, used = max(float(theta[fitted.model.size]), 1e-9), fitted.batch.common
    change, noise = (made - plain) / size, (plain + made) * share / size**2
    shift = fitted.estimator @ change
    way = change - fitted.jacobian @ shift
    along = np.zeros_like(way)
    along[used] = fitted.batch.weight[np.ix_(used, used)] @ way[used]
    square = max(float(way @ along), 1e-300)
    along /= square
    spread = float((fitted.fresh @ along).std()) * (1.0 + 2.0 * share) ** 0.5
    part = float(noise[used] @ np.diag(fitted.batch.weight)[used]) / square
    return Score(effect, float(fitted.rest @ along), spread, part, shift)


def possible(fit: Fit, fitted: Fitted, plain: FloatArray) -> list[Trial]:
    """Effects that the stream may have beyond the `plain` counts of the model, one trial of each kind.

    Afterpulses start from the mean delay with the largest score. Scores above 1 that noise of the simulated change
    lowers are estimated again by longer streams. A paralyzable detector, of size 1, is left out of a stream that fits
    if the 95 % upper limit of its score is below 1.
    """
    model = fitted.model
    of = {"afterpulsing": "afterpulse_probability", "mode": "paralyzable"}
    have = {of.get(name, name) for name, _ in model.fields} | {*model.names}
    centre = model.bounded(fitted.theta)
    dead = float(centre[model.light + 2])
    given = model.light + 2 not in fitted.free and fitted.by_shortest is None  # the detector's, not the electronics'
    have |= {"electronics_excess"} if given or "electronics_dead_time_ns" in have else set()

    def scored(effect: Effect, plain: FloatArray, times: float = 1.0) -> Score:
        wider = replace(model, effects=(*model.effects, effect))
        return _score(fit, fitted, plain, wider, np.r_[centre, effect.start], effect, times)

    listed: list[Score] = []
    for effect in effects(dead) if dead > 0.0 else ():
        if effect.names[0] not in have:
            with suppress(ValueError):  # a detector cannot have both
                listed.append(scored(effect, plain))
    listed = [s for s in listed if not s.effect.onoff or fitted.p_value < FALSE_ALARM or s.size + 1.645 * s.error > 1.0]
    best = {score.effect.names[0]: score for score in sorted(listed, key=lambda score: score.z)}
    scores = list(best.values())
    for times in fit.effort.closely:
        noisy = [score.z > 1.0 and score.noise > fit.effort.noise for score in scores]
        if any(noisy):
            plain = counts_of(fit, fitted, model, fitted.theta, times)[0]
            scores = [scored(s.effect, plain, times) if again else s for s, again in zip(scores, noisy, strict=True)]
    return [Trial(fit.shorter, fitted, score) for score in scores]


class Trial:
    """A further effect, and the fit with it by short batches, made when it is asked for."""

    def __init__(self, shorter: Fit, fitted: Fitted, score: Score) -> None:
        self.score, self.effect, self._shorter, self._fitted = score, score.effect, shorter, fitted

    @cached_property
    def final(self) -> Fitted | None:
        """The fit with the effect, tested by fresh streams; None if no detector can have it, or it did not converge."""
        fit, fitted, score, effect = self._shorter, self._fitted, self.score, self.effect
        model = replace(fitted.model, effects=(*fitted.model.effects, effect))
        size = effect.start[0]
        moved = fitted.theta.copy()
        if not effect.onoff and score.size > 0.0:
            size = min(score.size, effect.most[0])
            moved[fitted.free] -= score.shift * min(size, effect.start[0])
        theta = model.bounded(np.r_[moved, size, effect.start[1:]])
        spread = 0.5 * model.scale(theta)
        own = np.sqrt(np.diag(fitted.covariance))
        spread[fitted.free] = np.minimum(spread[fitted.free], np.maximum(8.0 * own, 1e-12))
        more = [] if effect.onoff else range(fitted.model.size, model.size)
        timed = [] if fitted.by_shortest is None else [fitted.model.light + 2]
        free = np.r_[np.union1d(fitted.free, timed), more].astype(np.intp)
        photons = float(fit.recording.photons)
        try:
            if fitted.model.light + 2 in free:  # the dead time has absorbed part of the effect
                gaps = np.diff(fit.recording.pieces[0][: 12 * fit.effort.first])
                theta = with_edge(fit, model, theta, np.sort(gaps))
            guess = fit.steps(Guess(model, theta, np.diag(spread[free]), free), photons, photons / 6.0)[0]
        except (ValueError, np.linalg.LinAlgError):
            return None
        final = fit.finish(guess)
        return final if final.converged else None

    @property
    def refuted(self) -> bool:
        """Whether the effect is on or off, and the fit with it is rejected: it is not there."""
        return self.effect.onoff and self.final is not None and self.final.p_value < FALSE_ALARM


@dataclass(frozen=True)
class Named:
    """An effect in the result: its score in standard deviations, and the decrease of the misfit, in its own."""

    effect: Effect
    z: float
    gain: float


def search(fit: Fit, fitted: Fitted) -> tuple[Fitted, list[Named], list[Trial]]:
    """The fit with the effects that the stream shows, those effects, and the trials of all others."""
    included: list[Named] = []
    for last in (*[False] * fit.effort.effects, True):
        plain = counts_of(fit, fitted, fitted.model, fitted.theta)[0]
        trials = possible(fit, fitted, plain)
        better = None if last else refitted(fit, fitted, plain, trials)
        if better is None:
            break
        fitted, effect = better
        if effect is not None:
            included.append(effect)
    return fitted, included, trials


def refitted(fit: Fit, fitted: Fitted, plain: FloatArray, trials: list[Trial]) -> tuple[Fitted, Named | None] | None:
    """The fit with the effect that explains most, or a better fit without any; None if no effect is significant.

    An effect is significant if its refit fits where the model is rejected; or if the refit is not worse and the
    residual counts have a significant score, along the change by a small effect or along that by the effect of the
    refit. (The first alone misleads: a slow recovery has the score of a paralyzable detector, and an effect that the
    dead time has absorbed has none.) Of light of free shape, which follows the recorded phases, only the misfit counts.
    All refits are by short batches; that with the least misfit is repeated by full ones.
    """
    from scipy.special import ndtri

    limit, size = float(-ndtri(FALSE_ALARM / max(2 * len(trials), 1))), fitted.model.size  # two scores each

    def significance(trial: Trial, final: Fitted | None) -> float:
        """The score of a significant effect, by a refit; else -inf."""
        if final is None or not final.theta[size] > 0.0 or final.p_value <= min(FALSE_ALARM, fitted.p_value):
            return -np.inf
        z = max(trial.score.z, _score(fit, fitted, plain, final.model, final.theta, trial.effect).z)
        clear = z > limit and final.model.waveform is None
        return z if clear or fitted.p_value < FALSE_ALARM < final.p_value else -np.inf

    significant = [
        (trial, trial.final) for trial in trials if significance(trial, trial.final) > -np.inf and trial.final
    ]
    if not significant:
        return None
    trial, final = min(significant, key=lambda pair: pair[1].misfit_z)
    if fitted.p_value < MISFIT:  # the first fit may have been a bad one
        known = final.free < size
        root = root_of(final.covariance[np.ix_(known, known)])
        other = fit.shorter.finish(Guess(fitted.model, final.theta[:size], root, final.free[known]))
        if other.converged and other.p_value > max(FALSE_ALARM, fitted.p_value / MISFIT):
            fitted, plain = other, counts_of(fit, other, other.model, other.theta)[0]
            if not _score(fit, fitted, plain, final.model, final.theta, trial.effect).z > limit:
                return fitted, None
    last = fit.finish(Guess(final.model, final.theta, root_of(final.covariance), final.free), finished=True)
    final = last if last.converged else final
    z = significance(trial, final)
    return (final, Named(trial.effect, z, fitted.misfit_z - final.misfit_z)) if z > -np.inf else None


@dataclass(frozen=True, eq=False)
class Drift:
    """Parameters by parts of the recording.

    `times_s` (parts,) their middles; `values` (parts, p), and `errors` (p,) of each; `trend` (p,) change from start to
    end, in standard deviations; `p_value` (p,) of it or of the scatter, the smaller; `growth` (p,) factor of the
    scatter on the stated errors; `flicker` relative standard deviation of counts in times shorter than such a part,
    `flicker_z` its score in standard deviations.
    """

    names: tuple[str, ...]
    times_s: FloatArray
    values: FloatArray
    errors: FloatArray
    trend: FloatArray
    change: FloatArray
    p_value: FloatArray
    growth: FloatArray
    flicker: float
    flicker_z: float

    @property
    def probability(self) -> float:
        """Probability that a constant recording shows as large a trend, scatter or flicker in any of the parameters."""
        p = min(float(self.p_value.min()), _above(self.flicker_z))
        return float(1.0 - (1.0 - p) ** (2 * self.p_value.size + 1))

    @property
    def drifts(self) -> NDArray[np.bool_]:
        """(p,) which parameters are not constant."""
        return np.asarray(self.p_value < FALSE_ALARM / (2 * self.p_value.size + 1))

    @property
    def flickers(self) -> bool:
        """Whether the light is not constant over shorter times."""
        return _above(self.flicker_z) < FALSE_ALARM / (2 * self.p_value.size + 1)


def _above(z: float) -> float:
    """Probability of a normal deviate above z."""
    from scipy.special import ndtr

    return float(ndtr(-z))


def _flicker(fit: Fit, fitted: Fitted, counts: float = 8.0, windows: int = 64) -> tuple[float, float, float]:
    """Relative standard deviation of flickering light, its score, and the factor on the variance of the counts.

    Half the mean squared difference of counts in successive windows (Allan's variance, which a slow drift does not
    change), over that of streams of the fit: for longer windows, relative to the shortest. Afterpulses and other
    correlations shorter than the windows change all of them alike, fluctuations of the light the longer ones more. The
    shortest windows have `counts` counts, each further size four times as many, as long as `windows` remain. The noise
    is the larger of that of Poisson counts and the scatter of these streams, whose light is drawn from its errors.
    """
    from scipy.special import ndtri

    recording, size = fit.recording, min(float(fit.recording.photons), fit.effort.batch / 4.0)
    cycles = max(2, round(fit.exposure(size)))
    rows = draws(fitted.model, fitted.unbounded, fitted.covariance, fitted.free)[:LIGHTS]
    drawn = [Recording((t,), (cycles,), recording.clock) for t in fitted.model.streams(rows, cycles, 0)]
    table: list[list[tuple[float, float, float]]] = []
    while not table or counts * windows < recording.photons:
        window = counts * recording.exposure / recording.photons
        table.append([x.unevenness(window) for x in (recording, *drawn)])
        counts *= 4.0
    variance, number, mean = np.maximum(np.array(table).transpose(2, 0, 1), 1e-300)  # (windows, streams) each
    expected = variance[:, 1:].mean(1)
    ratio, even = variance[:, 0] / expected, 3.0 / number[:, 0] + 3.0 / number[:, 1:].sum(1)  # of even counts
    if len(table) == 1:
        return 0.0, -np.inf, 1.0
    scatter = np.log(variance[1:, 1:] / variance[0, 1:]).var(1, ddof=1) * number[1:, 1:].mean(1) / number[1:, 0]
    z = np.log(ratio[1:] / ratio[0]) / np.sqrt(np.maximum(even[1:] + even[0], scatter * (1.0 + 1.0 / LIGHTS)))
    p, excess = min(1.0, z.size * _above(z.max())), np.sqrt(np.maximum(variance[:, 0] - expected, 0.0)) / mean[:, 0]
    return float(excess[1 + z.argmax()]), float(-ndtri(p)) if p > 0.0 else float(z.max()), float(ratio.max())


def drift(fit: Fit, fitted: Fitted) -> Drift | None:
    """Light and delay of parts of the recording, with all else constant; None for a short recording."""
    from scipy.special import chdtrc

    recording = fit.recording
    number = int(min(fit.effort.parts, recording.photons // LEAST_PHOTONS))
    if number < 4:
        return None
    parts = [part for part in recording.parts(number) if part.photons > 20]
    model, batch, light = fitted.model, fitted.batch, fitted.free[fitted.free < fitted.model.light]
    delays = light[(light > 0) & (light % 2 == 0)]
    # all light in proportion, and each delay; the rest is constant
    directions = np.zeros((model.size, 1 + delays.size))
    amounts = np.setdiff1d(light, delays)
    directions[amounts, 0] = fitted.theta[amounts] / fitted.theta[amounts].sum()
    directions[delays, 1 + np.arange(delays.size)] = 1.0
    response = fitted.jacobian @ directions[fitted.free]
    # and the number of registrations, because the weights are noisy
    sums = np.vstack([response.T @ batch.weight, np.arange(len(response)) < batch.cells.phases])
    precision = np.linalg.pinv(np.cov(sums @ fitted.noise.T))
    known = (sums @ response).T @ precision
    estimator = np.linalg.pinv(known @ sums @ response) @ known @ sums
    counts = np.array([batch.cells.of(part) * (recording.exposure / part.exposure) for part in parts])
    x = (counts - fitted.offset) @ estimator.T
    exposures = np.array([part.exposure for part in parts])
    share = exposures / exposures.sum()
    noise = (fitted.noise @ estimator.T).std(0)  # of the whole recording
    sd = noise * len(parts) ** 0.5  # of a part of mean exposure
    ends = np.cumsum(np.r_[0.0, exposures])
    middle = 0.5 * (ends[1:] + ends[:-1]) * recording.period_ns * 1e-9
    # parts of a recording with interruptions differ in exposure: weights are their shares
    place = 0.5 * (ends[1:] + ends[:-1]) / ends[-1] - 0.5
    place -= share @ place
    mean = share @ x
    spread = float(share @ place**2)
    slope = (share * place) @ (x - mean) / spread
    square = (share[:, None] * ((x - mean) / noise) ** 2).sum(0)
    trend = slope * spread**0.5 / noise
    p = np.minimum([2.0 * _above(abs(z)) for z in trend], chdtrc(len(parts) - 1, square))
    about = np.r_[fitted.theta[amounts].sum(), fitted.theta[delays]]
    growth = np.sqrt(np.maximum(square / (len(parts) - 1), 1.0))
    flicker, flicker_z, ratio = _flicker(fit, fitted)
    growth[0] = max(growth[0], ratio**0.5)
    names = ("light", *(model.names[k] for k in delays))
    return Drift(names, middle, x - mean + about, sd, trend, slope, p, growth, flicker, flicker_z)
