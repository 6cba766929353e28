"""Shapes moved by fractions of a bin, against exact statistics at the pixel's own delay."""

import numpy as np
import pytest
from harness import make_system, two_lobes
from native_jobs import align, shape_job

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines.pixels import Alignment
from mars_lidar.engines.table_reader import as_shapes
from mars_lidar.statistics import exposure_moments

BINS = 256
PERIOD_NS = 100.0
BIN_NS = PERIOD_NS / BINS
MOVES = np.array([0.0, 3.25, -20.5, 7.8, 127.6])  # bins


def system_of(sigma_bins: float, dead: float, **changes: object) -> ml.System:
    return make_system(dead * PERIOD_NS, 1000, BINS, sigma_ns=sigma_bins * BIN_NS, start="stationary").replace(
        **changes
    )


def moved(system: ml.System, signal: float, background: float, moves: np.ndarray, level: str = "") -> np.ndarray:
    """Shapes (moves, bins) by the native alignment."""
    canonical = exposure_moments(ml.Flux(signal, background, 50.0), system)
    n, delay = moves.size, 0.5 * PERIOD_NS + moves * BIN_NS
    rate = np.full(n, canonical.mean / system.cycles)
    job = shape_job(as_shapes(canonical.histogram), n)
    alignment = Alignment.of(system, np.full(n, signal), np.full(n, background), delay, rate)
    align(job, alignment, system.dead_time_periods)
    out = np.empty((n, BINS))
    _core.shape_aligned(job, out, level)
    return out


def distance(system: ml.System, signal: float, background: float) -> float:
    """Largest total variation to the exact shape at the moved delays."""
    exact = exposure_moments(ml.Flux(signal, background, 0.5 * PERIOD_NS + MOVES * BIN_NS), system).histogram
    exact /= exact.sum(-1, keepdims=True)
    shapes = moved(system, signal, background, MOVES)
    assert shapes.min() >= 0.0
    assert np.abs(shapes.sum(-1) - 1.0).max() < 2e-6
    return float(0.5 * np.abs(shapes - exact).sum(-1).max())


FLUXES = [(0.1, 0.1), (1.0, 1.0), (1.0, 0.01), (10.0, 0.1), (10.0, 10.0), (3.0, 0.0), (0.05, 5.0)]


@pytest.mark.full
@pytest.mark.parametrize("dead", [0.002, 0.1, 0.6375, 0.95, 0.98, 0.995, 0.999, 1.0, 1.01, 1.53])
@pytest.mark.parametrize("sigma_bins", [1.0, 2.0, 4.0])
def test_sub_bin_delays(sigma_bins: float, dead: float):
    """Within the design's 0.002 at any dead time, also where the pulse re-arms inside itself (0.98 to 1.01 periods).

    The largest of these is 0.00125; a linear shift of the binned values is 0.114 off at one bin, 0.016 at four.
    """
    system = system_of(sigma_bins, dead)
    worst = max(distance(system, *flux) for flux in FLUXES)
    assert worst < 2e-3


@pytest.mark.parametrize("dead", [0.1, 0.6375, 1.53])
def test_a_pulse_narrower_than_a_bin(dead: float):
    system = system_of(0.5, dead)
    assert max(distance(system, *flux) for flux in FLUXES) < 2e-3


def test_a_measured_pulse():
    pulse = ml.SampledPulse(two_lobes(), 0.2, "centroid")
    for dead in (0.3, 0.6375, 0.97):
        assert max(distance(system_of(1.0, dead, pulse=pulse), *flux) for flux in FLUXES) < 1.5e-3


def test_a_pulse_as_long_as_the_period():
    pulse = ml.GaussianPulse(sigma_ns=30.0)
    assert max(distance(system_of(1.0, 0.6375, pulse=pulse), *flux) for flux in FLUXES) < 1e-3


@pytest.mark.parametrize("dead", [0.6375, 0.995])
def test_every_level_aligns_alike(dead: float):
    system = system_of(2.0, dead)
    shapes = [moved(system, 3.0, 0.2, MOVES, level) for level in _core.levels()]
    assert all(np.array_equal(shapes[0], shape) for shape in shapes[1:])


def test_whole_bins_are_a_roll():
    system = system_of(2.0, 0.6375)
    shapes = moved(system, 3.0, 0.2, np.array([0.0, 5.0, -131.0]))
    assert np.array_equal(shapes[1], np.roll(shapes[0], 5))
    assert np.array_equal(shapes[2], np.roll(shapes[0], -131))
