"""The native sampler by itself: Multinomial(N, shape) whatever way it takes, the same bits at every level."""

import numpy as np
import pytest
from harness import goodness, refused, require
from harness.pvalues import bonferroni, mean_vector, variance_score
from native_jobs import shape_job
from scipy import stats

from mars_lidar import _core

BINS = 200


def peaked(bins: int) -> np.ndarray:
    """A uniform background, empty in parts, and a peak."""
    j = np.arange(bins)
    shape = 0.3 / bins + 0.7 * np.exp(-0.5 * ((j - 0.6 * bins) / (0.02 * bins + 0.2)) ** 2) / (0.05 * bins + 0.5)
    shape[(j % 17 == 3) & (bins > 20)] = 0.0
    return (shape / shape.sum()).astype(np.float32)


def sample(
    shape: np.ndarray, counts: np.ndarray, *, seed: int = 1, level: str = "", threads: int = 2, dtype: type = np.uint32
) -> np.ndarray:
    """Histograms (realizations, pixels, bins) of counts (realizations, pixels), all pixels of one shape."""
    realizations, pixels = counts.shape
    out = np.empty((realizations * pixels, shape.size), dtype)
    job = shape_job(shape[None], pixels, realizations, seed)
    _core.shape_histogram(job, np.ascontiguousarray(counts, dtype=np.int64), out, threads, level, None)
    return out.reshape(realizations, pixels, shape.size)


@pytest.mark.parametrize("photons", [1, 7, 60, 153, 154, 400, 3000, 200_000, 30_000_000, 3_000_000_000])
def test_multinomial_by_either_way(photons: int):
    """Photon by photon below 154 (0.15 x 1024), Poisson rounds above: means, variances, totals, covariances."""
    shape = peaked(BINS)
    draws = 8000
    cube = sample(shape, np.full((draws // 8, 8), photons)).reshape(-1, BINS)
    assert (cube.sum(-1, dtype=np.int64) == photons).all()
    assert not cube[:, shape == 0].any()
    p = shape.astype(float) / shape.astype(float).sum()
    often = p * draws * photons > 400
    x = cube[:, often].astype(float)
    mean, variance = photons * p[often], photons * (p * (1 - p))[often]
    two = np.add.reduceat(p, np.arange(0, BINS, 50)), np.add.reduceat(cube.astype(float), np.arange(0, BINS, 50), 1)
    outcomes = {
        "mean": bonferroni(2 * stats.norm.sf(np.abs(x.mean(0) - mean) / np.sqrt(variance / draws))),
        "parts": mean_vector(two[1][:, :-1], photons * two[0][:-1]),
    }
    if photons * p[often].min() > 1:
        z = variance_score(x, variance)
        outcomes["variance"] = bonferroni(2 * stats.norm.sf(np.abs(z)))
        z = variance_score(two[1], photons * two[0] * (1 - two[0]))
        outcomes["variance of parts"] = bonferroni(2 * stats.norm.sf(np.abs(z)))
    require(outcomes, f"multinomial, {photons} photons")


@pytest.mark.parametrize("mean", [0.05, 0.7, 3.0, 20.0, 39.0, 41.0, 90.0, 2000.0])
def test_counts_of_a_bin_are_binomial(mean: float):
    """A thousand equal bins: the law of each of them, over either form of the Poisson numbers (40)."""
    bins = 1024
    photons = round(mean * bins)
    cube = sample(np.full(bins, 1 / bins, np.float32), np.full((60, 4), photons), seed=3)
    law = stats.binom(photons, 1 / bins)
    low, high = int(law.ppf(1e-7)), int(law.isf(1e-7))
    observed = np.bincount(np.clip(cube.ravel(), low, high) - low, minlength=high - low + 1)
    expected = law.pmf(np.arange(low, high + 1)) * cube.size
    # bins of one exposure repel a little (1 in 1023), which makes the statistic smaller, not larger
    require({"law": goodness(observed, expected * observed.sum() / expected.sum())}, f"bin of mean {mean}")


@pytest.mark.parametrize("bins", [1, 2, 7, 63, 64, 65, 200, 1000, 4096, 70_001])
def test_any_number_of_bins_and_every_level(bins: int):
    shape = peaked(bins)
    counts = np.array([[0, 1, 30], [2000, 90_000, 10 * bins]])
    cubes = [sample(shape, counts, level=level, threads=1 + k % 2) for k, level in enumerate(_core.levels())]
    assert np.array_equal(cubes[0].sum(-1, dtype=np.int64), counts)
    assert all(np.array_equal(cubes[0], cube) for cube in cubes[1:])


def test_a_bin_that_is_too_full_is_an_error():
    shape = np.array([1.0, 0.0, 0.0], np.float32)
    refused("65535", sample, shape, np.array([[70_000]]), dtype=np.uint16, error=OverflowError)
    assert sample(shape, np.array([[65_535]]), dtype=np.uint16)[0, 0, 0] == 65_535
    refused("4294967295", sample, shape, np.array([[2**32]]), error=OverflowError)
