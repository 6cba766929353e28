"""What a recording shows beyond its model: effects of the detector, by a score and then by a refit; drift, by parts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.fit import LIGHTS, Fit, Fitted, counted
from mars_lidar.calibration.model import Effect, Model, effects
from mars_lidar.calibration.recording import Recording
from mars_lidar.calibration.start import first_spread, with_edge

_STREAMS = 4 * LIGHTS  # that tell the direction of an effect
NAMED = 4.0  # standard deviations of a score beyond which an effect is refitted: 3e-5 by chance
_CLEAR = 2.5  # errors of the size of an effect that has no score of its own
_FINISHED = 2  # refits that fresh streams judge
_MISFIT = 1e-3  # probability of the misfit below which effects without a clear score are refitted too
_FACTOR = 100.0  # of the probability of the misfit, for a refit that gains less in its square
_GAIN = 2.0  # standard deviations of the misfit that a refit must gain
_PARTS = 16  # of a recording, for drift
_PART_PHOTONS = 300  # of a part, at least
_DRIFTS = 3.0  # standard deviations of a trend: 0.3 % by chance
_SCATTERS = 1e-4  # probability of a scatter of the parts as large


@dataclass(frozen=True)
class Score:
    """An effect's size by the residual counts: its value and standard deviation, and what a unit of it shifts."""

    effect: Effect
    size: float
    error: float
    shift: FloatArray  # (free,) of the parameters, for an effect of size 1 that nobody knows of

    @property
    def z(self) -> float:
        """Standard deviations above none; no effect has a negative size."""
        return self.size / self.error

    @property
    def limit(self) -> float:
        """Upper limit of the size, 95 %."""
        return max(self.size, 0.0) + 1.645 * self.error


def scores(fit: Fit, fitted: Fitted) -> list[Score]:
    """The score of each effect that the model does not have, the clearest first."""
    model, law = fitted.model, fitted.batch
    have = {name for effect in model.effects for name in effect.names} | {name for name, _ in model.fields}
    have |= {"afterpulse_probability"} if "afterpulsing" in have else set()
    have |= {"electronics_excess"} if "electronics_dead_time_ns" in have else set()
    have |= {"paralyzable"} if "mode" in have else set()
    centre = model.bounded(fitted.theta)
    photons = float(fit.recording.photons)
    exposure = max(2, round(fit.exposure(fit.effort.of(photons))))
    rows = np.tile(centre, (_STREAMS, 1))
    plain = counted(model, law.cells, rows, exposure, fit.next_seed()).mean(0) * law.ratio
    listed = []
    used = law.common
    dead = float(centre[model.light + 2])
    for effect in effects(dead) if dead > 0.0 else ():
        if effect.names[0] in have:
            continue
        try:
            made = counted(model, law.cells, rows, exposure, fit.next_seed(), (effect,)).mean(0) * law.ratio
        except ValueError:  # a detector cannot have both
            continue
        change = (made - plain) / effect.start[0]
        shift = fitted.estimator @ change
        way = change - fitted.jacobian @ shift
        along = np.zeros_like(way)
        along[used] = law.weight[np.ix_(used, used)] @ way[used]
        along /= max(float(way @ along), 1e-300)
        spread = float((fitted.fresh @ along).std()) * (1.0 + law.ratio / _STREAMS) ** 0.5
        listed.append(Score(effect, float(fitted.left @ along), spread, shift))
    return sorted(listed, key=lambda score: -score.z)


@dataclass(frozen=True)
class Named:
    """An effect that a refit took in: z of its score before, and the gain of the misfit in standard deviations."""

    effect: Effect
    z: float
    gain: float


_Stepped = tuple[Model, FloatArray, FloatArray, NDArray[np.intp], bool, float]


def refitted(fit: Fit, fitted: Fitted, listed: list[Score]) -> tuple[Fitted, Named] | None:
    """The fit with the one effect that takes most of the misfit; None where no effect is clear.

    Effects are named by the refit: a slow recovery may have the score of a paralyzable detector, and one that the
    dead time has taken up has no score at all. So where the misfit is clear, effects without a score are tried too.
    """
    clear = [score for score in listed if score.z > NAMED]
    best = _best(fit, fitted, clear, listed)
    if best is None and fitted.p_value < _MISFIT:
        families = {score.effect.names[0] for score in clear}
        best = _best(fit, fitted, [score for score in listed if score.effect.names[0] not in families], listed)
    return best


def _best(fit: Fit, fitted: Fitted, tried: list[Score], listed: list[Score]) -> tuple[Fitted, Named] | None:
    trials: list[tuple[float, Score, _Stepped]] = []
    families: set[str] = set()
    for score in tried:
        family = score.effect.names[0]
        if family in families:
            continue
        families.add(family)
        grid = sorted((s for s in listed if s.effect.names[0] == family), key=lambda s: s.effect.delay_ns)
        place, least = grid.index(score), np.inf  # upwards: scores prefer short delays, unlike refits
        while place < len(grid):
            trial = _stepped(fit, fitted, grid[place])
            if trial is None or trial[-1] >= least:
                break
            least = trial[-1]
            trials.append((least, grid[place], trial))
            place += 1
    best: tuple[Fitted, Named] | None = None
    finals: list[tuple[Fitted, Named]] = []
    for _, score, (model, theta, root, free, settled, _) in sorted(trials, key=lambda trial: trial[0])[:_FINISHED]:
        final = fit.finish(model, theta, root, free, settled)
        named = Named(score.effect, score.z, fitted.misfit_z - final.misfit_z)
        gains = named.gain > _GAIN or final.p_value > max(_FACTOR * fitted.p_value, _MISFIT)
        if score.z <= NAMED and not score.effect.onoff:  # without a score of its own: its size must be clear
            gains = gains and final.theta[-1] > _CLEAR * final.covariance[-1, -1] ** 0.5
        if gains and final.converged:
            finals.append((final, named))
            if best is None or final.misfit_z < best[0].misfit_z:
                best = final, named
    if best is None:
        return None
    # delays of a grid that fit about as well: their difference is part of the error
    for final, named in finals:
        same = named.effect.names == best[1].effect.names and final is not best[0]
        if same and final.misfit_z < best[0].misfit_z + _GAIN:
            off = (final.theta - best[0].theta)[best[0].free]
            more = np.outer(off, off)
            wider = replace(
                best[0],
                covariance=best[0].covariance + more,
                unbounded_covariance=best[0].unbounded_covariance + more,
            )
            best = wider, best[1]
    return best


def _stepped(fit: Fit, fitted: Fitted, score: Score) -> _Stepped | None:
    """Parameters with one effect more, and the misfit; None where a detector cannot have it beside the others."""
    model, effect = fitted.model.with_effect(score.effect), score.effect
    size = effect.start[0] if effect.onoff else float(np.clip(score.size, 0.3 * effect.start[0], effect.most[0]))
    moved = fitted.theta.copy()
    moved[fitted.free] -= score.shift * min(size, effect.start[0])
    if fitted.model.light + 2 in fitted.free and effect.names[0] == "recovery_ns":
        moved, size = fitted.theta.copy(), effect.start[0]  # the dead time has taken up what it could of them
    theta = model.bounded(np.r_[moved, size, effect.start[1:]])
    spread = first_spread(model, theta)
    own = np.sqrt(np.diag(fitted.covariance))
    spread[fitted.free] = np.minimum(spread[fitted.free], np.maximum(8.0 * own, 1e-12))
    more = [] if effect.onoff else range(fitted.model.size, model.size)
    free = np.r_[fitted.free, np.array(more, np.intp)].astype(np.intp)
    photons = float(fit.recording.photons)
    try:
        if effect.names[0] == "recovery_ns" and fitted.model.light + 2 in fitted.free:
            gaps = np.diff(fit.recording.pieces[0][: 12 * fit.effort.first])
            theta = with_edge(fit, model, theta, np.sort(gaps))
        theta, root, misfit, settled = fit.steps(model, theta, np.diag(spread[free]), free, photons, 5, photons / 6.0)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return model, theta, root, free, settled, misfit


@dataclass(frozen=True, eq=False)
class Drift:
    """Parameters by parts of the recording.

    `times_s` (parts,) their middles; `values` (parts, p), and `errors` (p,) of each; `trend` (p,) change from begin to
    end, in standard deviations; `p_value` (p,) of the scatter; `growth` (p,) of the stated errors for it.
    """

    names: tuple[str, ...]
    times_s: FloatArray
    values: FloatArray
    errors: FloatArray
    trend: FloatArray
    change: FloatArray
    p_value: FloatArray
    growth: FloatArray

    @property
    def probability(self) -> float:
        """Probability of a trend or a scatter as large in a constant recording, all parameters together."""
        from scipy.stats import norm

        p = np.r_[2.0 * norm.sf(np.abs(self.trend)), self.p_value]
        return float(1.0 - (1.0 - p.min()) ** p.size)

    @property
    def drifts(self) -> NDArray[np.bool_]:
        """(p,) which parameters are not constant."""
        return (np.abs(self.trend) > _DRIFTS) | (self.p_value < _SCATTERS)


def drift(fit: Fit, fitted: Fitted) -> Drift | None:
    """Light and delay of parts of the recording, by the estimator of the whole; None for a short recording."""
    from scipy.stats import chi2

    recording: Recording = fit.recording
    number = int(min(_PARTS, recording.photons // _PART_PHOTONS))
    if number < 4:
        return None
    parts = [part for part in recording.parts(number) if part.photons > 20]
    model, law = fitted.model, fitted.batch
    free = fitted.free
    light = [k for k, index in enumerate(free) if index < model.light]
    values = []
    for part in parts:
        y = law.cells.of(part) * (recording.exposure / part.exposure)
        values.append(fitted.estimator @ (y - fitted.offset))
    estimates = np.array(values)[:, light]
    cov = fitted.scatter[np.ix_(light, light)] * len(parts)
    names = [model.names[free[k]] for k in light]
    signals = [i for i, name in enumerate(names) if not name.startswith("delay")]
    combine = np.zeros((1 + len(names) - len(signals), len(names)))
    combine[0, signals] = 1.0  # all light; then each delay
    for row, i in enumerate(i for i in range(len(names)) if i not in signals):
        combine[1 + row, i] = 1.0
    x = estimates @ combine.T
    sd = np.sqrt(np.diag(combine @ cov @ combine.T))
    place = np.linspace(-0.5, 0.5, len(parts))
    slope = place @ (x - x.mean(0)) / (place @ place)
    square = (((x - x.mean(0)) / sd) ** 2).sum(0)
    p = np.array([float(chi2.sf(value, len(parts) - 1)) for value in square])
    begins = np.cumsum([0.0, *(part.exposure for part in parts)])
    middle = 0.5 * (begins[1:] + begins[:-1]) * recording.period_ns * 1e-9
    about = np.r_[
        fitted.theta[[free[light[i]] for i in signals]].sum(),
        fitted.theta[[free[light[i]] for i in range(len(names)) if i not in signals]],
    ]
    return Drift(
        ("light", *(names[i] for i in range(len(names)) if i not in signals)),
        middle,
        x - x.mean(0) + about,
        sd,
        slope / (sd / np.sqrt(place @ place)),
        slope,
        p,
        np.sqrt(np.maximum(square / (len(parts) - 1), 1.0)),
    )
