"""The sweep of the declared domain: what it draws, that it finds what is wrong, and its quick form with fixed seeds."""

from __future__ import annotations

import time

import numpy as np
import pytest
from harness import make_system
from scipy import stats

import mars_lidar as ml
from mars_lidar.instrument.effects import EFFECTS
from mars_lidar.reconstruction.histogram_bound import _variances
from mars_lidar.statistics import ConvergenceError
from tests.domain import judge as judging
from tests.domain.__main__ import main
from tests.domain.checks import Check, Windows, neighbours, simulated, two_samples
from tests.domain.judge import Budget, judge, known
from tests.domain.sweep import Settings, Watched, judge_case
from tests.domain.systems import FAMILIES, MOVING, PERIOD_NS, Case, draw
from tests.harness.study import written


def pixel(signal: float = 1.0, background: float = 0.5, dead: float = 0.4, cycles: int = 100, **more: object) -> Case:
    system = make_system(dead * PERIOD_NS, cycles, 32, **more)
    return Case("by hand/0", "any", system, (signal,), (0.3,), background)


def silent(subject: str, what: str) -> None:
    """A watchman who does not watch."""


def test_systems_are_functions_of_their_number_and_reach_the_ends() -> None:
    facts = [draw(7, k).facts() for k in range(600)]
    assert facts[17] == draw(7, 17).facts()
    assert facts[17] != draw(8, 17).facts()
    ends = {"S": (0.0, 100.0), "B": (0.0, 100.0), "dead": (0.0, 1e4), "cycles": (1, 5e7), "bins": (1, 2e5)}
    for key, (least, most) in ends.items():
        assert min(f[key] for f in facts) == least, key
        assert max(f[key] for f in facts) > most, key
    assert {f["family"] for f in facts} == set(FAMILIES)
    assert {f["mode"] for f in facts} == {"nonparalyzable", "paralyzable", "synchronous", "gated", MOVING}
    assert {f["start"] for f in facts} == {"armed", "stationary"}
    assert set(" ".join(f["effects"] for f in facts).split()) == set(EFFECTS) - {"crosstalk"}


def test_a_right_engine_passes_and_wrong_ones_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Engine "poisson", which knows no dead time, called "exact": every kind of comparison sees it."""
    case, budget = pixel(), Budget(2e5, 1e6, 2000)
    outcomes = judge(case, 1, budget, silent)
    assert {o.subject for o in outcomes} >= set(judging.SUBJECTS)
    assert {o.state for o in outcomes if o.subject != "cramer_rao"} <= {
        judging.VERIFIED,
        judging.HANDED,
        judging.UNJUDGED,
    }
    assert min(c.p for o in outcomes for c in o.checks) > 1e-4
    monkeypatch.setattr(
        judging.checks,
        "simulated",
        lambda engine, *rest: _called(simulated("poisson" if engine == "exact" else engine, *rest), engine),
    )
    wrong = [c for o in judge(case, 1, budget, silent) for c in o.checks if c.p < 1e-9]
    kinds = {(c.b, c.what) for c in wrong if c.a == "exact"}
    assert {
        ("count_law", "mean of the count"),
        ("count_law", "variance of the count"),
        ("pmf", "law of the count"),
        ("mean_histogram", "mean histogram"),
        ("joint_law", "mean of the windows"),
        ("sequential", "law of the count"),
        ("sequential", "mean histogram"),
        ("simulator", "law of the count"),
    } <= kinds
    assert set(judging.blamed(wrong)) == {"exact"}


def _called(sample: object, name: str) -> object:
    sample.engine = name  # type: ignore[attr-defined]
    return sample


def test_the_second_drawing_decides() -> None:
    """Levels multiply; a chance deviation in the first drawing does not make a failure."""
    level = judging.second_level(100_000)
    assert level * judging.FIRST_LEVEL * 100_000 == pytest.approx(judging.FAMILY_LEVEL)
    settings = Settings(1, 1, Budget(2e4, 1e5, 100), 100)

    class Odd(Watched):
        def judge(self, case, seed, budget, patience=None):
            first = budget.exposures == 100
            check = Check("exact", "pmf", "law of the count", 1e-6 if first else 0.3, 0.1)
            return [judging.Outcome("exact", judging.VERIFIED, checks=[check])]

    judged = judge_case(pixel(), settings, Odd(), 1)
    assert judged.suspects
    assert not judged.failing
    assert judged.outcomes[0].state == judging.VERIFIED


def test_blame_and_refusals() -> None:
    bad = [Check("feedback", b, "mean", 0.0, 1.0) for b in ("count_law", "exact", "joint_law")]
    assert set(judging.blamed(bad)) == {"feedback"}
    assert set(judging.blamed([Check("exact", "mean_histogram", "x", 0.0, 1.0)])) == {"mean_histogram"}
    law = [Check(a, "count_law", "mean", 0.0, 1.0) for a in ("exact", "sequential", "simulator")]
    assert set(judging.blamed(law)) == {"count_law"}
    assert judging.refusal(ValueError("this does not do gates; use engine 'exact'"))
    assert not judging.refusal(ConvergenceError("not reached"))
    assert not judging.refusal(OverflowError("use fewer cycles"))
    assert not judging.refusal(RuntimeError("use anything"))


@pytest.mark.full
def test_what_hangs_is_stopped_and_what_crashes_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that works on and on, one that sleeps, one that ends."""

    class Ends:
        name = "ends"

        def __reduce__(self):
            import os

            return os._exit, (3,)

    with Watched(0.3) as watched:
        [only] = [o for o in watched.judge(Ends(), 1, Budget(1e3, 1e3, 10)) if o.state == judging.FAILED]  # type: ignore[arg-type]
        assert only.note.startswith("the process ended with code ")
        began = time.monotonic()
        slow = pixel(50.0, 50.0, 0.9999, 10**8)
        states = {o.subject: o.state for o in watched.judge(slow, 1, Budget(1e3, 1e3, 10))}
        assert states["exact"] == judging.SLOW
        assert time.monotonic() - began < 120.0


@pytest.mark.parametrize(
    ("case", "name"),
    [
        (pixel(dead=0.0), "Poisson"),
        (pixel(signal=0.0), "constant rate"),
        (pixel(signal=0.0, background=0.0), "darkness"),
        (pixel(dead=200.0), "one at most"),
        (pixel(signal=0.0, mode="paralyzable"), "paralyzable, constant rate"),
        (pixel(dead=0.0, mode="synchronous"), "Binomial"),
    ],
)
def test_closed_forms(case: Case, name: str) -> None:
    form, law = known(case), ml.count_law(case.flux()[0, 0], case.system)
    assert form is not None
    assert form.name == name
    assert form.mean == pytest.approx(float(law.mean), rel=1e-6, abs=1e-9)
    if form.variance is not None:
        assert form.variance == pytest.approx(float(law.variance), rel=1e-4, abs=1e-9)
    if form.pmf is not None and form.mean > 0:
        mine = np.zeros(max(form.pmf.size, law.support[-1] + 1))
        mine[law.support] = law.pmf
        assert 0.5 * np.abs(mine[: form.pmf.size] - form.pmf).sum() < 1e-5
    assert known(pixel()) is None


@pytest.mark.full
def test_two_samples_keep_their_level() -> None:
    """p-values of one engine against itself are even."""
    case = pixel()
    windows = Windows.of(case, ml.statistics.mean_histogram(case.flux()[0, 0], case.system))
    p: dict[str, list[float]] = {}
    for k in range(60):
        for check in two_samples(*(simulated("exact", case, 300, 2 * k + i, windows) for i in (0, 1))):
            p.setdefault(check.what, []).append(check.p)
    for name in ("law of the count", "variance of the count", "variance of the window"):
        assert stats.kstest(p[name], "uniform").pvalue > 1e-5, name
    assert min(p["mean histogram"]) > 1e-5


def test_merging_keeps_all_and_joins_the_few() -> None:
    weight = np.array([1.0, 50.0, 3.0, 3.0, 60.0, 1.0, 1.0])
    assert neighbours(weight, 40.0).tolist() == [0, 2]
    assert neighbours(np.ones(3), 40.0).tolist() == [0]
    assert neighbours(np.array([5, 1, 1, 1, 1, 9, 1]), 4).tolist() == [0, 1, 5]


def test_errors_without_information_are_infinite() -> None:
    """Two parameters that only their sum is known of, and a third of its own."""
    result = _variances(np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.25]]))
    assert np.isinf(result[:2]).all()
    assert result[2] == pytest.approx(4.0)
    regular = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]])
    assert np.array_equal(_variances(regular), np.diag(np.linalg.inv(regular)))


@pytest.mark.full
def test_quick_form(tmp_path, capsys) -> None:
    """Fifteen systems with fixed seeds: no failure, a report, its data and its maps."""
    assert main(["--quick", "--systems", "15", "--out", str(tmp_path)]) == 0
    study = written("domain", tmp_path)
    capsys.readouterr()
    failures = tmp_path / "domain_failures.csv"
    assert not failures.exists(), failures.read_text()
    assert "**No failure**" in study.text
    assert len(study.rows) == 15
    assert {row["exact"] for row in study.rows} <= set(judging.STATES)
    assert sum(row["exact"] == judging.VERIFIED for row in study.rows) > 10
    assert len(study.figures) == 4


@pytest.mark.full
def test_long_exposures_are_those_of_the_closed_form(tmp_path):
    assert main(["long-exposures", "--quick", "--out", str(tmp_path)]) == 0
    study = written("long-exposures", tmp_path)
    outcomes = [row["outcome"] for row in study.rows]
    assert outcomes.count("right") >= 3
    assert "wrong" not in outcomes
    assert f"{outcomes.count('right')} " in study.text
