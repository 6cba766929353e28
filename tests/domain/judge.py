"""One case, every subject: predictions, engines, timestamps, and the comparisons among them."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

import mars_lidar as ml
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import ConvergenceError, mean_histogram, photons_per_bin
from tests.domain import checks, simulator
from tests.domain.checks import FIRST_LEVEL, Check, Sample, Windows
from tests.domain.systems import PERIOD_NS, Case

_LIGHT = {"detection_efficiency", "dark_count_hz", "jitter", "code_density"}
_MOST = 20_000  # counts of a law that is written out


@dataclass(frozen=True, eq=False)
class Known:
    """Mean and variance of the count, as far as they are known, and P(N = 0), P(N = 1), ... where it is written out."""

    name: str
    mean: float
    variance: float | None = None
    pmf: NDArray[np.float64] | None = None


def known(case: Case) -> Known | None:
    """The closed form of the count of `case`, or None."""
    system, detector = case.system, case.system.detector
    if not set(detector.effects) <= _LIGHT or case.mode == "moving gate":
        return None
    dead, cycles, photons = system.dead_time_periods, system.cycles, case.photons
    if detector.mode == "gated" and (detector.gate_width_ns or 0.0) < PERIOD_NS:
        return None
    if photons == 0.0:
        return Known("darkness", 0.0, 0.0, np.ones(1))
    if detector.mode == "synchronous":
        if dead > 0.0:
            return None
        return _of(stats.binom(cycles, -np.expm1(-photons)), "Binomial")
    if dead == 0.0:
        return _of(stats.poisson(cycles * photons), "Poisson")
    if detector.mode == "paralyzable":
        return _paralyzable(case) if _constant(case) else None
    if dead >= cycles and system.start == "armed":
        return _of(stats.bernoulli(-np.expm1(-photons * cycles)), "one at most")
    return _constant_rate(case) if _constant(case) else None


def _of(law: object, name: str) -> Known:
    mean, variance = (float(x) for x in law.stats())  # type: ignore[attr-defined]
    wide = mean + 12.0 * np.sqrt(variance) + 30.0
    pmf = law.pmf(np.arange(int(wide))) if wide < _MOST else None  # type: ignore[attr-defined]
    return Known(name, mean, variance, pmf)


def _constant(case: Case) -> bool:
    """Whether the rate does not change over the period."""
    return case.strongest == 0.0 or (case.waveform is not None and bool(np.ptp(case.waveform) == 0.0))


def _paralyzable(case: Case) -> Known:
    rate, dead, cycles = case.photons, case.system.dead_time_periods, case.system.cycles
    if case.system.start == "stationary":
        return Known("paralyzable, constant rate", cycles * rate * float(np.exp(-rate * dead)))
    early = min(dead, cycles)
    mean = -np.expm1(-rate * early) + max(0.0, cycles - dead) * rate * np.exp(-rate * dead)
    return Known("paralyzable, constant rate", float(mean))


def _constant_rate(case: Case) -> Known | None:
    """Armed: P(N >= n) = P(Gamma(n) <= rate (t - (n - 1) dead)). Stationary: its mean."""
    rate, dead, cycles = case.photons, case.system.dead_time_periods, case.system.cycles
    if case.system.start == "stationary":
        return Known("constant rate", cycles * rate / (1.0 + rate * dead))
    most = int(cycles / dead) + 1
    if most > _MOST and cycles * rate > _MOST:
        return None
    n = np.arange(1, min(most, int(cycles * rate + 12.0 * np.sqrt(cycles * rate) + 30.0)) + 1)
    remaining = cycles - (n - 1) * dead
    reach = np.where(remaining > 0.0, special.gammainc(n, np.maximum(rate * remaining, 0.0)), 0.0)
    at_least = np.concatenate([[1.0], reach, [0.0]])
    pmf = at_least[:-1] - at_least[1:]
    mean = float(reach.sum())
    second = float(((2 * n - 1) * reach).sum())
    return Known("constant rate", mean, max(second - mean**2, 0.0), np.maximum(pmf, 0.0))


TOLERANCE = 1e-4  # of `count_law` and `mean_histogram`: their default
AGREE = 2e-3  # standard deviations, relative variance, total variation that two predictions may differ by
_QUICK_JOINT = 8.0  # photons in a dead time up to which `joint_law` takes milliseconds
_QUICK_SECONDS = 0.1  # of `joint_law`, up to which it is asked for very many windows too
_WIDEST = 2_000_000  # counts of a pmf that is kept


class Predictions:
    """What the predictions say of one case: filled step by step, None where they refused or were not asked."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.known = known(case)
        self.law: ml.CountLaw | None = None
        self.pmf: tuple[int, FloatArray] | None = None
        self.histogram: FloatArray | None = None
        self.joint: ml.JointLaw | None = None
        self.windows: Windows | None = None
        self.window_mean: FloatArray | None = None
        self.window_variance: FloatArray | None = None
        self.cell_variance: FloatArray | None = None
        self.echo_covariance = 0.0

    def steps(self) -> list[tuple[str, Callable[[], list[Check]]]]:
        """Names and calls, in order; each returns its comparisons with what is known so far."""
        steps = [
            ("count_law", self._count_law),
            ("pmf", self._pmf),
            ("mean_histogram", self._histogram),
            ("stationary shape", self._stationary),
        ]
        if self._joint_asked:
            steps.append(("joint_law", self._joint))
        single = self.case.waveform is None and len(self.case.signal) == 1
        if single and self.case.number % 6 == 0:  # a mean histogram and some algebra
            steps.append(("cramer_rao", self._bound))
        return steps

    @property
    def _joint_asked(self) -> bool:
        """Everywhere it is quick, and every fourth system elsewhere, to see whether it is."""
        case = self.case
        quick = case.photons * case.system.dead_time_periods <= _QUICK_JOINT and case.system.bins <= 4096
        return quick or case.number % 4 == 0

    def mean(self) -> FloatArray | None:
        """Mean histogram (bins,), whichever prediction has it."""
        return self.histogram if self.histogram is not None else None if self.joint is None else self.joint.mean

    def _count_law(self) -> list[Check]:
        law = ml.count_law(self.case.flux()[0, 0], self.case.system, threads=1)
        self.law = law
        results = [_sane("count_law", bool(np.isfinite(law.cumulants).all() and law.mean >= 0 and law.variance >= 0))]
        if self.known is not None:
            sd = np.sqrt(self.known.variance or 0.0) or 1.0
            size = max(sd, 1e-4 * self.known.mean, 1e-12)
            results.append(_agree("count_law", "closed form", "mean of the count", (law.mean - self.known.mean) / size))
            if self.known.variance is not None and self.known.variance > 1e-9 * max(self.known.mean, 1e-9):
                off = law.variance / self.known.variance - 1.0
                results.append(_agree("count_law", "closed form", "variance of the count", off))
        return results

    def _pmf(self) -> list[Check]:
        if self.law is None:
            return []
        pmf = np.asarray(self.law.pmf)
        support = self.law.support
        sd = max(float(np.sqrt(self.law.variance)), 1e-6)
        off = support - float(self.law.mean)  # of the mean, which may be 1e8, to parts of a count
        mean = float(pmf @ off)
        variance = float(pmf @ (off - mean) ** 2)
        results = [
            _sane("pmf", bool(np.isfinite(pmf).all() and pmf.min() > -1e-9)),
            _agree("pmf", "count_law", "total", pmf.sum() - 1.0),
            _agree("pmf", "count_law", "mean of the count", mean / max(sd, 1e-3)),
        ]
        if self.law.variance > 1e-6:
            results.append(
                _agree("pmf", "count_law", "variance of the count", variance / float(self.law.variance) - 1.0)
            )
        if self.known is not None and self.known.pmf is not None:
            wide = max(int(support[-1]) + 1, self.known.pmf.size)
            mine, theirs = np.zeros(wide), np.zeros(wide)
            mine[support], theirs[: self.known.pmf.size] = pmf, self.known.pmf
            results.append(_agree("pmf", "closed form", "law of the count", 0.5 * float(np.abs(mine - theirs).sum())))
        if pmf.size <= _WIDEST:
            self.pmf = int(support[0]), np.maximum(pmf, 0.0)
        return results

    def _histogram(self) -> list[Check]:
        mean = np.asarray(mean_histogram(self.case.flux()[0, 0], self.case.system, threads=1))
        self.histogram = mean
        self.windows = Windows.of(self.case, mean)
        least = float(mean.min(initial=0.0))
        results = [
            _sane("mean_histogram", bool(np.isfinite(mean).all() and least >= -1e-9 * max(1.0, float(mean.max()))))
        ]
        if self.law is not None:
            results.append(_agree("mean_histogram", "count_law", "mean of the count", self._in_sd(float(mean.sum()))))
        return results

    def _stationary(self) -> list[Check]:
        case = self.case
        shape = np.asarray(ml.registration_pdf(case.flux()[0, 0], case.system, "stationary", threads=1))
        results = [_sane("stationary shape", bool(np.isfinite(shape).all() and abs(shape.sum() - 1.0) < 1e-6))]
        dead = case.system.dead_time_periods
        plain = case.mode == "nonparalyzable" and not case.system.detector.effects
        if plain and dead == round(dead) and case.photons > 0.0:
            flat = photons_per_bin(case.flux()[0, 0], case.system, bins=case.system.bins)
            off = 0.5 * float(np.abs(shape - flat / flat.sum()).sum())
            results.append(_agree("stationary shape", "closed form", "shape", off))
        ready = "electronics_dead_time_ns" in case.system.detector.effects  # electronics begin ready: not stationary
        begins_stationary = case.system.start == "stationary" and not ready
        if begins_stationary and self.histogram is not None and self.histogram.sum() > 0.0:
            observed = self.histogram / self.histogram.sum()
            off = 0.5 * float(np.abs(shape - observed).sum())
            results.append(_agree("stationary shape", "mean_histogram", "shape", off))
        return results

    def _joint(self) -> list[Check]:
        began = time.process_time()
        joint = ml.joint_law(self.case.flux()[0, 0], self.case.system)
        took = time.process_time() - began
        self.joint = joint
        if self.windows is None:
            self.windows = Windows.of(self.case, joint.mean)
        weights = self.windows.weights.astype(np.float64)
        self.window_mean, self.window_variance = joint.window(weights)
        # a window of many cells takes as long as the law where the exposure is run through: that is not the law's time
        if took < _QUICK_SECONDS and max(joint.grid_bins, joint.mean.size) * self.windows.edges.size <= 4_000_000:
            self.cell_variance = joint.window(self.windows.cells().astype(np.float64))[1]
        self.echo_covariance = float(joint.covariance_of(weights[1], weights[2]))
        results = [_sane("joint_law", bool(np.isfinite(joint.mean).all() and np.isfinite(self.window_variance).all()))]
        if self.law is not None:
            results.append(_agree("joint_law", "count_law", "mean of the count", self._in_sd(joint.count_mean)))
            variance = float(self.law.variance)
            if variance > 1e-6 * max(1.0, float(self.law.mean)):
                off = self.window_variance[0] / variance - 1.0
                results.append(_agree("joint_law", "count_law", "variance of the count", off))
        if self.histogram is not None and self.histogram.sum() > 0.0:
            off = 0.5 * float(np.abs(self.histogram - joint.mean).sum() / self.histogram.sum())
            results.append(_agree("joint_law", "mean_histogram", "mean histogram", off))
        return results

    def _bound(self) -> list[Check]:
        bound = ml.cramer_rao(self.case.flux()[0, 0], self.case.system, threads=1)
        errors = np.array([bound.signal, bound.background, bound.delay_ns], dtype=np.float64)
        return [_sane("cramer_rao", bool((errors > 0.0).all() and np.isfinite(bound.information).all()))]

    def _in_sd(self, mean: float) -> float:
        assert self.law is not None
        sd = float(np.sqrt(max(float(self.law.variance), 0.0)))
        return (mean - float(self.law.mean)) / max(sd, 1e-3 * float(self.law.mean), 1e-9)


def _agree(a: str, b: str, what: str, off: Any) -> Check:
    """Agreement of two numbers whose scaled difference is `off`."""
    return Check(a, b, what, 1.0 if abs(float(off)) <= AGREE else 0.0, float(off))


def _sane(name: str, fine: bool) -> Check:
    """Numbers that are numbers: finite, not negative."""
    return Check(name, name, "finite and not negative", 1.0 if fine else 0.0, 0.0)


_INSPECTED = 3e5  # registrations that are looked at one by one
_LATTICE = 17  # bits of a period behind which phases are still to be even
_CELLS = 16


def recorded(case: Case, seed: int, budget: float) -> list[Check]:
    """Checks of `simulate_timestamps` with the exact engine: order, dead time, exposure, histogram, fine phases."""
    if case.registrations() > _INSPECTED:
        return []
    if case.mode == "paralyzable" and case.photons * case.system.cycles > 5 * _INSPECTED:
        return []
    pixels = int(np.clip(min(budget / max(case.registrations(), 1e-6), 2**22 / case.system.bins), 1, 64))
    flux, system = case.flux(pixels), case.system
    if case.mode in ("gated", "moving gate") and system.cycles * min(1.0, case.photons) * pixels > 10 * _INSPECTED:
        return []
    times = ml.simulate_timestamps(flux, system, seed=seed, threads=1)
    cube = ml.simulate(flux, system, seed=seed, threads=1).reshape(pixels, system.bins)
    owner = np.repeat(np.arange(pixels), np.diff(times.offsets))
    binned = np.bincount(owner * system.bins + times.bin, minlength=cube.size).reshape(cube.shape)
    t = times.times_ns / PERIOD_NS
    blurred = bool({"jitter", "code_density"} & set(system.detector.effects))
    least = max(system.dead_time_periods, system.electronics_dead_time_periods)
    facts = {
        "histogram of the timestamps": bool((binned == cube).all()),
        "times inside of the exposure": bool((t >= 0.0).all() and (t < system.cycles).all()),
        "times in order": bool((np.diff(t)[np.diff(owner) == 0] >= 0.0).all()),
        "dead time kept": blurred or bool((np.diff(t)[np.diff(owner) == 0] >= least * (1.0 - 1e-12) - 2.5e-7).all()),
        "no bin above the most that fits": bool(cube.max(initial=0) <= system.max_bin_count),
        "registrations in the gate": blurred
        or system.detector.mode != "gated"
        or bool((case.since_gate(t, early=2.5e-7) <= case.gate_width + 5e-7).all()),
    }
    results = [Check("timestamps", "timestamps", name, 1.0 if fine else 0.0, 0.0) for name, fine in facts.items()]
    return results + _lattice(case, t, owner)


def _lattice(case: Case, t: NDArray[np.float64], owner: NDArray[np.int64]) -> list[Check]:
    """Phases of smooth light are even on the scale of 2^-17 period: first registrations, and all of them."""
    spoiled = {"jitter", "code_density", "max_events_per_exposure"} & set(case.system.detector.effects)
    narrow = case.strongest > 0.0 and getattr(case.system.pulse, "sigma_ns", 0.0) < 1e-3 * PERIOD_NS
    if case.waveform is not None or spoiled or narrow or case.mode in ("gated", "moving gate", "synchronous"):
        return []
    fine = (t * 2.0**_LATTICE) % 1.0
    first = np.diff(owner, prepend=-1) != 0
    results = []
    for name, x in (("fine phases", fine), ("fine phases of the first", fine[first])):
        # a registration at the end of a dead time keeps its distance to the one before: the first only, or dim light
        if x.size < 40 * _CELLS or (name == "fine phases" and case.photons * case.system.dead_time_periods > 0.1):
            continue
        observed = np.bincount((x * _CELLS).astype(int), minlength=_CELLS)
        expected = x.size / _CELLS
        p = float(stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), _CELLS - 1))
        results.append(Check("timestamps", "closed form", name, p, float(np.abs(observed / expected - 1.0).max())))
    return results


VERIFIED, REFUSED, HANDED = "verified", "refused", "given to exact"
SLOW, FAILED, UNJUDGED = "slower than real use", "failed", "not judged"
STATES = (VERIFIED, HANDED, REFUSED, SLOW, UNJUDGED, FAILED)
ENGINES = ("exact", "feedback", "auto", "mars", "sequential")
LAWS = ("count_law", "pmf", "mean_histogram", "stationary shape", "joint_law", "cramer_rao")
SUBJECTS = (*ENGINES, "timestamps", *LAWS)
_SUSPECTS = (
    *("feedback", "auto", "mars", "cramer_rao", "stationary shape", "pmf", "joint_law", "mean_histogram", "count_law"),
    *("timestamps", "exact", "sequential", "simulator", "closed form"),
)
_ADVICE = re.compile(
    r"\b(use|engines?|instead|simulat\w*|give|take|methods?|shorter|fewer|must|at most|at least|mode)\b", re.IGNORECASE
)

FAMILY_LEVEL = 1e-3  # of the sweep: both drawings of a check reject


@dataclass
class Outcome:
    """What one subject did in a case."""

    subject: str
    state: str
    seconds: float = 0.0
    note: str = ""
    checks: list[Check] = field(default_factory=list)


def refusal(error: BaseException) -> bool:
    """Whether an exception says what to do, as a refusal has to."""
    return isinstance(error, (ValueError, MemoryError, ConvergenceError)) and bool(_ADVICE.search(str(error)))


def blamed(failing: list[Check]) -> dict[str, list[Check]]:
    """Checks by the party at fault: whoever is in most of the failing pairs, again and again until none is left.

    Of two that stand alone against each other it is the one further from first principles (`_SUSPECTS`, in order).
    """
    remaining, result = list(failing), {}
    while remaining:
        times = Counter(name for check in remaining for name in {check.a, check.b})
        pairs = {name: len({frozenset((c.a, c.b)) for c in remaining if name in (c.a, c.b)}) for name in times}
        worst = min(times, key=lambda name: (-pairs[name], (*_SUSPECTS, name).index(name)))
        result[worst] = [check for check in remaining if worst in (check.a, check.b)]
        remaining = [check for check in remaining if worst not in (check.a, check.b)]
    return result


def second_level(checks: int) -> float:
    """Level of the second drawing, so that `checks` true hypotheses all survive with probability 1 - `FAMILY_LEVEL`."""
    return FAMILY_LEVEL / (max(checks, 1) * FIRST_LEVEL)


LAW_SECONDS = 2.0  # a prediction that takes longer is slower than real use
EXPOSURE_SECONDS = 2.0  # likewise one exposure of one pixel
_NS = {"exact": 5e-9, "sequential": 16e-9}  # rough seconds of a registration, of an arrival
_LANES = 32  # exposures that the exact engine draws in the time of one
_NEEDS = {"cramer_rao": ("mean_histogram",), "mars": ("count_law", "mean_histogram"), "pmf": ("count_law",)}
_SLACK = {"feedback": 0.05, "auto": 0.05}  # standard deviations that the mean of a bin may be off (docs/feedback.md)
_OWN = 0.15  # arrivals that the sweep's own simulator may draw, over the registrations of an engine
_MARS_SECONDS = 0.03  # of its laws, beyond which engine "mars" is not asked for them again
_DRAWN = ("exact", "sequential", "feedback", "auto", "mars")  # in order of drawing; each has a seed of its own
_PAIRS = tuple(
    pair.split()
    for pair in ("exact sequential", "exact simulator", "sequential simulator", "feedback exact", "auto exact")
)
Tell = Callable[[str, str], None]


@dataclass(frozen=True)
class Budget:
    """How much is drawn for a case: `registrations` by an engine, `cells` of histograms (exposures x bins)."""

    registrations: float
    cells: float
    exposures: int

    def times(self, factor: int) -> Budget:
        """A larger budget."""
        return Budget(self.registrations * factor, self.cells * factor, self.exposures * factor)


def judge(case: Case, seed: int, budget: Budget, tell: Tell, skip: Collection[str] = ()) -> list[Outcome]:
    """All outcomes of a case.

    `tell(subject, "begin" | "end")` lets a watchman see what takes too long; `skip`: subjects that were stopped before.
    """
    return _Judge(case, seed, budget, tell, skip).run()


class _Judge:
    def __init__(self, case: Case, seed: int, budget: Budget, tell: Tell, skip: Collection[str]) -> None:
        self.case, self.seed, self.budget, self.tell, self.skip = case, seed, budget, tell, skip
        self.outcomes: list[Outcome] = []
        self.predicted = Predictions(case)
        self.samples: dict[str, Sample] = {}
        self.windows: Windows | None = None

    def run(self) -> list[Outcome]:
        for name, step in self.predicted.steps():
            if name == "pmf" and self.predicted.law is None and "count_law" not in self.skip:
                continue
            self._attempt(name, step, LAW_SECONDS)
        mean = self.predicted.mean()
        self.windows = self.predicted.windows
        if self.windows is None and mean is not None:
            self.windows = Windows.of(self.case, mean)
        for engine in _DRAWN:
            if engine == "auto" and self.case.number % 2:
                continue  # it draws with the other two: every second system
            self._attempt(engine, lambda engine=engine: self._engine(engine), np.inf)  # type: ignore[misc]
        self._attempt("timestamps", lambda: recorded(self.case, self.seed, 0.25 * self.budget.registrations), np.inf)
        if self.windows is not None and "simulator" not in self.skip:
            self._own()
        self._pairs()
        return self.outcomes

    def _attempt(self, subject: str, call: Callable[[], list[Check]], limit: float) -> None:
        """Run one step and keep what became of it."""
        if subject in self.skip:
            return
        outcome = Outcome(subject, UNJUDGED)
        self.outcomes.append(outcome)
        needed = _NEEDS.get(subject, ())
        if stopped := [name for name in needed if name in self.skip]:
            outcome.state, outcome.note = SLOW, f"needs {stopped[0]}, which is"
            return
        if subject == "mars" and sum(o.seconds for o in self.outcomes if o.subject in needed) > _MARS_SECONDS:
            outcome.note = "not asked: its laws were judged, and take long"
            return
        self.tell(subject, "begin")
        began = time.process_time()
        try:
            outcome.checks = call()
            if outcome.checks:
                outcome.state = VERIFIED
        except _Skipped as why:
            outcome.state, outcome.note = why.state, str(why)
        except Exception as error:
            outcome.state = REFUSED if refusal(error) else FAILED
            outcome.note = f"{type(error).__name__}: {error}"[:400]
        outcome.seconds = time.process_time() - began
        if outcome.state in (VERIFIED, UNJUDGED) and outcome.seconds > limit:
            outcome.state, outcome.note = SLOW, f"{outcome.seconds:.1f} s of processor time"
        self.tell(subject, "end")

    def _engine(self, engine: str) -> list[Check]:
        """Draw, and compare with the predictions."""
        case, per_exposure = self.case, self.case.registrations()
        if engine != "exact" and engine != "sequential":
            ml.simulate(case.flux(), case.system.replace(cycles=1), engine=engine, threads=1)  # claims it, or refuses
        # before a stationary exposure the sequential engine draws so many periods
        early = 320.0 * (case.system.dead_time_periods + 1.0) if case.system.start == "stationary" else 0.0
        arrivals = case.photons * (case.system.cycles + early)
        events = arrivals if engine == "sequential" or case.mode == "paralyzable" else per_exposure
        if case.mode in ("gated", "moving gate"):
            events = max(events, min(arrivals, case.system.cycles))
        seconds = events * (_NS["sequential"] if engine == "sequential" else _NS["exact"] * _LANES)
        if engine in ("exact", "sequential") and seconds > EXPOSURE_SECONDS:
            raise _Skipped(SLOW, f"an exposure takes some {seconds:.3g} s")
        items = self._items(events)
        if engine in ("feedback", "auto"):
            items = self._handed(engine, items, per_exposure)
        if self.windows is None:
            self.windows = Windows.of(case, self._pilot())
        sample = checks.simulated(engine, case, items, self.seed + 1 + 1000 * _DRAWN.index(engine), self.windows)
        if sample.counts.sum() > 0 or items * per_exposure > 30:
            self.samples[engine] = sample
        if engine in ("feedback", "auto") and sample.handed >= 1.0:
            raise _Skipped(HANDED, "report: pixels given to exact")
        return self._against_predictions(sample)

    def _items(self, events: float) -> int:
        budget, bins = self.budget, self.case.system.bins
        return int(np.clip(min(budget.registrations / max(events, 1e-9), budget.cells / bins), 1, budget.exposures))

    def _pilot(self) -> FloatArray:
        """Roughly the mean histogram where nothing predicts it: a few short exposures."""
        cycles = int(np.clip(1e5 / max(self.case.photons, 1e-9), 1, self.case.system.cycles))
        cube = ml.simulate(self.case.flux(), self.case.system.replace(cycles=cycles), threads=1, seed=self.seed + 99)
        return np.asarray(cube.reshape(-1).astype(np.float64) + 1e-9)

    def _handed(self, engine: str, items: int, per_exposure: float) -> int:
        """Exposures to draw with an engine that may give pixels to `exact`: few of those, many of its own."""
        cost = per_exposure * _NS["exact"] * _LANES
        if engine == "auto" and per_exposure <= 4 * self.case.system.bins:
            return min(items, 64)
        pixels = 1 if cost > 0.03 else 16
        report: dict[str, float] = {}
        case = self.case
        ml.simulate(case.flux(pixels), case.system, engine=engine, threads=1, seed=self.seed, report=report)
        share = checks.handed(report) / pixels
        if share >= 1.0 and cost > EXPOSURE_SECONDS:
            raise _Skipped(HANDED, "report: pixels given to exact")
        if share > 0.0:
            return min(items, 64)
        parts = 0 if self.case.waveform is None else self.case.waveform.size
        per = max(self.case.system.bins, parts, 2000.0)
        return int(np.clip(0.15 * self.budget.cells / per, 1, 0.5 * self.budget.exposures))

    def _against_predictions(self, sample: Sample) -> list[Check]:
        laws, results, engine = self.predicted, [], sample.engine
        slack = _SLACK.get(engine, 0.0)
        joint_claimed = engine != "mars"
        number = sample.windows[:, :1]
        for oracle, law in (("count_law", laws.law), ("closed form", laws.known)):
            if law is None or law.variance is None:
                continue
            mean, variance = np.array([float(law.mean)]), np.array([float(law.variance)])
            allowed = (slack + TOLERANCE) * np.sqrt(variance) + (2e-6 * mean + 0.03) * (slack > 0.0)
            results += checks.mean_of(sample, oracle, "mean of the count", number, mean, variance, allowed)
            results += checks.variances_of(sample, oracle, ["variance of the count"], number, variance)
        if laws.pmf is not None and (slack == 0.0 or sample.items < 200):
            results += checks.against_law(sample, "pmf", *laws.pmf)
        if laws.histogram is not None and self.windows is not None:
            results += self._histogram(sample, laws.histogram, slack)
        if laws.joint is not None and laws.window_variance is not None and joint_claimed:
            results += self._joint(sample, slack)
        return results

    def _histogram(self, sample: Sample, mean: FloatArray, slack: float) -> list[Check]:
        """Cells of the mean histogram, with the joint law's variances or else those of the sample; rare windows."""
        assert self.windows is not None
        cells = np.add.reduceat(mean, self.windows.edges)
        variance = self.predicted.cell_variance
        if variance is None or sample.engine == "mars":
            scatter = sample.cells.var(0, ddof=1) if sample.items >= 50 else None
            variance = np.maximum(scatter, cells / sample.items) if scatter is not None else None
        results = []
        if variance is not None:
            allowed = slack * np.sqrt(variance) * np.sqrt(10.0 * (slack > 0) + 1.0) + 0.2 * TOLERANCE * cells.sum()
            results += checks.mean_of(
                sample, "mean_histogram", "mean histogram", sample.cells, cells, variance, allowed
            )
        for low, high in self.case.rare:
            bins = self.case.system.bins
            first, last = int(np.ceil(low * bins)), int(np.floor(high * bins))
            inside = np.arange(first, last) % bins
            expected = float(mean[inside].sum()) * sample.items
            if slack == 0.0 and 0 < inside.size < bins // 2 and expected < 1e5:
                name = f"rare photons, {low:.4f} to {high:.4f}"
                results.append(checks.rare(sample, "mean_histogram", name, int(sample.total[inside].sum()), expected))
        return results

    def _joint(self, sample: Sample, slack: float) -> list[Check]:
        laws = self.predicted
        assert laws.window_mean is not None
        assert laws.window_variance is not None
        sd = np.sqrt(laws.window_variance)
        allowed = 1e-3 * sd + slack * sd * 3.0 + 1e-6 * laws.window_mean
        x = sample.windows
        results = checks.mean_of(
            sample, "joint_law", "mean of the windows", x, laws.window_mean, laws.window_variance, allowed
        )
        names = ["variance of the count", "variance of the window", "variance of the echo"]
        if slack == 0.0 or sample.items < 1000:
            results += checks.variances_of(sample, "joint_law", names, x, laws.window_variance)
            pulse, echo = x[:, 1].astype(np.float64), x[:, 2].astype(np.float64)
            name = "covariance at the dead time"
            results += checks.covariance_of(sample, "joint_law", name, pulse, echo, laws.echo_covariance)
        return results

    def _own(self) -> None:
        """The sweep's own simulator, where it is cheap."""
        each = max(simulator.arrivals(self.case), 1e-9)
        items = int(min(_OWN * self.budget.registrations / each, 2000, self.budget.cells / 10 / self.case.system.bins))
        if not simulator.able(self.case) or items < 20 or each > 3000:
            return
        assert self.windows is not None
        self.tell("simulator", "begin")
        drawn = simulator.counts(self.case, items, self.seed + 5)
        self.samples["simulator"] = checks.collect("simulator", [drawn], self.windows)
        compared = self._against_predictions(self.samples["simulator"])
        self.outcomes.append(Outcome("simulator", VERIFIED, checks=compared))
        self.tell("simulator", "end")

    def _pairs(self) -> None:
        """Two-sample comparisons: exact and feedback with those that draw every arrival."""
        by_name = {outcome.subject: outcome for outcome in self.outcomes}
        for a, b in _PAIRS:
            if a in self.samples and b in self.samples and not self.samples[a].handed:
                if a in ("feedback", "auto") and self.samples[b].items > 400:
                    continue  # feedback states its own error, which many exposures would see
                compared = checks.two_samples(self.samples[a], self.samples[b])
                for name in (a, b):
                    outcome = by_name[name]
                    if compared and outcome.state == UNJUDGED:
                        outcome.state = VERIFIED
                by_name[a].checks = by_name[a].checks + compared


class _Skipped(Exception):
    """A step that ended without numbers to compare, in the state given."""

    def __init__(self, state: str, why: str) -> None:
        super().__init__(why)
        self.state = state
