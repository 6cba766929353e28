"""The classifier study: its AUC and features against what is known of them, and its quick form."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from harness import require
from scipy import stats

from studies.__main__ import main
from studies.joint import run as joint
from studies.joint import table as bins
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


SHORT = bins.Case("too short", 1.0, 1.0, 0.6375, cycles=50)


def test_features():
    case, settings = bins.REFERENCE[0], joint.Settings((), 50, bins=256)
    fine = joint.near(case, 256)
    x = joint.Sample.of(case, settings, "feedback", 1)
    assert not x.handed
    assert x.coarse.shape == (50, bins.COARSE + 2)
    assert (x.coarse[:, : bins.COARSE].sum(1) == x.coarse[:, -2]).all()
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
    bright = [row for row in rows if row["case"] == bins.SEVEN[6].name]
    recorded = {row["engine"]: float(row["auc_qda"]) for row in bright if row["auc_qda"]}
    assert recorded["mars"] > 0.7, "its window variance is more than twice the exact one"
    assert recorded["renewal"] > 0.7


def test_without_scikit_learn(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    assert main(["joint", "--quick", "--out", str(tmp_path)]) == 2
    assert "mars-lidar[studies]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
