"""The paper's pipeline in NumPy, and the runtime study: no time is asserted, only what is done with times."""

import numpy as np
import pytest
from harness.ledger import require
from scipy import stats

import mars_lidar as ml
from mars_lidar.engines import ANY_SYSTEM
from studies.runtime import run as runtime
from studies.runtime.numpy_pipeline import STAGES, NumpyTable, synthesize
from tests.harness.study import quick_study


@pytest.fixture(scope="module")
def system():
    return runtime.system(runtime.QUICK, 300).replace(bins=64)


@pytest.mark.full
def test_files(tmp_path):
    study = quick_study("runtime", tmp_path)
    rows, text = study.rows, study.text
    assert {row["axis"] for row in rows} == {"cycles", "flux", "realizations", "pixels"}
    assert {*ANY_SYSTEM, runtime.NUMPY} <= {row["contender"] for row in rows}
    assert all((row["seconds"] == "") == bool(row["why"]) for row in rows)
    assert "| 105.1 MB | 105 MB |" in text
    assert "40.83" in text
    assert "`Table` of this run, 5 x 4 entries" in text  # flux 0 is a node of either axis
    assert study.figures == ["runtime_axes.png"]


def test_pipeline_draws_the_law_of_its_table(system):
    """On a node of the table and delays on bins: count and shape are those of the exact law, joint law aside."""
    table = NumpyTable.of(ml.Table.build(system, (0.1, 1.0, 3), (0.1, 1.0, 2)), system)
    signal, background = 10**-0.5, 1.0
    delay = (0.5 + 7 / 64) * system.period_ns
    pixels = 1500
    flux = ml.Flux(np.full((1, pixels), signal), background, delay)
    stages = {}
    out = np.zeros((1, 1, pixels, 64), system.histogram_dtype)
    synthesize(table, flux, out, seed=3, stages=stages)
    cube = out[0, 0].astype(np.int64)
    assert set(stages) == set(STAGES)
    assert sum(stages.values()) > 0
    expected = ml.statistics.exposure_moments(ml.Flux(signal, background, 0.5 * system.period_ns), system)
    counts = cube.sum(-1)
    z = (counts.mean() - expected.mean) / np.sqrt(expected.variance / pixels)
    # rounding adds a twelfth to the variance
    chi = counts.var(ddof=1) / (expected.variance + 1 / 12) * (pixels - 1)
    shape = np.roll(expected.histogram, 7)
    total = cube.sum(0)
    require(
        {
            "mean": 2 * stats.norm.sf(abs(z)),
            "variance": 2 * min(stats.chi2.sf(chi, pixels - 1), stats.chi2.cdf(chi, pixels - 1)),
            "shape": stats.chisquare(total, shape / shape.sum() * total.sum()).pvalue,
        },
        "NumPy pipeline",
    )


def test_pipeline_takes_the_nearest_entry_and_bin(system):
    table = NumpyTable.of(ml.Table.build(system, (0.01, 10.0, 4), (0.1, 10.0, 3)), system)
    signal, background = np.array([0.011, 0.3, 9.0, 99.0]), np.array([0.1, 0.4, 8.0, 0.01])
    assert table.rows(signal, background).tolist() == [0, 4, 11, 9]
    flux = ml.Flux(np.full((1, 4), 10.0), 0.1, np.array([[0.1, 0.5, 0.9, 0.999]]) * system.period_ns)
    out = np.zeros((20, 1, 4, 64), system.histogram_dtype)
    synthesize(table, flux, out, seed=1, stages={})
    assert (out.sum((-1, -2)) > 0).all()
    peaks = out.sum(0)[0].argmax(-1)
    canonical = int(table.doubled[9, :64].argmax())
    apart = (peaks - canonical - np.rint((flux.delay_ns[0] / system.period_ns - 0.5) * 64)) % 64
    assert np.minimum(apart, 64 - apart).max() <= 1


def points(axis, contender, seconds, hits):
    return [
        runtime.Point(axis, float(k), contender, s, "", float(h))
        for k, (s, h) in enumerate(zip(seconds, hits, strict=True), 1)
    ]


def test_crossover():
    hits = [10, 100, 1000, 10_000]
    exact = points("cycles", "exact", [1e-3, 1e-2, 1e-1, 1.0], hits)
    flat = points("cycles", "other", [3e-2] * 4, hits)
    at, rule = runtime.crossover([*exact, *flat], "cycles", "exact", "other")
    assert at == pytest.approx(300.0)
    assert rule == "exact is faster than other below 300 registrations per pixel, slower above"
    slow = points("cycles", "slow", [9.0] * 4, hits)
    at, rule = runtime.crossover([*exact, *slow], "cycles", "exact", "slow")
    assert at is None
    assert rule.startswith("exact is faster than slow from 10 to 1e+04")
    late = points("cycles", "late", [9.0, 9.0, 1e-2, 9.0], hits)
    at, rule = runtime.crossover([*exact, *late], "cycles", "exact", "late")
    assert at is None
    assert rule == "exact is faster than late at 1e+04 registrations per pixel, not everywhere below"
    at, rule = runtime.crossover(exact, "cycles", "exact", "other")
    assert at is None
    assert "not timed together" in rule


def test_points_that_would_take_too_long_are_left_out(monkeypatch):
    """A contender whose time grows with the square of the axis is stopped; its clock is ours."""
    clock = [0.0]
    monkeypatch.setattr(runtime.time, "perf_counter", lambda: clock[0])

    def prepare(flux, system, realizations):
        def run(seed, out):
            clock[0] += 0.01 * system.cycles**1.4 / 10**1.4
            return {}

        return run

    monkeypatch.setattr(runtime, "contenders", lambda tables: [runtime.Contender("slow", "slow", prepare)])
    axis = runtime.Axis("cycles", "cycles", (10.0, 100.0, 1000.0, 10_000.0), 2)
    result = runtime.along(runtime.QUICK, axis, str)
    assert [p.seconds is not None for p in result] == [True, True, False, False]
    assert result[2].why == result[3].why == "predicted 6.31 s"


def test_flux_beyond_the_table_is_left_out():
    single = next(c for c in runtime.contenders(runtime.Tables((4, 3))) if c.name == runtime.NUMPY)
    assert single.takes(ml.Flux(0.01, 10.0, 1.0))
    assert not single.takes(ml.Flux(0.009, 1.0, 1.0))
    assert not single.takes(ml.Flux(0.1, 10.1, 1.0))
