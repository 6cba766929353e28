"""Ideal streams that were calibrated wrongly, each by the number it has in a sweep of `studies.streams`."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mars_lidar.calibrate.calibration_light import MOST_BLURRED, Light
from mars_lidar.calibrate.hidden_dead_time import excess
from mars_lidar.calibrate.recovery_edge import edge_of
from mars_lidar.calibrate.shortest_intervals import Ages, Underlying
from mars_lidar.instrument.pulse import GaussianPulse
from studies.streams import cases as streams

FARTHEST = 5.5  # standard errors: of a hundred and more normal numbers none is beyond, once in a million times


@pytest.mark.parametrize(
    ("seed", "number"),
    [
        (17, 67),  # a bright pulse narrower than its jitter: the delay was off by 6 errors, the jitter by 5
        (17, 97),  # few photons of a pulse that is all jitter: signal by 16, all light by 21, dead time by 8
        (17, 212),  # a pulse a period later taken for the edge: the dead time by 40 errors
        (17, 237),  # all light of a pulse in one unit of the clock: the signal by 7
        (17, 283),  # a clock that rounds as much as the pixel is lit: the signal by 17
        (17, 315),  # a jitter that hides, watched too early: all light by 15
        (17, 332),  # a pulse a period later: dead time 29, delay 10
        (17, 351),  # the same with a wide jitter: dead time 14
        (17, 360),  # the same with many photons: all light by 6
        (17, 378),  # photons of one unit of the clock were told to be afterpulses
        (29, 100),  # a clock coarser than the pulse, hardly a background: the dead time by 117
        (29, 129),  # bright, every twelfth period one photon: the signal by 661
        (29, 134),  # bright, one photon each period: the dead time by 26
    ],
)
def test_no_small_error_on_a_wrong_number(seed: int, number: int):
    """No false alarm, and each estimate within its error or without one."""
    found = streams.outcome(streams.drawn(number + 1, seed)[number])
    assert found.refused == ""
    assert found.alarms == ()
    far = {name: pull for name, pull in found.pulls.items() if abs(pull) > FARTHEST}
    assert far == {}


def test_a_window_ends_where_the_intervals_do():
    """An edge twice as wide as it was taken for: ages without records are not known, not empty."""
    dead, width, period = 60.0, 0.8, 1000.0
    random = np.random.default_rng(3)
    flat = Underlying.of(np.full(4096, 1.5 / 4096), np.full(4096, 1.0), period)
    interval = dead + random.exponential(period / 1.5, 200_000) + width * random.standard_normal(200_000)
    limit = dead + 16.0 * 0.5 * width
    near = np.flatnonzero(interval < limit)
    ages = Ages(interval[near], near.astype(np.float64), 0.0, 0.0, limit)
    edge = edge_of(ages, lambda _: flat, dead, 0.5 * width)
    assert edge is not None
    assert edge.fits > 1e-4
    assert abs(edge.dead_time_ns - dead) < 5.0 * edge.dead_time_error_ns
    assert abs(edge.jitter_ns - width / math.sqrt(2.0)) < 5.0 * edge.jitter_error_ns


@pytest.mark.parametrize("signal", [30.0, 700.0, 1e5])
def test_bright_light_under_jitter_is_a_number(signal: float):
    """e^-photons overflowed from 709 photons on; the integral of the records' light is that of the light."""
    light = Light(100.0, 1024, GaussianPulse(sigma_ns=1.0), 1, True, 3.0)
    theta = light.bounded(np.array([1.0, signal, 40.0, 0.5]))
    rate, slopes = light.jacobian(theta)
    assert np.isfinite(rate).all()
    assert np.isfinite(slopes).all()
    assert float(rate.sum()) == pytest.approx(min(signal + 1.0, MOST_BLURRED), rel=1e-6)


def test_excess_of_even_light_is_that_of_an_exponential_law():
    """And where no light would have shown a shorter dead time, all of them are as likely."""
    period, number = 100.0, 10_000
    even = Underlying.of(np.full(1000, 0.2 / 1000), np.full(1000, 1.0), period)
    assert excess(even, number, 50.0) == pytest.approx((0.05, 0.05), rel=1e-2)
    pulse = np.zeros(1000)
    pulse[500] = 0.2
    mean, error = excess(Underlying.of(pulse, pulse, period), number, 90.0)
    assert (mean, error) == pytest.approx((45.0, 90.0 / math.sqrt(12.0)), rel=2e-2)
