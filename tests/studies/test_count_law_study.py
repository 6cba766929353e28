"""The study of count laws: its distances, its floors, what it calls right, and its quick form."""

from dataclasses import replace

import numpy as np
import pytest
from harness.ledger import require
from scipy import stats

from mars_lidar.engines import ENGINES
from mars_lidar.engines.exact import PoissonEngine
from mars_lidar.statistics.count_pmf import Pmf, kl_divergence
from mars_lidar.statistics.tolerances import TOL
from studies.common.distance import wasserstein
from studies.common.sample import draw
from studies.count_law import run as count_law
from tests.harness.study import quick_study, written


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
def test_files(study):
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
