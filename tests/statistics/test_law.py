"""Count laws and shapes under their two verbs (docs/theory_exposure.md, sections 8 and 9)."""

import math

import numpy as np
import pytest
from harness.cases import random_cases, system_of
from harness.laws import law_of, pmf_of
from harness.ledger import require
from harness.pvalues import bonferroni, counts_against_law, goodness
from harness.reference import REFERENCE_NAMES, Reference
from harness.refusal import refused
from scipy import stats

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError, PhaseChain, holding_times
from mars_lidar.statistics.histogram import registration_pdf
from mars_lidar.statistics.law import count_law
from mars_lidar.statistics.tolerances import TOL


def moments_of(law):
    """Mean, variance, third and fourth cumulant from the pmf."""
    mean = (law.pmf * law.support).sum(-1)
    offset = law.support - mean[..., None]
    second, third, fourth = ((law.pmf * offset**k).sum(-1) for k in (2, 3, 4))
    return mean, second, third, fourth - 3 * second**2


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("signal", "background", "dead", "cycles"),
    [
        (1.0, 1.0, 0.6375, 1000),
        (10.0, 0.1, 0.976562, 1000),
        (10.0, 0.01, 1.97, 800),
        (0.05, 0.02, 0.6375, 100),
        (3.0, 0.5, 2.25, 700),
        (2.0, 2.0, 0.0003, 50),
        (1.0, 0.2, 40.5, 500),
        (3.0, 3.0, 0.4, 1),
        (1e-6, 0.0, 0.5, 1000),
        (2.0, 1.0, 0.6375, 10**6),
    ],
)
def test_pmf_agrees_with_cumulants(signal, background, dead, cycles, start):
    system = system_of(dead, cycles=cycles, start=start, sigma=0.01)
    law = count_law(ml.Flux(signal, background, 37.0), system)
    assert law.pmf.shape == law.support.shape == law.cdf.shape
    assert (law.pmf >= 0).all()
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-8)
    assert law.outside <= 2e-12
    assert (np.diff(law.support) == 1).all()
    assert law.support[0] >= 0
    for k, result in enumerate(moments_of(law)):
        scale = max(abs(law.cumulants[k]), float(law.variance) ** ((k + 1) / 2), 1e-12)
        noise = 1e-13 * law.support.size ** (k + 1)  # of the transform, some 1e-15 for every count
        assert result == pytest.approx(law.cumulants[k], abs=1e-5 * scale + noise)


def test_batches():
    system = system_of(0.6375)
    signal, background = np.array([[0.1], [2.0]]), np.array([0.0, 0.3, 3.0])
    law = count_law(ml.Flux(signal, background, 20.0), system)
    assert law.mean.shape == law.variance.shape == law.outside.shape == (2, 3)
    assert law.cumulants.shape == (2, 3, 4)
    assert law.support.shape == law.pmf.shape == law.cdf.shape
    assert law.pmf.shape[:2] == (2, 3)
    for i, j in np.ndindex(2, 3):
        pixel = count_law(ml.Flux(signal[i, 0], background[j], 20.0), system)
        size = pixel.pmf.size
        np.testing.assert_array_equal(law.support[i, j, :size], pixel.support)
        np.testing.assert_allclose(law.pmf[i, j, :size], pixel.pmf, atol=1e-8)
        np.testing.assert_allclose(law.pmf[i, j, size:], 0.0)
    delays = count_law(ml.Flux(1.0, 1.0, [10.0, 90.0]), system)
    assert delays.mean.shape == (2,)
    assert delays.mean[0] != delays.mean[1]
    assert "cells of shape (2,)" in repr(delays)


def test_no_flux():
    law = count_law(ml.Flux(0.0, 0.0), system_of(0.5))
    assert law.mean == law.variance == 0
    assert law.pmf[law.support == 0] == 1.0
    np.testing.assert_allclose(registration_pdf(ml.Flux(0.0, [0.0, 1e-9]), system_of(0.5)), 1 / 64, rtol=1e-6)


def test_poisson():
    for dead, method in ((0.0, "exact"), (0.6, "poisson")):
        law = count_law(ml.Flux([1.0, 1e-4], 0.5, 50.0), system_of(dead), method)
        np.testing.assert_allclose(law.cumulants[0], 1500.0)
        exact = stats.poisson.pmf(law.support, law.mean[:, None])
        inside = law.pmf > 0
        np.testing.assert_allclose(law.pmf[inside], exact[inside], rtol=1e-9)
        np.testing.assert_allclose(law.pmf.sum(-1), 1.0, atol=1e-11)


def test_mars_is_the_gaussian_of_the_paper():
    system = system_of(0.6375)
    for rearm in (None, "centre", "edge"):
        law = count_law(ml.Flux([1.0, 0.002], 0.001, 50.0), system, "mars", rearm=rearm)
        chains = [
            PhaseChain.from_flux(ml.Flux(signal, 0.001, 50.0), system, rearm=rearm or "centre")
            for signal in (1.0, 0.002)
        ]
        mean, variance = np.transpose([(1000 / t.mu, 1000 * t.sigma2 / t.mu**3) for t in map(holding_times, chains)])
        np.testing.assert_array_equal(law.mean, mean)
        np.testing.assert_array_equal(law.variance, variance)
        np.testing.assert_array_equal(law.cumulants[:, 2:], 0.0)
        edges = np.where(law.support == 0, -np.inf, law.support - 0.5)
        normal = stats.norm(mean[:, None], np.sqrt(variance[:, None]))
        inside = law.pmf > 0
        exact = normal.cdf(law.support + 0.5) - normal.cdf(edges)
        np.testing.assert_allclose(law.pmf[inside], exact[inside], atol=1e-14)
        np.testing.assert_allclose(law.cdf[:, -1], 1.0, atol=1e-14)
    assert (
        count_law(ml.Flux(1.0, 1.0, 50.0), system, "mars", rearm="edge").mean
        > count_law(ml.Flux(1.0, 1.0, 50.0), system, "mars").mean
    )


def test_renewal_is_the_constant_rate_gaussian():
    law = count_law(ml.Flux(1.0, 1.0, 50.0), system_of(0.6375), "renewal")
    assert law.mean == pytest.approx(2000 / 2.275)
    assert law.variance == pytest.approx(2000 / 2.275**3)
    result = moments_of(law)
    assert result[0] == pytest.approx(law.mean)
    assert result[1] == pytest.approx(law.variance + 1 / 12, rel=1e-6)  # a Gaussian on integers


def test_shapes():
    system = system_of(0.6375, bins=128, cycles=100_000)
    methods = ("exposure", "stationary", "chain")
    shapes = {m: registration_pdf(ml.Flux([0.5, 5.0], 1.0, 30.0), system, m) for m in methods}
    for shape in shapes.values():
        assert shape.shape == (2, 128)
        assert (shape >= 0).all()
        np.testing.assert_allclose(shape.sum(-1), 1.0, atol=1e-12)
    # a long exposure is stationary, the chain re-arms at bin centres
    assert 0.5 * np.abs(shapes["exposure"] - shapes["stationary"]).sum(-1).max() < 1e-5
    assert 0.5 * np.abs(shapes["chain"] - shapes["stationary"]).sum(-1).max() < 5e-4
    edge = registration_pdf(ml.Flux([0.5, 5.0], 1.0, 30.0), system, "chain", rearm="edge")
    assert np.abs(edge - shapes["chain"]).sum() > 1e-4
    # a short one is not
    short = registration_pdf(ml.Flux(0.5, 1.0, 30.0), system.replace(cycles=3))
    assert 0.5 * np.abs(short - shapes["stationary"][0]).sum() > 0.02


@pytest.mark.parametrize(
    ("law", "method", "rearm", "message"),
    [
        (count_law, "normal", None, "method must be one of 'exact', .*'normal'"),
        (registration_pdf, "exact", None, "method must be one of 'exposure'"),
        (count_law, "exact", "edge", "rearm must be None for method 'exact'"),
        (count_law, "mars", "left", "rearm must be one of.*'left'"),
    ],
)
def test_bad_input(law, method, rearm, message):
    refused(message, law, ml.Flux(1.0, 1.0, 50.0), system_of(0.5), method, rearm=rearm)


def test_a_pmf_that_contradicts_its_cumulants_is_refused(monkeypatch):
    monkeypatch.setitem(vars(TOL), "tail", 0.2)  # too small a window: the pmf is aliased
    with pytest.raises(ConvergenceError, match=r"S = 1, B = 1 .* disagrees with the cumulants"):
        _ = count_law(ml.Flux(1.0, 1.0, 50.0), system_of(0.6375)).pmf


@pytest.mark.full
def test_random_systems_against_the_exact_engine():
    """120 systems; the whole test fails by chance once in some ten thousand times.

    In 98 of 100 runs it detects a mean that is 7 standard errors off in one system, or 0.7 in all of them.
    """
    scores, p_values = [], []
    for number, case in enumerate(random_cases(120, 20261, photons=4e5)):
        law = count_law(case.flux[0, 0], case.system, threads=1)
        cube = ml.simulate(case.flux, case.system, realizations=500, seed=number, threads=1)
        counts = cube.sum(-1, dtype=np.int64).ravel()
        if law.variance * counts.size < 20:  # locked: too few events for a Gaussian score
            assert abs(counts.mean() - law.mean) < 0.02
            continue
        scores.append((counts.mean() - law.mean) / math.sqrt(law.variance / counts.size))
        spread = law.cumulants[3] + 2 * law.variance**2
        scores.append((((counts - law.mean) ** 2).mean() - law.variance) / math.sqrt(spread / counts.size))
        p_values.append(counts_against_law(counts, pmf_of(law)))
    assert len(p_values) > 75
    assert np.abs(scores[::2]).max() < 4.9
    assert np.abs(scores[1::2]).max() < 7  # the square's own tails are heavier
    assert min(p_values) > 1e-7
    assert stats.kstest(scores[::2], "norm").pvalue > 1e-5
    assert stats.kstest(p_values, "uniform").pvalue > 1e-6  # pooled cells: uniform only roughly


@pytest.mark.parametrize("name", REFERENCE_NAMES)
def test_reference(name):
    """Law of the count and mean histogram against ten cases of an independent simulator."""
    reference = Reference.load(name)
    case, size = reference.case(), reference.realizations
    law = law_of(case.flux[0, 0], case.system)
    pmf, observed = np.zeros((2, max(law.count_pmf.size, reference.count.size)))
    pmf[: law.count_pmf.size], observed[: reference.count.size] = law.count_pmf, reference.count
    n = np.arange(pmf.size)
    mean = pmf @ n
    second, fourth = (pmf @ (n - mean) ** k for k in (2, 4))
    often = reference.mean * size > 500
    score = (reference.mean - law.histogram)[often] / np.sqrt(reference.variance[often] / size)
    z = [
        (reference.count_mean - mean) / math.sqrt(second / size),
        (reference.count_var - second) / math.sqrt((fourth - second**2) / size),
    ]
    p = {
        "count law": goodness(observed, size * pmf + 1e-12),
        "moments": bonferroni(2 * stats.norm.sf(np.abs(z))),
        "mean histogram": bonferroni(2 * stats.norm.sf(np.abs(score))),
    }
    require(p, f"count law, {name}")
