"""Photons one by one out of a table's rows: the law of the shape that would be formed from them."""

from functools import cache

import numpy as np
import pytest
from harness import goodness, make_system, require
from harness.pvalues import bonferroni, variance_score
from native_jobs import align, shape_job
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines.pixels import Alignment
from mars_lidar.engines.table_reader import as_shapes
from mars_lidar.statistics import exposure_moments

BINS = 200
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
