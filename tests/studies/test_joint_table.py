"""The joint table: what samples are compared with, against independent bins and known figures, and its quick form."""

import numpy as np
import pytest
from harness.ledger import require
from scipy import stats

from mars_lidar.engines import ANY_SYSTEM
from studies.joint import table as joint
from studies.joint.table import COARSE, RATIOS, REFERENCE, SEVEN, Case, Law, Sample
from tests.harness.study import quick_study


def compared(case, engine, exposures, seed):
    """Ratios to the closed form of a sample on 256 bins."""
    return Law(case, 256).ratios(Sample.of(case, 256, engine, exposures, seed))


def test_files(tmp_path):
    study = quick_study("joint-table", tmp_path)
    assert len(study.rows) == len(joint.QUICK.cases) * len(ANY_SYSTEM)
    assert {row["engine"] for row in study.rows} == set(ANY_SYSTEM)
    assert all(f"| {case.name} |" in study.text for case in joint.QUICK.cases)


def test_cases_are_the_declared_ones():
    assert len(REFERENCE) == 10
    assert len(SEVEN) == 7
    assert [case.name for case in joint.FULL.cases] == [case.name for case in (*REFERENCE, *SEVEN)]


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
            assert not joint.beyond(result[key], key)
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
    assert all(joint.beyond(result[key], key) for key in ("window", "bin", "count", "window mean"))
    assert compared(SEVEN[6], "mars", 800, 3)["window"][0] == pytest.approx(2.3, rel=0.3)


def test_bins_without_neighbours():
    """Neighbours are compared only where both bins vary; a lone pulse has none."""
    case = Case("pulse alone", 1.0, 0.0, 0.1, delay=0.5 + 0.5 / COARSE, sigma=0.0005, cycles=100)
    result = compared(case, "sequential", 400, 2)
    assert np.isnan(result["neighbour"]).all()
    assert not joint.beyond(result["neighbour"], "neighbour")
    assert result["bin"][0] == pytest.approx(1.0, abs=6 * result["bin"][1])
    near = Case("on an edge", 1.0, 0.0, 0.1, delay=0.5, sigma=0.0005, cycles=100)
    assert np.isfinite(compared(near, "exact", 400, 3)["neighbour"]).all()
