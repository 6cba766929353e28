"""The Poisson engine by itself: the sampler at every mean, independent bins, full bins.

Every statistical check compares a p-value with ALPHA; with some 110 of them the file raises a false alarm
with a probability of about 1e-4 for a new choice of seeds. The seeds are fixed.
"""

from __future__ import annotations

import numpy as np
import pytest
from native_emulation import poisson_sample
from native_jobs import Case, chi_square, gaussian_energy, z_to_p
from scipy import stats

from mars_lidar import _core

ALPHA = 8e-7


def sample(mean: float, n: int, seed: int = 1) -> np.ndarray:
    return poisson_sample(seed, mean, n)


@pytest.mark.parametrize("mean", [1e-3, 0.1, 0.9, 3.0, 9.999, 10.0, 10.5, 14.0, 30.0, 100.0, 2e3])
def test_sampler_follows_the_poisson_law(mean: float):
    n = 500_000
    x = sample(mean, n)
    k = np.arange(x.max() + 20)
    assert chi_square(np.bincount(x, minlength=k.size), n * stats.poisson.pmf(k, mean)) > ALPHA


@pytest.mark.parametrize("mean", [1e4, 1e6, 1e9, 1e12])
def test_sampler_at_large_means(mean: float):
    """Cells of a fifth of a standard deviation against the distribution function, and odd against even."""
    n = 500_000
    x = sample(mean, n)
    edges = np.unique(np.floor(mean + np.sqrt(mean) * np.linspace(-5, 5, 51)))
    expected = n * np.diff(np.concatenate([[0.0], stats.poisson.cdf(edges, mean), [1.0]]))
    observed = np.diff(np.concatenate([[0], np.searchsorted(np.sort(x), edges, side="right"), [n]]))
    assert chi_square(observed, expected) > ALPHA
    assert stats.binomtest(int((x % 2).sum()), n).pvalue > ALPHA


def test_sampler_at_vanishing_means():
    assert not sample(0.0, 10).any()
    assert not sample(1e-12, 1_000_000).any()
    assert stats.poisson.cdf(sample(1e-6, 4_000_000).sum(), 4.0) > ALPHA
    assert stats.poisson.sf(sample(1e-6, 4_000_000).sum() - 1, 4.0) > ALPHA


# background of a bin: placed photons, table, rejection
@pytest.mark.parametrize("per_bin", [0.0, 0.02, 2.9, 3.1, 40.0, 9e3, 2e4])
@pytest.mark.parametrize("bins", [96, 1000])
def test_bins_are_independent_poisson_numbers(per_bin: float, bins: int):
    realizations = 40_000 // bins * 10
    case = Case(
        signal=0.4, background=per_bin * bins / 1000, delay=-0.001, bins=bins, realizations=realizations, seed=9
    )
    mean = 400 * gaussian_energy(-0.001, 0.00375, bins) + per_bin
    cube = case.histogram("poisson", threads=2).astype(float)
    assert not cube[:, mean < 1e-9].any()
    assert chi_square(cube.sum(0), realizations * mean) > ALPHA
    likely = mean > 1e-2
    m = mean[likely]
    deviation = (cube[:, likely] - m) / np.sqrt(m)
    size = deviation.size
    # variance of all bins; covariance of neighbours, of halves of a row, and of successive realizations
    assert z_to_p((np.sum(deviation**2) - size) / np.sqrt(realizations * np.sum(2 + 1 / m)))[()] > ALPHA
    for lower, right in (
        (deviation[:, 1:], deviation[:, :-1]),
        (deviation[:, : m.size // 2], deviation[:, m.size - m.size // 2 :]),
        (deviation[1:], deviation[:-1]),
    ):
        assert z_to_p(np.sum(lower * right) / np.sqrt(lower.size))[()] > ALPHA
    total = np.sum((cube.sum(1) - mean.sum()) ** 2) / mean.sum()
    assert 2 * min(stats.chi2.sf(total, realizations), stats.chi2.cdf(total, realizations)) > ALPHA


def test_the_dead_time_is_ignored():
    dead = Case(dead_time=50.0, stationary=True).histogram("poisson")
    assert np.array_equal(dead, Case(dead_time=0.0).histogram("poisson"))


@pytest.mark.parametrize(
    ("signal", "background", "dtype"),
    [
        (70.0, 0.0, np.uint16),
        (0.0, 70.0 * 64, np.uint16),
        (60.0, 20.0 * 64, np.uint16),
        (1e6, 0.0, np.uint32),
        (0.0, 1e6 * 64, np.uint32),
    ],
)
def test_a_full_bin_is_an_error(signal: float, background: float, dtype: type):
    cycles = 1000 if dtype is np.uint16 else 10**6
    case = Case(signal=signal, background=background, delay=0.508, cycles=cycles)
    with pytest.raises(OverflowError, match=str(np.iinfo(dtype).max)):
        case.histogram("poisson", dtype=dtype)


def test_wrong_arrays_are_errors():
    case = Case()
    with pytest.raises(ValueError, match="out"):
        _core.poisson_histogram(case.job(), case.pulse, np.empty((2, 64), np.uint16), 1, None)
    with pytest.raises(TypeError):
        _core.poisson_histogram(case.job(), case.pulse, np.empty((1, 64), np.int16), 1, None)
