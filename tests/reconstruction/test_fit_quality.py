"""Goodness of fit of reconstructed pixels: stated false alarms, wrong dead times and pulses flagged with advice."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

import mars_lidar as ml
from mars_lidar.reconstruction import Flags

PIXELS = (20, 20)


def system(dead: float = 50.0, sigma: float = 0.3, bins: int = 500) -> ml.System:
    return ml.System(
        period_ns=100.0,
        cycles=8000,
        bins=bins,
        pulse=ml.GaussianPulse(sigma_ns=sigma),
        detector=ml.Detector(dead_time_ns=dead),
    )


def cube(signal: float, background: float, truth: ml.System, seed: int) -> np.ndarray:
    delay = np.random.default_rng(seed).uniform(0.0, 100.0, PIXELS)
    return ml.simulate(ml.Flux(np.full(PIXELS, signal), background, delay), truth, seed=seed)[0]


@pytest.mark.parametrize(("signal", "background"), [(0.6, 0.4), (0.05, 0.05), (3.0, 0.5)])
def test_pixels_of_the_model_fit(signal: float, background: float) -> None:
    """No more p-values below 1 % of 400 than chance has at 1e-4, and half of them not far from above a half."""
    found = ml.reconstruct(cube(signal, background, system(), 1), system(), threads=1)
    assert found.p_value is not None
    small = int((found.p_value < 0.01).sum())
    assert binom.sf(small - 1, found.p_value.size, 0.01) > 1e-4
    assert 0.3 < (found.p_value < 0.5).mean() < 0.6  # four tests together are conservative in the middle
    assert found.misfits < 0.015
    assert found.advice == ""


@pytest.mark.parametrize(
    ("dead", "sigma", "words"),
    [
        (5.0, 0.3, "a longer dead time"),
        (40.0, 0.3, "a longer dead time"),
        (60.0, 0.3, "a shorter dead time"),
        (50.0, 0.15, "a wider pulse"),
        (50.0, 0.6, "a narrower pulse"),
        (50.0, 0.03, "a wider pulse"),
    ],
)
def test_a_wrong_dead_time_or_pulse_is_flagged_in_99_of_100(dead: float, sigma: float, words: str) -> None:
    """At 5,000 photons a pixel."""
    counts = cube(0.6, 0.4, system(), 2)
    assert 4500 < counts.sum(-1).mean() < 5600
    found = ml.reconstruct(counts, system(dead, sigma), threads=1)
    assert (found.flags & Flags.MISFIT > 0).mean() >= 0.99
    assert found.advice.startswith(words)


def test_a_dead_time_of_several_periods_and_a_dim_pixel() -> None:
    truth = system(dead=230.0)
    found = ml.reconstruct(cube(0.8, 0.4, truth, 3), truth, threads=1)
    assert found.misfits < 0.015
    empty = ml.reconstruct(np.zeros((2, 500), np.uint16), system(), threads=1)
    assert np.isnan(empty.p_value).all()
    assert not (empty.flags & Flags.MISFIT).any()
