"""The count law from four cumulants: close to the exact law, true to the request, drawn as it is listed."""

import numpy as np
import pytest
from harness import goodness, make_system, refused, require
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.statistics.count_pmf import Pmf, gaussian_pmf, total_variation
from mars_lidar.statistics.matched import matched_pmf, trusted

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
def test_poisson(mean):
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
