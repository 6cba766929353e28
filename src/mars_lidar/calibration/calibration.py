"""`calibrate`: estimates of light and detector from a recorded photon stream, a test of fit, and suspected effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.display import brief, measured
from mars_lidar._base.resources import one_blas_thread
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.calibration import start, suspects
from mars_lidar.calibration.fit import Effort, Fit, Fitted, Guess, draws
from mars_lidar.calibration.look import Look, look_at
from mars_lidar.calibration.model import Model, Waveform, all_carriers
from mars_lidar.calibration.realizations import Realizations, realizations
from mars_lidar.calibration.recording import FALSE_ALARM, LEAST_PHOTONS, Recording, recording_of, recording_of_arrivals
from mars_lidar.calibration.suspects import Drift, Named, Trial
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

    value: float
    error: float
    low: float
    high: float
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
    size: float
    error: float
    gain: float
    option: str
    included: bool

    def __str__(self) -> str:
        size = "" if np.isnan(self.size) else f" {self.size:.3g}"
        size += "" if np.isnan(self.error) else f" ± {self.error:.2g}"
        gain = (
            "" if np.isnan(self.gain) else f", including it reduces the misfit by {self.gain:.1f} standard deviations"
        )
        state = "in the result" if self.included else f"not in the result: {self.option}"
        clear = f"{self.z:.1f} standard deviations{gain}" if self.z > 0.0 else f"no significant score{gain}"
        return f"{self.name}{size} ({clear}); {state}"


@dataclass(frozen=True)
class Limit:
    """An effect that is not in the result: 95 % upper limit in units of `name`, and the estimates of a fit with it.

    `ranges`: 95 % intervals of the estimates with the effect, if they extend beyond the intervals without it by more
    than the stated error. The limit is 1 for a paralyzable detector that fits as well, NaN if the fit did not converge.
    """

    name: str
    words: str
    limit: float
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __str__(self) -> str:
        ranges = ", ".join(f"{name} {low:.5g} to {high:.5g}" for name, (low, high) in self.ranges.items())
        size = f"{self.name} below {self.limit:.3g} (95 %)" if self.limit != 1.0 else "fits as well"
        size = "no limit, since the fit with it did not converge" if np.isnan(self.limit) else size
        return f"{self.words}: {size}" + (f"; then {ranges}" if ranges else "")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Light and detector of a recorded stream, the result of `calibrate`.

    Attributes
    ----------
    look
        Content of the recording, before any model.
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
    recording, fitted
        The recorded times and the fit, of which figures and `realizations` are made; no fit with ``look=True``.
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
    estimates: dict[str, Estimate]
    p_value: float
    suspects: tuple[Suspect, ...]
    limits: tuple[Limit, ...]
    drift: Drift | None
    system: System | None
    flux: Flux | None
    waveform: FloatArray | None
    waveform_error: FloatArray | None
    recording: Recording
    fitted: Fitted | None
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
            remedy = "give what is known (dead_time_ns, jitter_ns), pulse='free', returns=2, or a longer recording"
            return f"the fit of {model} did not converge, nothing is estimated: {remedy}"
        if self.fits:
            return f"p = {self.p_value:.2g}: {model} is not rejected at the {self.level:.0%} level"
        return f"p = {self.p_value:.2g}: {model} does not fit"

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
        Several pixels without `pooled`, fewer than 300 registrations, records that are not photons, recordings with
        different periods; a detector that is not free-running or has effects that one pixel cannot reveal; a pulse
        that is given twice, or an afterpulse probability without a delay.

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
    >>> abs(dead_time.value - 50.0) < 4.0 * dead_time.error
    True
    """
    number = checks.integer("returns", returns, low=1, high=4)
    alpha = checks.real("level", level, low=0.0, high=0.5, strict_low=True)
    for name, value in (("look", look), ("pooled", pooled)):
        if not isinstance(value, bool):
            raise TypeError(f"{name} must be True or False, got {value!r}")
    start_seed = checks.integer("seed", seed, low=0, high=2**31)
    recording = _recorded(times, pooled, checks.real("unit_ns", unit_ns, low=0.0))
    shape, fields, fixed = _known(given, pulse)
    described = look_at(recording)
    if look:
        return Calibration(described, {}, float("nan"), (), (), None, None, None, None, None, recording, None, alpha)
    if recording.photons < LEAST_PHOTONS:
        raise ValueError(
            f"times must hold at least {LEAST_PHOTONS} registrations to be calibrated, got {recording.photons}; "
            "look=True describes a shorter recording"
        )
    if described.same_time > _SAME_TIME * recording.photons and described.unit_ns == 0.0:
        raise ValueError(
            f"times must be of photons one after the other, got {described.same_time:,} of {recording.photons:,} at "
            "exactly the time of the one before"
        )
    return _Run(recording, described, shape, number, fields, fixed, alpha, start_seed).result()


def _recorded(times: Any, pooled: bool, unit_ns: float) -> Recording:
    """The recording of streams, or of an array of times without a laser."""
    streams = isinstance(times, Sequence) and len(times) > 0 and all(isinstance(t, Timestamps) for t in times)
    if streams or isinstance(times, Timestamps):
        return recording_of(times, pooled=pooled)
    return recording_of_arrivals(times, unit_ns)


def _known(
    given: System | Detector | Mapping[str, Any] | None, pulse: Pulse | str
) -> tuple[Pulse | str, dict[str, Any], dict[str, float]]:
    """Shape of the pulse, fields of the detector, and fixed parameters, from what is given."""
    if isinstance(pulse, str):
        checks.choice("pulse", pulse, ("gaussian", "free"))
    elif not isinstance(pulse, Pulse):
        raise TypeError(f"pulse must be a Pulse, 'gaussian' or 'free', got {pulse!r}")
    if isinstance(given, System):
        return _known(given.detector, given.pulse if pulse == "gaussian" else pulse)
    if isinstance(given, Detector):
        return pulse, *_of_detector(given)
    if given is None:
        return pulse, {}, {}
    known = dict(checks.known_keys("given", given, GIVEN))
    fixed: dict[str, float] = {}
    if "pulse_sigma_ns" in known:
        sigma = checks.real("pulse_sigma_ns", known.pop("pulse_sigma_ns"), low=0.0, strict_low=True)
        if pulse != "gaussian":
            raise ValueError("give the pulse once: pulse or pulse_sigma_ns")
        pulse = GaussianPulse(sigma_ns=sigma)
    if "dead_time_ns" in known:
        fixed["dead_time_ns"] = checks.real("dead_time_ns", known.pop("dead_time_ns"), low=0.0)
    if "jitter_ns" in known:
        fixed["jitter"] = checks.real("jitter_ns", known.pop("jitter_ns"), low=0.0)
    probability, delay = known.pop("afterpulse_probability", None), known.pop("afterpulse_delay_ns", None)
    if (probability is None) != (delay is None):
        raise ValueError("afterpulse_probability and afterpulse_delay_ns belong together: give both, or neither")
    if probability is not None:
        known["afterpulsing"] = Afterpulsing(probability=float(probability), delay_ns=float(delay))
    Detector(dead_time_ns=fixed.get("dead_time_ns", known.get("twilight_ns", 0.0)), **known)  # checks the fields
    return pulse, known, fixed


def _of_detector(detector: Detector) -> tuple[dict[str, Any], dict[str, float]]:
    if detector.mode not in ("nonparalyzable", "paralyzable"):
        raise ValueError(f"given must be a free-running detector, got mode {detector.mode!r}")
    for name in ("crosstalk", "max_events_per_exposure", "code_density"):
        if name in detector.effects:
            raise ValueError(f"given must not have {name}: the stream of one pixel does not show it")
    bare = detector.without(*LIGHT_EFFECTS)
    fixed = {"dead_time_ns": bare.dead_time_ns, "jitter": 0.0}
    fields: dict[str, Any] = {"mode": bare.mode} if bare.mode != "nonparalyzable" else {}
    for name in bare.effects:
        if name == "jitter" and isinstance(bare.jitter, Jitter) and bare.jitter.tail_fraction == 0.0:
            fixed["jitter"] = bare.jitter.std_ns
        else:
            fields[name] = getattr(bare, name)
    return fields, fixed


@dataclass(eq=False)
class _Run:
    """One calibration: the model, its fit, and what follows from it."""

    recording: Recording
    look: Look
    shape: Pulse | str
    returns: int
    fields: dict[str, Any]
    fixed: dict[str, float]
    level: float
    seed: int
    wave: tuple[FloatArray, FloatArray] | None = None
    most: float = np.inf  # 95 % upper limit of the signal in a pulse, where none is significant

    def __post_init__(self) -> None:
        recording, shape = self.recording, self.shape
        self.fit = Fit(recording, Effort(), (self.seed, 0))
        if isinstance(shape, Pulse):
            shape.check(recording.period_ns)
        fields, given = tuple(self.fields.items()), "jitter" in self.fixed
        model = pulsed = Model(recording.clock, 0, fields=fields, jitter_given=given)
        if shape == "free":
            self.wave = start.free_waveform(recording, self.fit.effort.shape_bins)
            fine = recording.photons >= self.fit.effort.bin_photons * self.fit.effort.light_bins
            light = start.free_waveform(recording, self.fit.effort.light_bins) if fine else self.wave
            waveform = Waveform(*light, recording.exposure, recording.period_ns, fine)
            model = pulsed = replace(model, waveform=waveform)
        elif recording.laser:
            p, self.most = start.brightest_window(recording)
            pulsed = replace(model, returns=self.returns, pulse=shape if isinstance(shape, Pulse) else None)
            model = pulsed if p <= FALSE_ALARM else model
        self.model, self.pulsed = model, pulsed

    def result(self, attempt: int = 0) -> Calibration:
        """The fit, the effects that it includes, and the suspects that remain.

        A fit that is clearly rejected with every effect may be a local minimum: another one is used if it fits.
        """
        fitted = self.first(attempt)
        wrong = () if fitted.converged and fitted.p_value >= self.level else self.wrong_values(fitted)
        included: list[Named] = []
        drift = suspects.drift(self.fit, fitted) if fitted.converged else None
        trials: list[Trial] = []
        if fitted.converged and not wrong and not (drift is not None and drift.flickers):  # which looks like effects
            fitted, included, trials = suspects.search(self.fit, fitted)
            drift = suspects.drift(self.fit, fitted) if included else drift
        out = self.assembled(fitted, included, trials, drift, wrong)
        if attempt == 0 and not included and not wrong and fitted.p_value < suspects.MISFIT * FALSE_ALARM:
            other = self.result(self.fit.effort.attempts)
            return other if other.fits else out
        return out

    def wrong_values(self, fitted: Fitted) -> tuple[Suspect, ...]:
        """Given values that the stream contradicts (without one of them it fits), and the estimate of each."""
        out = []
        pulse = {"pulse_sigma_ns": self.shape.sigma_ns if isinstance(self.shape, GaussianPulse) else self.shape}
        known: dict[str, Any] = {**self.fixed, **self.fields, **(pulse if isinstance(self.shape, Pulse) else {})}
        for own, given in known.items():
            fields, fixed = ({k: v for k, v in part.items() if k != own} for part in (self.fields, self.fixed))
            shape = "gaussian" if own == "pulse_sigma_ns" else self.shape
            name = "jitter_ns" if own == "jitter" else own
            run = _Run(self.recording, self.look, shape, self.returns, fields, fixed, self.level, self.seed)
            free = run.first()
            if not free.converged or free.p_value < self.level:
                continue
            at = _estimates(free, np.ones(free.model.size)).get(name, Estimate(np.nan, np.nan, np.nan, np.nan))
            printed = f"{given:g}" if isinstance(given, float) else str(given)
            gain = fitted.misfit_z - free.misfit_z if fitted.converged else float("nan")
            z = abs(at.value - given) / at.error if isinstance(given, float) and at.error > 0.0 else 0.0
            words = f"given {name} = {printed}, where the stream has"
            option = f"leave it out, and p = {free.p_value:.2g}"
            out.append(Suspect(words, z, at.value, at.error, gain, option, included=False))
        return tuple(out)

    def first(self, attempt: int = 0) -> Fitted:
        """The fit without effects by the streams of an attempt, and of further ones until a pulse is significant.

        Where the phases have a bright window, a fit without a pulse is a bad one. Light without a pulse is tried first
        where they have none, and must not be rejected.
        """
        tried: list[tuple[bool, bool, Fit, Fitted]] = []
        while len(tried) < self.fit.effort.attempts and not (tried and tried[-1][0] and tried[-1][1]):
            self.fit = Fit(self.recording, Effort(), (self.seed, attempt + len(tried)))
            fitted = self._attempt()
            dark = self.model.returns < self.pulsed.returns and fitted.p_value < FALSE_ALARM
            tried.append((fitted.converged, fitted.lit and not dark, self.fit, fitted))
            self.model = self.pulsed
        *_, self.fit, fitted = max(tried, key=lambda each: each[:2])
        return fitted

    def _attempt(self) -> Fitted:
        """A fit with the simulated streams of `fit`."""
        fit, model = self.fit, self.model
        tried = []
        begin = start.starts(fit, self.recording, model, self.fixed)
        known = {*self.fixed, *(["width"] if model.returns == 0 or model.pulse is not None else [])}
        free = np.array([k for k, name in enumerate(model.names) if name not in known], np.intp)
        first, photons = fit.effort.first, float(self.recording.photons)
        for _, theta in begin[:2]:
            trial = Guess(model, theta, np.diag(0.5 * model.scale(theta)[free]), free)
            tried.append(fit.steps(trial, min(photons, first)))
        guess, _, settled = min(tried, key=lambda trial: trial[1])
        if first < photons:
            more = 6.0 if settled else 1.0
            guess, _, settled = fit.steps(guess._replace(root=guess.root / more**0.5), photons, more * first)
        final = fit.finish(guess)
        return replace(final, converged=final.converged and (settled or final.p_value >= self.level))

    def assembled(
        self,
        fitted: Fitted,
        included: list[Named],
        trials: list[Trial],
        drift: Drift | None,
        wrong: tuple[Suspect, ...],
    ) -> Calibration:
        """The result of the last fit."""
        growth = _growth(fitted, drift)
        estimates = _estimates(fitted, growth)
        if self.most < np.inf and fitted.model.returns < 2 and not (fitted.model.returns and fitted.lit):
            signal = min(float(fitted.theta[1]), self.most) if fitted.model.returns else 0.0
            words = "no significant pulse: upper limit of one anywhere"
            estimates["signal"] = Estimate(signal, np.nan, 0.0, self.most, words, 0.0, self.most)
        named: list[Suspect] = list(wrong)
        for refit in included:
            name = refit.effect.names[0]
            printed = "electronics_dead_time_ns" if name == "electronics_excess" else name
            at = estimates.get(printed, Estimate(np.nan, np.nan, np.nan, np.nan))
            words, option = refit.effect.words, f"given {printed}"
            named.append(Suspect(words, refit.z, at.value, at.error, refit.gain, option, included=True))
        p = fitted.p_value if fitted.converged else 0.0
        if drift is not None:
            p = min(1.0, 2.0 * min(p, drift.probability))
            option = "calibrate parts of the recording; the errors include the scatter of the parts"
            for k in np.flatnonzero(drift.drifts):
                change = drift.change[k] / (drift.values[:, k].mean() if k == 0 else 1.0)
                words = "drift of the light, relative" if k == 0 else f"drift of {drift.names[k]}, ns"
                error = abs(drift.change[k] / drift.trend[k]) * abs(change / drift.change[k])
                named.append(Suspect(words, abs(drift.trend[k]), change, error, np.nan, option, included=False))
            if drift.flickers:
                words = "flicker of the light, counts relative"
                named.append(Suspect(words, drift.flicker_z, drift.flicker, np.nan, np.nan, option, included=False))
        if p < min(self.level, FALSE_ALARM) and not any(not suspect.included for suspect in named):
            worst, z = _worst_cells(fitted)
            advice = "pulse='free', or returns=2" if worst.startswith("phases") else "no option of the model"
            named.append(Suspect(worst, z, np.nan, np.nan, np.nan, advice, included=False))
        centre = fitted.model.bounded(fitted.theta)
        cycles = int(np.clip(self.recording.exposure, 1, TOL.cycles))
        wave, error = self.wave or (None, None)
        if wave is not None and error is not None:
            wave, error = (float(centre[0] / wave.sum()) * part for part in (wave, error))
        others = [trial for trial in trials if fitted.p_value >= FALSE_ALARM and not trial.refuted]
        limits = tuple(_limit(trial, estimates, drift) for trial in others)
        for limit in limits:
            for name, (low, high) in limit.ranges.items():
                at = estimates[name]
                estimates[name] = replace(at, least=min(at.least, low), most=max(at.most, high))
        estimates = estimates if fitted.converged else {}
        known = bool(estimates) and self.recording.laser
        system = fitted.model.system(centre, cycles, 1024) if known else None
        flux = fitted.model.flux(centre) if known else None
        ordered = tuple(sorted(named, key=lambda suspect: (not suspect.included, -suspect.z)))
        look, recording = self.look, self.recording
        return Calibration(
            look, estimates, p, ordered, limits, drift, system, flux, wave, error, recording, fitted, self.level
        )


def _growth(fitted: Fitted, drift: Drift | None) -> FloatArray:
    """Factor (p,) on the errors: of the light, scatter of the parts of the recording over their errors; else 1."""
    out = np.ones(fitted.model.size)
    if drift is None:
        return out
    for k, name in enumerate(drift.names):
        if drift.drifts[k] or (k == 0 and drift.flickers):
            which = [i for i, own in enumerate(fitted.model.names[: fitted.model.light]) if (own == name) or k == 0]
            out[which] = np.maximum(out[which], drift.growth[k])
    return out


def _estimates(fitted: Fitted, growth: FloatArray) -> dict[str, Estimate]:
    """Estimates by name: the most probable values, with errors and intervals of draws; errors grow by `growth` (p,)."""
    model = fitted.model
    scale = growth[fitted.free]
    covariance = fitted.covariance * np.outer(scale, scale)
    drawn = draws(model, fitted.unbounded, covariance, fitted.free)
    centre, names = model.bounded(fitted.theta), model.names
    k = model.light
    free = {names[i] for i in fitted.free}
    grown = dict(zip(names, growth > 1.0, strict=True))  # the scatter of the parts includes a misfit
    misfit = "of a model that does not fit: no error is stated"
    withheld = {name: misfit for name in names if fitted.p_value < FALSE_ALARM and not grown[name]}
    errors = dict(zip(fitted.free.tolist(), np.sqrt(np.diag(covariance)), strict=True))
    if not withheld and not fitted.lit:  # there may be another pulse
        dark = "no significant pulse: no error is stated"
        withheld |= dict.fromkeys((*names[:k], "width", "jitter"), dark)
    if model.waveform is not None and "jitter" in free:  # which the shape follows
        withheld.setdefault("jitter", "beside light of free shape: no error is stated")
    extremes = _at_bounds(fitted, covariance, drawn) if model.split and "jitter" in free else []
    out: dict[str, Estimate] = {}

    def put(name: str, value: float, sample: FloatArray, *needs: str, note: str = "", limit: bool = False) -> None:
        if not free & set(needs):
            out[name] = Estimate(value, 0.0, value, value, "given")
            return
        if not withheld.keys().isdisjoint(needs):
            out[name] = Estimate(value, np.nan, np.nan, np.nan, next(withheld[own] for own in needs if own in withheld))
            return
        # near a bound of the angle the interval also covers the draws next to it
        parts = [sample, *(sample[rows] for rows in extremes)]
        ends = [np.quantile(part, (0.025, 0.975)) for part in parts]
        low, high = (0.0, np.quantile(sample, 0.95)) if limit else (np.min(ends), np.max(ends))
        out[name] = Estimate(value, float(((sample - value) ** 2).mean() ** 0.5), float(low), float(high), note)

    light = names[0] if model.returns else "light"  # all of it
    put(light, float(centre[0]), drawn[:, 0], names[0])
    for i in range(1, k):
        period = model.clock.period_ns
        value = float(centre[i] % period if names[i].startswith("delay") else centre[i])
        put(names[i], value, drawn[:, i] + (value - centre[i]), names[i])
    pulses, jitters = model.widths(drawn)
    pulse, jitter = map(float, model.widths(centre))
    note = "not detected" if "jitter" in free and fitted.unbounded[k + 1] < 2.0 * errors[k + 1] else ""
    if note and model.split and np.quantile(jitters, 0.975) > 0.985 * centre[k]:
        note = "not identified: any share of the recorded width"
    if model.gaussian:
        put("width_ns", float(centre[k]), drawn[:, k], "width")
        shared = note if note.startswith("not identified") else ""
        put("pulse_sigma_ns", pulse, pulses, "width", note=shared)
    put("jitter_ns", jitter, jitters, "jitter", note=note, limit=bool(note))  # equal tails would exclude zero
    at = k + 3
    dead, observed = drawn[:, k + 2], float(centre[k + 2])
    for effect in model.effects:
        columns = drawn[:, at : at + len(effect.names)].copy()
        values = centre[at : at + len(effect.names)]
        if effect.names[0] == "electronics_excess":
            put("electronics_dead_time_ns", observed, dead, "dead_time_ns")
            put("dead_time_ns", observed / (1.0 + float(values[0])), dead / (1.0 + columns[:, 0]), "electronics_excess")
        elif effect.names[0] == "afterpulse_probability":  # in the option's units, with those that the dead time hides
            after, delay = float(values[0]), float(np.exp(values[1]))
            columns[:, 1] = np.exp(columns[:, 1])
            carriers = np.array([all_carriers(*each) for each in np.c_[columns, dead]])
            put("afterpulse_probability", all_carriers(after, delay, observed), carriers, *effect.names)
            put("afterpulse_delay_ns", delay, columns[:, 1], effect.names[1])
            put("afterpulses_after_dead_time", after, columns[:, 0], "afterpulse_probability")
        elif not effect.onoff:
            put(effect.names[0], float(values[0]), columns[:, 0], effect.names[0])
        at += len(effect.names)
    if fitted.by_shortest is not None and "dead_time_ns" not in withheld:
        value, low, high = fitted.by_shortest
        out["dead_time_ns"] = Estimate(value, np.nan, low, high, "by the shortest interval alone")
    elif "dead_time_ns" not in out:
        put("dead_time_ns", observed, dead, "dead_time_ns")
    return {name: replace(own, least=own.low, most=own.high) for name, own in out.items()}


def _at_bounds(fitted: Fitted, covariance: FloatArray, drawn: FloatArray) -> list[NDArray[np.intp]]:
    """For each bound of the jitter angle within its 95 % interval: indices of the 5 % of draws next to that bound."""
    k, order = fitted.model.light + 1, np.argsort(drawn[:, fitted.model.light + 1])
    reach = 1.96 * float(np.sqrt(np.diag(covariance))[list(fitted.free).index(k)])
    most = float(fitted.model.bounded(np.where(np.arange(drawn.shape[1]) == k, np.pi, fitted.theta))[k])
    count, angle = len(order) // 20, float(fitted.unbounded[k])
    return [part for part, end in ((order[:count], 0.0), (order[-count:], most)) if abs(angle - end) < reach]


def _limit(trial: Trial, estimates: dict[str, Estimate], drift: Drift | None) -> Limit:
    """Upper limit of an effect that is not in the result, and the estimates of a fit with it where they differ."""
    name, words, final = trial.effect.names[0], trial.effect.words, trial.final
    if final is None or final.p_value < FALSE_ALARM:
        return Limit(name, words, float("nan"))
    sizes = draws(final.model, final.unbounded, final.covariance, final.free)[:, -len(trial.effect.names)]
    ranges = {}
    period = final.model.clock.period_ns
    for key, other in _estimates(final, _growth(final, drift)).items():
        own = estimates.get(key, other)
        turn = period * round((own.value - other.value) / period) if key.startswith("delay") else 0.0
        low, high = other.low + turn, other.high + turn
        if max(own.low - low, high - own.high) > (own.high - own.low) / 3.92:
            ranges[key] = low, high
    return Limit(name, words, float(np.quantile(sizes, 0.95)), ranges)


def _worst_cells(fitted: Fitted) -> tuple[str, float]:
    """The group of cells that fits worst, in words, and by how many standard deviations."""
    cells = fitted.batch.cells
    middle = cells.phases + cells.gap_edges.size + 1
    names, ends = (
        ("phases: shape of the light", "intervals", "intervals by phase"),
        (0, cells.phases, middle, cells.size),
    )
    worst, most = "", -np.inf
    for words, (first, end) in zip(names, pairwise(ends), strict=True):
        used = np.flatnonzero(fitted.offset[first:end] > 5.0) + first
        scale = fitted.fresh[:, used].std(0)
        drawn = ((fitted.fresh[:, used] / scale) ** 2).sum(1)
        z = (float(((fitted.rest[used] / scale) ** 2).sum()) - drawn.mean()) / drawn.std()
        if z > most:
            worst, most = words, float(z)
    return worst, most
