"""The native sampler by itself: Multinomial(N, shape) whatever way it takes, the same bits at every level."""

from functools import cache

import numpy as np
import pytest
from harness import bonferroni, goodness, make_system, mean_vector, refused, require, two_lobes
from harness.pvalues import variance_score
from native_jobs import align, shape_job
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines.pixels import Alignment
from mars_lidar.engines.table_reader import as_shapes
from mars_lidar.statistics import exposure_moments

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


# Photons one by one out of a table's rows: the law of the shape that would be formed from them.


PERIOD_NS = 100.0
SIGNALS, BACKGROUNDS = (0.2, 1.3), (0.05, 0.6)


@cache
def shapes_of(dead: float, signals: tuple[float, ...], backgrounds: tuple[float, ...]) -> tuple[ml.System, np.ndarray]:
    system = make_system(dead * PERIOD_NS, 1000, BINS, sigma_ns=0.9, start="stationary")
    s, b = np.meshgrid(signals, backgrounds, indexing="ij")
    return system, as_shapes(exposure_moments(ml.Flux(s.ravel(), b.ravel(), 50.0), system).histogram)


class Pixels:
    """Pixels of a mixture of four rows at some delays, and their job."""

    def __init__(self, dead: float, moves: list[float], signal: float = 0.75, background: float = 0.3, seed: int = 4):
        self.n = len(moves)
        system, rows_of = shapes_of(dead, SIGNALS, BACKGROUNDS)
        weights = np.tile([0.1, 0.3, 0.4, 0.2], (self.n, 1))
        rows = np.tile(np.arange(4), (self.n, 1))
        if signal == 0.0:
            system, rows_of = shapes_of(dead, (0.0,), (0.3, 0.9))
            rows, weights = rows * 0, np.tile([1.0, 0.0, 0.0, 0.0], (self.n, 1))
        if background == 0.0:
            system, rows_of = shapes_of(dead, (1.9,), (0.0,))
            rows, weights = rows * 0, np.tile([1.0, 0.0, 0.0, 0.0], (self.n, 1))
        self.system, self.shapes, self.rows, self.weights, self.seed = system, rows_of, rows, weights, seed
        delay = 0.5 * PERIOD_NS + np.array(moves) * PERIOD_NS / BINS
        both = np.full(self.n, signal), np.full(self.n, background)
        self.alignment = Alignment.of(system, *both, delay, np.full(self.n, 0.4))
        self.guides = np.zeros((len(rows_of), 64), np.float32)

    def job(self, realizations: int, guided: bool = True) -> _core.ShapeJob:
        job = shape_job(self.shapes, self.n, realizations, self.seed, self.rows, self.weights)
        align(job, self.alignment, self.system.dead_time_periods)
        if guided:
            job.guide(guides=self.guides, threads=2)
        return job

    def aligned(self) -> np.ndarray:
        out = np.empty((self.n, BINS))
        _core.shape_aligned(self.job(1), out, "")
        return out / out.sum(-1, keepdims=True)

    def draw(self, counts: np.ndarray, level: str = "", guided: bool = True, dtype: type = np.uint16) -> np.ndarray:
        out = np.full((counts.size, BINS), 9, dtype)
        _core.shape_histogram(self.job(len(counts), guided), counts.astype(np.int64), out, 2, level, None)
        return out.reshape(*counts.shape, BINS)


MOVES = [0.0, 13.0, 3.31, -20.77, 99.5]


@pytest.mark.full
@pytest.mark.parametrize(
    ("dead", "signal", "background"),
    [(0.6375, 0.75, 0.3), (0.12, 0.75, 0.3), (2.3, 0.75, 0.3), (0.6375, 0.0, 0.3), (0.6375, 1.9, 0.0)],
)
def test_photons_follow_the_formed_shape(dead: float, signal: float, background: float):
    """60 photons 20,000 times: bins by chi-square, and the variance of the frame and of three parts behind it."""
    pixels = Pixels(dead, MOVES, signal, background)
    photons, draws = 60, 20_000
    cube = pixels.draw(np.full((draws, len(MOVES)), photons))
    assert (cube.sum(-1) == photons).all()
    assert not np.array_equal(cube, pixels.draw(np.full((draws, len(MOVES)), photons), guided=False))
    outcomes = {}
    for k, (move, shape) in enumerate(zip(MOVES, pixels.aligned(), strict=True)):
        assert not cube[:, k, shape == 0.0].any()
        observed = cube[:, k].sum(0, dtype=np.int64)
        outcomes[f"bins, moved {move:g}"] = goodness(observed, shape * observed.sum())
        turned = -int(np.floor(move)) - BINS // 2 + 15  # the frame begins here
        parts = np.add.reduceat(np.roll(cube[:, k], turned, -1), [0, 30, 90, 150], -1)
        p = np.add.reduceat(np.roll(shape, turned), [0, 30, 90, 150])
        parts, p = parts[:, (p > 1e-3) & (p < 0.999)].astype(float), p[(p > 1e-3) & (p < 0.999)]
        if p.size:
            z = variance_score(parts, photons * p * (1 - p))
            outcomes[f"parts, moved {move:g}"] = bonferroni(2 * stats.norm.sf(np.abs(z)))
    require(outcomes, f"photons one by one, t_d {dead:g}, S {signal:g}, B {background:g}")


def test_every_level_places_alike():
    rng = np.random.default_rng(3)
    pixels = Pixels(0.6375, MOVES)
    counts = rng.integers(0, 400, (40, len(MOVES)))
    counts[0], counts[1] = 0, 1
    cubes = [pixels.draw(counts, level) for level in _core.levels()]
    assert np.array_equal(cubes[0].sum(-1), counts)
    assert all(np.array_equal(cubes[0], cube) for cube in cubes[1:])
    assert np.array_equal(cubes[0], pixels.draw(counts, dtype=np.uint32))


# Shapes moved by fractions of a bin, against exact statistics at the pixel's own delay.


ALIGNMENT_BINS = 256
BIN_NS = PERIOD_NS / ALIGNMENT_BINS
ALIGNMENT_MOVES = np.array([0.0, 3.25, -20.5, 7.8, 127.6])  # bins


def system_of(sigma_bins: float, dead: float, **changes: object) -> ml.System:
    return make_system(
        dead * PERIOD_NS, 1000, ALIGNMENT_BINS, sigma_ns=sigma_bins * BIN_NS, start="stationary"
    ).replace(**changes)


def moved(system: ml.System, signal: float, background: float, moves: np.ndarray, level: str = "") -> np.ndarray:
    """Shapes (moves, bins) by the native alignment."""
    canonical = exposure_moments(ml.Flux(signal, background, 50.0), system)
    n, delay = moves.size, 0.5 * PERIOD_NS + moves * BIN_NS
    rate = np.full(n, canonical.mean / system.cycles)
    job = shape_job(as_shapes(canonical.histogram), n)
    alignment = Alignment.of(system, np.full(n, signal), np.full(n, background), delay, rate)
    align(job, alignment, system.dead_time_periods)
    out = np.empty((n, ALIGNMENT_BINS))
    _core.shape_aligned(job, out, level)
    return out


def distance(system: ml.System, signal: float, background: float) -> float:
    """Largest total variation to the exact shape at the moved delays."""
    exact = exposure_moments(ml.Flux(signal, background, 0.5 * PERIOD_NS + ALIGNMENT_MOVES * BIN_NS), system).histogram
    exact /= exact.sum(-1, keepdims=True)
    shapes = moved(system, signal, background, ALIGNMENT_MOVES)
    assert shapes.min() >= 0.0
    assert np.abs(shapes.sum(-1) - 1.0).max() < 2e-6
    return float(0.5 * np.abs(shapes - exact).sum(-1).max())


FLUXES = [(0.1, 0.1), (1.0, 1.0), (1.0, 0.01), (10.0, 0.1), (10.0, 10.0), (3.0, 0.0), (0.05, 5.0)]


DEADS = (0.002, 0.1, 0.6375, 0.95, 0.98, 0.995, 0.999, 1.0, 1.01, 1.53)
PULSES = {  # width in bins, or the pulse; bound of the total variation; dead times
    "a bin": (1.0, None, 2e-3, DEADS),
    "two bins": (2.0, None, 2e-3, DEADS),
    "four bins": (4.0, None, 2e-3, DEADS),
    "narrower than a bin": (0.5, None, 2e-3, (0.1, 0.6375, 1.53)),
    "measured": (1.0, ml.SampledPulse(two_lobes(), 0.2, "centroid"), 1.5e-3, (0.3, 0.6375, 0.97)),
    "as long as the period": (1.0, ml.GaussianPulse(sigma_ns=30.0), 1e-3, (0.6375,)),
}
LONG = [*PULSES][:3]


@pytest.mark.parametrize(
    ("name", "dead"),
    [
        pytest.param(name, dead, marks=[pytest.mark.full] * (name in LONG))
        for name, (*_, deads) in PULSES.items()
        for dead in deads
    ],
)
def test_sub_bin_delays(name: str, dead: float):
    """Within the design's 0.002 at any dead time, also where the pulse re-arms inside itself (0.98 to 1.01 periods).

    The largest of these is 0.00125; a linear shift of the binned values is 0.114 off at one bin, 0.016 at four.
    """
    sigma_bins, pulse, bound, _ = PULSES[name]
    system = system_of(sigma_bins, dead, **({"pulse": pulse} if pulse else {}))
    assert max(distance(system, *flux) for flux in FLUXES) < bound


@pytest.mark.parametrize("dead", [0.6375, 0.995])
def test_every_level_aligns_alike(dead: float):
    system = system_of(2.0, dead)
    shapes = [moved(system, 3.0, 0.2, ALIGNMENT_MOVES, level) for level in _core.levels()]
    assert all(np.array_equal(shapes[0], shape) for shape in shapes[1:])


def test_whole_bins_are_a_roll():
    system = system_of(2.0, 0.6375)
    shapes = moved(system, 3.0, 0.2, np.array([0.0, 5.0, -131.0]))
    assert np.array_equal(shapes[1], np.roll(shapes[0], 5))
    assert np.array_equal(shapes[2], np.roll(shapes[0], -131))
