"""The harness itself: wrong engines are found, and by the right comparison; right ones raise no alarm.

False alarms of the second kind of test are counted like all others; the first kind shows power.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from harness.cases import PERIOD_NS, Case, flux_of, make_system
from harness.check import COUNTS, EVERYTHING, JOINT, SHAPE, compare
from harness.laws import JointLaw, Law, armed_count_pmf, constant_rate_moments, stationary_count_pmf
from harness.ledger import LEVEL, rejected, require
from harness.pvalues import bonferroni, goodness, mean_vector, merge, same_law, two_mean_vectors, variance_score
from harness.reference import Reference
from harness.sample import draw
from mars_lidar import Detector, Flux, GaussianPulse, count_law
from mars_lidar.engines import ENGINES, Engine
from mars_lidar.engines.engine import PhaseRecords, Records, Task

EXACT = ENGINES["exact"]
HISTOGRAMS = {COUNTS, SHAPE, JOINT}
MID = Case("mid", flux_of(2.0, 1.0), make_system(63.75, 100, 64, sigma_ns=1.5), 6000)
REPELLING = replace(MID, flux=flux_of(2.0, 5.0), system=MID.system.replace(detector=Detector(dead_time_ns=10.0)))


class Wrong(Engine):
    """The exact engine at a task that is not the one it was given."""

    name = "wrong"
    description = "for the tests of the harness"

    def mistake(self, task: Task) -> Task:
        return task

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        EXACT.histogram(self.mistake(task), out)

    def records(self, task: Task, expected: float) -> Records | PhaseRecords:
        return EXACT.records(self.mistake(task), expected)


class DeadTimeOff(Wrong):
    def mistake(self, task: Task) -> Task:
        dead = task.system.detector.dead_time_ns
        return replace(task, system=task.system.replace(detector=Detector(dead_time_ns=1.01 * dead)))


class HalfABinLate(Wrong):
    def mistake(self, task: Task) -> Task:
        flux = task.flux
        return replace(task, flux=Flux(flux.signal, flux.background, flux.delay_ns + 0.5 * task.system.bin_ns))


class WrongStart(Wrong):
    def mistake(self, task: Task) -> Task:
        other = {"armed": "stationary", "stationary": "armed"}[task.system.start]
        return replace(task, system=task.system.replace(start=other))


class WiderPulse(Wrong):
    def mistake(self, task: Task) -> Task:
        return replace(
            task, system=task.system.replace(pulse=GaussianPulse(sigma_ns=1.05 * task.system.pulse.sigma_ns))
        )


class OneCycleShort(Wrong):
    def mistake(self, task: Task) -> Task:
        return replace(task, system=task.system.replace(cycles=task.system.cycles - 1))


class RepeatedRealizations(Wrong):
    """Realization 2 k + 1 is realization 2 k again."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        half = replace(task, realizations=(task.realizations + 1) // 2)
        part = np.empty((half.items, out.shape[1]), out.dtype)
        EXACT.histogram(half, part)
        shape = (half.realizations, -1, out.shape[1])
        out[:] = np.repeat(part.reshape(shape), 2, axis=0)[: task.realizations].reshape(out.shape)


class CountTimesMultinomial(Wrong):
    """The right count and the right mean shape, the photons placed independently: what MaRS does."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        EXACT.histogram(task, out)
        shape = out.sum(0) / out.sum()
        out[:] = np.random.default_rng(task.seed).multinomial(out.sum(1, dtype=np.int64), shape)


class GaussianCounts(Wrong):
    """The right mean and variance of the count, rounded from a normal number."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        EXACT.histogram(task, out)
        total = out.sum(1)
        random = np.random.default_rng(task.seed)
        number = np.maximum(np.round(random.normal(total.mean(), total.std(), total.size)), 0).astype(int)
        out[:] = random.multinomial(number, out.sum(0) / out.sum())


class IndependentBins(Wrong):
    """The right mean histogram, Poisson bins: the literature's noise model."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        EXACT.histogram(task, out)
        out[:] = np.random.default_rng(task.seed).poisson(out.mean(0), out.shape)


def failures(engine: Engine, case: Case, claims: Collection[str] = EVERYTHING) -> set[str]:
    return rejected(compare(engine, case, EXACT, claims))


@pytest.mark.full
@pytest.mark.parametrize(
    ("engine", "case", "claims", "expected"),
    [
        (DeadTimeOff(), MID, EVERYTHING, {"mean histogram", "intervals"}),
        (DeadTimeOff(), REPELLING, EVERYTHING, {"count mean", "intervals"}),
        (HalfABinLate(), MID, EVERYTHING, {"mean histogram"}),
        (WrongStart(), MID, EVERYTHING, {"profile over the exposure"}),
        (WrongStart(), replace(MID, system=MID.system.replace(cycles=1)), HISTOGRAMS, {"count mean"}),
        (WiderPulse(), MID, EVERYTHING, {"mean histogram"}),
        (OneCycleShort(), MID, EVERYTHING, {"count mean", "profile over the exposure"}),
        (IndependentBins(), MID, HISTOGRAMS, {"count variance", "count law", "window"}),
        (RepeatedRealizations(), MID, HISTOGRAMS, {"independence"}),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, Engine) else "",
)
def test_wrong_engine_is_found(engine: Engine, case: Case, claims: Collection[str], expected: set[str]):
    assert expected <= failures(engine, case, claims)


@pytest.mark.parametrize("case", [replace(MID, items=24_000), REPELLING], ids=["repulsion 10 %", "repulsion 60 %"])
def test_faults_of_the_joint_law_are_found_there_only(case: Case):
    """Count x multinomial has the right counts and the right mean shape: only the joint law shows it."""
    expected = {"histogram variance", "window", "lag-1 covariance"}
    assert failures(CountTimesMultinomial(), case, HISTOGRAMS) == expected


@pytest.mark.parametrize(
    ("engine", "case", "expected"),
    [
        (CountTimesMultinomial(), replace(MID, items=24_000), {"window variance", "lag-1 covariance"}),
        (CountTimesMultinomial(), REPELLING, {"cell variance", "window variance", "lag-1 covariance"}),
        (DeadTimeOff(), REPELLING, {"count mean", "mean histogram"}),
        (WiderPulse(), MID, {"mean histogram"}),
        (OneCycleShort(), MID, {"count mean"}),
        (IndependentBins(), MID, {"count variance", "cell variance", "window variance", "lag-1 covariance"}),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, Engine) else "",
)
def test_wrong_engine_is_found_by_the_closed_form(engine: Engine, case: Case, expected: set[str]):
    wrong = rejected(compare(engine, case, JointLaw.of(case), HISTOGRAMS))
    assert expected <= wrong
    if isinstance(engine, CountTimesMultinomial):
        assert not wrong & {"count mean", "count variance", "mean histogram"}


def test_wrong_count_law_with_the_right_moments_is_found():
    case = replace(MID, flux=flux_of(0.05, 0.02), items=20_000)
    assert failures(GaussianCounts(), case, {COUNTS}) == {"count law"}


def test_dead_time_ignored_is_found():
    assert {"count mean", "mean histogram"} <= failures(ENGINES["poisson"], MID, HISTOGRAMS)


@pytest.mark.parametrize(
    ("engine", "name", "expected"),
    [
        (DeadTimeOff(), "s01_mid", {"count mean", "mean histogram"}),
        (HalfABinLate(), "s06_longdead", {"mean histogram"}),
        (CountTimesMultinomial(), "s05_shortdead", {"histogram variance", "window variance"}),
        (IndependentBins(), "s08_fewphotons", {"count law", "count variance"}),
        (OneCycleShort(), "s02_bright", {"count mean"}),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, Engine) else x if isinstance(x, str) else "",
)
def test_wrong_engine_is_found_by_the_reference(engine: Engine, name: str, expected: set[str]):
    reference = Reference.load(name)
    assert expected <= rejected(compare(engine, reference.case(), reference, HISTOGRAMS))


@pytest.mark.full
def test_no_more_false_alarms_than_stated():
    """The exact engine against itself, 60 times: no comparison has small p-values too often."""
    case = replace(MID, items=1000, system=MID.system.replace(cycles=30, bins=32))
    runs = [compare(EXACT, case, EXACT, EVERYTHING, seed) for seed in range(2, 62)]
    outcomes = {}
    for name in runs[0]:
        p = np.array([run[name] for run in runs])
        for level in (0.02, 0.2):
            outcomes[f"{name} below {level}"] = stats.binom.sf((p < level).sum() - 1, p.size, level)
    require(outcomes, "size of the harness")
    # chi-square, without Bonferroni's reserve: uniform, not only bounded
    p = stats.kstest([run["count law"] for run in runs], "uniform").pvalue
    require({"count law uniform": p}, "size of the harness")


def test_p_values_of_hotelling_are_uniform_for_correlated_bins():
    random = np.random.default_rng(1)
    mixing = random.normal(size=(12, 12)) @ np.diag(np.geomspace(1, 1e-3, 12))
    p = [two_mean_vectors(*(random.normal(size=(2, 300, 12)) @ mixing)) for _ in range(400)]
    q = [mean_vector(random.normal(size=(300, 12)) @ mixing, np.zeros(12)) for _ in range(400)]
    require({f"below {a}": stats.binom.sf((np.array(p + q) < a).sum() - 1, 800, a) for a in (0.01, 0.1)}, "Hotelling")
    assert np.mean(np.array(p) < 0.2) > 0.08  # Bonferroni costs at most half


def test_nothing_varies():
    """A count that never changes: equal is equal, and the smallest difference is not chance."""
    still = np.full((100, 3), 7)
    assert two_mean_vectors(still, still) == 1.0
    assert two_mean_vectors(still, still + 1) == 0.0
    assert mean_vector(still, still[0]) == 1.0
    assert mean_vector(still, still[0] + 1) < LEVEL
    total = np.random.default_rng(0).multinomial(50, [0.2, 0.3, 0.5], 200)  # the sum never changes
    other = np.random.default_rng(1).multinomial(51, [0.2, 0.3, 0.5], 200)
    assert two_mean_vectors(total[:100], total[100:]) > LEVEL
    assert two_mean_vectors(total, other) == 0.0


@pytest.mark.parametrize("variance", [None, 2e-6, 0.0])
def test_a_count_that_hardly_ever_changes(variance: float | None):
    """A locked pixel: all counts are equal, and equal to the prediction as far as they can tell."""
    still = np.full(6000, 1500)
    for mean in (1500.0, 1500.0 + 1e-8, 1500.0 + 2e-6, 1500.0 - 2e-6):  # rounding; one exposure of 500,000 differs
        assert mean_vector(still, mean, variance=variance) > 0.9
    for mean in (1500.02, 1499.98, 1501.0):  # 120 and more exposures should have differed
        assert mean_vector(still, mean, variance=variance) < LEVEL
    assert mean_vector(np.column_stack([still, still]), [1500.0, 1500.02]) < LEVEL
    beside = np.column_stack([still, np.random.default_rng(2).poisson(40.0, 6000)])
    assert mean_vector(beside, [1500.0 + 2e-6, 40.0]) > LEVEL
    assert mean_vector(beside, [1500.02, 40.0]) < LEVEL
    assert mean_vector(beside, [1500.0, 41.0]) < LEVEL


def test_a_variance_that_cannot_be_seen():
    still = np.full(6000, 1500)
    assert np.abs(variance_score(still, 2e-6)) < 0.1
    assert 2 * stats.norm.sf(np.abs(variance_score(still, 0.02))) < LEVEL
    beside = np.column_stack([still, np.random.default_rng(3).poisson(40.0, 6000)])
    assert np.all(np.abs(variance_score(beside, [2e-6, 40.0])) < 5)
    assert np.all(np.abs(variance_score(beside, [0.02, 44.0])) > 5)


@pytest.mark.parametrize(("dead", "differ"), [(0.9, 0), (0.893, 20)])
def test_a_locked_pixel_is_right_and_a_wrong_one_is_found(dead: float, differ: int):
    """So bright that counts repeat: the engine agrees with the exact law, and one period less does not."""
    locked = Case("locked", flux_of(0.0, 300.0), make_system(dead * PERIOD_NS, 60, 16, sigma_ns=1.5), 2000)
    exact = count_law(Flux(0.0, 300.0), locked.system)
    pmf = np.zeros(exact.support[-1] + 1)
    pmf[exact.support] = exact.pmf
    law = Law(count_pmf=pmf)
    counts = draw(EXACT, locked, 1).counts
    assert abs((counts != 67).sum() - differ) < 15
    require(compare(EXACT, locked, law, {COUNTS}), "locked pixel")
    assert "count mean" in rejected(compare(OneCycleShort(), locked, law, {COUNTS}))


def test_cells_are_merged_in_order():
    assert merge([5, 1, 1, 1, 1, 9, 1], 4).tolist() == [0, 1, 1, 1, 1, 2, 2]
    assert merge([1, 1], 40).tolist() == [0, 0]
    assert goodness([0, 10, 5], [0, 50.0, 50.0]) < LEVEL
    assert goodness([1, 10, 5], [0, 10.0, 6.0]) == 0.0  # what cannot happen has happened
    assert same_law([1000, 0], [0, 1000]) < LEVEL
    assert bonferroni([0.5, 0.01]) == 0.02


@pytest.mark.parametrize(("rate", "dead", "cycles"), [(1.0, 0.6375, 300), (3.0, 0.4, 200), (0.2, 2.0, 400)])
def test_closed_forms_agree_with_each_other(rate: float, dead: float, cycles: int):
    n = np.arange(int(rate * cycles / (1 + rate * dead) + 12 * np.sqrt(rate * cycles)))
    for pmf, stationary in ((armed_count_pmf, False), (stationary_count_pmf, True)):
        law = pmf(rate, dead, cycles, n.size - 1)
        mean, variance = constant_rate_moments(rate, dead, cycles, stationary=stationary)
        assert law.sum() == pytest.approx(1.0, abs=1e-9)
        assert law @ n == pytest.approx(mean, abs=1e-6)
        assert law @ (n - mean) ** 2 == pytest.approx(variance, abs=1e-4)
