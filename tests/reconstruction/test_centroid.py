"""The centre of mass of the counts: unbiased to a hundredth of a bin, with the spread of a mean, where light is dim."""

from __future__ import annotations

import numpy as np
import pytest
from harness import make_system, require
from scipy import stats

import mars_lidar as ml
from mars_lidar.reconstruction import METHODS

SYSTEM = make_system(20.0, 40_000, 100, sigma_ns=1.5)
SKEWED = ml.SampledPulse([0, 4, 10, 7, 4, 2.5, 1.5, 1, 0.5, 0.2], 0.7)
PIXELS = 3000


def delays_of(system: ml.System, signal: float, background: float, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the delay, ns, of the centroid and of the peak."""
    flux = ml.Flux(np.full((1, delays.size), signal), background, delays[None])
    cube = ml.simulate(flux, system, seed=3)[0]
    errors = []
    for name in ("centroid", "peak"):
        delay = ml.reconstruct(cube, system, name).delay_ns[0]
        errors.append((delay - delays + 50.0) % 100.0 - 50.0)
    return errors[0], errors[1]


@pytest.mark.parametrize("pulse", [SYSTEM.pulse, SKEWED, ml.SampledPulse(SKEWED.values, 0.7, "centroid")])
def test_bias_and_spread(pulse):
    system = SYSTEM.replace(pulse=pulse)
    delays = np.random.default_rng(1).uniform(0.0, 100.0, PIXELS)  # also round the end of the period
    centroid, peak = delays_of(system, 0.005, 0.0, delays)
    z = centroid.mean() / (centroid.std() / np.sqrt(PIXELS))
    # bins are 1 ns: the truncated window and the finite bin leave up to 0.01 ns
    allowed = 0.01 / (centroid.std() / np.sqrt(PIXELS))
    require({"mean": float(2.0 * stats.norm.sf(max(abs(z) - allowed, 0.0)))}, f"centroid, {pulse!r:.40}")
    assert centroid.std() < 0.6 * peak.std()
    if isinstance(pulse, ml.GaussianPulse):
        spread = np.sqrt((1.5**2 + 1.0 / 12.0) / (0.005 * 40_000))
        assert centroid.std() == pytest.approx(spread, rel=0.1)  # 4 standard deviations of it, and the loss of tails


def test_with_background_and_where_nothing_is_seen():
    centroid, peak = delays_of(SYSTEM, 0.005, 0.005, np.linspace(0.0, 99.9, PIXELS))
    assert abs(centroid.mean()) < 0.03
    assert np.sqrt(np.mean(centroid**2)) < np.sqrt(np.mean(peak**2))
    empty = np.zeros((2, 100), np.uint16)
    empty[1] = 7  # nothing stands out
    maps = ml.reconstruct(empty, SYSTEM, "centroid")
    assert np.isnan(maps.depth_m[0])
    assert np.isfinite(maps.depth_m[1])
    assert "centroid" in METHODS
