"""Stationary starts where registrations lock to a bright pulse and drift through it slowly."""

import numpy as np
import pytest
from harness import COUNTS, PERIOD_NS, SHAPE, Case, check, flux_of, law_of, make_system

import mars_lidar as ml
from mars_lidar.engines import ENGINES

GATE = {"mode": "gated", "gate_start_ns": 0.0, "gate_width_ns": PERIOD_NS}


@pytest.mark.full
@pytest.mark.parametrize("detector", [{}, GATE], ids=["free running", "gated"])
@pytest.mark.parametrize("dead", [0.9995, 2.0008])
def test_a_locked_pixel_starts_as_the_statistics_say(dead: float, detector: dict[str, object]):
    """A grid that blurs each turn by a part of a bin puts 0.001 registrations too many into each period."""
    system = make_system(dead * PERIOD_NS, 12, 64, sigma_ns=0.5, start="stationary", **detector)
    case = Case(f"locked, t_d {dead:g}", flux_of(20.0, 0.05, 0.37), system, 80_000)
    check(ENGINES["exact"], case, law_of(ml.Flux(20.0, 0.05, 37.0), system), {COUNTS, SHAPE})


@pytest.mark.full
def test_the_sequential_engine_begins_in_any_phase_of_a_slow_drift():
    """A round of the phase through the pulse took 200 turns, but began within 64: half too large a variance."""
    system = make_system(PERIOD_NS, 12, 64, start="stationary")
    case = Case("drift through a bright pulse", flux_of(200.0, 0.01, 0.37), system, 1000)
    check(ENGINES["sequential"], case, law_of(ml.Flux(200.0, 0.01, 37.0), system), {COUNTS})


@pytest.mark.parametrize("signal", [3.0, 160.0])
def test_a_state_that_depends_on_the_switching_on_is_refused(signal: float):
    """Two peaks, and a dead time that ends shortly before the one that was registered: a bright pixel stays with it."""
    samples = np.zeros(256)
    samples[:8] = samples[200:208] = 1.0
    system = make_system(4.964 * PERIOD_NS, 50, 64, pulse=ml.SampledPulse(samples, 0.1, "first"), start="stationary")
    flux = ml.Flux(signal, 0.1, 7.0)
    if signal < 10.0:  # it changes between the peaks every few registrations
        drawn = ml.simulate(flux, system, realizations=4000, seed=5)[:, 0, 0].mean(0)
        law = ml.mean_histogram(flux, system)
        assert np.abs(drawn - law).max() < 5.0 * np.sqrt(law.max() / 4000)
        return
    for engine in ("exact", "sequential"):
        with pytest.raises(ValueError, match=r"depends on when the detector was switched on.*start='armed'"):
            ml.simulate(flux, system, engine=engine, seed=5)
    assert ml.simulate(flux, system.replace(start="armed"), seed=5).sum() > 0


@pytest.mark.parametrize("light", ["pulses", "waveforms"])
def test_pixels_of_one_light_share_the_state_that_they_start_in(light: str):
    """In any order among others, with the bits that each has alone."""
    which = np.array([0, 1, 0, 2, 1, 0, 2, 2])
    signal, background = np.array([20.0, 30.0, 20.0])[which], np.array([0.5, 0.5, 0.8])[which]
    flux = ml.Flux(signal[None], background[None], 40.0)
    if light == "waveforms":
        shape = np.exp(-0.5 * ((np.arange(64) - 20.0) / 3.0) ** 2)
        flux = ml.Flux(waveform=signal[None, :, None] * shape / shape.sum(), background=background[None])
    system = make_system(97.0, 20, 64, sigma_ns=2.0, start="stationary")
    cube = ml.simulate(flux, system, realizations=3, seed=4).reshape(3, 8, 64)
    for k in range(8):
        alone = ml.simulate(flux[:, k : k + 1], system, realizations=3, seed=4, pixel_index=[[k]])
        assert np.array_equal(alone.reshape(3, 64), cube[:, k])
