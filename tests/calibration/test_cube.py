"""What the pixels of a cube share, from histograms alone."""

from __future__ import annotations

import numpy as np
import pytest

import mars_lidar as ml
from mars_lidar.calibration import calibrate_cube
from tests.reconstruction.test_fit_quality import system


@pytest.mark.full
@pytest.mark.parametrize(("dead", "sigma"), [(5.0, 0.3), (40.0, 0.03)])
def test_dead_time_and_pulse_are_found_from_wrong_ones(dead: float, sigma: float) -> None:
    """Within 4.5 stated errors of the truth, and the histograms fit then."""
    random = np.random.default_rng(3)
    light = random.uniform(0.2, 0.8, (8, 8)), random.uniform(0.1, 0.6, (8, 8)), random.uniform(0.0, 100.0, (8, 8))
    counts = ml.simulate(ml.Flux(*light), system(bins=1000), seed=5)[0]
    found = calibrate_cube(counts, system(dead, sigma, bins=1000))
    for name, true in (("dead_time_ns", 50.0), ("pulse_sigma_ns", 0.3)):
        estimate = found.estimates[name]
        assert abs(estimate.value - true) < 4.5 * estimate.error
        assert estimate.error < 0.01 * true
    assert found.fits


def test_too_few_photons_are_refused() -> None:
    with pytest.raises(ValueError, match="1000 registrations"):
        calibrate_cube(np.ones((3, 500), np.uint16), system())
