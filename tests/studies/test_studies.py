"""The studies in their quick form: they run, write what they promise, and their figures make sense."""

from __future__ import annotations

import json
import re
import sys
import types
from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import h5py
import jinja2
import numpy as np
import pytest
from harness import make_system, refused, require
from matplotlib.figure import Figure
from scipy import stats

import mars_lidar as ml
from mars_lidar.engines import ANY_SYSTEM, ENGINES
from mars_lidar.engines.exact import PoissonEngine
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.pmf import Pmf, kl_divergence
from mars_lidar.statistics.tolerances import TOL
from studies import Request
from studies.__main__ import main
from studies.common import report
from studies.common.distance import g_test, sampling_floor, variance_score, wasserstein
from studies.common.sample import PERIOD_NS, draw, system_of
from studies.count_law import law
from studies.count_law import run as count_law
from studies.covariance import run as covariance
from studies.detectors import run as detectors
from studies.registry import STUDIES
from studies.runtime import run as runtime
from studies.runtime.numpy_pipeline import STAGES, NumpyTable, synthesize
from tests.harness.study import quick_study, read_csv, written


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Output folder of both studies, in one run of the command."""
    out = tmp_path_factory.mktemp("studies")
    assert main(["covariance", "law", "--quick", "--out", str(out)]) == 0
    return out


@pytest.mark.full
def test_files(quick):
    assert sum(len(written(name, quick).figures) for name in ("covariance", "law")) == 5


@pytest.mark.full
def test_covariance_figures_make_sense(quick):
    rows = read_csv(quick / "covariance.csv")
    assert len(rows) == 2 * sum(grid.size for grid in covariance.QUICK.grids)
    for row in rows:
        exact, sigma2 = float(row["exact_sum_ns2"]), float(row["sigma2_ns2"])
        assert sigma2 > 0
        assert float(row["defect"]) < 1e-9
        single = float(row["sigma_ss2_ns2"])
        assert sigma2 == pytest.approx(single + 2 * exact, rel=1e-4, abs=1e-5 * single)
        assert abs(float(row["error_cutoff_0_ns2"])) == pytest.approx(abs(exact), rel=1e-5, abs=1e-9)
        assert abs(float(row["error_cutoff_500_ns2"])) < 1e-6 * sigma2
        assert abs(float(row["error_automatic_1e-06_ns2"])) < 1e-3 * sigma2
        assert 0 <= float(row["abs_lambda_3"]) <= float(row["abs_lambda_2"]) < 1
        if float(row["dead_time_ns"]) == 0 and float(row["signal"]) < 1 and row["rearm"] == "centre":
            # Poisson: intervals are independent of their past but for the flux they see, sigma = mu
            assert sigma2 == pytest.approx(float(row["mu_ns"]) ** 2, rel=1e-2)
    text = (quick / "covariance.md").read_text()
    assert "- cells skipped: 0" in text
    assert "125.91" in text


@pytest.mark.full
def test_rules_of_the_covariance_sum():
    cells = covariance.compute(covariance.QUICK, "centre", str)
    errors = [covariance.mean_error(cells, covariance.cutoff_name(c)) for c in (0, 20, 500)]
    assert all(first > other for first, other in pairwise(errors))
    best = covariance.best_cutoff(cells)
    assert covariance.mean_error(cells, covariance.cutoff_name(best)) <= errors[1]
    for cell in cells:
        expected = -2 * cell.terms.exact_sum / cell.terms.sigma2
        assert cell.relative_error("cut-off 0") == pytest.approx(expected)


@pytest.mark.parametrize("rearm", ["centre", "edge"])
def test_leading_modes_are_those_of_the_dense_matrix(rearm):
    system = covariance.QUICK.system(100.0, 95.0)
    light = ml.Flux(5.0, 0.3, 0.5 * system.period_ns)
    dense = covariance.TruncatedSums.of(ml.statistics.holding_time_covariance(light, system, bins=256, rearm=rearm))
    leading = covariance.LeadingTerms.of(dense)
    size = np.abs(dense.eigenvalues)
    np.testing.assert_allclose(np.abs(leading.eigenvalues[:10]), size[:10], atol=1e-7)
    for lags, number in ((0, 5), (6, 5), (2, 8)):
        assert leading.spectral_sum(lags, number) == pytest.approx(dense.spectral_sum(lags, number), rel=1e-7)
    assert leading.automatic_rule() == dense.automatic_rule()


def test_modes_without_convergence_name_the_cell(monkeypatch):
    monkeypatch.setattr(covariance, "_WORST", 0.0)
    light, system = ml.Flux(1.0, 1.0, 50.0), covariance.QUICK.system(100.0, 30.0)
    leading = covariance.LeadingTerms.of(ml.statistics.holding_time_covariance(light, system, bins=128))
    refused(r"S = 1, B = 1 .*eigenvalue 1 has a residual", leading.spectral_sum, error=ConvergenceError)


@pytest.mark.full
def test_law_figures_make_sense(quick):
    settings, rows = law.QUICK, read_csv(quick / "law.csv")
    cells = len(settings.signal) * len(settings.background)
    grid = len(settings.dead) * len(settings.cycles) * cells
    assert 0 < len(rows) < grid + len(settings.stationary) * cells + settings.systems * settings.pixels
    for row in rows:
        assert row["trusted"] == "False" or law.AIM / 4 < float(row["tv_exact_matched"]) <= law.AIM
        assert all(0 <= float(row[f"tv_exact_{name}"]) <= 1 + 1e-12 for name in law.LAWS)
        assert float(row["cumulant_2"]) >= 0
    text = (quick / "law.md").read_text()
    assert "few photons" in text
    assert f"| grid, armed | {grid} |" in text
    assert "None given" in text


def test_distances_to_the_exact_law():
    """Without dead time the count is Poisson: its Gaussian is as far as the skewness says."""
    part = law.measure("armed", system_of(0.0, 200), np.array([0.5, 2.0]), np.array([0.1, 0.2]))
    assert part.cumulants[:, 1] == pytest.approx([120.0, 440.0])
    assert (part.distance["poisson"] < 1e-6).all()
    assert (part.distance["matched"] < law.AIM).all()
    np.testing.assert_allclose(part.distance["renewal"], part.distance["gaussian"], atol=1e-6)
    expected = law._PER_SKEWNESS / np.sqrt(part.cumulants[:, 1])
    np.testing.assert_allclose(part.distance["gaussian"], expected, rtol=0.05)
    cells = law.Cells([part, part])
    where = cells.where("gaussian", cells.cumulants[:, 0] < 200)
    assert (where["cells"], where["cell"]) == (2, part.name(0))
    assert cells.where("mars", np.zeros(4, bool))["cells"] == 0
    assert sum(here.sum() for here in cells.regimes().values()) == 4


def test_cells_whose_law_is_refused_are_left_out(monkeypatch):
    """A half of a batch at a time, until only the cells that are refused are missing."""
    exact = law.laws_of

    def refuses(flux, system):
        if (np.asarray(flux.signal) == 3.0).any():
            raise ConvergenceError("too long")
        return exact(flux, system)

    monkeypatch.setattr(law, "laws_of", refuses)
    part = law.measure("armed", system_of(50.0, 50), np.array([1.0, 3.0, 2.0]), np.full(3, 0.1))
    assert np.isnan(part.distance["mars"]).tolist() == [False, True, False]
    cells = law.Cells([part])
    assert cells.refused == 1
    assert [k for _, k in cells.cells] == [0, 2]


def test_edgeworth_constant():
    z = stats.norm()
    integral = z.expect(lambda x: np.abs(x**3 - 3 * x), lb=-12, ub=12)
    assert pytest.approx(integral / 12, rel=1e-6) == law._PER_SKEWNESS


def test_sampling_floor_and_g_test():
    random = np.random.default_rng(4)
    counts = np.arange(60)
    poisson = Pmf(0, stats.poisson.pmf(counts, 20.0))
    floor = sampling_floor(poisson, 10_000, 400, random)
    # mean |binomial - its mean| of many bins is that of a normal
    expected = 0.5 * np.sqrt(2 / np.pi * poisson.p * (1 - poisson.p) / 10_000).sum()
    assert floor.mean() == pytest.approx(expected, rel=0.05)
    p_values, scores = [], []
    for _ in range(200):
        sample = Pmf.of_counts(random.poisson(20.0, 10_000))
        p_values.append(g_test(poisson, sample, 10_000))
        scores.append(variance_score(np.full(4, 20.0), sample, 10_000))
    assert stats.kstest(p_values, "uniform").pvalue > 1e-4
    assert stats.kstest(scores, "norm").pvalue > 1e-4
    other = Pmf.of_counts(random.poisson(20.5, 10_000))
    assert g_test(poisson, other, 10_000) < 1e-6
    # a count that is all but certain
    assert g_test(Pmf(7, np.array([1.0])), Pmf(7, np.array([1.0])), 100) == 1.0
    rare = Pmf(7, np.array([0.99999, 0.00001]))
    assert g_test(rare, Pmf(7, np.array([1.0])), 1000) == pytest.approx(1.0)
    assert g_test(rare, Pmf(7, np.array([0.99, 0.01])), 1000) < 1e-10


def test_reference_study(tmp_path):
    """A case made here, by the exact engine, judged as the reference cases are."""
    system = system_of(0.4 * PERIOD_NS, 50, bins=1)
    counts = ml.simulate(ml.Flux(1.0, 0.2, 40.0), system, realizations=5000, seed=9).sum(-1).ravel()
    values, times = np.unique(counts, return_counts=True)
    data = tmp_path / "cases"
    data.mkdir()
    case = {
        "S": 1.0,
        "B": 0.2,
        "dead": 0.4,
        "cycles": 50,
        "tau": 40.0 / system.period_ns,
        "sigma": 0.5 / system.period_ns,
        "count": {str(v): int(t) for v, t in zip(values, times, strict=True)},
    }
    (data / "made.json").write_text(json.dumps(case))
    case = law._read(data / "made.json")
    rows = {row["law"]: row for row in law.compare("made", case, 500, 0)}
    assert list(rows) == ["exact", *law.LAWS]
    assert rows["exact"]["good"]
    assert rows["matched"]["good"]
    assert not rows["poisson"]["good"]
    assert not rows["renewal"]["good"]
    assert abs(rows["exact"]["z_mean"]) < 5
    del case["tau"]
    (data / "made.json").write_text(json.dumps(case))
    refused(r"made\.json must hold .* lacks tau", law._read, data / "made.json")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["maps"], "STUDY must be one of"),
        (["law", "--data", "/nonexistent"], '"/nonexistent" does not exist'),
        (["law", "--out", "/dev/null/out"], "/dev/null/out: Not a directory"),
        (["law", "--train"], "--train is of study image alone, got law"),
        (["count-law", "--truth", "poisson"], "--truth must be one of 'sequential', 'exact'"),
        (["image", "--captures", "/nowhere"], "does not exist"),
        ([], "STUDY is missing: one or more of law"),
    ],
)
def test_bad_command(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_a_folder_without_cases_is_refused(tmp_path):
    refused("data must be a folder with", Request(out=tmp_path, data=tmp_path).cases)
    assert Request(out=tmp_path).cases() == []


def test_help_lists_the_studies(capsys):
    assert main(["--help"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert all(f"{name} {words}" in output for name, (_, words) in STUDIES.items())


# The study of detector modes and effects in its quick form.


@pytest.mark.full
def test_modes_and_effects(tmp_path, monkeypatch):
    """A few of the effects; the law of the electronics takes a minute."""
    few = [each for each in detectors.EFFECTS if each.figure in ("", "afterpulsing", "crosstalk", "jitter")]
    monkeypatch.setattr(detectors, "EFFECTS", few)
    study = quick_study("detectors", tmp_path)
    assert [row["detector"] for row in study.rows] == [each.name for each in (*detectors.MODES, *few)]
    groups = {each.figure for each in (*detectors.MODES, *few, *detectors.IN_FOG)} - {""}
    assert study.figures == [f"detectors_{name}.png" for name in sorted(groups)]
    fog = read_csv(tmp_path / "detectors_fog.csv")
    for row in (*study.rows, *fog):
        simulated_only = row["detector"] == "moving gate" or row["effect"] in ("afterpulsing", "crosstalk")
        assert (row["predicted mean"] == "-") == simulated_only
        if not simulated_only:
            p = 2 * stats.norm.sf(abs(float(row["z mean"])))
            require({"mean": p}, f"detector study, {row['effect']}, {row['detector']}")
    wall = {row["detector"]: float(row["wall"]) for row in fog}
    assert wall["synchronous"] < 0.4 * wall["non-paralyzable"], "the light of the fog arrives first"
    assert [abs(float(row["z"])) < 5.4 for row in read_csv(tmp_path / "detectors_rate.csv")] == [True] * 5


# The study of hardware in its quick form.


@pytest.mark.full(seconds=16)
def test_quick(tmp_path):
    study = quick_study("hardware", tmp_path)
    assert study.figures == ["hardware_pixels.png", "hardware_range.png"]
    rows = {row["stream"]: row for row in study.rows}
    assert rows["bright"]["fits"] == "True"
    assert rows["dead time given 5 ns too short"]["fits"] == "False"
    assert abs(float(rows["bright"]["signal"]) - 0.8) < 5 * float(rows["bright"]["signal_error"])
    assert main(["hardware", "--quick", "--out", str(tmp_path), "--stream", str(tmp_path / "none.mat")]) == 2


@pytest.mark.nightly
def test_a_measured_stream(tmp_path):
    example = tmp_path / "decay.mat"
    flux = ml.Flux(waveform=1.5 * np.exp(-np.arange(100) / 8.0) / 8.0)
    made_by = make_system(80.0, 8000, 100, period_ns=50.0)
    times = ml.simulate_timestamps(flux, made_by, seed=3)
    with h5py.File(example, "w") as file:
        file["tPhoton"] = np.floor(times.times_ns / 0.064)[None]
        file["syncPeriod"] = [[50.0 / 0.064]]
    study = quick_study("hardware", tmp_path / "out", "--stream", example)
    assert study.figures == [f"hardware_{name}.png" for name in ("measured", "pixels", "range")]
    rows = {row["stream"]: row for row in study.rows}
    assert rows["free shape"]["fits"] == "True"  # 3,500 photons


# The study of count laws: its distances, its floors, what it calls right, and its quick form.


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Output folder of the study in its quick form, and the cells that it computed."""
    out, computed = tmp_path_factory.mktemp("count_law"), []
    compute = count_law.compute

    def recorded(*arguments):
        computed.append(compute(*arguments))
        return computed[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(count_law, "compute", recorded)
        quick_study("count-law", out)
    return out, *computed


@pytest.fixture(scope="module")
def cells(study):
    return study[1]


@pytest.mark.full
def test_files_of_count_laws(study):
    result = written("count-law", study[0])
    assert len(result.figures) == 1
    assert len(result.rows) == sum(grid.size for grid in count_law.QUICK.grids)
    assert "engine `sequential`" in result.text


@pytest.mark.full
def test_exact_law_passes_and_poisson_fails(cells):
    outcomes = {}
    for cell in cells:
        size = cell.realizations
        z = (cell.mean - cell.exact[0]) / cell.mean_error
        outcomes[f"{cell.name()}: mean"] = 2 * stats.norm.sf(abs(z))
        score = cell.scores["mars_exact"]
        assert score.figures.shape == (4,)
        assert score.floors.shape == (count_law.QUICK.resamplings, 4)
        assert cell.truth.p.sum() == pytest.approx(1.0)
        assert np.rint(cell.truth.p * size).sum() == size
    require(outcomes, "count-law study")
    figures, floor, limit = count_law.average(cells, "mars_exact")
    assert all(value <= 2 * bound for value, bound in zip(figures, limit, strict=True))
    assert all(low < high for low, high in zip(floor, limit, strict=True))
    assert count_law.average(cells, "poisson")[0][0] > 100 * floor[0]
    bright = max(cells, key=lambda cell: cell.signal + cell.background)
    assert count_law.right(bright, "mars_exact") == {"mean": True, "variance": True, "shape": True}
    assert count_law.right(bright, "renewal") == {"mean": False, "variance": False, "shape": True}
    assert not any(count_law.right(bright, "poisson")[key] for key in ("mean", "variance"))


def test_distances():
    normal = stats.norm.pdf(np.arange(60), 30.0, 3.0)
    later = np.roll(normal, 4)
    assert wasserstein(normal, later) == pytest.approx(4.0, rel=1e-6)
    assert kl_divergence(normal, later) == pytest.approx(0.5 * (4.0 / 3.0) ** 2, rel=1e-3)
    assert kl_divergence(normal, normal) == pytest.approx(0.0, abs=1e-9)
    certain, other_folder = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    assert kl_divergence(certain, other_folder) == pytest.approx(-np.log(TOL.tail))
    both = np.stack([normal, later])
    np.testing.assert_allclose(wasserstein(both, normal), [0.0, 4.0], atol=1e-6)


def test_floors_are_those_of_samples():
    """Of a Poisson law: differences of moments are half-normal, the mean of KL is a sum over binomials."""
    law = Pmf(0, stats.poisson.pmf(np.arange(80), 20.0))
    size = 10_000
    random = np.random.default_rng(3)
    result = count_law.resampled_figures(law, size, 0, 2000, random)
    assert result[:, 2].mean() == pytest.approx(np.sqrt(2 / np.pi * 20.0 / size), rel=0.06)
    assert result[:, 3].mean() == pytest.approx(np.sqrt(2 / np.pi * (20.0 + 2 * 20.0**2) / size), rel=0.06)
    times = np.arange(1, size + 1)
    rates = np.log(times[:, None] / (size * law.p)) * times[:, None] / size
    expected = (stats.binom.pmf(times[:, None], size, law.p) * rates).sum()
    assert result[:, 1].mean() == pytest.approx(expected, rel=0.05)
    twice = count_law.resampled_figures(law, size, size, 500, random)
    assert twice[:, 2].mean() == pytest.approx(np.sqrt(2) * result[:, 2].mean(), rel=0.12)


@pytest.mark.full
def test_sample_noise_of_the_shape():
    """The floor of the shape is the distance that a sample really has; of a Poisson pixel that is known."""
    system = count_law.QUICK.system(100.0, 0.0).replace(bins=64)
    signal, background = np.array([0.0]), np.array([1.0])
    results = [draw("poisson", signal, background, system, realizations=200, seed=k) for k in range(30)]
    floor = np.mean([item.shape_floor[0] for item in results])
    apart = np.mean([0.5 * np.abs(item.shape[0] - 1 / 64).sum() for item in results])
    assert floor == pytest.approx(apart, rel=0.1)
    assert floor == pytest.approx(0.5 * np.sqrt(2 / np.pi * 63 / (200 * system.cycles)), rel=0.1)
    assert results[0].counts.shape == (200, 1)
    assert abs(results[0].counts.mean() - system.cycles) < 6 * np.sqrt(system.cycles / 200)


@pytest.mark.full
def test_engine_without_a_law_is_sampled(monkeypatch):
    class Other(PoissonEngine):
        name = "other"

    monkeypatch.setitem(ENGINES, "other", Other())
    names = [simulator.name for simulator in count_law.simulators(50, 1)]
    assert names[:6] == ["poisson", "renewal", "mars_centre", "mars_edge", "mars_exact", "mars_matched"]
    other = next(simulator for simulator in count_law.simulators(50, 1) if simulator.name == "other")
    system = count_law.QUICK.system(100.0, 50.0)
    result = other.predict(np.array([0.1, 0.2]), np.array([0.1, 0.1]), system)
    assert result.sampled == 50
    np.testing.assert_allclose(result.mean, [20.0, 30.0], atol=6 * np.sqrt(30.0 / 50))
    settings = replace(count_law.QUICK, grids=count_law.QUICK.grids[1:], realizations=100, sampled=50)
    scores = count_law.compute(settings, "exact", str)[0].scores["other"]
    assert scores.shape_floor > 1.5 * count_law.compute(settings, "exact", str)[0].scores["poisson"].shape_floor


def test_truth_by_the_exact_engine():
    settings = replace(count_law.QUICK, grids=count_law.QUICK.grids[1:])
    pairs = zip(*(count_law.compute(settings, truth, str) for truth in ("exact", "sequential")), strict=True)
    z = [(first.mean - other.mean) / np.hypot(first.mean_error, other.mean_error) for first, other in pairs]
    require({f"cell {k}: mean": 2 * stats.norm.sf(abs(v)) for k, v in enumerate(z)}, "truths agree")


# The paper's pipeline in NumPy, and the runtime study: no time is asserted, only what is done with times.


@pytest.fixture(scope="module")
def system():
    return runtime.system(runtime.QUICK, 300).replace(bins=64)


@pytest.mark.full
def test_files_of_runtimes(tmp_path):
    study = quick_study("runtime", tmp_path)
    rows, text = study.rows, study.text
    assert {row["axis"] for row in rows} == {"cycles", "flux", "realizations", "pixels"}
    assert {*ANY_SYSTEM, runtime.NUMPY} <= {row["contender"] for row in rows}
    assert all((row["seconds"] == "") == bool(row["why"]) for row in rows)
    assert "| 105.1 MB | 105 MB |" in text
    assert "40.83" in text
    assert "`Table` of this run, 5 x 4 entries" in text  # flux 0 is a node of either axis
    assert study.figures == ["runtime_axes.png"]


def test_flux_beyond_the_table_is_left_out():
    contender = next(c for c in runtime.contenders(runtime.Tables((4, 3))) if c.name == runtime.NUMPY)
    takes = [contender.takes(ml.Flux(*light, 1.0)) for light in ((0.01, 10.0), (0.009, 1.0), (0.1, 10.1))]
    assert takes == [True, False, False]


def test_pipeline_takes_the_nearest_entry(system):
    table = NumpyTable.of(ml.Table.build(system, (0.01, 10.0, 4), (0.1, 10.0, 3)), system)
    signal, background = np.array([0.011, 0.3, 9.0, 99.0]), np.array([0.1, 0.4, 8.0, 0.01])
    assert table.rows(signal, background).tolist() == [0, 4, 11, 9]


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


def points(axis, contender, seconds, hits):
    return [
        runtime.Point(axis, float(k), contender, s, "", float(h))
        for k, (s, h) in enumerate(zip(seconds, hits, strict=True), 1)
    ]


@pytest.mark.parametrize(
    ("seconds", "at", "rule"),
    [
        ([3e-2] * 4, 300.0, "exact is faster than other below 300 registrations per pixel, slower above"),
        ([9.0] * 4, None, "exact is faster than other from 10 to 1e+04"),
        ([9.0, 9.0, 1e-2, 9.0], None, "exact is faster than other at 1e+04 registrations per pixel, not everywhere"),
        ([], None, "not timed together"),
    ],
)
def test_crossover(seconds, at, rule):
    hits = [10, 100, 1000, 10_000]
    exact = points("cycles", "exact", [1e-3, 1e-2, 1e-1, 1.0], hits)
    other = points("cycles", "other", seconds, hits[: len(seconds)])
    result, words = runtime.crossover([*exact, *other], "cycles", "exact", "other")
    assert result == (None if at is None else pytest.approx(at))
    assert rule in words


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


# What all studies share: the names on the command line, templates, tables, and that the package knows none of them.


ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "studies"
TEMPLATES = sorted(FOLDER.rglob("*.md.jinja"))


def test_every_name_that_a_report_prints_is_a_study():
    printed = set()
    for text in (ROOT / "docs").rglob("*.md"):
        if (ROOT / "docs" / "copied") in text.parents:  # made with the site; the changelog names studies that are gone
            continue
        for command in re.findall(r"python -m studies ([a-z-][a-z -]*)", text.read_text(encoding="utf-8")):
            printed |= {word for word in command.split(" --")[0].split() if not word.startswith("-")}
    assert {"covariance", "law", "joint-table"} <= printed <= {*STUDIES, "neural", "train", "info", "compare"}


@pytest.mark.parametrize("name", sorted(STUDIES))
def test_every_study_has_a_module_that_runs(name: str):
    pytest.importorskip("torch", reason="extra 'learn'")
    module = import_module(STUDIES[name][0])
    assert callable(module.run)
    assert f'"{name}"' in (module.__doc__ or "").splitlines()[0]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: str(path.relative_to(FOLDER)))
def test_templates_parse_and_are_filled_by_a_module_beside_them(path: Path):
    environment = jinja2.Environment(autoescape=True)
    environment.filters |= dict.fromkeys(("f", "n", "each", "mean", "median", "quantile"), str)
    environment.parse(path.read_text(encoding="utf-8"))
    stem = path.name.removesuffix(".md.jinja")
    module = path.with_name(f"{'run' if stem == 'report' else stem}.py").relative_to(ROOT).with_suffix("")
    assert ".".join(module.parts) in {module for module, _ in STUDIES.values()}


def test_a_template_is_filled_strictly(tmp_path: Path):
    template = tmp_path / "x.md.jinja"
    template.write_text(
        "# A\n\n{{ for_looking }}\n\n{% for v in values %}\n- {{ v|f('.2f') }}\n{% endfor %}\n\n{{ rest }}\n"
    )
    request = Request(out=tmp_path, quick=True)
    refused("rest", report.render, request, template, {"values": [1.0]}, error=jinja2.UndefinedError)
    facts = {"values": [1.0, 2.345], "rest": "end"}
    text = report.render(request, template, facts)
    assert text == "# A\n\n_Quick run: a preview, not for citation._\n\n- 1.00\n- 2.35\n\nend\n"
    assert "Quick" not in report.render(Request(out=tmp_path), template, facts)


@pytest.mark.parametrize(("stem", "template"), [("short", "short"), ("run", "report")])
def test_a_report_has_the_template_and_the_constants_of_its_module(tmp_path: Path, stem: str, template: str):
    facts = {"word": "at", "rows": [{"a": 1, "b": 0.1234567}], "tables": {"wrong": [{"c": "?"}]}}
    module = types.ModuleType("made_up")
    module.__file__, module.LIMIT, module.FULL, module.QUICK = str(tmp_path / f"{stem}.py"), 3, 8, 2  # type: ignore[attr-defined]
    module.run = lambda settings, request: facts | {"figures": {"": Figure(), "map": Figure()}}  # type: ignore[attr-defined]
    words = "{{ word }} {{ study.LIMIT }} {{ s }}{{ flag }} {{ figures[1].name }}"
    (tmp_path / f"{template}.md.jinja").write_text(words)
    request = Request(out=tmp_path, quick=True)
    written = report.make(request, "x-y", module)
    assert [path.name for path in written] == ["x_y.md", "x_y.png", "x_y_map.png", "x_y.csv", "x_y_wrong.csv"]
    assert written[0].read_text() == "at 3 2 --quick x_y_map.png\n"
    assert written[3].read_text() == "a,b\n1,0.123457\n"
    facts["tables"] = {"wrong": []}
    assert len(report.make(request, "x-y", module)) == 4
    assert not (tmp_path / "x_y_wrong.csv").exists(), "what an earlier run wrote would be taken for this one's"
    assert report.make(request, "x-y", module, 5)[0].read_text().startswith("at 3 5")


def test_filters_and_tables():
    assert [report.number(v) for v in (1.23456, 12345.6, 3e7, 7, "x")] == ["1.235", "12346", "3e+07", "7", "x"]
    assert report.table([]) == ""
    table = "| a | b |\n|---|---|\n| 1 | 0.5 |\n| 123456 | x |"
    assert report.table([{"a": 1, "b": 0.5}, {"a": 123456.0, "b": "x"}]) == table


def test_without_jinja_it_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert main(["law", "--quick", "--out", str(tmp_path)]) == 2
    assert "pip install 'mars-lidar[studies]'" in capsys.readouterr().err
