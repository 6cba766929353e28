"""The classifier study: its AUC and features against what is known of them, and its quick form."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from harness import require
from scipy import stats

from mars_lidar.engines import ANY_SYSTEM
from studies.__main__ import main
from studies.joint import covariance as joint_covariance
from studies.joint import run as joint
from studies.joint import table as joint_table
from studies.joint.covariance import QUICK, random_systems
from studies.joint.table import COARSE, RATIOS, REFERENCE, SEVEN, Case, Law, Sample
from tests.harness.study import quick_study


def test_auc_and_its_error():
    """Against a count of pairs; errors against the scatter of repeated samples."""
    random = np.random.default_rng(3)
    low, high = random.integers(0, 6, 40).astype(float), random.integers(1, 8, 30).astype(float)
    pairs = high[:, None] - low
    assert joint.auc(low, high)[0] == pytest.approx(np.mean((pairs > 0) + 0.5 * (pairs == 0)))
    assert joint.auc(high, low)[0] == pytest.approx(1.0 - joint.auc(low, high)[0])
    shifted = [joint.auc(random.normal(size=300), random.normal(1.0, size=200)) for _ in range(400)]
    value, error = np.array(shifted).T
    truth = stats.norm.cdf(np.sqrt(0.5))
    z = (value - truth) / error
    require({"normal": stats.kstest(z, "norm").pvalue}, "AUC of shifted normals")
    null = [joint.auc(random.normal(size=300), random.normal(size=200))[0] for _ in range(400)]
    z = (np.array(null) - 0.5) / joint.chance_error(300, 200)
    require({"normal": stats.kstest(z, "norm").pvalue}, "AUC of one law")


@pytest.mark.full
@pytest.mark.parametrize("kind", joint.CLASSIFIERS)
def test_classifiers(kind):
    """Of two normal laws the best AUC is known; of one law it is chance, collinear and constant features or not."""
    pytest.importorskip("sklearn", reason="extra 'studies'")
    random = np.random.default_rng(5)
    x, y, z = (random.normal(size=(2000, 3)) for _ in range(3))
    y[:, 0] += 1.0
    x, y, z = (np.column_stack([a, a.sum(-1), np.full(len(a), 7.0)]) for a in (x, y, z))
    result, error = joint.separate(kind, x, y, 1)
    best = stats.norm.cdf(np.sqrt(0.5))
    assert best - 0.05 - 4 * error < result < best + 5.2 * error
    result, _ = joint.separate(kind, x, z, 1)
    p = 2 * stats.norm.sf(abs(result - 0.5) / joint.chance_error(1000, 1000))
    require({kind: p}, "one law, two samples")
    assert joint.separate(kind, x[:, 4:], y[:, 4:], 1) == (0.5, 0.0)


def test_qda_sees_covariance():
    """Normal laws of one mean and correlations +-0.6: the AUC of the likelihood ratio is known by simulation of it."""
    pytest.importorskip("sklearn", reason="extra 'studies'")
    random = np.random.default_rng(6)
    laws = [np.array([[1.0, c], [c, 1.0]]) for c in (0.6, -0.6)]
    x, y = (random.multivariate_normal([0, 0], law, size=4000) for law in laws)
    best, _ = joint.auc(*(-np.prod(random.multivariate_normal([0, 0], law, size=50_000), -1) for law in laws))
    result, error = joint.separate(joint.QDA, x, y, 1)
    assert abs(result - best) < 5.2 * error + 0.003
    assert result > 0.7


SHORT = joint_table.Case("too short", 1.0, 1.0, 0.6375, cycles=50)


def test_features():
    case, settings = REFERENCE[0], joint.Settings((), 50, bins=256)
    fine = joint.near(case, 256)
    x = joint.Sample.of(case, settings, "feedback", 1)
    assert not x.handed
    assert x.coarse.shape == (50, COARSE + 2)
    assert (x.coarse[:, :COARSE].sum(1) == x.coarse[:, -2]).all()
    assert {128 - 16, 128, 128 + 16} <= set(fine.tolist())
    echo = int(256 * (0.5 + 0.6375 - 1.0))
    assert {echo - 16, echo + 16} <= set(fine.tolist())
    assert x.fine.shape == (50, fine.size) == (50, 66)
    assert joint.Sample.of(SHORT, settings, "feedback", 1).handed, "given to exact"


def test_pixels_given_to_exact_are_not_judged():
    pytest.importorskip("sklearn", reason="extra 'studies'")
    results = {o.engine: o for o in joint.examine(SHORT, joint.Settings((), 300, bins=256), 0, joint.TESTS[:1])}
    assert not results["feedback"].aucs
    assert results["mars"].aucs
    assert joint.given_to_exact(list(results.values())) == ["too short"]


@pytest.mark.full
def test_files(tmp_path):
    pytest.importorskip("sklearn", reason="extra 'studies'")
    study = quick_study("joint", tmp_path)
    rows = study.rows
    assert "Quick run" in study.text
    assert study.figures == ["joint.png"]
    quick = joint.QUICK
    assert len(rows) == len(joint.ENGINES) * len(quick.cases)
    outcomes = {}
    for row in rows:
        if row["engine"] in (joint.AGAIN, "feedback"):
            for key in ("qda", "fine_qda", "gradient_boosting", "random_forest"):
                z = (float(row[f"auc_{key}"]) - 0.5) / quick.chance
                outcomes[f"{row['case']}, {row['engine']}, {key}"] = 2 * stats.norm.sf(abs(z))
    assert len(outcomes) == 16
    require(outcomes, "joint study")
    bright = [row for row in rows if row["case"] == SEVEN[6].name]
    recorded = {row["engine"]: float(row["auc_qda"]) for row in bright if row["auc_qda"]}
    assert recorded["mars"] > 0.7, "its window variance is more than twice the exact one"
    assert recorded["renewal"] > 0.7


def test_without_scikit_learn(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    assert main(["joint", "--quick", "--out", str(tmp_path)]) == 2
    assert "mars-lidar[studies]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# The study of the closed-form covariance in its quick form: law and exact engine agree on random systems.


@pytest.fixture(scope="module")
def systems():
    return random_systems(QUICK, str)


@pytest.mark.full
def test_random_systems(systems):
    """One z from each system and kind: independent, standard normal."""
    for name, z in joint_covariance._scores(systems, QUICK).items():
        outcome = {"normal": stats.kstest(z, "norm").pvalue, "chi-square": stats.chi2.sf((z**2).sum(), z.size)}
        require(outcome, f"joint-covariance study, {name}")
    assert {o.law.settled >= 0 for o in systems} == {True, False}, "both routes"


@pytest.mark.full
def test_report(systems, tmp_path, monkeypatch):
    monkeypatch.setattr(joint_covariance, "random_systems", lambda *_: systems)
    study = quick_study("joint-covariance", tmp_path)
    assert "Quick run" in study.text
    assert "None given" in study.text
    assert study.figures == ["joint_covariance.png"]
    assert len(study.rows) == QUICK.systems
    assert all(float(row["movement"]) <= 1e-4 for row in study.rows)


# The joint table: what samples are compared with, against independent bins and known figures, and its quick form.


def compared(case, engine, exposures, seed):
    """Ratios to the closed form of a sample on 256 bins."""
    return Law(case, 256).ratios(Sample.of(case, 256, engine, exposures, seed))


def test_files_of_the_table(tmp_path):
    study = quick_study("joint-table", tmp_path)
    assert len(study.rows) == len(joint_table.QUICK.cases) * len(ANY_SYSTEM)
    assert {row["engine"] for row in study.rows} == set(ANY_SYSTEM)
    assert all(f"| {case.name} |" in study.text for case in joint_table.QUICK.cases)


def test_window_goes_round_the_circle():
    inside = np.flatnonzero(REFERENCE[6].window(1024))
    assert {0, 1023} <= set(inside.tolist())
    assert inside.size == pytest.approx(6 * 0.00375 * 1024, abs=1)
    assert Case("narrow", 1.0, 1.0, 0.5, sigma=1e-4).window(64).sum() == 2


def test_without_dead_time_bins_are_independent():
    """Poisson bins: both engines have the law's window, bins and count; no covariance of neighbours to compare."""
    case = Case("no dead time", 0.5, 0.5, 0.0, cycles=300)
    outcomes = {}
    for seed, engine in enumerate(("exact", "poisson")):
        result = compared(case, engine, 4000, seed)
        assert list(result) == list(RATIOS)
        for key, none in (("window", 1.0), ("bin", 1.0), ("count", 1.0), ("window mean", 0.0)):
            value, error = result[key]
            outcomes[f"{engine}: {key}"] = 2 * stats.norm.sf(abs(value - none) / error)
            assert not joint_table.beyond(result[key], key)
    require(outcomes, "joint table")


@pytest.mark.full
def test_errors_are_the_scatter_of_samples():
    """Standard errors of 60 samples of one law against the scatter of their ratios; 5 of its own errors."""
    case, law = SEVEN[6], Law(SEVEN[6], 256)
    results = [law.ratios(Sample.of(case, 256, "exact", 500, k)) for k in range(60)]
    outcomes = {}
    for key in RATIOS:
        value, error = np.array([item[key] for item in results]).T
        z = (value - (key != "window mean")) / error
        outcomes[key] = 2 * min(stats.chi2.sf((z**2).sum(), z.size), stats.chi2.cdf((z**2).sum(), z.size))
    require(outcomes, "errors of the joint table")


def test_dead_time_is_seen():
    """The closed form, whose count and window variance the reference simulation gave as 140.2 and 273.6."""
    law = Law(REFERENCE[0], 256)
    assert law._count == pytest.approx(140.2, rel=0.05)
    assert law._window[1] == pytest.approx(273.6, rel=0.05)
    result = compared(REFERENCE[0], "poisson", 800, 2)
    assert result["count"][0] > 5
    assert all(joint_table.beyond(result[key], key) for key in ("window", "bin", "count", "window mean"))
    assert compared(SEVEN[6], "mars", 800, 3)["window"][0] == pytest.approx(2.3, rel=0.3)


def test_bins_without_neighbours():
    """Neighbours are compared only where both bins vary; a lone pulse has none."""
    case = Case("pulse alone", 1.0, 0.0, 0.1, delay=0.5 + 0.5 / COARSE, sigma=0.0005, cycles=100)
    result = compared(case, "sequential", 400, 2)
    assert np.isnan(result["neighbour"]).all()
    assert not joint_table.beyond(result["neighbour"], "neighbour")
    assert result["bin"][0] == pytest.approx(1.0, abs=6 * result["bin"][1])
    near = Case("on an edge", 1.0, 0.0, 0.1, delay=0.5, sigma=0.0005, cycles=100)
    assert np.isfinite(compared(near, "exact", 400, 3)["neighbour"]).all()
