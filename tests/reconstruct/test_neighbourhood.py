"""Dim cubes with the pixels around: errors that hold, edges that stay, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from harness import require
from scipy import stats

import mars_lidar as ml
from mars_lidar.reconstruct import Flags

SIDE, SIGMA = 40, 0.5
SYSTEM = ml.System(
    period_ns=100.0,
    cycles=1000,
    bins=500,
    pulse=ml.GaussianPulse(sigma_ns=SIGMA),
    detector=ml.Detector(dead_time_ns=75.0),
)
Y, X = np.mgrid[:SIDE, :SIDE]
SURFACES = {
    "flat": 40.0 + 0.0 * X,
    "sloped": 40.0 + 0.3 * X + 0.1 * Y,
    "over the period's end": 99.0 + 0.05 * X,
    "a small step": 40.0 + SIGMA * (X >= SIDE // 2),
    "a step": 40.0 + 3.0 * SIGMA * (X >= SIDE // 2),
    "an edge": 40.0 + 10.0 * (X >= SIDE // 2),
}


def drawn(delay: np.ndarray, photons: float, seed: int = 1) -> np.ndarray:
    level = photons / SYSTEM.cycles
    return ml.simulate(ml.Flux(np.full(delay.shape, level), level, delay), SYSTEM, seed=seed)[0]


def off_by(found: ml.Reconstruction, delay: np.ndarray) -> np.ndarray:
    return (found.delay_ns - delay + 50.0) % 100.0 - 50.0


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("photons", [0.5, 2.0])
def test_errors_hold(name: str, photons: float) -> None:
    """Pixels share photons, and are not independent: a window's worth of pixels counts as one."""
    delay = SURFACES[name]
    found = ml.reconstruct(drawn(delay, photons), SYSTEM, neighbourhood=3)
    off, stated = off_by(found, delay), np.isfinite(found.delay_error_ns)
    assert stated.mean() > 0.6
    count = int(stated.sum() / 49)
    outcomes = {}
    for share, times in ((0.68, 1.0), (0.94, 1.96)):
        inside = (np.abs(off) <= times * found.delay_error_ns)[stated].mean()
        outcomes[f"{share:.0%}"] = float(stats.binom.cdf(np.floor(inside * count), count, share))
        assert inside > share
    require(outcomes, f"errors of a neighbourhood, {name}, {photons:g} photons")


def test_edges_stay_and_depth_is_better_than_alone() -> None:
    delay = SURFACES["an edge"]
    cube = drawn(delay, 2.0)
    alone, found = ml.reconstruct(cube, SYSTEM), ml.reconstruct(cube, SYSTEM, neighbourhood=4)
    off = np.abs(off_by(found, delay))
    assert np.median(off) < 0.35 * np.nanmedian(np.abs(off_by(alone, delay)))
    beside = np.abs(X - SIDE // 2 + 0.5) < 1.0  # the columns on either side of the edge
    right_side = (off[beside] < 3.0 * SIGMA).mean()  # of 80 pixels: 0.95 here, 0.6 alone
    assert right_side > 0.88
    assert right_side > (np.abs(off_by(alone, delay))[beside] < 3.0 * SIGMA).mean() + 0.15
    assert 1 <= found.radius.min() <= found.radius.max() <= 4


def test_signal_of_the_window() -> None:
    found = ml.reconstruct(drawn(SURFACES["flat"], 2.0), SYSTEM, neighbourhood=4)
    level = 2.0 / SYSTEM.cycles
    assert found.signal.mean() == pytest.approx(level, rel=0.06)
    assert found.background.mean() == pytest.approx(level, rel=0.06)
    for values, errors in ((found.signal, found.signal_error), (found.background, found.background_error)):
        assert (np.abs(values - level) <= 1.96 * errors).mean() > 0.88


def test_no_signal_is_flagged() -> None:
    """Windows overlap, so that a false one is seen by its neighbours: the share of pixels is what is stated."""
    dark = ml.simulate(ml.Flux(np.zeros((64, 64)), 0.003, 0.0), SYSTEM, seed=4)[0]
    found = ml.reconstruct(dark, SYSTEM, neighbourhood=3)
    assert (found.flags & Flags.NO_SIGNAL == 0).mean() < 0.02
    empty = ml.reconstruct(np.zeros((4, 5, 500), np.uint16), SYSTEM, neighbourhood=2)
    assert (empty.flags & Flags.EMPTY > 0).all()
    assert np.isnan(empty.depth_m).all()


def test_images_apart_threads_and_stores(tmp_path) -> None:
    cube = np.stack([drawn(SURFACES["sloped"][:16, :20], 1.0, seed) for seed in (1, 2)])
    both = ml.reconstruct(cube, SYSTEM, neighbourhood=2, threads=2)
    for k in range(2):
        one = ml.reconstruct(cube[k], SYSTEM, neighbourhood=2, threads=1)
        for name in ("delay_ns", "signal", "delay_error_ns", "radius"):
            assert np.array_equal(getattr(both, name)[k], getattr(one, name), equal_nan=True), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"neighbourhood": 0}, "neighbourhood must"),
        ({"neighbourhood": 13}, "neighbourhood must"),
        ({"method": "peak"}, "'peak' has not"),
        ({"returns": 2}, "one return a pixel"),
        ({"cube": np.ones((9, 500), np.uint16)}, r"needs images, a cube \(..., H, W, bins\)"),
        ({"cube": np.ones((2, 2, 500), np.uint16)}, "dead times take 37.5 % of this exposure"),
        ({"system": SYSTEM.replace(detector=ml.Detector(dead_time_ns=0.0, mode="synchronous"))}, "'synchronous'"),
    ],
)
def test_bad_input(change: dict, message: str) -> None:
    given = {"cube": np.zeros((3, 3, 500), np.uint16), "system": SYSTEM, "neighbourhood": 2, **change}
    with pytest.raises((ValueError, TypeError), match=message):
        ml.reconstruct(**given)
