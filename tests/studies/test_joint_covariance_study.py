"""The study of the closed-form covariance in its quick form: law and exact engine agree on random systems."""

from __future__ import annotations

import pytest
from harness import require
from scipy import stats

from studies.joint import covariance as joint_covariance
from studies.joint.covariance import QUICK, random_systems
from tests.harness.study import quick_study


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
