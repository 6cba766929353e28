"""The studies in their quick form: they run, write what they promise, and their figures make sense."""

import json
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.chain import PhaseChain
from mars_lidar.statistics.count_pmf import Pmf, gaussian_pmf, total_variation
from studies import STUDIES, Request
from studies.__main__ import main
from studies.common.distance import g_test, sampling_floor, variance_score
from studies.common.sample import PERIOD_NS, system_of
from studies.count_law import law
from studies.covariance import run as covariance
from tests.harness.study import read_csv, written


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
    system = covariance.QUICK.system(100.0, 30.0)
    leading = covariance.LeadingTerms.of(
        ml.statistics.holding_time_covariance(ml.Flux(1.0, 1.0, 0.5 * system.period_ns), system, bins=128)
    )
    assert isinstance(leading.chain, PhaseChain)
    with pytest.raises(ConvergenceError, match=r"S = 1, B = 1 .*eigenvalue 1 has a residual"):
        leading.spectral_sum()


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


def test_total_variation():
    a, b = Pmf(3, np.array([0.5, 0.5])), Pmf(4, np.array([0.25, 0.75]))
    assert total_variation(a, b) == pytest.approx(0.75)
    assert total_variation(a, a) == 0
    assert total_variation(a, Pmf(100, np.array([1.0]))) == pytest.approx(1.0)
    assert Pmf.of_counts(np.array([5, 7, 7, 7], np.uint16)).p.tolist() == [0.25, 0.0, 0.75]
    assert a.on(4, 6).tolist() == [0.5, 0.0, 0.0]
    assert gaussian_pmf(10.3, 4.0).p.sum() == pytest.approx(1.0)


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
    with pytest.raises(ValueError, match=r"made\.json must hold .* lacks tau"):
        law._read(data / "made.json")


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
    with pytest.raises(ValueError, match="data must be a folder with"):
        Request(out=tmp_path, data=tmp_path).cases()
    assert Request(out=tmp_path).cases() == []


def test_help_lists_the_studies(capsys):
    assert main(["--help"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert all(f"{name} {words}" in output for name, (_, words) in STUDIES.items())
