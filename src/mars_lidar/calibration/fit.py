"""The fit: counts of the recorded stream against counts of streams that the exact engine draws at random parameters.

For streams of parameters theta_k about a centre c, counts regress as s_k = a + J (theta_k - c) + e_k. With W the
inverse covariance of e, G = (J' W J)^-1 J' W turns recorded counts into a step, and a last, fresh batch of streams
gives the bias, slope and scatter of that very estimator (simulated method of moments: McFadden, Econometrica 57, 995,
1989; Gourieroux, Monfort, Renault, J. Appl. Econometrics 8, S85, 1993). Counts are linear in the exposure, so streams
may be shorter than the recording.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.calibration.cells import Cells
from mars_lidar.calibration.model import Model
from mars_lidar.calibration.recording import FALSE_ALARM, LEAST_PHOTONS, Recording, brightest_window
from mars_lidar.calibration.shortest import Shortest, shortest_law

Index: TypeAlias = NDArray[np.intp]
LIGHTS = 16  # streams of one detector, in one call of the engine
_NEAR = 3.0  # standard errors of the recording about the estimate, from which the last streams are drawn
_WIDER = 4.0  # standard errors of the logarithm of a mean delay, by a normal law, within which it may lie
_DOUBTFUL = 0.01  # p-value below which a fit is tested again
_STREAMS = 64  # by so many streams
_RETESTED = 1e8  # of so many photons at most
_CUMULATED = 100.0  # registrations expected of a light, or intervals up to an edge, for a normal law of their number


@dataclass(frozen=True)
class Effort:
    """Numbers of simulated streams and of their photons: more take longer, and make the errors less noisy.

    Attributes
    ----------
    settings
        Detectors of a batch, each with `LIGHTS` streams.
    stream, batch, share, least
        Fewest photons of a stream, most photons of a batch, and photons of a batch relative to those of the recording:
        up to that number, and at least.
    first, rounds
        Photons of the recording that the first steps weigh; most steps.
    spread
        Standard deviation of the parameters of a batch, in standard errors of a stream of its length.
    longer, more, recentred
        The last streams have `longer` times as many photons, so that their parameters differ less; the batch that
        gives the weights has `more` times as many streams; it is recentred at most `recentred` times.
    pieces
        Pieces of each stream whose counts are correlated.
    draws
        Draws from the law of the estimate, for intervals within the bounds of the parameters.
    attempts
        Attempts to fit a recording, each with other simulated streams; the first that converges is used.
    effects
        Effects that are included at most, one after the other.
    parts
        Parts of a recording that are tested for drift: a trend then has 14 degrees of freedom.
    closest, noise
        Most photons, relative to a batch, of the streams that estimate the score of an effect again, where more than
        this share of the square of its change is noise.
    shape_bins, light_bins, bin_photons
        Most bins of free light in the result; and of that from which streams are drawn, if each has so many photons.
    """

    settings: int = 32
    stream: int = 2_000
    batch: float = 4e6
    share: float = 12.0
    least: float = 2.0
    first: int = 8_000
    rounds: int = 10
    spread: float = 2.0
    longer: float = 4.0
    more: int = 2
    recentred: int = 4
    pieces: int = 16
    draws: int = 20_000
    attempts: int = 3
    effects: int = 2
    parts: int = 16
    closest: float = 16.0
    noise: float = 0.1
    shape_bins: int = 256
    light_bins: int = 1024
    bin_photons: float = 10.0

    def of(self, photons: float, times: float = 1.0) -> int:
        """Photons of each stream of a batch, for this many of the recording; `times` as many for the last batches."""
        number = self.settings * LIGHTS
        wanted = times * max(self.stream, min(self.share * photons, self.batch) / number)
        return int(min(photons, max(wanted, self.least * photons / number)))


class Guess(NamedTuple):
    """Parameters (p,) of a model, which of them are free, and a root (free, free) of the covariance of those.

    `law`: the linear law of the last step, if that was for the whole recording.
    """

    model: Model
    theta: FloatArray
    root: FloatArray
    free: Index
    law: Batch | None = None


class Batch(NamedTuple):
    """A linear law of the counts about a centre, for an exposure: offset (c,), slope (c, p), weight (c, c)."""

    cells: Cells
    centre: FloatArray
    offset: FloatArray
    slope: FloatArray
    weight: FloatArray
    counts: FloatArray  # (streams, c) in units of the exposure
    residual: FloatArray
    ratio: float  # exposure of the law over that of a simulated stream
    theta: FloatArray

    @property
    def common(self) -> NDArray[np.bool_]:
        """(c,) cells with enough counts for a normal law in streams this short."""
        return np.asarray(self.offset > 2.0 * max(1.0, self.ratio / 4.0))

    def one_count(self, model: Model, free: Index) -> FloatArray:
        """Covariance (free, free) that one registration more or less adds to background and signals.

        It is the inverse square of the sum of the positive slopes of phases; without it an amount of no counts has no
        error. It is left out where light has over `_CUMULATED` registrations by the intervals: of a saturated detector
        only these depend on its light.
        """
        positive, phases = np.maximum(self.slope[:, free], 0.0), self.cells.phases
        gaps = positive[phases : phases + self.cells.gap_edges.size + 1].sum(0)
        amount = (free == 0) | ((free < model.light) & (free % 2 == 1))
        few = amount & (self.centre[free] * gaps < _CUMULATED)
        return np.diag(few / np.maximum(positive[:phases].sum(0), 1.0 / model.scale(self.centre)[free]) ** 2)

    def estimator(self, free: Index, prior: FloatArray | float = 0.0) -> FloatArray:
        """G (free, c), with an optional prior precision (free, free)."""
        jacobian = self.slope[:, free]
        information = jacobian.T @ self.weight @ jacobian + prior
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-10) * np.outer(scale, scale)
        return np.asarray(inverse @ jacobian.T @ self.weight)


def counted(model: Model, cells: Cells, rows: FloatArray, cycles: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Counts (rows, c) of simulated streams, and the correlation (c, c) of counts in pieces of one stream.

    There is a stream for each row of parameters (rows, p); `LIGHTS` rows share a detector. Pieces have the light of
    their stream, so that their scatter is noise alone.
    """
    square, totals, pieces = np.zeros((cells.size, cells.size)), [], Effort.pieces
    for k in range(0, len(rows), LIGHTS):
        streams = model.streams(rows[k : k + LIGHTS], cycles, seed + k)
        counts = cells.count(streams, pieces, cycles * model.clock.period_ns / pieces)
        totals.append(counts.sum(1))
        off = (counts - counts.mean(1, keepdims=True)).reshape(-1, cells.size).astype(np.float32)
        square += off.T @ off
    sd = np.sqrt(np.maximum(np.diag(square), 1e-300))
    return np.concatenate(totals), square / np.outer(sd, sd)


def design(model: Model, centre: FloatArray, root: FloatArray, free: Index, seed: int, number: int) -> FloatArray:
    """Parameters (streams, p), normal of covariance root root' about the centre; `LIGHTS` rows share a detector."""
    random, k = np.random.default_rng(seed), model.light
    varied = (free < k) | ((free == k + 1) & (not model.split))  # within a call of the engine
    order = np.argsort(varied, kind="stable")
    lower = np.asarray(np.linalg.qr(root[order].T, mode="r")).T  # so that detectors do not depend on the light

    def normal(rows: int, columns: int) -> FloatArray:
        """Deviates (rows, columns) without correlation, of variance 1."""
        z = random.standard_normal((rows, columns))
        return np.asarray(np.linalg.qr(z - z.mean(0))[0] * rows**0.5)

    rows = np.tile(centre, (number * LIGHTS, 1))
    between = np.repeat(normal(number, int((~varied).sum())), LIGHTS, 0)
    rows[:, free[order]] += np.c_[between, normal(len(rows), int(varied.sum()))] @ lower.T
    rows[:, k : k + 2] = np.abs(rows[:, k : k + 2])
    if model.split:
        rows[:, k + 1] = np.arcsin(np.abs(np.sin(rows[:, k + 1])))
    return model.bounded(rows)


def root_of(cov: FloatArray) -> FloatArray:
    """A square root of a covariance, which rounding may have made indefinite."""
    scale = np.sqrt(np.maximum(np.diag(cov), 1e-300))
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 1e-9)))


def least_squares(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coefficients, residuals, and inverse of the normal matrix, of values (n, ...) on a constant and on x (n, k)."""
    terms = np.c_[np.ones(len(x)), x]
    inverse = np.asarray(np.linalg.pinv(terms.T @ terms), np.float64)
    slope = inverse @ terms.T @ y
    return slope, y - terms @ slope, inverse


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit, tested by new streams: most probable parameters (p,), covariance of the free ones, misfit."""

    model: Model
    free: Index
    theta: FloatArray
    covariance: FloatArray  # of the law before the bounds
    unbounded: FloatArray  # (p,) before the bounds of the model
    batch: Batch  # cells and weights
    offset: FloatArray  # (c,) expected counts at the centre of the last streams
    estimator: FloatArray  # (free, c): theta_free = centre + estimator @ (counts - offset)
    jacobian: FloatArray  # (c, free)
    rest: FloatArray  # (c,) recorded counts less those of the fitted model
    noise: FloatArray  # (streams, c) counts of fresh streams less expected ones, of the recording's exposure
    fresh: FloatArray  # (streams, c) residual counts of these streams, of mean 0
    misfit_z: float  # standard deviations of the misfit above that of fresh streams
    p_value: float
    window_p: float  # p-value of the brightest window of the phases, less the fitted light
    converged: bool
    by_shortest: tuple[float, float, float] | None  # the dead time and its interval, if the counts do not determine it

    @property
    def guess(self) -> Guess:
        """This estimate, as the start of another fit."""
        return Guess(self.model, self.theta, root_of(self.covariance), self.free)

    @property
    def lit(self) -> bool:
        """Whether the signal of every return differs from zero (95 %), by the probability exp(-signal) of no photon."""
        amounts = (self.free < self.model.light) & (self.free % 2 == 1)
        signal, variance = self.theta[self.free[amounts]], np.diag(self.covariance)[amounts]
        return bool((signal >= np.log1p(1.96 * variance**0.5)).all())


def most_probable(model: Model, theta: FloatArray, covariance: FloatArray, free: Index) -> FloatArray:
    """The most probable parameters (p,) of a normal law within the bounds of the model.

    One parameter after the other, the one farthest beyond its bound first, is set to that bound, and the others to
    their mean given that value.
    """
    sd = np.sqrt(np.diag(covariance))
    theta, at_bound = theta.copy(), np.zeros(len(free), bool)
    for _ in free:
        beyond = np.where(at_bound, 0.0, (model.bounded(theta) - theta)[free] / sd)
        worst = int(np.abs(beyond).argmax())
        if beyond[worst] == 0.0:
            break
        at_bound[worst] = True
        off = (model.bounded(theta) - theta)[free[at_bound]]
        gain = covariance[np.ix_(~at_bound, at_bound)] @ np.linalg.pinv(covariance[np.ix_(at_bound, at_bound)])
        theta[free[~at_bound]] += gain @ off
        theta[free[at_bound]] += off
    return model.bounded(theta)


def draws(model: Model, theta: FloatArray, covariance: FloatArray, free: Index) -> FloatArray:
    """Draws (n, p) from the normal law of mean `theta` and covariance of the free parameters, within the bounds.

    If fewer than 200 lie there, all draws are moved to the most probable parameters and clipped.
    """
    rows = np.tile(theta, (Effort.draws, 1))
    rows[:, free] += np.random.default_rng(0).standard_normal((Effort.draws, len(free))) @ root_of(covariance).T
    inside = (np.abs(model.bounded(rows) - rows)[:, free] <= 1e-12 * np.abs(theta[free])).all(1)
    if inside.sum() >= 200:
        return rows[inside]
    return model.bounded(rows + most_probable(model, theta, covariance, free) - theta)


class Fit:
    """Gauss-Newton from a starting point to the whole recording, and the last batches."""

    def __init__(self, recording: Recording, effort: Effort, seed: tuple[int, ...]) -> None:
        self.recording, self.effort = recording, effort
        self._random = np.random.default_rng(seed)

    @property
    def shorter(self) -> Fit:
        """A fit whose last batches are as short as those of the steps, to choose between models."""
        effort = replace(self.effort, least=0.25, longer=1.0, more=1, recentred=2)
        return Fit(self.recording, effort, (self.next_seed(),))

    def next_seed(self) -> int:
        """A seed that no batch has had."""
        return int(self._random.integers(2**53))

    def exposure(self, photons: float) -> float:
        """Laser periods in which the recording has this many photons."""
        return self.recording.exposure * photons / self.recording.photons

    def cycles(self, photons: float) -> int:
        """Whole laser periods, at least two, in which the recording has about this many photons."""
        return max(2, round(self.exposure(photons)))

    def streams(self, model: Model, theta: FloatArray, photons: float, number: int = LIGHTS) -> Recording:
        """Simulated streams of parameters `theta` (p,), each with this many photons of the recording."""
        return model.streams(np.tile(theta, (number, 1)), self.cycles(photons), self.next_seed())

    def cells(self, model: Model, theta: FloatArray, photons: float) -> Cells:
        """Cells of a law for this many photons, by streams at `theta`."""
        return Cells(model, theta, self.streams(model, theta, self.effort.of(photons)), photons)

    def distance(self, model: Model, theta: FloatArray) -> float:
        """Mean square of the differences of recorded counts from those of streams at `theta`, in standard deviations.

        Of as many photons as the first steps weigh, and by the square roots of the counts, whose variance is even.
        """
        photons = min(self.recording.photons, self.effort.first)
        cells = self.cells(model, theta, photons)
        drawn = cells.count(self.streams(model, theta, photons))[:, 0]
        recorded = cells.of(self.recording) * (photons / self.recording.photons)
        off = 2.0 * np.sqrt(recorded + 0.375) - 2.0 * np.sqrt(drawn + 0.375).mean(0)
        return float((off**2).mean())

    def law(self, guess: Guess, photons: float, cells: Cells, spread: float, times: float = 1, more: int = 1) -> Batch:
        """The linear law of counts about a guess for so many photons, by `more` streams, `times` as long."""
        model, theta, root, free, _ = guess
        size = self.effort.of(photons, times)
        linear = np.diag(model.scale(theta)[free] ** -2.0)
        precision = np.linalg.inv(spread**2 * photons / size * root @ root.T) + linear
        wide = root_of(np.asarray(np.linalg.inv(precision), np.float64))
        rows = design(model, theta, wide, free, self.next_seed(), more * self.effort.settings)
        cycles = self.cycles(size)
        ratio = self.exposure(photons) / cycles
        totals, correlation = counted(model, cells, rows, cycles, self.next_seed())
        y, x = totals * ratio, (rows - theta)[:, free]
        scale = np.maximum(np.abs(x).max(0), 1e-300)
        fitted, residual, inverse = least_squares(x / scale, y)
        # a cell that few streams reach has a variance of its own count at least, as Poisson's
        variance = np.maximum((residual**2).sum(0) / (len(y) - len(fitted)) / ratio, 0.25 * y.mean(0) + 0.5 / len(y))
        strength = fitted[1:] ** 2 / (np.diag(inverse)[1:, None] * variance * ratio)
        slope = np.zeros((cells.size, theta.size))
        slope[:, free] = (fitted[1:] * np.maximum(0.0, 1.0 - 2.0 / np.maximum(strength, 1e-9)) / scale[:, None]).T
        off = correlation - np.diag(np.diag(correlation))
        noise = (1.0 - correlation**2) / (len(rows) * (self.effort.pieces - 1))
        # Ledoit and Wolf, J. Multivar. Anal. 88, 365 (2004): shrinking to no correlation
        shrink = np.clip((noise.sum() - np.trace(noise)) / max((off**2).sum(), 1e-9), 0.02, 0.95)
        weight = np.linalg.inv((1.0 - shrink) * off + np.eye(len(off))) / np.sqrt(np.outer(variance, variance))
        return Batch(cells, theta, fitted[0], slope, weight, y, residual, ratio, rows)

    def steps(self, guess: Guess, photons: float, first: float = 0.0) -> tuple[Guess, float, bool]:
        """Gauss-Newton steps for ever more photons, up to `photons`; misfit per cell, and whether they converged."""
        model, theta, root, free, _ = guess
        weighed = float(min(photons, max(first, self.effort.first)))
        for _ in range(self.effort.rounds):
            cells = self.cells(model, theta, weighed)
            law = self.law(Guess(model, theta, root, free), weighed, cells, self.effort.spread)
            recorded = cells.of(self.recording) * (weighed / self.recording.photons)
            prior = np.asarray(np.linalg.inv(root @ root.T) / 36.0, np.float64)
            gain = law.estimator(free, prior)
            step = gain @ (recorded - law.offset)
            scatter = law.residual @ gain.T
            cov = scatter.T @ scatter / (len(scatter) - len(free) - 1) / law.ratio + law.one_count(model, free)
            jacobian = law.slope[:, free]
            inverse = np.linalg.inv(jacobian.T @ law.weight @ jacobian + prior)
            cov = cov + inverse @ prior @ inverse
            size = float(np.sqrt(max(float(step @ prior @ step) * 9.0, 0.0) / len(step)))
            step = step / max(1.0, size / 2.0)
            moved = theta.copy()
            moved[free] += step
            theta = most_probable(model, moved, cov, free)
            rest = recorded - law.offset - jacobian @ step
            misfit = float(rest @ law.weight @ rest / len(rest)) if size <= 2.0 else np.inf
            near = size < (0.6 if weighed >= photons else 1.5)
            grown = min(photons, weighed * 6.0) if near else weighed
            cov = cov * (weighed / grown)
            root = root_of(cov + np.diag(0.02**2 * np.diag(cov)))
            if near and weighed >= photons:
                break
            weighed = grown
        whole = near and weighed >= photons
        return Guess(model, theta, root, free, law if whole and self.effort.more == 1 else None), misfit, whole

    def shortest(self, model: Model, rows: FloatArray) -> tuple[float, Shortest]:
        """Probability of the shortest interval for draws (n, p) of the parameters, and its law, without effects.

        The fit counts intervals in cells, without their places within a cell, so that it does not use this interval.
        """
        k = model.light + 2
        parts = np.array_split(rows[np.argsort(rows[:, k - 1])], 2 * LIGHTS)  # of about the same jitter each
        middles = np.array([part[len(part) // 2] for part in parts])
        law = shortest_law(self.recording, model, middles, self.next_seed())
        return law.p_value([part[:, k] for part in parts]), law

    def finish(self, guess: Guess, known: bool = False, finished: bool = False, again: bool = True) -> Fitted:
        """The last estimate, with the slope, bias, scatter and misfit that fresh streams around it show.

        A guess that is already the result of `finish` has the covariance with which the last streams are drawn.

        If the estimate is far from the guess, whose cells and weights it has, it is made again from where it is
        (`again`).

        The dead time follows from the shortest interval alone (`known`) if that contradicts the 95 % interval of the
        counts, or is more precise, or if counts claim over twice as much as intervals can tell. The other parameters
        are then fitted once more at that dead time.
        """
        model, centre, root, free, law = guess
        photons, effort = float(self.recording.photons), self.effort
        prior, middle = model.prior(centre, free)
        if law is None:
            closer = effort.spread / effort.more**0.5  # counts near the end of a dead time are linear over short ranges
            law = self.law(guess, photons, self.cells(model, centre, photons), closer, effort.longer, effort.more)
        nearby = _NEAR * (effort.of(photons, effort.longer) / photons) ** 0.5
        gain = law.estimator(free)
        recorded = law.cells.of(self.recording)
        for trial in range(effort.recentred):
            near = self.law(Guess(model, centre, root, free), photons, law.cells, nearby, effort.longer)
            slope, rest, inverse = least_squares((near.theta - centre)[:, free], (near.counts - near.offset) @ gain.T)
            freedom, local = len(rest) - len(slope), slope[1:].T
            away = gain @ (recorded - near.offset) - slope[0]
            information = np.linalg.pinv(rest.T @ rest / freedom)
            there = np.r_[1.0, np.linalg.pinv(local) @ away]  # the place at which the law is used, and its noise there
            for _ in range(2):
                scale = 1.0 / (1.0 / near.ratio + there @ inverse @ there)
                # the square of an estimated slope exceeds that of the slope by its variance
                fisher = scale * (local.T @ information @ local - len(free) * inverse[1:, 1:])
                # noise may have made it indefinite; streams lie within `_NEAR` errors, and no larger one is stated
                values, vectors = np.linalg.eigh(root.T @ fisher @ root)
                whole = (vectors * np.maximum(values, _NEAR**-2.0)) @ vectors.T + root.T @ prior @ root
                cov = root @ np.linalg.inv(whole) @ root.T
                solve = scale * cov @ local.T @ information
                there[1:] = solve @ away + cov @ prior @ (middle - centre)[free]
            estimator = solve @ gain
            cov = cov + near.one_count(model, free)
            raw = centre.copy()
            raw[free] += there[1:]
            mean = most_probable(model, raw, cov, free)
            size = np.abs((mean - centre)[free]) / np.sqrt(np.diag(cov))
            if (trial or finished) and size.max() < 1.0:
                break
            root = root_of(cov)
            centre = centre + (mean - centre) / max(1.0, float(size.max()) / _NEAR)
        if any(model.names[index].startswith("log_") for index in free):
            raw, cov = self._over_delays(Guess(model, raw, root_of(cov), free), law, near.offset, recorded)
            mean = most_probable(model, raw, cov, free)
        moved = np.abs((near.centre - guess.theta)[free]) / np.sqrt(np.diag(cov))
        if again and effort.more > 1 and moved.max() > _NEAR:
            return self.finish(Guess(model, near.centre, root_of(cov), free), known, again=False)
        jacobian, identity = law.slope[:, free] @ local, np.eye(len(recorded))
        unbound = identity - jacobian @ estimator
        # a parameter at a bound cannot move further, so that the projection does not remove counts in its direction
        at_bound = ((model.bounded(mean + 1e-6 * (raw - mean)) == mean) & (raw != mean))[free]
        estimator = estimator - cov[:, at_bound] @ np.linalg.pinv(cov[np.ix_(at_bound, at_bound)]) @ estimator[at_bound]
        project = identity - jacobian @ estimator
        departure = near.residual * (len(near.residual) / freedom / near.ratio) ** 0.5
        fresh = departure @ project.T
        fresh -= fresh.mean(0)
        rest = project @ (recorded - near.offset - jacobian[:, at_bound] @ (mean - near.centre)[free[at_bound]])
        z, p = _misfit(rest, fresh, law, near.offset, near.ratio / len(near.counts))
        rows = draws(model, raw, cov, free)
        if p < _DOUBTFUL and effort.more > 1:
            p = self._tested_again(model, rows, law, near.offset, unbound, recorded)
        window_p = 1.0  # cells resolve the fitted pulse alone
        if effort.more > 1 and model.returns:
            cycles = self.cycles(max(LEAST_PHOTONS, min(effort.share * photons, effort.batch) / LIGHTS))
            made = model.streams(rows[:LIGHTS], cycles, self.next_seed())
            window_p = min(1.0, brightest_window(self.recording, made)[0])
            p = min(p, window_p) if window_p < FALSE_ALARM else p
        interval = None
        if not (model.effects or model.fields):
            early, shortest = self.shortest(model, rows)
            dead, timed = shortest.dead_time, free == model.light + 2
            error = float(np.sqrt(cov[timed, timed].sum()))
            unknown = timed.any() and shortest.decides(float(mean[model.light + 2]), error)
            if timed.any() and (early < 0.05 or unknown):
                at = mean.copy()
                at[model.light + 2] = dead[0]
                own = Guess(model, at, root_of(cov[np.ix_(~timed, ~timed)]), free[~timed])
                other = self.refit(own, known=True)
                if other.converged and other.p_value > FALSE_ALARM:
                    return other
            if known or unknown:
                interval, mean[model.light + 2] = dead, dead[0]
            elif early < FALSE_ALARM:
                p = min(p, early)
        counts, converged = (estimator, jacobian, rest, departure, fresh), bool(size.max() < _NEAR)
        return Fitted(model, free, mean, cov, raw, law, near.offset, *counts, z, p, window_p, converged, interval)

    def refit(self, guess: Guess, known: bool = False) -> Fitted:
        """Steps by the whole recording from a guess, and the last estimate from there."""
        photons = float(self.recording.photons)
        return self.finish(self.steps(guess, photons, photons / 6.0)[0], known)

    def _over_delays(
        self, guess: Guess, law: Batch, offset: FloatArray, recorded: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (free, free) of a model with afterpulses, from its likelihood at each mean delay.

        That law is far from normal: afterpulses of long delays resemble background. In streams of all delays within
        `_WIDER` errors of the guess counts are linear in the other parameters, and in products of the probability with
        powers of the logarithm of the delay.
        """
        model, theta, root, free, _ = guess
        late = next(k for k, name in enumerate(model.names) if name.startswith("log_"))  # after the probability
        others, varied = free[(free < late - 1) | (free > late)], free != late
        photons, settings = float(self.recording.photons), self.effort.settings
        reach = _WIDER * float(np.linalg.norm(root[~varied]))
        place = float(model.bounded(theta)[late])
        least, most = (float(model.bounded(np.full(model.size, place + end))[late]) for end in (-reach, reach))
        wide = _NEAR * root_of((root @ root.T)[np.ix_(varied, varied)])
        cycles = self.cycles(self.effort.of(photons, self.effort.longer))
        ratio = self.exposure(photons) / cycles

        def powers(delay: FloatArray) -> FloatArray:
            return np.asarray(np.vander((2.0 * delay - least - most) / (most - least), 4, increasing=True))

        def batch() -> tuple[FloatArray, FloatArray]:
            rows = design(model, theta, wide, free[varied], self.next_seed(), settings)
            rows[:, late] = np.repeat(self._random.permutation(np.linspace(least, most, settings)), LIGHTS)
            counts = counted(model, law.cells, rows, cycles, self.next_seed())[0] * ratio - offset
            return np.c_[(rows - theta)[:, others], rows[:, late - 1, None] * powers(rows[:, late])], counts

        jacobian = least_squares(*batch())[0][1:].T
        gain = np.linalg.inv(jacobian.T @ law.weight @ jacobian) @ jacobian.T @ law.weight
        x, counts = batch()
        slope, rest, inverse = least_squares(x, counts @ gain.T)
        information, away = (
            np.linalg.inv(rest.T @ rest / (len(rest) - len(slope))),
            gain @ (recorded - offset) - slope[0],
        )
        # the others and the probability at each delay, as coefficients of all that counts are linear in
        delays, n = np.linspace(least, most, 65), others.size
        to = np.tile(np.eye(n + 4, n + 1), (delays.size, 1, 1))
        to[:, n:, n] = powers(delays)
        local, there = slope[1:].T @ to, np.tile(np.eye(1, n + 5), (delays.size, 1))
        for _ in range(2):
            noise = 1.0 / ratio + np.einsum("ki,ij,kj->k", there, inverse, there)
            weighted = local.transpose(0, 2, 1) @ information / noise[:, None, None]
            covariance = np.linalg.inv(weighted @ local)
            values = covariance @ weighted @ away
            there[:, 1:] = np.einsum("kij,kj->ki", to, values)
        off = away - np.einsum("kij,kj->ki", local, values)
        log = np.linalg.slogdet(covariance)[1] - away.size * np.log(noise)
        log -= np.einsum("ki,ij,kj->k", off, information, off) / noise
        weight = np.exp(0.5 * (log - log.max()))
        weight /= weight.sum()
        order, mean = np.argsort(np.r_[others, late - 1, late]), theta.copy()
        values = np.c_[theta[others] + values[:, :n], values[:, n], delays][:, order]
        mean[free] = weight @ values
        within = np.pad(np.tensordot(weight, covariance, 1), (0, 1))[np.ix_(order, order)]
        return mean, within + np.cov(values.T, aweights=weight, ddof=0)

    def _tested_again(
        self, model: Model, rows: FloatArray, law: Batch, offset: FloatArray, project: FloatArray, recorded: FloatArray
    ) -> float:
        """The p-value of the misfit by streams about as long as the recording, of parameters (n, p) from their law.

        Counts that are not linear in the parameters scatter more in these than in the shorter streams of a linear law.
        """
        photons = float(self.recording.photons)
        cycles = self.cycles(min(photons, _RETESTED / _STREAMS))
        made = [law.cells.of(model.streams(row, cycles, self.next_seed())) for row in rows[:_STREAMS]]
        rest = (np.array(made) * (self.exposure(photons) / cycles) - offset) @ project.T
        mean = rest.mean(0)
        return _misfit(project @ (recorded - offset) - mean, rest - mean, law, offset, 1.0 / len(rest))[1]

    def repeated(self, fitted: Fitted) -> Fitted:
        """The mean of a fit and of one more from its place, with other cells, weights and simulated streams.

        They differ by the noise of simulated streams, and where counts are not linear in the parameters. The covariance
        is the mean of both, since each has such noise too, and no error is smaller than the difference.
        """
        other = self.finish(fitted.guess, known=fitted.by_shortest is not None, again=False)
        free, change = other.free, np.zeros_like(other.theta)
        change[free] = (other.theta - fitted.theta)[free]
        same = np.isin(fitted.free, free)  # all but a dead time that has just been taken from the shortest interval
        covariance = 0.5 * (fitted.covariance[np.ix_(same, same)] + other.covariance)
        growth = np.maximum(1.0, np.abs(change[free]) / np.sqrt(np.diag(covariance)))
        return replace(
            other,
            theta=other.model.bounded(other.theta - 0.5 * change),
            unbounded=other.unbounded - 0.5 * change,
            covariance=covariance * np.outer(growth, growth),
            converged=fitted.converged and other.converged,
        )


def _misfit(rest: FloatArray, fresh: FloatArray, law: Batch, offset: FloatArray, noise: float) -> tuple[float, float]:
    """Misfit r' W r of the residual counts r, in standard deviations above its mean over fresh streams; its p-value.

    `offset` (c,) expected counts, with `noise` times the variance of the recorded ones.

    The probability is that of two tests together: the weighted square of all cells, and the largest residual of the
    cumulated intervals, which is sensitive to a few missing or early intervals at the end of the dead time.
    """
    from scipy.special import gammaincc, ndtr

    used = law.common
    weight = law.weight[np.ix_(used, used)]
    drawn = np.einsum("ki,ij,kj->k", fresh[:, used], weight, fresh[:, used])
    recorded = float(rest[used] @ weight @ rest[used]) / (1.0 + noise)
    shape = drawn.mean() ** 2 / drawn.var()
    square = float(gammaincc(shape, recorded * shape / drawn.mean()))
    gaps = slice(law.cells.phases, law.cells.phases + law.cells.gap_edges.size)
    enough = np.cumsum(offset[gaps]) > _CUMULATED
    scatter = np.cumsum(fresh[:, gaps], axis=1).std(0)[enough] * (1.0 + noise) ** 0.5
    departure = np.abs(np.cumsum(rest[gaps])[enough]) / scatter
    late = 2.0 * enough.sum() * float(ndtr(-departure.max(initial=0.0)))
    return float((recorded - drawn.mean()) / drawn.std()), smaller_of(square, late)


def smaller_of(*p_values: float) -> float:
    """Probability that the smallest of so many independent p-values is at most the smallest of these."""
    return float(-np.expm1(len(p_values) * np.log1p(-min(*p_values, 1.0 - 1e-16))))
