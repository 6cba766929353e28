"""The joint table: its statistics against closed forms, and its quick form."""

import csv

import numpy as np
import pytest
from harness.ledger import require
from scipy import stats

from mars_lidar.engines import ANY_SYSTEM
from studies.__main__ import main
from studies.joint import table as joint

POISSON = joint.Case("no dead time", 0.5, 0.5, 0.0, cycles=300)


def test_files(tmp_path):
    assert main(["joint-table", "--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "joint_table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(joint.QUICK.cases) * len(ANY_SYSTEM)  # exact: once more instead of once
    assert {row["engine"] for row in rows} == {joint.AGAIN, *ANY_SYSTEM} - {"exact"}
    text = (tmp_path / "joint_table.md").read_text()
    assert all(f"| {case.name} |" in text for case in joint.QUICK.cases)


def test_cases_are_the_declared_ones():
    assert len(joint.REFERENCE) == 10
    assert len(joint.SEVEN) == len(joint.SEVEN_RATIOS) == 7
    assert [case.name for case in joint.FULL.cases] == [case.name for case in (*joint.REFERENCE, *joint.SEVEN)]


def test_window_goes_round_the_circle():
    inside = joint.window(joint.REFERENCE[6], 1024)
    assert {0, 1023} <= set(inside.tolist())
    assert inside.size == pytest.approx(6 * 0.00375 * 1024, abs=1)


def test_moments_without_dead_time():
    """Independent Poisson bins: variance = mean for window, count and bins, no correlation of neighbours."""
    settings = joint.Settings((POISSON,), realizations=4000, bins=256)
    found = joint.moments(settings, POISSON, "exact", 5)
    other = joint.moments(settings, POISSON, "poisson", 6)
    assert found.count[:, 0].mean() == pytest.approx(300.0, abs=6 * np.sqrt(300 / 4000))
    outcomes = {}
    for name, pair in (("count", found.count), ("window", found.window)):
        ratio = pair[:, 1] / pair[:, 0].mean()
        outcomes[f"{name}: variance is the mean"] = stats.ttest_1samp(ratio, 1.0).pvalue
    score = joint.score(POISSON.name, "poisson", other, found)
    for key, none in (("window", 1.0), ("count", 1.0), ("bin", 1.0), ("neighbour", 0.0), ("window_mean", 0.0)):
        value, error = getattr(score, key)
        outcomes[f"poisson against exact: {key}"] = 2 * stats.t.sf(abs(value - none) / error, 39)
    require(outcomes, "joint table")


def test_dead_time_is_seen():
    settings = joint.Settings((joint.REFERENCE[0],), realizations=800, bins=256)
    truth = joint.moments(settings, joint.REFERENCE[0], "exact", 1)
    # closed form: docs/theory_exposure.md; the reference simulation of this case gave 140.2 and 273.6
    assert truth.count[:, 1].mean() == pytest.approx(140.2, rel=0.3)
    assert truth.window[:, 1].mean() == pytest.approx(273.6, rel=0.3)
    score = joint.score("", "poisson", joint.moments(settings, joint.REFERENCE[0], "poisson", 2), truth)
    assert score.count[0] > 5
    assert score.bins == joint.COARSE


def test_bins_without_neighbours():
    """Neighbours are compared only where both bins have counts; a lone pulse has none."""
    case = joint.Case("pulse alone", 1.0, 0.0, 0.1, delay=0.5 + 0.5 / joint.COARSE, sigma=0.0005, cycles=100)
    settings = joint.Settings((case,), realizations=400)
    found = joint.moments(settings, case, "exact", 1)
    score = joint.score("", "sequential", joint.moments(settings, case, "sequential", 2), found)
    assert score.bins == 1
    assert np.isnan(score.neighbour).all()
    assert score.bin[0] == pytest.approx(1.0, abs=6 * score.bin[1])
    near = joint.Case("on an edge", 1.0, 0.0, 0.1, delay=0.5, sigma=0.0005, cycles=100)
    both = joint.moments(settings, near, "exact", 3)
    again = joint.score("", "exact", joint.moments(settings, near, "exact", 4), both)
    assert again.bins == 2
    assert np.isfinite(again.neighbour).all()
