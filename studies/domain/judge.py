"""One case, every subject: predictions, engines, timestamps, and the comparisons among them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from mars_lidar import simulate
from mars_lidar._base.types import FloatArray
from studies.domain import simulator
from studies.domain.case import Case
from studies.domain.checks import (
    Check,
    against_law,
    covariance_of,
    mean_of,
    rare,
    two_samples,
    variances_of,
)
from studies.domain.predictions import TOLERANCE, Predictions
from studies.domain.records import recorded
from studies.domain.samples import Sample, Windows, collect, handed, simulated
from studies.domain.verdict import FAILED, HANDED, REFUSED, SLOW, UNJUDGED, VERIFIED, Outcome, refusal

LAW_SECONDS = 2.0  # a prediction that takes longer is slower than real use
EXPOSURE_SECONDS = 2.0  # likewise one exposure of one pixel
_NS = {"exact": 5e-9, "sequential": 16e-9}  # rough seconds of a registration, of an arrival
_LANES = 32  # exposures that the exact engine draws in the time of one
_NEEDS = {"cramer_rao": ("mean_histogram",), "mars": ("count_law", "mean_histogram"), "pmf": ("count_law",)}
_SLACK = {"feedback": 0.05, "auto": 0.05}  # standard deviations that the mean of a bin may be off (docs/feedback.md)
_OWN = 0.15  # arrivals that the sweep's own simulator may draw, over the registrations of an engine
_MARS_SECONDS = 0.03  # of its laws, beyond which engine "mars" is not asked for them again
ENGINES = ("exact", "sequential", "feedback", "auto", "mars")  # in order of drawing; each has a seed of its own
_PAIRS = (
    ("exact", "sequential"),
    ("exact", "simulator"),
    ("sequential", "simulator"),
    ("feedback", "exact"),
    ("auto", "exact"),
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
        for engine in ENGINES:
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
            simulate(case.flux(), case.system.replace(cycles=1), engine=engine, threads=1)  # claims it, or refuses
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
        sample = simulated(engine, case, items, self.seed + 1 + 1000 * ENGINES.index(engine), self.windows)
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
        cube = simulate(self.case.flux(), self.case.system.replace(cycles=cycles), threads=1, seed=self.seed + 99)
        return np.asarray(cube.reshape(-1).astype(np.float64) + 1e-9)

    def _handed(self, engine: str, items: int, per_exposure: float) -> int:
        """Exposures to draw with an engine that may give pixels to `exact`: few of those, many of its own."""
        cost = per_exposure * _NS["exact"] * _LANES
        if engine == "auto" and per_exposure <= 4 * self.case.system.bins:
            return min(items, 64)
        pixels = 1 if cost > 0.03 else 16
        report: dict[str, float] = {}
        case = self.case
        simulate(case.flux(pixels), case.system, engine=engine, threads=1, seed=self.seed, report=report)
        share = handed(report) / pixels
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
            results += mean_of(sample, oracle, "mean of the count", number, mean, variance, allowed)
            results += variances_of(sample, oracle, ["variance of the count"], number, variance)
        if laws.pmf is not None and (slack == 0.0 or sample.items < 200):
            results += against_law(sample, "pmf", *laws.pmf)
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
            results += mean_of(sample, "mean_histogram", "mean histogram", sample.cells, cells, variance, allowed)
        for low, high in self.case.rare:
            bins = self.case.system.bins
            first, last = int(np.ceil(low * bins)), int(np.floor(high * bins))
            inside = np.arange(first, last) % bins
            expected = float(mean[inside].sum()) * sample.items
            if slack == 0.0 and 0 < inside.size < bins // 2 and expected < 1e5:
                name = f"rare photons, {low:.4f} to {high:.4f}"
                results.append(rare(sample, "mean_histogram", name, int(sample.total[inside].sum()), expected))
        return results

    def _joint(self, sample: Sample, slack: float) -> list[Check]:
        laws = self.predicted
        assert laws.window_mean is not None
        assert laws.window_variance is not None
        sd = np.sqrt(laws.window_variance)
        allowed = 1e-3 * sd + slack * sd * 3.0 + 1e-6 * laws.window_mean
        x = sample.windows
        results = mean_of(
            sample, "joint_law", "mean of the windows", x, laws.window_mean, laws.window_variance, allowed
        )
        names = ["variance of the count", "variance of the window", "variance of the echo"]
        if slack == 0.0 or sample.items < 1000:
            results += variances_of(sample, "joint_law", names, x, laws.window_variance)
            pulse, echo = x[:, 1].astype(np.float64), x[:, 2].astype(np.float64)
            name = "covariance at the dead time"
            results += covariance_of(sample, "joint_law", name, pulse, echo, laws.echo_covariance)
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
        self.samples["simulator"] = collect("simulator", [drawn], self.windows)
        checks = self._against_predictions(self.samples["simulator"])
        self.outcomes.append(Outcome("simulator", VERIFIED, checks=checks))
        self.tell("simulator", "end")

    def _pairs(self) -> None:
        """Two-sample comparisons: exact and feedback with those that draw every arrival."""
        by_name = {outcome.subject: outcome for outcome in self.outcomes}
        for a, b in _PAIRS:
            if a in self.samples and b in self.samples and not self.samples[a].handed:
                if a in ("feedback", "auto") and self.samples[b].items > 400:
                    continue  # feedback states its own error, which many exposures would see
                checks = two_samples(self.samples[a], self.samples[b])
                for name in (a, b):
                    outcome = by_name[name]
                    if checks and outcome.state == UNJUDGED:
                        outcome.state = VERIFIED
                by_name[a].checks = by_name[a].checks + checks


class _Skipped(Exception):
    """A step that ended without numbers to compare, in the state given."""

    def __init__(self, state: str, why: str) -> None:
        super().__init__(why)
        self.state = state
