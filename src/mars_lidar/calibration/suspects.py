"""Deviations of a recording from its model: detector effects, by a score and then a refit; drift, by parts."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.calibration.fit import LIGHTS, Fit, Fitted, Guess, draws, root_of
from mars_lidar.calibration.model import Effect, Model, effects
from mars_lidar.calibration.recording import FALSE_ALARM, LEAST_PHOTONS
from mars_lidar.calibration.start import with_edge

# standard deviations that the largest of seven independent scores exceeds with the probability of a false alarm
_SIGNIFICANT = NormalDist().inv_cdf((1.0 - FALSE_ALARM) ** (1.0 / 7.0))


_FAR = 5.0  # standard deviations of each count, on average, by which light that is not fitted is wrong


class Score(NamedTuple):
    """Size of an effect from the residual counts, its standard deviation, and the shift of the parameters.

    `along` (c,) the weights of the residual counts; `noise`: share of noise in the square of the simulated change,
    which lowers the score; `shift` (free,) of the estimates, by an effect of size 1 that the model does not have.
    """

    effect: Effect
    size: float
    error: float
    along: FloatArray
    noise: float
    shift: FloatArray

    @property
    def z(self) -> float:
        """Standard deviations above zero; the size of an effect that is on or off counts as 1 at most."""
        return min(self.size, 1.0 if self.effect.onoff else np.inf) / max(self.error, 1e-300)


class Scores:
    """Scores of further effects of a fitted stream."""

    def __init__(self, fit: Fit, fitted: Fitted) -> None:
        self.fit, self.fitted = fit, fitted
        self._plain: dict[float, tuple[FloatArray, float]] = {}
        self.tested: list[Score] = []

    def counts(self, model: Model, theta: FloatArray, times: float = 1.0) -> tuple[FloatArray, float]:
        """Counts that a model expects in the cells of the fit, by `times` a batch; ratio of their variance to them."""
        fit, photons = self.fit, float(self.fit.recording.photons)
        simulated = times * min(fit.effort.share * photons, fit.effort.batch)
        streams = fit.streams(model, model.bounded(theta), simulated / LIGHTS)
        ratio = fit.exposure(photons) / streams.cycles[0]
        return self.fitted.batch.cells.of(streams) / LIGHTS * ratio, ratio / LIGHTS

    def of(self, effect: Effect, theta: FloatArray, times: float = 1.0) -> Score:
        """Size of an effect by generalised least squares: residual counts along the change that it makes at `theta`.

        From that change the part is removed that the other parameters of the fit can absorb. The noise of the
        simulated counts makes the size too small on average, and no false score; where much of the change is noise, a
        score above 1 is estimated again by longer streams, of `times` a batch, if that may decide its significance.
        """
        fitted, used, effort = self.fitted, self.fitted.batch.common, self.fit.effort
        wider = replace(fitted.model, effects=(*fitted.model.effects, effect))
        size, weight = max(float(theta[fitted.model.size]), 1e-9), fitted.batch.weight[np.ix_(used, used)]
        enough = min((each for each in self._plain if each >= times), default=times)
        if enough not in self._plain:
            self._plain[times] = self.counts(fitted.model, fitted.theta, times)
        (plain, own), (made, share) = self._plain[enough], self.counts(wider, theta, times)
        change, noise = (made - plain) / size, (plain * own + made * share) / size**2
        shift = fitted.estimator @ change
        way = change - fitted.jacobian @ shift
        along = np.zeros_like(way)
        along[used] = weight @ way[used]
        square = max(float(way @ along), 1e-300)
        along /= square
        spread = float((fitted.fresh @ along).std()) * (1.0 + own + share) ** 0.5
        part = float(noise[used] @ np.diag(weight)) / square
        score = Score(effect, float(fitted.rest @ along), spread, along, part, shift)
        off, grown = 2.0 * part**0.5, score.z * max(1.0 - part, 0.01) ** -0.5
        if score.z < 1.0 or part < effort.noise or times > 1.0 or not score.z - off < _SIGNIFICANT < grown + off:
            self.tested.append(score)
            return score
        return self.of(effect, theta, min(effort.closest, np.ceil(part / effort.noise)))

    @property
    def limit(self) -> float:
        """What the largest of all scores so far exceeds by chance with the probability of a false alarm.

        They are about normal, with the correlations that they have in streams of the fit.
        """
        drawn = self.fitted.fresh @ np.array([score.along for score in self.tested]).T
        root = root_of(np.corrcoef(drawn, rowvar=False).reshape(len(self.tested), -1))
        largest = (np.random.default_rng(0).standard_normal((100_000, len(self.tested))) @ root.T).max(1)
        return float(np.quantile(largest, 1.0 - FALSE_ALARM))


def possible(scores: Scores) -> list[Trial]:
    """Effects that the stream may have beyond the model, one trial of each kind.

    Afterpulses start from the mean delay with the largest score. A paralyzable detector, of size 1, is left out of a
    stream that fits if its size is significantly below 1.
    """
    fitted = scores.fitted
    model = fitted.model
    of = {"afterpulsing": "afterpulse_probability", "mode": "paralyzable"}
    have = {of.get(name, name) for name, _ in model.fields} | {*model.names}
    centre = model.bounded(fitted.theta)
    dead = float(centre[model.light + 2])
    given = model.light + 2 not in fitted.free and fitted.by_shortest is None  # the detector's, not the electronics'
    have |= {"electronics_excess"} if given or "electronics_dead_time_ns" in have else set()
    tested: dict[str, list[Score]] = {}
    for effect in effects(dead) if dead > 0.0 else ():
        if effect.names[0] not in have:
            with suppress(ValueError):  # a detector cannot have both
                score = scores.of(effect, np.r_[centre, effect.start])
                most = (score.size + _SIGNIFICANT * score.error) / max(1.0 - score.noise, 1e-9)  # noise lowers the size
                if not effect.onoff or fitted.p_value < FALSE_ALARM or most > 1.0:
                    tested.setdefault(effect.names[0], []).append(score)
    return [Trial(scores.fit, fitted, max(own, key=lambda score: score.z)) for own in tested.values()]


class Trial:
    """A further effect by its score, and the fit with it, made when it is asked for."""

    def __init__(self, fit: Fit, fitted: Fitted, score: Score) -> None:
        self.fit, self.fitted, self.score, self.effect = fit, fitted, score, score.effect
        self.direct: Fitted | None = None
        self.model = replace(fitted.model, effects=(*fitted.model.effects, self.effect))

    @cached_property
    def guess(self) -> Guess:
        """Parameters of the fit without the effect, less what the effect makes of them, and the effect."""
        fitted, score, effect = self.fitted, self.score, self.effect
        size = effect.start[0]
        moved = fitted.theta.copy()
        if not effect.onoff and score.size > 0.0:
            size = min(score.size, effect.most[0])
            moved[fitted.free] -= score.shift * min(size, effect.start[0])
        theta = self.model.bounded(np.r_[moved, size, effect.start[1:]])
        spread = 0.5 * self.model.scale(theta)
        own = np.sqrt(np.diag(fitted.covariance))
        spread[fitted.free] = np.minimum(spread[fitted.free], np.maximum(8.0 * own, 1e-12))
        more = [] if effect.onoff else range(fitted.model.size, self.model.size)
        timed = [] if fitted.by_shortest is None else [fitted.model.light + 2]
        free = np.r_[np.union1d(fitted.free, timed), more].astype(np.intp)
        return Guess(self.model, theta, np.diag(spread[free]), free)

    def refit(self, direct: bool = False) -> Fitted | None:
        """The fit with the effect, tested by fresh streams; None if no detector can have it, or it did not converge.

        `direct`: by full batches, from the size that the score gives; else by steps, and short batches.
        """
        guess, fitted = self.guess, self.fitted
        fit = self.fit if direct else self.fit.shorter
        with suppress(ValueError, np.linalg.LinAlgError):
            if direct:
                near = np.diag(guess.root).copy()
                near[np.isin(guess.free, fitted.free)] = np.sqrt(np.diag(fitted.covariance))
                near[guess.free == fitted.model.size] = self.score.error
                final = fit.finish(guess._replace(root=np.diag(near)))
            else:
                if fitted.model.light + 2 in guess.free:  # the dead time has absorbed part of the effect
                    guess = guess._replace(theta=with_edge(fit, self.model, guess.theta))
                final = fit.refit(guess)
            if final.converged:
                self.direct = final if direct and final.p_value > FALSE_ALARM else None
                return final
        return None

    @cached_property
    def final(self) -> Fitted | None:
        """The fit by full batches, if it was made and is not rejected, or by short ones."""
        return self.direct or self.refit()

    @property
    def refuted(self) -> bool:
        """Whether the effect is on or off, and the fit with it is rejected: it is not there."""
        return self.effect.onoff and self.final is not None and self.final.p_value < FALSE_ALARM


def search(fit: Fit, fitted: Fitted) -> tuple[Fitted, list[tuple[Score, float]], list[Trial], Fitted | None]:
    """The fit with the effects that the stream shows, their scores and gains, trials of all others, and `other_light`.

    A gain is the decrease of the misfit, in its standard deviations.
    """
    included: list[tuple[Score, float]] = []
    for remaining in reversed(range(fit.effort.effects + 1)):
        scores = Scores(fit, fitted)
        trials = possible(scores)
        better = refitted(scores, trials) if remaining and trials else None
        if better is None:
            break
        fitted, effect = better
        included += effect
        if fitted.model.paralyzable and fitted.p_value < FALSE_ALARM:
            fitted = other_light(fit, fitted) or fitted
    of = [trial for trial in trials if trial.effect.onoff and (fitted.p_value < FALSE_ALARM or not trial.refuted)]
    paralyzable = fitted if fitted.model.paralyzable else next((trial.final for trial in of), None)
    other = other_light(fit, paralyzable) if paralyzable is not None else None
    if other is not None and fitted.p_value < FALSE_ALARM:
        included += [(trial.score, fitted.misfit_z - other.misfit_z) for trial in of]
        return other, included, possible(Scores(fit, other)), None
    return fitted, included, trials, other


def other_light(fit: Fit, fitted: Fitted) -> Fitted | None:
    """The fit of a paralyzable detector in the other light, if it is not rejected.

    In constant light its intervals depend on x * exp(-x) alone, x photons in a dead time, so that there are two of it.
    """
    from scipy.special import lambertw

    model, theta = fitted.model, fitted.model.bounded(fitted.theta)
    x = float(theta[model.amounts].sum() * theta[model.light + 2] / model.clock.period_ns)
    theta[model.amounts] *= -lambertw(-x * np.exp(-x), -1 if x < 1.0 else 0).real / x
    with suppress(ValueError, np.linalg.LinAlgError):
        if fit.distance(model, theta) < _FAR**2:
            guess = Guess(model, theta, np.diag(0.5 * model.scale(theta)[fitted.free]), fitted.free)
            final = fit.refit(guess)
            if final.converged and final.p_value > FALSE_ALARM:
                return final
    return None


def refitted(scores: Scores, trials: list[Trial]) -> tuple[Fitted, list[tuple[Score, float]]] | None:
    """The fit with the effect that explains most, or a better fit without any; None if no effect is significant.

    Beside the fit with an effect stand the effect's larger score and its gain.

    An effect is significant if its refit fits where the model is rejected; or if the refit is not worse and the
    residual counts have a significant score, along the change by a small effect or along that by the effect of the
    refit. (The first alone misleads: a slow recovery has the score of a paralyzable detector, and an effect that the
    dead time has absorbed has none.) Of light of free shape, which follows the recorded phases, only the misfit counts.
    The refit with the least misfit is repeated by full batches. The fit without the effect is repeated, too, from the
    same place and with other streams: the mean of the scores beside both must be significant, or both rejected, since
    a score has noise of the fit that it stands beside.
    """
    fit, fitted = scores.fit, scores.fitted
    size = fitted.model.size
    p_value = fitted.p_value if fitted.converged else 0.0

    def better(final: Fitted) -> bool:
        return bool(final.theta[size] > 0.0 and final.p_value > min(FALSE_ALARM, p_value))

    def significant(final: Fitted, z: float, p_value: float = p_value) -> bool:
        clear = z > limit and fitted.converged and final.model.waveform is None
        return clear or p_value < FALSE_ALARM < final.p_value

    def score_of(trial: Trial, final: Fitted) -> Score:
        return max(trial.score, scores.of(trial.effect, final.theta), key=lambda score: score.z)

    limit = scores.limit
    clear = [trial for trial in trials if trial.score.z > limit]
    for direct in (True, False):
        refits = [(trial, trial.refit(True) if direct else trial.final) for trial in (clear if direct else trials)]
        good = [(trial, final) for trial, final in refits if final is not None and better(final)]
        scored = [(trial, final, score_of(trial, final)) for trial, final in good]
        limit = scores.limit
        candidates = [each for each in scored if significant(each[1], each[2].z)]
        if candidates:
            break
    else:
        return None
    trial, final, score = min(candidates, key=lambda each: each[1].misfit_z)
    # the fit without the effect once more, from the place of the refit: the first one may have been bad
    if 0.5 * score.z < limit:
        known = final.free < size
        root = root_of(final.covariance[np.ix_(known, known)])
        other = fit.finish(Guess(fitted.model, final.theta[:size], root, final.free[known]), again=False)
        if other.converged:
            small = np.r_[fitted.model.bounded(other.theta), trial.effect.start]
            again = Scores(fit, other).of(trial.effect, small if score is trial.score else final.theta)
            if not significant(final, 0.5 * (score.z + again.z), max(p_value, other.p_value)):
                return (other, []) if p_value < FALSE_ALARM else None
    if not direct:
        last = fit.finish(final.guess, finished=True)
        if last.converged:
            final, score = last, score_of(trial, last)
    if not (better(final) and significant(final, score.z)):
        return None
    return final, [(score, fitted.misfit_z - final.misfit_z)]


@dataclass(frozen=True, eq=False)
class Drift:
    """Parameters by parts of the recording.

    `times_s` (parts,) their middles; `values` (parts, p), and `errors` (p,) of each; `trend` (p,) change from start to
    end, in standard deviations; `p_value` (p,) of it or of the scatter, the smaller, times the number of tests (of
    which a trend of the light counts as three quarters of all); `growth` (p,) factor of the scatter on the stated
    errors; `flicker` relative standard deviation of counts in times shorter than such a part, `flicker_z` its score in
    standard deviations, `flicker_p` its p-value, times the number of tests.
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
    flicker_p: float

    @property
    def probability(self) -> float:
        """Probability that a constant recording shows as large a trend, scatter or flicker in any of the parameters."""
        return float(min(1.0, self.flicker_p, *self.p_value))

    @property
    def drifts(self) -> NDArray[np.bool_]:
        """(p,) which parameters are not constant."""
        return np.asarray(self.p_value < FALSE_ALARM)

    @property
    def flickers(self) -> bool:
        """Whether the light is not constant over shorter times."""
        return self.flicker_p < FALSE_ALARM


def _flicker(fit: Fit, fitted: Fitted, counts: float = 8.0, windows: int = 64) -> tuple[float, float, float, float]:
    """Relative standard deviation of flickering light, score, p-value, and the factor on the variance of the counts.

    Half the mean squared difference of counts in successive windows (Allan's variance, which a slow drift does not
    change), over that of streams of the fit: for longer windows, relative to the shortest. Afterpulses and other
    correlations shorter than the windows change all of them alike, fluctuations of the light the longer ones more. The
    shortest windows have `counts` counts, each further size four times as many, as long as `windows` remain. The noise
    is the larger of that of Poisson counts and the scatter of these streams, whose light is drawn from its errors.
    """
    from scipy.special import ndtr

    recording, size = fit.recording, min(float(fit.recording.photons), fit.effort.batch / 4.0)
    cycles = fit.cycles(size)
    rows = draws(fitted.model, fitted.unbounded, fitted.covariance, fitted.free)[:LIGHTS]
    drawn = fitted.model.streams(rows, cycles, 0).stretches
    sizes = counts * 4.0 ** np.arange(16)
    lengths = sizes[sizes * windows < recording.photons] * recording.exposure / recording.photons
    if lengths.size == 1:
        return 0.0, -np.inf, 1.0, 1.0
    table = [[x.unevenness(length) for x in (recording, *drawn)] for length in lengths]
    variance, number, mean = np.maximum(np.array(table).transpose(2, 0, 1), 1e-300)  # (windows, streams) each
    variance = np.maximum(variance, 1.0 / np.maximum(number, 1.0))  # of one count more in one window
    expected = variance[:, 1:].mean(1)
    ratio, even = variance[:, 0] / expected, 3.0 / number[:, 0] + 3.0 / number[:, 1:].sum(1)  # of even counts
    scatter = np.log(variance[1:, 1:] / variance[0, 1:]).var(1, ddof=1) * number[1:, 1:].mean(1) / number[1:, 0]
    z = np.log(ratio[1:] / ratio[0]) / np.sqrt(np.maximum(even[1:] + even[0], scatter * (1.0 + 1.0 / LIGHTS)))
    excess = np.sqrt(np.maximum(variance[:, 0] - expected, 0.0)) / mean[:, 0]
    largest = int(z.argmax())
    return float(excess[1 + largest]), float(z[largest]), z.size * float(ndtr(-z[largest])), float(ratio.max())


def drift(fit: Fit, fitted: Fitted) -> Drift | None:
    """Light and delay of parts of the recording, with all else constant; None for a short recording."""
    from scipy.special import chdtrc, ndtr

    recording = fit.recording
    number = int(min(fit.effort.parts, recording.photons // LEAST_PHOTONS))
    if number < 4:
        return None
    parts = [part for part in recording.parts(number) if part.photons > 20]
    model, batch, scores = fitted.model, fitted.batch, Scores(fit, fitted)
    light = fitted.free[fitted.free < model.light]
    delays = light[(light > 0) & (light % 2 == 0)]
    # all light in proportion, and each delay; the rest is constant
    steps = np.zeros((1 + delays.size, model.size))
    amounts = np.setdiff1d(light, delays)
    steps[0, amounts] = 0.1 * fitted.theta[amounts]
    steps[1 + np.arange(delays.size), delays] = 0.5 * model.scale(fitted.theta)[delays]
    up, down = (np.array([scores.counts(model, fitted.theta + step)[0] for step in way * steps]) for way in (1, -1))
    response = (0.5 * (up - down) / steps.sum(1)[:, None]).T
    # a single count in a cell where none is expected in a part would decide
    weight = batch.weight * np.outer(*[fitted.offset > 2.0 * len(parts)] * 2)
    # and the number of registrations, because the weights are noisy
    sums = np.vstack([response.T @ weight, np.arange(len(response)) < batch.cells.phases])
    precision = np.linalg.pinv(np.cov(sums @ fitted.noise.T))
    known = (sums @ response).T @ precision
    estimator = np.linalg.pinv(known @ sums @ response) @ known @ sums
    counts = np.array([batch.cells.of(part) * (recording.exposure / part.exposure) for part in parts])
    x = (counts - fitted.offset) @ estimator.T
    exposures = np.array([part.exposure for part in parts])
    share = exposures / exposures.sum()
    noise = (fitted.noise @ estimator.T).std(0)  # of the whole recording
    # counts of a saturated detector are so even that it matters where in a period, or between counts, a part ends
    end = 0.5 * (1.0 + recording.photons / recording.exposure) / response[: batch.cells.phases, 0].sum()
    noise[0] = np.hypot(noise[0], end * len(parts) ** 0.5)
    sd = noise * len(parts) ** 0.5  # of a part of mean exposure
    ends = np.cumsum(np.r_[0.0, exposures])
    middle = 0.5 * (ends[1:] + ends[:-1]) * recording.period_ns * 1e-9
    # parts of a recording with interruptions differ in exposure: weights are their shares
    place = 0.5 * (ends[1:] + ends[:-1]) / ends[-1] - 0.5
    place -= share @ place
    x -= share @ x
    spread = float(share @ place**2)
    slope = (share * place) @ x / spread
    square = (share[:, None] * (x / noise) ** 2).sum(0)
    trend = slope * spread**0.5 / noise
    others = 8.0 * trend.size  # 2 trend.size tests share a quarter of the level
    tests = np.where(np.arange(trend.size) == 0, 4.0 / 3.0, others)
    p = np.minimum(tests * 2.0 * ndtr(-np.abs(trend)), others * chdtrc(len(parts) - 1, square))
    about = np.r_[fitted.theta[amounts].sum(), fitted.theta[delays]]
    growth = np.sqrt(np.maximum(square / (len(parts) - 1), 1.0))
    flicker, flicker_z, flicker_p, ratio = _flicker(fit, fitted)
    growth[0] = max(growth[0], ratio**0.5)
    names = ("light", *(model.names[k] for k in delays))
    return Drift(names, middle, x + about, sd, trend, slope, p, growth, flicker, flicker_z, others * flicker_p)
