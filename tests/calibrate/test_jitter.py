"""Calibration of a jittered stream of which nothing is told: dead time, jitter and light without bias, and it fits."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from harness import ledger
from scipy import stats

import mars_lidar as ml
from mars_lidar.calibrate.dead_time import HIDDEN, SHARP
from mars_lidar.calibrate.intervals import stream_of
from mars_lidar.calibrate.jittered import Records, after_blur, normal_kernel, unblurred
from mars_lidar.calibrate.shortest_intervals import Ages, Underlying, is_sharp, shortest

PERIOD, DELAY, DEAD, SIGMA = 1e3 / 7.5, 40.0, 85.0, 0.5


def streams(signal: float, background: float, jitter: float, number: int, cycles: int, seed: int) -> ml.Timestamps:
    detector = ml.Detector(dead_time_ns=DEAD, jitter=ml.Jitter(sigma_ns=jitter) if jitter else None)
    made_by = ml.System(
        period_ns=PERIOD, cycles=cycles, bins=1024, pulse=ml.GaussianPulse(sigma_ns=SIGMA), detector=detector
    )
    light = ml.Flux(np.full((1, number), signal), background, DELAY)
    return dataclasses.replace(ml.simulate_timestamps(light, made_by, seed=seed), info={})


@pytest.mark.parametrize(
    ("signal", "background", "jitter", "cycles"),
    [(0.8, 0.1, 0.2, 200_000), (5.0, 0.5, 0.1, 100_000), (5.0, 0.5, 0.4, 60_000), (0.3, 2.0, 0.05, 100_000)],
)
def test_nothing_told_nothing_biased(signal, background, jitter, cycles):
    """Scores of all that is estimated are of mean 0 and, together, of the variance that the stated errors say."""
    number = 6
    times = streams(signal, background, jitter, number, cycles, seed=41)
    scores = []
    for k in range(number):
        found = ml.calibrate(times.pixel(0, k))
        assert found.converged
        assert found.dead_time_by == "edge"
        assert found.too_short == 0
        errors = found.errors
        assert found.jitter_error_ns == pytest.approx(errors["jitter_ns"])
        assert isinstance(found.pulse, ml.GaussianPulse)
        scores.append(
            [
                (found.dead_time_ns - DEAD) / found.dead_time_error_ns,
                (found.jitter_ns - jitter) / errors["jitter_ns"],
                (found.background - background) / errors["background"],
                (found.signal - signal) / errors["signal"],
                (found.delay_ns - DELAY) / errors["delay_ns"],
                (found.pulse.sigma_ns - math.hypot(SIGMA, jitter)) / errors["sigma_ns"],
            ]
        )
    z = np.array(scores)
    names = ("dead time", "jitter", "B", "S", "delay", "sigma")
    bias = 2.0 * stats.norm.sf(np.abs(z.sum(0)) / math.sqrt(number))
    outcomes = {f"bias {name}": float(p) for name, p in zip(names, bias, strict=True)}
    # dead time and jitter go together, and so do signal and delay: scatter one by one
    for name, column in zip(names, (z**2).sum(0), strict=True):
        outcomes[f"scatter {name}"] = 2.0 * min(stats.chi2.sf(column, number), stats.chi2.cdf(column, number))
    ledger.require(outcomes, f"calibrate, jitter {jitter}, S = {signal}, B = {background}")


def test_what_was_calibrated_fits_the_stream_and_so_does_its_file(tmp_path):
    """The verdict of `validate`, by the calibration and by the system that it writes; without the jitter it fails."""
    times = streams(0.8, 0.1, 0.2, 1, 250_000, seed=43)
    found = ml.calibrate(times)
    assert ml.validate(times, found, cycles=250, simulated=400).consistent
    found.system(1, 1024, "armed").save(tmp_path / "lab.yaml")
    told = ml.System.load(tmp_path / "lab.yaml")
    assert told.detector.jitter == ml.Jitter(sigma_ns=found.jitter_ns)
    again = ml.calibrate(times, told)
    assert again.jitter_ns == found.jitter_ns
    assert again.dead_time_by == "given"
    assert ml.validate(times, again, cycles=500, detector=told.detector, simulated=1000).consistent
    sharp = ml.calibrate(times, dead_time_ns=DEAD)
    assert sharp.too_short > 0
    assert not ml.validate(times, sharp, cycles=250).consistent


def test_a_sharp_edge_is_called_blurred_as_often_as_it_should():
    """The values of the test are uniform at most; `SHARP` is its level. Smallest interval then, of the stated error."""
    number = 50
    times = streams(0.8, 0.1, 0.0, number, 20_000, seed=45)
    chances, z = [], []
    for k in range(number):
        stream = stream_of(times.pixel(0, k))
        ages = shortest(stream, min(float(dt.min()) for dt in stream.intervals()))
        rate = 0.8 * ml.GaussianPulse(sigma_ns=SIGMA).bin_energy(DELAY, PERIOD, 1024) + 0.1 / 1024
        phases = stream.histogram(1024).astype(float)
        chances.append(is_sharp(ages, Underlying.of(rate, phases, PERIOD))[0])
        found = ml.calibrate(times.pixel(0, k))
        if found.dead_time_by == "smallest interval":
            assert found.jitter_ns == 0.0
            known = ml.calibrate(times.pixel(0, k), jitter_ns=0.0)
            assert found.dead_time_error_ns >= known.dead_time_error_ns
            assert found.jitter_limit_ns > 0.1 * known.dead_time_error_ns
            z.append((known.dead_time_ns - DEAD) / known.dead_time_error_ns + 1.0)
    below = int((np.array(chances) < 0.1).sum())
    outcomes = {"level": float(stats.binom.sf(below - 1, number, 0.1))}
    outcomes["excess"] = float(stats.kstest(z, "expon").pvalue)  # the smallest of n is exponential behind the edge
    ledger.require(outcomes, "a sharp edge")
    assert len(z) >= 0.95 * number


def test_how_much_jitter_may_hide():
    """Of edges as wide as `HIDDEN` says nine in ten are found, at 1 % false alarms: by Poisson events of rate 1."""
    random, number = np.random.default_rng(55), 300
    flat = Underlying(np.full(64, 1e-6), np.ones(64), 1e4)
    found = {}
    for width in (0.0, math.sqrt(2.0) * HIDDEN):
        chances = []
        for _ in range(number):
            after = np.sort(600.0 * random.random(random.poisson(600.0)))
            after = np.sort(after + width * random.standard_normal(after.size))[:300] + 1000.0
            chances.append(is_sharp(Ages(after, np.arange(after.size), 0.0, 0.0, math.inf), flat)[0])
        found[width > 0.0] = int((np.array(chances) < SHARP).sum())
    outcomes = {"power": float(stats.binom.cdf(found[True], number, 0.9))}
    outcomes["level"] = float(stats.binom.sf(found[False] - 1, number, SHARP))
    ledger.require(outcomes, "a hidden jitter")


def test_the_rate_of_records_is_that_of_a_fine_simulation():
    """(1) of `jittered`: the first photons of a bright pulse, blurred, over what is left, blurred."""
    bins, sigma, jitter = 4096, 0.6, 0.3
    rate = 4.0 * ml.GaussianPulse(sigma_ns=sigma).bin_energy(20.0, PERIOD, bins) + 0.2 / bins
    kernel = normal_kernel(jitter, PERIOD, bins)
    found = Records(rate, kernel)
    assert found.rate.sum() == pytest.approx(rate.sum(), rel=1e-9)
    random = np.random.default_rng(47)
    arrival = np.interp(
        random.exponential(size=400_000),
        np.concatenate([[0.0], np.cumsum(np.tile(rate, 4))]),
        np.arange(4 * bins + 1) * PERIOD / bins,
        right=np.inf,
    )
    record = arrival + jitter * random.standard_normal(arrival.size)
    edges = 20.0 + np.linspace(-3.0, 3.0, 31)
    seen = np.histogram(record, edges)[0]
    before = np.array([(record >= edge).sum() for edge in edges[:-1]])
    cumulative = np.concatenate([[0.0], np.cumsum(found.rate)])
    light = np.diff(np.interp(edges, np.arange(bins + 1) * PERIOD / bins, cumulative))
    expected = -np.expm1(-light) * before
    square = float(((seen - expected) ** 2 / (expected * np.exp(-light))).sum())
    ledger.require({"records": 2 * min(stats.chi2.sf(square, 30), stats.chi2.cdf(square, 30))}, "rate of records")
    step = 1e-5 * rate
    slope = (Records(rate + step, kernel).rate - found.rate) / 1e-5
    assert found.slope(rate) == pytest.approx(slope, rel=1e-3, abs=1e-4 * slope.max())


def test_bright_light_is_convolved_without_a_transform():
    """Beyond 20 photons a period the tail behind the pulse is below the rounding of a Fourier transform."""
    bins = 2048
    kernel = normal_kernel(0.4, PERIOD, bins)
    pulse = ml.GaussianPulse(sigma_ns=0.5).bin_energy(20.0, PERIOD, bins)
    near, far = (Records(total * pulse + 0.1 / bins, kernel).rate for total in (19.89, 19.91))
    assert far == pytest.approx(near, rel=0.02)
    assert (Records(40.0 * pulse + 0.1 / bins, kernel).rate > 0.0).all()


def test_a_free_shape_gets_dead_time_and_jitter_too():
    times = streams(0.8, 0.5, 0.2, 4, 300_000, seed=49)
    found = [ml.calibrate(times.pixel(0, k), pulse="free") for k in range(4)]
    assert all(one.dead_time_by == "edge" for one in found)
    z = np.array(
        [
            [
                (one.dead_time_ns - DEAD) / one.dead_time_error_ns,
                (one.jitter_ns - 0.2) / one.jitter_error_ns,
                (one.total - 1.3) / one.total_error,
            ]
            for one in found
        ]
    )
    outcomes = {name: float(2 * stats.norm.sf(abs(v) / 2.0)) for name, v in zip("tjL", z.sum(0), strict=True)}
    ledger.require(outcomes, "free shape, jitter")
    kernel = normal_kernel(0.2, PERIOD, 1024)
    blurred = np.fft.irfft(np.fft.rfft(found[0].light_arguments()["waveform"]) * np.fft.rfft(kernel), 1024)
    assert found[0].waveform is not None
    assert blurred.sum() == pytest.approx(found[0].waveform.sum())
    assert unblurred(kernel, kernel)[0] > kernel[0]


def test_jitter_that_is_given():
    times = streams(0.8, 0.5, 0.2, 1, 300_000, seed=51)
    found = ml.calibrate(times, jitter_ns=0.2)
    assert abs(found.dead_time_ns - DEAD) < 4.5 * found.dead_time_error_ns
    assert (found.jitter_ns, found.jitter_error_ns) == (0.2, 0.0)
    both = ml.calibrate(times, dead_time_ns=DEAD, jitter_ns=0.2, hold_off_ns=86.0)
    assert both.hold_off_ns == pytest.approx(DEAD + 8.5 * 0.2)
    none = ml.calibrate(times, jitter_ns=0.0)
    assert none.dead_time_by == "smallest interval"
    with pytest.raises(ValueError, match="jitter_ns must be a finite number in"):
        ml.calibrate(times, jitter_ns=9.0)


def test_a_measured_pulse_holds_the_jitter():
    """The recorded response is given; light, dead time and jitter come out, and the pulse before the jitter."""
    t, jitter, number = np.arange(100), 0.3, 2
    shape = (t / 6.0) ** 2 * np.exp(-t / 6.0)
    with pytest.raises(ValueError, match="add zeros at its end"):
        after_blur(ml.SampledPulse(shape, 0.05, "centroid"), jitter)
    laser = ml.SampledPulse(np.pad(shape, (0, 80)), 0.05, "centroid")
    detector = ml.Detector(dead_time_ns=DEAD, jitter=ml.Jitter(sigma_ns=jitter))
    made_by = ml.System(period_ns=PERIOD, cycles=60_000, bins=1024, pulse=laser, detector=detector)
    light = ml.Flux(np.full((1, number), 0.8), 0.5, DELAY)
    times = dataclasses.replace(ml.simulate_timestamps(light, made_by, seed=53), info={})
    response = after_blur(laser, jitter)
    edges = np.linspace(-4.0, 6.0, 101)
    kernel = np.diff(stats.norm.cdf(np.linspace(-2.005, 2.005, 402), scale=jitter))
    blurred = np.diff(np.convolve(laser.cumulative(np.linspace(-6.0, 8.0, 1401)), kernel, "valid")[::10])
    assert np.diff(response.cumulative(edges)) == pytest.approx(blurred, abs=2e-4)
    scores = []
    for k in range(number):
        found = ml.calibrate(times.pixel(0, k), pulse=response)
        errors = found.errors
        scores.append(
            [
                (found.dead_time_ns - DEAD) / found.dead_time_error_ns,
                (found.jitter_ns - jitter) / found.jitter_error_ns,
                (found.background - 0.5) / errors["background"],
                (found.signal - 0.8) / errors["signal"],
            ]
        )
        assert abs(found.delay_ns - DELAY) < 6.0 * errors["delay_ns"]
        assert abs(float(found.flux().delay_ns.item()) - DELAY) < 6.0 * errors["delay_ns"] + 1e-3
    z = np.array(scores)
    bias = 2.0 * stats.norm.sf(np.abs(z.sum(0)) / math.sqrt(number))
    outcomes = {name: float(p) for name, p in zip("tjBS", bias, strict=True)}
    ledger.require(outcomes, "measured pulse, jitter")
    told = found.system(60_000, 1024)
    again = ml.calibrate(times.pixel(0, number - 1), told)
    assert again.signal == pytest.approx(found.signal, rel=1e-3)
    assert again.delay_ns == pytest.approx(found.flux().delay_ns.item(), abs=2e-3)
    assert ml.validate(times.pixel(0, number - 1), found, cycles=250, simulated=300).consistent
