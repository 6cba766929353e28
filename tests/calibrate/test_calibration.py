"""Calibration: unbiased, as sure as the bound allows, and honest about what it does not know."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from harness import ledger
from scipy import stats

import mars_lidar as ml
from mars_lidar.calibrate import calibration_bound, rapp_total, recovery

PERIOD = 1e3 / 7.5
DELAY = 40.0


def system(cycles: int = 4000, dead_ns: float = 85.0, sigma_ns: float = 0.5, **changes) -> ml.System:
    return ml.System(
        period_ns=PERIOD,
        cycles=cycles,
        bins=256,
        pulse=ml.GaussianPulse(sigma_ns=sigma_ns),
        detector=ml.Detector(dead_time_ns=dead_ns),
        **changes,
    )


def stream(light: ml.Flux, made_by: ml.System, seed: int = 1) -> ml.Timestamps:
    return ml.simulate_timestamps(light, made_by, seed=seed)


def bare(times: ml.Timestamps) -> ml.Timestamps:
    return dataclasses.replace(times, info={})


@pytest.mark.parametrize(("dead_ns", "start"), [(85.0, "armed"), (0.0, "stationary"), (300.0, "stationary")])
def test_unbiased_with_right_errors_at_the_bound(dead_ns, start):
    """Scores of replicates are standard normal; stated errors are the Cramer-Rao bound's to 20 %."""
    replicates = 10
    scores = []
    for signal, background in itertools.product((0.05, 0.5, 5.0), repeat=2):
        cycles = 20_000 if signal < 1 else 6000
        if signal < 0.1 * background:  # else a chance peak of the background passes for the return now and then
            cycles = 80_000 if dead_ns > 200 else 40_000
        made_by = system(cycles, dead_ns, start=start)
        times = stream(ml.Flux(np.full((1, replicates), signal), background, DELAY), made_by, seed=17)
        found = [ml.calibrate(times.pixel(0, k)) for k in range(replicates)]
        assert all(one.converged for one in found)
        bound = np.array(list(calibration_bound(signal, background, made_by, delay_ns=DELAY).errors.values()))
        stated = np.array([list(one.errors.values()) for one in found])
        assert (np.abs(stated.mean(0) / bound - 1.0) < 0.2).all()
        got = np.array([[one.background, one.signal, one.delay_ns] for one in found])
        z = (got - [background, signal, DELAY]) / bound
        ledger.require(
            {
                f"bias {name}": float(2 * stats.norm.sf(abs(z[:, k].sum()) / math.sqrt(replicates)))
                for k, name in enumerate(("B", "S", "delay"))
            },
            f"calibrate, S = {signal}, B = {background}, dead time {dead_ns:g}",
        )
        scores.append(z)
    square = float((np.concatenate(scores) ** 2).sum())
    number = 3 * 9 * replicates
    ledger.require({"scatter": 2 * min(stats.chi2.sf(square, number), stats.chi2.cdf(square, number))}, "calibrate")


def test_efficiency_and_dark_counts_are_in_the_light_of_the_bound():
    """As in that of a calibration: they change nothing of it."""
    plain = system(1000, 75.0)
    detector = ml.Detector(dead_time_ns=75.0, detection_efficiency=0.3, dark_count_hz=1e6)
    found = calibration_bound(0.5, 2.0, plain.replace(detector=detector), delay_ns=DELAY)
    assert np.array_equal(found.information, calibration_bound(0.5, 2.0, plain, delay_ns=DELAY).information)


def test_the_bound_is_the_textbook_s_without_dead_time():
    """Poisson: the information is that of the counts of the bins."""
    made_by = system(1000, 0.0)
    found = calibration_bound(0.5, 2.0, made_by, delay_ns=DELAY)
    bins = 2**14
    edges = (np.arange(bins) + 0.5) / bins * PERIOD - DELAY
    shape = stats.norm.pdf(edges, scale=0.5) * PERIOD / bins
    light = 0.5 * shape + 2.0 / bins
    slopes = np.array([np.full(bins, 1 / bins), shape, 0.5 * shape * edges / 0.25])
    information = 1000 * (slopes / light) @ slopes.T
    assert found.information == pytest.approx(information, rel=2e-3, abs=1e-3 * np.abs(information).max())
    assert found.names == ("background", "signal", "delay_ns")


def test_width_dead_time_and_edge_of_the_period():
    """Nothing told: sigma and dead time from the stream, the pulse across the edge of the period."""
    times = bare(stream(ml.Flux(0.8, 0.2, 133.2), system(100_000), seed=3))
    found = ml.calibrate(times)
    errors = found.errors
    assert found.names == ("background", "signal", "delay_ns", "sigma_ns")
    assert isinstance(found.pulse, ml.GaussianPulse)
    assert abs(found.pulse.sigma_ns - 0.5) < 4 * errors["sigma_ns"]
    assert abs((found.delay_ns - 133.2 + 60) % PERIOD - 60) < 4 * errors["delay_ns"]
    assert abs(found.signal - 0.8) < 4 * errors["signal"]
    assert abs(found.background - 0.2) < 4 * errors["background"]
    assert abs(found.dead_time_ns - 85.0) < 5 * found.dead_time_error_ns < 0.06  # with what a jitter may hide
    assert found.too_short == 0


def test_several_returns():
    light = ml.Flux.multi(ml.Flux(0.5, 0.1, 30.0), ml.Flux(0.3, 0.0, 34.0), ml.Flux(0.1, 0.0, 132.9))
    found = ml.calibrate(stream(light, system(100_000), seed=4), returns=3)
    errors = found.errors
    for k, (signal, delay) in enumerate([(0.5, 30.0), (0.3, 34.0), (0.1, 132.9)]):
        assert abs(found.returns_signal[k] - signal) < 4.5 * errors[f"signal_{k + 1}"]
        assert abs(found.returns_delay_ns[k] - delay) < 4.5 * errors[f"delay_ns_{k + 1}"]
    assert found.flux().total.item() == pytest.approx(found.total)
    assert found.rate.sum() == pytest.approx(found.total)


def test_a_measured_pulse_and_a_free_shape():
    t = np.arange(80)
    pulse = ml.SampledPulse((t / 8.0) ** 2 * np.exp(-t / 8.0), 0.05)  # a fast edge, a slow tail
    made_by = system(100_000).replace(pulse=pulse)
    times = stream(ml.Flux(0.6, 0.3, DELAY), made_by, seed=6)
    found = ml.calibrate(times)
    assert found.pulse == pulse
    assert abs(found.signal - 0.6) < 4 * found.errors["signal"]
    assert abs(found.delay_ns - DELAY) < 5 * found.errors["delay_ns"]
    free = ml.calibrate(times, pulse="free")
    assert abs(free.total - 0.9) < 4 * free.total_error
    assert free.waveform is not None
    light = 0.6 * pulse.bin_energy(DELAY, PERIOD, 256) + 0.3 / 256
    passes = free.armed.passes
    square = float(((free.waveform - light) ** 2 / (light / passes)).sum())
    ledger.require({"bins": 2 * min(stats.chi2.sf(square, 256), stats.chi2.cdf(square, 256))}, "free shape")


def test_rapp_s_total_is_unbiased_with_its_error():
    replicates = 60
    for signal, background in ((0.05, 0.1), (1.0, 1.0), (0.0, 3.0)):
        times = stream(ml.Flux(np.full((1, replicates), signal), background, DELAY), system(5000), seed=8)
        found = [rapp_total(times.pixel(0, k), 85.0) for k in range(replicates)]
        z = np.array([(one.total - signal - background) / one.total_error for one in found])
        p = {
            "bias": 2 * stats.norm.sf(abs(z.sum()) / math.sqrt(replicates)),
            "scatter": 2 * min(stats.chi2.sf((z**2).sum(), replicates), stats.chi2.cdf((z**2).sum(), replicates)),
        }
        ledger.require(p, f"Rapp, S = {signal}, B = {background}")


def test_a_hold_off_keeps_out_what_the_model_does_not_have():
    """Electronics that are dead longer than the detector, and afterpulses: told, and kept out by a hold-off."""
    made_by = system(300_000)
    pulse = made_by.pulse
    two = ml.Detector(dead_time_ns=50.0, electronics_dead_time_ns=85.0)
    traps = ml.Detector(dead_time_ns=85.0, afterpulsing=ml.Afterpulsing(probability=0.05, delay_ns=100.0))
    for detector, background, wide, sign in ((two, 1.0, 135.0, "only"), (traps, 0.1, 600.0, "afterpulses")):
        light = ml.Flux(0.8, background, DELAY)
        times = bare(stream(light, made_by.replace(detector=detector), seed=9))
        wrong = ml.calibrate(times, pulse=pulse, dead_time_ns=85.0)
        assert abs(wrong.background - background) > 5 * wrong.errors["background"]
        right = ml.calibrate(times, pulse=pulse, dead_time_ns=85.0, hold_off_ns=wide)
        assert abs(right.background - background) < 4 * right.errors["background"]
        assert abs(right.signal - 0.8) < 4 * right.errors["signal"]
        assert right.armed.left_out > 500
        found = recovery(times, right.rate, 85.0, hold_off_ns=wide, reach_ns=wide + 50.0)
        assert found.p_value < 1e-9
        assert any(sign in text for text in found.findings())
    clean = stream(light, made_by, seed=11)
    good = ml.calibrate(bare(clean), pulse=pulse, dead_time_ns=85.0)
    found = recovery(clean, good.rate, 85.0)
    ledger.require({"recovery": found.p_value}, "a clean detector")
    assert not found.findings()


def test_streams_without_signal_or_background():
    dark = ml.calibrate(stream(ml.Flux(0.0, 0.5, 0.0), system(20_000), seed=12))
    assert abs(dark.total - 0.5) < 5 * dark.errors["background"]
    assert dark.signal < 0.02
    clean = ml.calibrate(stream(ml.Flux(0.5, 0.0, DELAY), system(20_000), seed=12))
    assert clean.background < 1e-4
    assert abs(clean.signal - 0.5) < 5 * clean.errors["signal"]


def test_short_intervals_are_told():
    times = stream(ml.Flux(0.8, 1.0, DELAY), system(20_000, 80.0), seed=13)
    short = int((np.diff(times.times_ns) < 85.0).sum())
    found = ml.calibrate(times, dead_time_ns=85.0)
    assert found.too_short == short > 100
    assert found.armed.left_out == short
    assert ml.calibrate(times).too_short == 0


def test_bad_input(tmp_path):
    times = stream(ml.Flux(0.8, 1.0, DELAY), system(200))
    for arguments, words in (
        ({"returns": 0}, "returns must be an integer in"),
        ({"returns": 2, "pulse": "free"}, "returns must be 1"),
        ({"pulse": "square"}, "pulse must be a Pulse, 'gaussian' or 'free', got 'square'"),
        ({"dead_time_ns": -1.0}, "dead_time_ns must be"),
        ({"dead_time_ns": math.nan}, "dead_time_ns must be"),
        ({"hold_off_ns": 20.0}, "hold_off_ns must be at least the dead time of 85 ns, got 20"),
        ({"pulse": ml.GaussianPulse(sigma_ns=500.0)}, "sigma_ns must lie in"),
    ):
        with pytest.raises(ValueError, match=words):
            ml.calibrate(times, **arguments)
    with pytest.raises(TypeError, match="system must be a System"):
        ml.calibrate(times, "lab")
    with pytest.raises(ValueError, match="at least 10 registrations"):
        ml.calibrate(stream(ml.Flux(0.0, 1e-6, 0.0), system(10)))
    with pytest.raises(ValueError, match="signal must be"):
        calibration_bound(0.0, 1.0, system())
    with pytest.raises(ValueError, match="mode 'nonparalyzable'"):
        calibration_bound(1.0, 1.0, system().replace(detector=ml.Detector(dead_time_ns=1.0, mode="paralyzable")))
    with pytest.raises(ValueError, match="rate must be"):
        recovery(times, [math.nan], 85.0)
