"""`calibrate`: estimates of light and detector from a recorded photon stream, a test of fit, and suspected effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.display import brief, measured
from mars_lidar._base.resources import one_blas_thread
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.calibration import start, suspects
from mars_lidar.calibration.fit import Effort, Fit, Fitted, Guess, draws, smaller_of
from mars_lidar.calibration.look import Look, look_at
from mars_lidar.calibration.model import Model, Waveform, all_carriers
from mars_lidar.calibration.realizations import Realizations, realizations
from mars_lidar.calibration.recording import (
    FALSE_ALARM,
    LEAST_PHOTONS,
    Recording,
    brightest_window,
    free_waveform,
    recording_of,
    recording_of_arrivals,
)
from mars_lidar.calibration.suspects import Drift, Score, Trial
from mars_lidar.instrument.avalanches import Afterpulsing
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.effects import LIGHT_EFFECTS, Jitter
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import System
from mars_lidar.instrument.tolerances import TOL
from mars_lidar.light.flux import Flux
from mars_lidar.light.timestamps import Timestamps

_SAME_TIME = 0.01  # fraction of records at exactly the time of the preceding one, above which they are not photons
LEVEL = 0.01  # false-alarm probability of the verdict
_NOT_LINEAR = 0.5  # photons: an error of a signal that is not small beside 1, over which exp(-signal) changes

GIVEN = (
    *("dead_time_ns", "jitter_ns", "pulse_sigma_ns", "twilight_ns", "recovery_ns", "electronics_dead_time_ns"),
    *("mode", "afterpulse_probability", "afterpulse_delay_ns"),
)


@dataclass(frozen=True)
class Estimate:
    """Estimate of a parameter: value, standard error and 95 % interval; the error of a given value is 0.

    `note` states whether it was given, not detected, or not identified; the interval of a jitter that was not detected
    begins at 0. The error of a dead time that follows from the shortest interval alone is NaN: its law is not normal,
    and the interval is stated. In a model that does not fit all errors and intervals are NaN.

    `least` and `most`: ends of the range of its 95 % intervals in this model and in those with one further effect that
    fit the stream as well (`Calibration.limits`).
    """

    value: float = np.nan
    error: float = np.nan
    low: float = np.nan
    high: float = np.nan
    note: str = ""
    least: float = np.nan
    most: float = np.nan

    @property
    def short(self) -> str:
        """In words, without the range in fits with a further effect."""
        if self.error == 0.0:
            return f"{self.value:.6g} ({self.note or 'given'})"
        interval = "" if np.isnan(self.low) else f" (95 %: {self.low:.3g} to {self.high:.3g})"
        return f"{self.value:.4g}{interval}, {self.note}" if self.note else measured(self.value, self.error)

    def __str__(self) -> str:
        least, most = (measured(end, self.error).split()[0] for end in (self.least, self.most))
        wider = self.least < self.low or self.most > self.high
        return f"{self.short}; {least} to {most} with a further effect" if wider else self.short


@dataclass(frozen=True)
class Suspect:
    """An effect or deviation in the stream beyond the plain model.

    `z`: score in standard deviations; `size` and `error`: in the units of its option; `gain`: decrease of the misfit
    when the effect is included, in standard deviations of the misfit; `option`: the argument that sets it; `included`:
    whether the result includes it.
    """

    name: str
    z: float
    size: float = np.nan
    error: float = np.nan
    gain: float = np.nan
    option: str = ""
    included: bool = False

    def __str__(self) -> str:
        size = "" if np.isnan(self.size) else f" {self.size:.3g}"
        size += "" if np.isnan(self.error) else f" ± {self.error:.2g}"
        clear = f"{self.z:.1f} standard deviations" if self.z > 0.0 else "no significant score"
        if not np.isnan(self.gain):
            clear += f", including it reduces the misfit by {self.gain:.1f} standard deviations"
        state = "in the result" if self.included else f"not in the result: {self.option}"
        return f"{self.name}{size} ({clear}); {state}"


@dataclass(frozen=True)
class Limit:
    """An effect that is not in the result: 95 % upper limit in units of `name`, and the estimates of a fit with it.

    `ranges`: 95 % intervals of the estimates with the effect, if they extend beyond the intervals without it by more
    than the stated error. The limit is 1 for a paralyzable detector that fits as well, NaN if the fit did not
    converge, or is rejected.
    """

    name: str
    words: str
    limit: float = np.nan
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __str__(self) -> str:
        ranges = ", ".join(f"{name} {low:.5g} to {high:.5g}" for name, (low, high) in self.ranges.items())
        size = f"{self.name} below {self.limit:.3g} (95 %)" if self.limit != 1.0 else "fits as well"
        size = "no limit, since the fit with it did not converge, or is rejected" if np.isnan(self.limit) else size
        return f"{self.words}: {size}" + (f"; then {ranges}" if ranges else "")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Light and detector of a recorded stream, the result of `calibrate`.

    Attributes
    ----------
    look
        Content of the recording, before any model.
    recording
        The recorded times.
    estimates
        By name: ``signal``, ``background`` (photons per period), ``delay_ns``, ``width_ns`` (sigma of the recorded
        pulse, jitter included), ``pulse_sigma_ns``, ``jitter_ns`` (sigma), ``dead_time_ns``, and those of the effects
        in the result, in the units of `Detector`. With several returns ``signal_1``, ``delay_ns_1``, ...
    p_value
        Probability of a misfit at least this large if the model holds, drift included; NaN with ``look=True``.
    suspects
        Effects and deviations beyond the plain model, the most significant first.
    limits
        Effects that are not in the result, each with its upper limit.
    drift
        Light and delay by parts of the recording, or None for a short one.
    system, flux
        Instrument and light of these estimates, for `simulate`; None with ``look=True``.
    waveform, waveform_error
        Light (bins,) as recorded, jitter included, in photons per period and bin, with ``pulse="free"``; else None.
    fitted
        The fit, of which, with `recording`, figures and `realizations` are made; None with ``look=True``.
    level
        False-alarm probability of the verdict.

    See Also
    --------
    calibrate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=5000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=0.3), detector=ml.Detector(dead_time_ns=50.0),
    ... )
    >>> times = ml.simulate_timestamps(ml.Flux(0.4, 0.15, 30.0), system, seed=1)
    >>> result = ml.calibrate(times, look=True)
    >>> result.verdict
    'not fitted'
    >>> result.look.registrations == times.times_ns.size
    True
    """

    look: Look
    recording: Recording
    estimates: dict[str, Estimate] = field(default_factory=dict)
    p_value: float = np.nan
    suspects: tuple[Suspect, ...] = ()
    limits: tuple[Limit, ...] = ()
    drift: Drift | None = None
    system: System | None = None
    flux: Flux | None = None
    waveform: FloatArray | None = None
    waveform_error: FloatArray | None = None
    fitted: Fitted | None = None
    level: float = LEVEL

    __repr__ = brief

    @property
    def fits(self) -> bool:
        """Whether the model is not rejected, at `level`."""
        return bool(self.p_value >= self.level)

    @property
    def verdict(self) -> str:
        """The outcome of the test of fit, in one sentence."""
        if self.fitted is None:
            return "not fitted"
        included = [suspect.name for suspect in self.suspects if suspect.included]
        model = "the model" + (f" with {' and '.join(included)}" if included else "")
        if not self.fitted.converged:
            remedies = "give what is known (dead_time_ns, jitter_ns), pulse='free', returns=2, or a longer recording"
            reason = "; ".join(self.look.problems) or remedies
            return f"the fit of {model} did not converge, nothing is estimated: {reason}"
        outcome = f"is not rejected at the {self.level:.0%} level" if self.fits else "does not fit"
        return f"p = {self.p_value:.2g}: {model} {outcome}"

    def realizations(self, cycles: int, *, simulated: int = 4000, seed: int = 0) -> Realizations:
        """Distribution of the count in pieces of `cycles` periods, and of `simulated` pieces drawn with `seed` (T6).

        Raises
        ------
        ValueError
            No fit (``look=True``), no laser, or fewer than 20 such pieces in the recording.
        """
        if self.fitted is None or not self.recording.laser:
            raise ValueError("realizations need a fit and a laser period: calibrate without look=True")
        number = checks.integer("cycles", cycles, low=1, high=TOL.cycles)
        drawn = checks.integer("simulated", simulated, low=200, high=10**7)
        return realizations(self.recording, self.fitted, number, drawn, seed)


@checked
@one_blas_thread
def calibrate(
    times: Timestamps | Sequence[Timestamps] | ArrayLike,
    given: System | Detector | Mapping[str, Any] | None = None,
    *,
    pulse: Pulse | Literal["gaussian", "free"] = "gaussian",
    returns: int = 1,
    look: bool = False,
    pooled: bool = False,
    unit_ns: float = 0.0,
    level: float = LEVEL,
    seed: int = 0,
) -> Calibration:
    """Estimate light and detector from the photon stream of one free-running pixel, with errors and a test of fit.

    Counts of the stream by phase, by interval and by both are compared with those of streams that the exact engine
    simulates, and the stated errors are the scatter of the same estimate over such streams (docs/calibration.md).
    Detector effects that the counts reveal are included one after the other, each time the one whose refit fits best.

    Parameters
    ----------
    times
        The stream of one pixel (`Timestamps.load`, `Timestamps.pixel`), or a sequence of recordings of that pixel; or
        (n,) times in ns of a recording without a laser, in constant light. Only times, period and clock are used.
    given
        Known values, which are not fitted: a mapping of ``dead_time_ns``, ``jitter_ns`` (sigma), ``pulse_sigma_ns`` (of
        the light, without the jitter) and fields of `Detector` (``afterpulse_probability`` with
        ``afterpulse_delay_ns``, ``twilight_ns``, ``recovery_ns``, ``electronics_dead_time_ns``, ``mode``); a
        `Detector`; or a `System`, whose pulse is then also known.
    pulse
        A `Pulse` of known shape, without the jitter; ``"gaussian"``, of unknown width; or ``"free"``: light of any
        shape, estimated bin by bin.
    returns
        Number of returns, 1 to 4.
    look
        Describe the recording and stop before the fit.
    pooled
        All pixels of `times` are recordings of one and the same pixel.
    unit_ns
        Clock unit of an array of times, ns; 0: real numbers.
    level
        False-alarm probability of the verdict.
    seed
        Seed of the simulated streams; estimates for different seeds differ within their errors.

    Returns
    -------
    Calibration
        Estimates with errors, test of fit, suspects, limits, drift, and the system and flux for a simulation.

    Raises
    ------
    TypeError
        `times` are neither `Timestamps` nor numbers, `pulse` is not a pulse, or a switch is not True or False.
    ValueError
        Several pixels without `pooled`, fewer than 300 registrations, records that are not photons, photons that repeat
        with another period, recordings with different periods; a detector that is not free-running or has effects that
        one pixel cannot reveal; light of free shape with several returns, a pulse that is given twice, or an afterpulse
        probability without a delay.

    See Also
    --------
    Calibration, Timestamps, simulate_timestamps, reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=5000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=0.3), detector=ml.Detector(dead_time_ns=50.0),
    ... )
    >>> times = ml.simulate_timestamps(ml.Flux(0.4, 0.15, 30.0), system, seed=1)
    >>> result = ml.calibrate(times)
    >>> result.fits
    True
    >>> dead_time = result.estimates["dead_time_ns"]
    >>> dead_time.low < 50.0 < dead_time.high
    True
    """
    number = checks.integer("returns", returns, low=1, high=4)
    alpha = checks.real("level", level, low=0.0, high=0.5, strict_low=True)
    for name, value in (("look", look), ("pooled", pooled)):
        if not isinstance(value, bool):
            raise TypeError(f"{name} must be True or False, got {value!r}")
    start_seed = checks.integer("seed", seed, low=0, high=2**31)
    unit = checks.real("unit_ns", unit_ns, low=0.0)
    streams: Any = [times] if isinstance(times, Timestamps) else times
    if isinstance(streams, Sequence) and len(streams) > 0 and all(isinstance(each, Timestamps) for each in streams):
        recording = recording_of(streams, pooled=pooled)
    else:
        recording = recording_of_arrivals(streams, unit)
    shape, fields, fixed = _known(given, pulse)
    described = Calibration(look_at(recording), recording, level=alpha)
    if look:
        return described
    if recording.photons < LEAST_PHOTONS:
        raise ValueError(
            f"times must hold at least {LEAST_PHOTONS} registrations to be calibrated, got {recording.photons}; "
            "look=True describes a shorter recording"
        )
    same_time = described.look.same_time
    if same_time > _SAME_TIME * recording.photons and recording.clock.unit_ns == 0.0:
        raise ValueError(
            f"times must be of photons one after the other, got {same_time:,} of {recording.photons:,} at "
            "exactly the time of the one before"
        )
    if recording.laser and described.look.own_period_ns is not None:
        raise ValueError(f"times must repeat with the laser period, but {described.look.problems[0]}")
    model = _model(recording, shape, number, fields, "jitter" in fixed)
    return _Run(described, model, fixed, start_seed).result()


def _known(
    given: System | Detector | Mapping[str, Any] | None, pulse: Pulse | str
) -> tuple[Pulse | str, dict[str, Any], dict[str, float]]:
    """Shape of the pulse, fields of the detector, and fixed parameters, from what is given."""
    if isinstance(given, System):
        pulse = given.pulse if pulse == "gaussian" else pulse
        given = given.detector
    if isinstance(given, Detector):
        fields = _of_detector(given)
    else:
        fields = dict(checks.known_keys("given", {} if given is None else given, GIVEN))
    if "pulse_sigma_ns" in fields:
        sigma = checks.real("pulse_sigma_ns", fields.pop("pulse_sigma_ns"), low=0.0, strict_low=True)
        if pulse != "gaussian":
            raise ValueError("give the pulse once: pulse or pulse_sigma_ns")
        pulse = GaussianPulse(sigma_ns=sigma)
    if fields.get("mode") in ("synchronous", "gated"):
        raise ValueError(f"given must be a free-running detector, got mode {fields['mode']!r}")
    names = {"dead_time_ns": "dead_time_ns", "jitter_ns": "jitter"}  # of the options and of the parameters
    fixed = {own: checks.real(name, fields.pop(name), low=0.0) for name, own in names.items() if name in fields}
    probability, delay = fields.pop("afterpulse_probability", None), fields.pop("afterpulse_delay_ns", None)
    if (probability is None) != (delay is None):
        raise ValueError("afterpulse_probability and afterpulse_delay_ns belong together: give both, or neither")
    if probability is not None:
        fields["afterpulsing"] = Afterpulsing(probability=probability, delay_ns=delay)
    Detector(dead_time_ns=fixed.get("dead_time_ns", fields.get("twilight_ns", 0.0)), **fields)  # checks the fields
    return pulse, fields, fixed


def _of_detector(detector: Detector) -> dict[str, Any]:
    """What a detector gives: dead time, standard deviation of the jitter, and fields that are not as by default."""
    for name in ("crosstalk", "max_events_per_exposure", "code_density"):
        if name in detector.effects:
            raise ValueError(f"given must not have {name}: the stream of one pixel does not show it")
    bare = detector.without(*LIGHT_EFFECTS)
    given = {"dead_time_ns": bare.dead_time_ns, "jitter_ns": 0.0}
    if isinstance(bare.jitter, Jitter) and bare.jitter.tail_fraction == 0.0:
        given["jitter_ns"], bare = bare.jitter.std_ns, bare.without("jitter")
    mode = {"mode": bare.mode} if bare.mode != "nonparalyzable" else {}
    return given | mode | {name: getattr(bare, name) for name in bare.effects}


def _model(recording: Recording, shape: Pulse | str, returns: int, fields: dict[str, Any], jitter_given: bool) -> Model:
    """The model of a recording: light of any shape, returns with a laser, or constant light."""
    model = Model(recording.clock, 0, fields=tuple(fields.items()), jitter_given=jitter_given)
    pulse = shape if isinstance(shape, Pulse) else None
    if pulse is not None:
        pulse.check(recording.period_ns)
    if shape == "free":
        if returns > 1:
            raise ValueError(f"returns must be 1 with pulse='free', whose light has any shape, got {returns}")
        fine = recording.photons >= Effort.bin_photons * Effort.light_bins
        light = free_waveform(recording, Effort.light_bins if fine else Effort.shape_bins)
        return replace(model, waveform=Waveform(*light, recording.exposure, recording.period_ns, fine))
    return replace(model, returns=returns, pulse=pulse) if recording.laser else model


@dataclass(eq=False)
class _Run:
    """One calibration: the recording as described, its model without effects, and parameters of known value."""

    described: Calibration
    model: Model
    fixed: dict[str, float]
    seed: int

    def result(self, attempt: int = 0) -> Calibration:
        """The fit, the effects that it includes, and the suspects that remain.

        A fit that is rejected with every effect may be a local minimum: one by other streams is used if it fits.
        """
        fit, plain = self.first(attempt)
        wrong = [] if self.accepts(plain) else self.wrong_values(plain)
        drift = suspects.drift(fit, plain) if plain.converged else None
        fitted, other = plain, None
        included: list[tuple[Score, float]] = []
        trials: list[Trial] = []
        if not wrong and not (drift and drift.flickers):  # which looks like effects
            fitted, included, trials, other = suspects.search(fit, plain)
            drift = drift if fitted is plain or not fitted.converged else suspects.drift(fit, fitted)
        if fitted.converged and not included:
            fitted = fit.repeated(fitted)
        if attempt == 0 and fitted.converged and not included and not wrong and fitted.p_value < FALSE_ALARM:
            again = self.result(Effort.attempts)
            if again.fits:
                return again
        return self.assembled(fitted, included, trials, other, drift, wrong)

    def accepts(self, fitted: Fitted) -> bool:
        """Whether a fit converged and is not rejected."""
        return fitted.converged and fitted.p_value >= self.described.level

    def wrong_values(self, fitted: Fitted) -> list[Suspect]:
        """Given values that the stream contradicts (without one of them it fits), and the estimate of each."""
        out = []
        pulse = self.model.pulse
        known: dict[str, Any] = {**self.fixed, **dict(self.model.fields)}
        if pulse is not None:
            known["pulse_sigma_ns"] = pulse.sigma_ns if isinstance(pulse, GaussianPulse) else pulse
        for own, given in known.items():
            fixed = {name: value for name, value in self.fixed.items() if name != own}
            fields = tuple(item for item in self.model.fields if item[0] != own)
            shape = None if own == "pulse_sigma_ns" else pulse
            model = replace(self.model, pulse=shape, fields=fields, jitter_given="jitter" in fixed)
            _, free = replace(self, model=model, fixed=fixed).first()
            if not self.accepts(free):
                continue
            name = "jitter_ns" if own == "jitter" else own
            at = _estimates(free).get(name, Estimate())
            printed = f"{given:g}" if isinstance(given, float) else str(given)
            gain = fitted.misfit_z - free.misfit_z if fitted.converged else np.nan
            z = abs(at.value - given) / at.error if isinstance(given, float) and at.error > 0.0 else 0.0
            words = f"given {name} = {printed}, where the stream has"
            out.append(Suspect(words, z, at.value, at.error, gain, f"leave it out, and p = {free.p_value:.2g}"))
        return out

    def first(self, attempt: int = 0) -> tuple[Fit, Fitted]:
        """The fit without effects by the streams of an attempt, and of further ones until a pulse is significant.

        Where the phases have a bright window, a fit without a pulse is a bad one. Light without a pulse is tried first
        where they have none, and must not be rejected.
        """
        recording, tried = self.described.recording, []
        for number in range(attempt, attempt + Effort.attempts):
            fit = Fit(recording, Effort(), (self.seed, number))
            dark = number == 0 and self.model.returns > 0 and brightest_window(recording)[0] > FALSE_ALARM
            model = replace(self.model, returns=0, pulse=None) if dark else self.model
            fitted = self._attempt(fit, model, start.starts(fit, model, self.fixed)[number - attempt :])
            pulses = fitted.lit and (fitted.window_p > FALSE_ALARM or fitted.p_value < fitted.window_p)
            good = fitted.converged, pulses and not (dark and fitted.p_value < FALSE_ALARM)
            tried.append((good, fit, fitted))
            if all(good):
                break
        _, fit, fitted = max(tried, key=lambda each: each[0])
        return fit, fitted

    def _attempt(self, fit: Fit, model: Model, places: list[FloatArray]) -> Fitted:
        """A fit with the simulated streams of `fit`, from the better of the first two places."""
        known = {*self.fixed} if model.gaussian else {*self.fixed, "width"}
        free = np.array([k for k, name in enumerate(model.names) if name not in known], np.intp)
        photons = float(fit.recording.photons)
        first = min(fit.effort.first, photons)
        guesses = [Guess(model, theta, np.diag(0.5 * model.scale(theta)[free]), free) for theta in places[:2]]
        tried = [fit.steps(guesses[0], first)]
        with suppress(ValueError):  # steps from the second best place may lead to no photons
            tried.append(fit.steps(guesses[1], first))
        early, _, settled = min(tried, key=lambda trial: trial[1])
        guess, error = early, np.linalg.norm(early.root, axis=1)
        if first < photons:
            more = 6.0 if settled else 1.0
            guess, _, settled = fit.steps(early._replace(root=early.root / more**0.5), photons, more * first)
        final = fit.finish(guess)
        # steps that did not settle may have led away from what the first photons say
        near = bool((np.abs(final.theta - early.theta)[free] < 5.0 * error).all())
        accepted = settled or (near and final.p_value >= self.described.level)
        return replace(final, converged=final.converged and accepted)

    def assembled(
        self,
        fitted: Fitted,
        included: list[tuple[Score, float]],
        trials: list[Trial],
        other: Fitted | None,
        drift: Drift | None,
        wrong: list[Suspect],
    ) -> Calibration:
        """The result of the last fit."""
        model, recording = fitted.model, self.described.recording
        centre = model.bounded(fitted.theta)
        estimates = _estimates(fitted, drift) if fitted.converged else {}
        if estimates and self.model.returns and model.returns < 2 and not (model.returns and fitted.lit):
            _, most = brightest_window(recording)
            signal = min(float(fitted.theta[1]), most) if model.returns else 0.0
            words = "no significant pulse: upper limit of one anywhere"
            estimates["signal"] = Estimate(signal, np.nan, 0.0, most, words)
        named = [*wrong]
        for score, gain in included:
            name = score.effect.names[0]
            printed = "electronics_dead_time_ns" if name == "electronics_excess" else name
            at, option = estimates.get(printed, Estimate()), f"given {printed}"
            named.append(Suspect(score.effect.words, score.z, at.value, at.error, gain, option, included=True))
        p = fitted.p_value if fitted.converged else 0.0
        if drift is not None:
            p = smaller_of(p, drift.probability)
            named += _changes(drift)
        if p < min(self.described.level, FALSE_ALARM) and all(suspect.included for suspect in named):
            named.append(_worst_cells(fitted))
        others = [trial for trial in trials if fitted.p_value >= FALSE_ALARM and not trial.refuted]
        limits = [_limit(trial, estimates, drift) for trial in others]
        if other is not None:
            words = "paralyzable detector in its other light"
            limits.append(Limit("paralyzable", words, 1.0, _ranges(other, estimates, drift)))
        for name, own in estimates.items():
            ranges = [(own.low, own.high), *(limit.ranges[name] for limit in limits if name in limit.ranges)]
            lows, highs = zip(*ranges, strict=True)
            estimates[name] = replace(own, least=min(lows), most=max(highs))
        cycles, known = int(np.clip(recording.exposure, 1, TOL.cycles)), fitted.converged and recording.laser
        light = free_waveform(recording, Effort.shape_bins) if model.waveform else None
        wave, error = (float(centre[0] / light[0].sum()) * part for part in light) if light else (None, None)
        return replace(
            self.described,
            estimates=estimates,
            p_value=p,
            suspects=tuple(sorted(named, key=lambda suspect: (not suspect.included, -suspect.z))),
            limits=tuple(limits),
            drift=drift,
            system=model.system(centre, cycles, 1024) if known else None,
            flux=model.flux(centre) if known else None,
            waveform=wave,
            waveform_error=error,
            fitted=fitted,
        )


def _changes(drift: Drift) -> list[Suspect]:
    """The parameters that are not constant, and flicker."""
    out = []
    option = "calibrate parts of the recording; the errors include the scatter of the parts"
    for k in np.flatnonzero(drift.drifts):
        change = drift.change[k] / (drift.values[:, k].mean() if k == 0 else 1.0)
        words = "drift of the light, relative" if k == 0 else f"drift of {drift.names[k]}, ns"
        out.append(Suspect(words, abs(drift.trend[k]), change, abs(change / drift.trend[k]), option=option))
    if drift.flickers:
        out.append(Suspect("flicker of the light, counts relative", drift.flicker_z, drift.flicker, option=option))
    return out


def _worst_cells(fitted: Fitted) -> Suspect:
    """The group of cells that fits worst."""
    words = ("phases: shape of the light", "intervals", "intervals by phase")
    advice = ("pulse='free', or returns=2", *["no option of the model"] * 2)
    if fitted.window_p < FALSE_ALARM:
        return Suspect(words[0], -NormalDist().inv_cdf(fitted.window_p + 1e-16), option=advice[0])
    cells = fitted.batch.cells
    groups = np.split(np.arange(cells.size), [cells.phases, cells.phases + cells.gap_edges.size + 1])
    worst = Suspect("", -np.inf, option=advice[-1])
    for name, option, group in zip(words, advice, groups, strict=True):
        used = group[fitted.offset[group] > 5.0]
        scale = fitted.fresh[:, used].std(0)
        drawn = ((fitted.fresh[:, used] / scale) ** 2).sum(1)
        z = (float(((fitted.rest[used] / scale) ** 2).sum()) - drawn.mean()) / drawn.std()
        worst = Suspect(name, float(z), option=option) if z > worst.z else worst
    return worst


def _limit(trial: Trial, estimates: dict[str, Estimate], drift: Drift | None) -> Limit:
    """Upper limit of an effect that is not in the result, and the estimates of a fit with it where they differ."""
    effect, final = trial.effect, trial.final
    if final is None or final.p_value < FALSE_ALARM:
        return Limit(effect.names[0], effect.words)
    sizes = draws(final.model, final.unbounded, final.covariance, final.free)[:, -len(effect.names)]
    return Limit(effect.names[0], effect.words, float(np.quantile(sizes, 0.95)), _ranges(final, estimates, drift))


def _ranges(final: Fitted, estimates: dict[str, Estimate], drift: Drift | None) -> dict[str, tuple[float, float]]:
    """95 % intervals of a fit that extend beyond those of the result by more than its errors."""
    period, ranges = final.model.clock.period_ns, {}
    for name, other in _estimates(final, drift).items():
        own = estimates.get(name, other)
        turn = period * round((own.value - other.value) / period) if name.startswith("delay") else 0.0
        low, high = other.low + turn, other.high + turn
        if max(own.low - low, high - own.high) > (own.high - own.low) / 3.92:
            ranges[name] = low, high
    return ranges


def _quantities(model: Model, rows: FloatArray) -> dict[str, tuple[FloatArray, str]]:
    """Quantities (...) that are stated, of parameters (..., p) within the bounds; and the parameter that each needs."""
    of = dict(zip(model.names, rows.T, strict=True))
    dead, (pulse, jitter) = of["dead_time_ns"], model.widths(rows)
    out = {name if model.returns else "light": (of[name], name) for name in model.names[: model.light]}
    if model.gaussian:
        out |= {"width_ns": (of["width"], "width"), "pulse_sigma_ns": (pulse, "width")}
    out["jitter_ns"] = jitter, "jitter"
    for effect in model.effects:
        name = effect.names[0]
        if name == "electronics_excess":
            out["electronics_dead_time_ns"] = dead, "dead_time_ns"
            out["dead_time_ns"] = dead / (1.0 + of[name]), name
        elif name == "afterpulse_probability":  # in the option's units, with those that the dead time hides
            after, delay = of[name], np.exp(of["log_afterpulse_delay"])
            out[name] = np.vectorize(all_carriers)(after, delay, dead), name
            out["afterpulse_delay_ns"] = delay, "log_afterpulse_delay"
            out["afterpulses_after_dead_time"] = after, name
        elif not effect.onoff:
            out[name] = of[name], name
    out.setdefault("dead_time_ns", (dead, "dead_time_ns"))
    return out


def _estimates(fitted: Fitted, drift: Drift | None = None) -> dict[str, Estimate]:
    """Estimates by name: most probable values, with errors and intervals of draws, grown by the scatter of parts."""
    model, names, k = fitted.model, fitted.model.names, fitted.model.light
    growth = _growth(model, drift)
    covariance = fitted.covariance * np.outer(growth[fitted.free], growth[fitted.free])
    drawn = draws(model, fitted.unbounded, covariance, fitted.free)
    centre = model.bounded(fitted.theta)
    values, samples = _quantities(model, centre), _quantities(model, drawn)
    errors = dict(zip([names[i] for i in fitted.free], np.sqrt(np.diag(covariance)).tolist(), strict=True))
    withheld: dict[str, str] = {}
    if fitted.p_value < FALSE_ALARM:
        withheld = dict.fromkeys(names, "of a model that does not fit: no error is stated")
    elif not fitted.lit:  # there may be another pulse
        words = "no significant pulse" if model.returns < 2 else "a return without significant signal"
        withheld = dict.fromkeys((*names[:k], "width", "jitter"), f"{words}: no error is stated")
    if model.waveform is not None:  # which the shape follows
        withheld.setdefault("jitter", "beside light of free shape: no error is stated")
    notes: dict[str, str] = {}
    if "jitter" in errors and fitted.unbounded[k + 1] < 2.0 * errors["jitter"]:
        notes["jitter_ns"] = "not detected"
        if model.split and np.quantile(samples["jitter_ns"][0], 0.975) > 0.985 * centre[k]:
            notes = dict.fromkeys(("jitter_ns", "pulse_sigma_ns"), "not identified: any share of the recorded width")
    # near a bound of the angle the interval also covers the draws next to it
    covered = [slice(None), *(_at_bounds(fitted, errors["jitter"], drawn) if model.split else ())]
    least = model.bounded(np.full(model.size, -np.inf))
    out: dict[str, Estimate] = {}
    for name, (exact, parameter) in values.items():
        value, sample = float(exact), samples[name][0]
        if name.startswith("delay"):
            value = value % model.clock.period_ns
            sample = sample + (value - float(exact))
        if parameter not in errors:
            out[name] = Estimate(value, 0.0, value, value, "given")
        elif parameter in withheld:
            out[name] = Estimate(value, note=withheld[parameter])
        else:
            ends = [np.quantile(sample[rows], (0.025, 0.975)) for rows in covered]
            low, high = np.min(ends), np.max(ends)
            index = names.index(parameter)
            if index < k and fitted.unbounded[index] - 1.96 * errors[parameter] < least[index]:
                low = sample.min()  # equal tails would exclude a light of zero
            if name == "jitter_ns" and notes:
                low, high = 0.0, max([np.quantile(sample, 0.95), *(end for _, end in ends[1:])])
            error, note = float(((sample - value) ** 2).mean() ** 0.5), notes.get(name, "")
            if name.startswith("signal") and error > _NOT_LINEAR and 4.0 * centre[k] < centre[k + 2]:
                error, high, note = np.nan, np.inf, "nearly every pulse is recorded"
            out[name] = Estimate(value, error, float(low), float(high), note)
    if fitted.by_shortest is not None:
        value, low, high = fitted.by_shortest
        out["dead_time_ns"] = Estimate(value, np.nan, low, high, "by the shortest interval alone")
    return out


def _growth(model: Model, drift: Drift | None) -> FloatArray:
    """Factor (p,) on the errors: of the light, scatter of the parts of the recording over their errors; else 1."""
    out = np.ones(model.size)
    if drift is None:
        return out
    for k, name in enumerate(drift.names):
        which = slice(model.light) if k == 0 else model.names.index(name)
        if drift.drifts[k] or (k == 0 and drift.flickers):
            out[which] = np.maximum(out[which], drift.growth[k])
    return out


def _at_bounds(fitted: Fitted, error: float, drawn: FloatArray) -> list[NDArray[np.intp]]:
    """For each bound of the jitter angle within its 95 % interval: indices of the 5 % of draws next to that bound."""
    k = fitted.model.light + 1
    order, angle = np.argsort(drawn[:, k]), fitted.unbounded[k]
    most = fitted.model.bounded(np.where(np.arange(drawn.shape[1]) == k, np.pi, fitted.theta))[k]
    ends = ((order[: order.size // 20], 0.0), (order[-(order.size // 20) :], most))
    return [part for part, end in ends if abs(angle - end) < 1.96 * error]
