"""The study of the closed-form covariance in its quick form: law and exact engine agree on random systems."""

from __future__ import annotations

import csv

import pytest
from harness import require
from scipy import stats

from studies.__main__ import main
from studies.common.report import MAX_FIGURE_BYTES
from studies.joint import covariance as joint_covariance
from studies.joint.covariance import QUICK, random_systems


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
    assert main(["joint-covariance", "--quick", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "joint_covariance.md").read_text()
    assert "Quick form" in text
    assert "None given" in text
    assert "![closed form and simulation](joint_covariance.png)" in text
    assert 5_000 < (tmp_path / "joint_covariance.png").stat().st_size <= MAX_FIGURE_BYTES
    with (tmp_path / "joint_covariance.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == QUICK.systems
    assert all(float(row["movement"]) <= 1e-4 for row in rows)
