"""Count laws and shapes under their two verbs (docs/theory_exposure.md, sections 8 and 9)."""

import math

import numpy as np
import pytest
from harness.cases import make_system, random_cases, system_of
from harness.laws import law_of, pmf_of
from harness.ledger import require
from harness.pvalues import bonferroni, counts_against_law, goodness
from harness.reference import REFERENCE_NAMES, Reference
from harness.refusal import refused
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.statistics import ConvergenceError, PhaseChain, holding_times
from mars_lidar.statistics import pmf as _pmf
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.count_laws import count_law
from mars_lidar.statistics.histogram import registration_pdf
from mars_lidar.statistics.matched import matched_pmf, trusted
from mars_lidar.statistics.moments import refined_moments
from mars_lidar.statistics.pmf import Pmf, exact_pmfs, gaussian_pmf, guessed_pmfs, total_variation
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


# The count law from four cumulants: close to the exact law, true to the request, drawn as it is listed.


PERIOD_NS = 1e3 / 7.5
AIM = 0.002
NEEDLESS = 0.06
# one of each form: smooth, few photons, locked (binomial loss, loss and gain), mended, two integers
FORMS = {
    "smooth": (750.0, 141.0, -60.0, 20.0),
    "few": (3.12613859, 3.07040571, 2.96147295, 2.75102986),
    "loss": (99.03743, 0.95289, -0.93375, 0.89606),
    "both": (9999.74073, 0.61156, -0.25924, 0.61138),
    "mended": (93.86469, 0.48981, -0.047, 0.01119),
    "pair": (7.25, 0.1875, 0.09375, -0.0234375),
}


def matched_counts(cumulants, uniform, threads=1):
    """(cells, draws) counts by inversion, as the engines draw them, at `uniform` (cells, draws)."""
    uniform = np.array(uniform)
    out = np.empty(uniform.shape, np.int64)
    _core.matched_draw(cumulants=np.array(cumulants), uniform=uniform, out=out, threads=threads)
    return out


def cumulants_of(window):
    n, p = window.first + np.arange(window.p.size), window.p
    mean = (p * n).sum()
    m2, m3, m4 = ((p * (n - mean) ** k).sum() for k in (2, 3, 4))
    return np.array([mean, m2, m3, m4 - 3 * m2**2])


def exact(dead, cycles, signal, background, start="armed"):
    system = make_system(dead * PERIOD_NS, cycles, 64, sigma_ns=0.5, period_ns=PERIOD_NS, start=start)
    return ml.count_law(ml.Flux(signal, background, 0.5 * PERIOD_NS), system)


def distances(law):
    return np.array(
        [total_variation(w, Pmf(int(law.support[k, 0]), law.pmf[k])) for k, w in enumerate(matched_pmf(law.cumulants))]
    )


@pytest.mark.full
def test_close_to_the_exact_law():
    # off the grid of the study
    signal, background = np.meshgrid(np.geomspace(0.013, 9.3, 8), np.geomspace(0.012, 9.1, 6))
    far, sure = [], []
    for start in ("armed", "stationary"):
        for cycles in (100, 1000):
            for dead in (0.1, 0.6375, 0.9766, 1.53):
                law = exact(dead, cycles, signal.ravel(), background.ravel(), start)
                far.append(distances(law))
                sure.append(trusted(law.cumulants))
    far, sure = np.concatenate(far), np.concatenate(sure)
    assert far[sure].max() <= AIM
    assert (~sure & (far <= AIM)).mean() < NEEDLESS
    assert (far <= AIM).mean() > 0.97
    assert far.max() < 0.03


def test_unlike_a_gaussian():
    law = exact(0.6375, 1000, np.array([0.001, 9.0]), np.array([0.002, 0.01]))
    best = [gaussian_pmf(*k[:2]) for k in law.cumulants]
    away = [total_variation(g, Pmf(int(law.support[k, 0]), law.pmf[k])) for k, g in enumerate(best)]
    assert min(away) > 10 * AIM
    assert distances(law).max() < AIM


@pytest.mark.parametrize("name", FORMS)
def test_probabilities_have_the_cumulants(name):
    asked = np.array(FORMS[name])
    window = matched_pmf([asked])[0]
    assert window.p.min() >= 0
    assert window.p.sum() == pytest.approx(1, abs=1e-12)
    result, spread = cumulants_of(window), np.sqrt(asked[1])
    scale = np.array([1.0, spread, spread**2, spread**3]) * spread
    # the quantile of the smooth form is a series, the others are exact
    tolerance = 2e-3 if name == "smooth" else 1e-6
    np.testing.assert_array_less(np.abs(result - asked) / scale, tolerance)


@pytest.mark.parametrize("name", FORMS)
def test_draws_follow_the_listed_probabilities(name):
    random = np.random.default_rng([2027, list(FORMS).index(name)])
    drawn = matched_counts([FORMS[name]], random.random((1, 400_000)))[0]
    window = matched_pmf([FORMS[name]])[0]
    assert drawn.min() >= window.first
    assert drawn.max() < window.first + window.p.size
    observed = np.bincount(drawn - window.first, minlength=window.p.size)
    require({"frequencies": goodness(observed, drawn.size * window.p)}, f"matched law, {name}")


@pytest.mark.parametrize("name", FORMS)
def test_one_inversion(name):
    """The count at u is the quantile: at each edge of the distribution function it steps by one."""
    window = matched_pmf([FORMS[name]])[0]
    below = np.cumsum(window.p)
    count = window.first + np.arange(below.size)
    inside = (below > 1e-9) & (below < 1 - 1e-9) & (window.p > 1e-9) & (np.append(window.p[1:], 0) > 1e-9)
    edge = below[inside]
    assert matched_counts([FORMS[name]], [edge * (1 - 1e-11)])[0].tolist() == count[inside].tolist()
    assert matched_counts([FORMS[name]], [edge * (1 + 1e-11)])[0].tolist() == (count[inside] + 1).tolist()


def test_many_cells_on_threads_as_one_by_one():
    random = np.random.default_rng(5)
    cells = np.array(list(FORMS.values()))[random.integers(0, len(FORMS), 3000)]
    u = random.random((3000, 2))
    together = matched_counts(cells, u, threads=2)
    np.testing.assert_array_equal(
        together[::500],
        np.vstack([matched_counts(cells[k : k + 1], u[k : k + 1], threads=1) for k in range(0, 3000, 500)]),
    )


def test_normal_quantile():
    """A law so wide that its count is the quantile to 1e-9."""
    u = np.concatenate([np.geomspace(1e-15, 0.5, 60), 1 - np.geomspace(1e-15, 0.5, 60)])
    counts = matched_counts([(1e12, 1e18, 0.0, 0.0)], [u])[0]
    expected = 1e12 + 1e9 * stats.norm.ppf(u)
    np.testing.assert_allclose(counts - 1e12, np.floor(expected + 0.5) - 1e12, rtol=0, atol=2)


@pytest.mark.parametrize("mean", [*np.geomspace(1e-9, 1e9, 19), 0.5, 3.0, 8.9, 9.1, 30.0])
def test_poisson_from_its_cumulants(mean):
    window = matched_pmf([[mean] * 4])[0]
    n = window.first + np.arange(window.p.size)
    p = stats.poisson.pmf(n, mean)
    assert 0.5 * (np.abs(window.p - p).sum() + 1 - p.sum()) < 5e-4
    assert trusted([[mean] * 4])[0]


@pytest.mark.parametrize("cycles", [1, 2, 3, 8])
@pytest.mark.parametrize("fires", [0.02, 0.3, 0.5, 0.8, 0.99])
def test_binomial_of_few_cycles(cycles, fires):
    """A locked pixel of a few cycles."""
    q, v = 1 - fires, cycles * fires * (1 - fires)
    window = matched_pmf([(cycles * fires, v, v * (q - fires), v * (1 - 6 * fires * q))])[0]
    p = stats.binom.pmf(window.first + np.arange(window.p.size), cycles, fires)
    assert 0.5 * np.abs(window.p - p).sum() < 5e-3


def test_extremes():
    assert matched_pmf([(0.0, 0.0, 0.0, 0.0)])[0].p[0] == 1
    assert matched_counts([(0.0, 0.0, 0.0, 0.0)], [[1e-300, 1 - 1e-16]]).tolist() == [[0, 0]]
    certain = matched_pmf([(41.0, 0.0, 0.0, 0.0)])[0]
    assert (certain.first, certain.p[0]) == (41, 1.0)
    # a variance that no integer of this mean can have: the nearest law keeps the mean
    least = matched_pmf([(41.3, 0.1, 0.0, 0.0)])[0]
    np.testing.assert_allclose(cumulants_of(least)[:2], [41.3, 0.21])
    assert not trusted([(41.3, 0.1, 0.0, 0.0)])[0]
    large = matched_pmf([(1e9, 2e8, -3e7, 1e7)])[0]
    np.testing.assert_allclose(cumulants_of(large)[:3], [1e9, 2e8, -3e7], rtol=1e-4)


@pytest.mark.full
def test_cumulants_that_no_count_has():
    """Anything at all gives a law: what interpolation makes of a table must never fail."""
    random = np.random.default_rng(11)
    size = 20_000
    mean = 10 ** random.uniform(-6, 4, size)
    variance = mean * 10 ** random.uniform(-4, 0.5, size)
    others = random.standard_cauchy((2, size)) * variance ** np.array([[1.5], [2.0]])
    cells = np.stack([mean, variance, *others], axis=-1)
    for window in matched_pmf(cells):
        assert window.first >= 0
        assert window.p.min() >= 0
        assert abs(window.p.sum() - 1) < 1e-9
    u = np.sort(random.uniform(1e-16, 1 - 1e-16, (size, 9)), axis=1)
    counts = matched_counts(cells, u)
    assert (np.diff(counts, axis=1) >= 0).all()
    wild = [(5.0, 2.0, 1e300, -1e300), (5.0, 2.0, -1e300, 1e300), (1e-300, 1e-300, 0.0, 0.0), (5.0, 1e9, 0.0, 0.0)]
    for window in matched_pmf(wild):
        assert abs(window.p.sum() - 1) < 1e-9


@pytest.mark.parametrize("atoms", [2, 3, 4, 5])
def test_laws_on_a_few_integers_keep_mean_and_variance(atoms):
    random = np.random.default_rng(atoms)
    p = random.dirichlet(np.full(atoms, 0.3), 2000)
    first = random.integers(0, 5000, 2000)
    cells = np.array([cumulants_of(Pmf(int(f), q)) for f, q in zip(first, p, strict=True)])
    spread = np.sqrt(np.maximum(cells[:, 1], 1e-12))
    result = np.array([cumulants_of(window) for window in matched_pmf(cells)])
    assert (np.abs(result[:, 0] - cells[:, 0]) <= 0.02 * spread + 1e-6).all()
    assert (np.abs(result[:, 1] - cells[:, 1]) <= 0.05 * cells[:, 1] + 1e-6).all()


def test_next_to_no_step_at_the_change_of_form():
    """The laws on either side of a variance of 9 and of the other thresholds are near one another."""
    steps = []
    for variance, third, fourth in ((9.0, -3.0, 1.0), (9.0, 8.0, 7.0), (0.7, -0.1, 0.02)):
        first, other = (matched_pmf([(40.3, variance * scale, third, fourth)])[0] for scale in (1 - 1e-9, 1 + 1e-9))
        steps.append(total_variation(first, other))
    assert max(steps) < 0.01


@pytest.mark.parametrize(
    ("cumulants", "message"),
    [
        ([1.0, 1.0, 1.0, 1.0], r"cumulants must be of shape \(cells, 4\), got \(4,\)"),
        ([(1.0, -1.0, 0.0, 0.0)], r"cumulants\[0\] must be finite .* variance >= 0, got \[1.0, -1.0"),
        ([(1.0, 1.0, 0.0, 0.0), (np.nan, 1.0, 0.0, 0.0)], r"cumulants\[1\] must be finite"),
        ([(1e16, 1.0, 0.0, 0.0)], r"a mean in \[0, 1e\+15\]"),
        ([(1e15, 1e14, 0.0, 0.0)], r"cumulants\[0\] must have a variance for which"),
    ],
)
def test_bad_cumulants(cumulants, message):
    refused(message, matched_pmf, cumulants)


# Exact pmfs whose support is guessed from cumulants that are known but roughly.


SYSTEM = make_system(63.75, 120, 32)


def cells():
    signal, background = np.array([8.0, 3.0, 0.3, 0.001, 6.0]), np.array([0.02, 0.5, 3.0, 0.002, 0.2])
    some = Cells.of(signal, background, SYSTEM, delay_ns=[3.0, 50.0, 60.0, 10.0, 97.0])
    result = refined_moments(some, 1, tolerance=1e-4, threads=1)
    return some, result.cumulants.reshape(-1, 4), result.bins.reshape(-1)


def alone(monkeypatch):
    """Cells whose law is computed by their own cumulants."""
    asked, compute = [], _pmf._by_own_cumulants
    monkeypatch.setattr(_pmf, "_by_own_cumulants", lambda cell, threads: asked.append(1) or compute(cell, threads))
    return asked


def test_they_are_the_exact_ones(monkeypatch):
    some, cumulants, bins = cells()
    asked, windows = alone(monkeypatch), []
    for guess, truth in zip(
        guessed_pmfs(some, cumulants, bins, 1, windows.append), exact_pmfs(some, cumulants, bins, 1), strict=True
    ):
        assert total_variation(guess, truth) < 1e-11
    assert not asked
    assert windows[-1] == some.size


@pytest.mark.parametrize(
    "wrong",
    [
        lambda k: k + np.array([25.0, 0, 0, 0]),  # elsewhere altogether
        lambda k: k + np.array([1.0, 0, 0, 0]),  # by a good part of the spread
        lambda k: k * [1.0, 1e-6, 1, 1],  # far too narrow
        lambda k: k * [1.0, 1e6, 1, 1],  # wider than a guess may be
    ],
)
def test_a_wrong_guess_is_noticed(monkeypatch, wrong):
    some, cumulants, bins = cells()
    wide = np.array([1, 2, 4])  # counts of some spread: the others are all but certain
    some, cumulants, bins = some.part(wide), cumulants[wide], bins[wide]
    asked = alone(monkeypatch)
    guesses = guessed_pmfs(some, np.asarray(wrong(cumulants)), bins, 1)
    for guess, truth in zip(guesses, exact_pmfs(some, cumulants, bins, 1), strict=True):
        assert total_variation(guess, truth) < 1e-6
    assert asked
