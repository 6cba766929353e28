"""Maximum likelihood: derivatives, bias, and variance at the bound, by simulation."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
import pytest
from harness import make_system, refused, require
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.reconstruction import (
    METHODS,
    Flags,
    MaximumLikelihood,
    log_likelihood,
    systematic_error,
    window_error,
    window_weights,
)
from mars_lidar.reconstruction.histogram_record import recording_of

PERIOD = 100.0
PLAIN = make_system(75.3, 4000, 500, sigma_ns=0.5)


def with_dead(dead_ns: float, **more) -> ml.System:
    detector = {k: more.pop(k) for k in list(more) if k.startswith("gate") or k == "mode"}
    return PLAIN.replace(detector=ml.Detector(dead_time_ns=dead_ns, **detector), **more)


SYSTEMS = {
    "plain": (PLAIN, 1.0, 1.0, 37.013),
    "no dead time": (with_dead(0.0), 2.0, 1.0, 37.013),
    "below one bin": (with_dead(0.1), 1.0, 1.0, 37.013),
    "several periods": (with_dead(253.3, cycles=10_000), 2.0, 0.5, 99.95),
    "whole period": (with_dead(100.0), 5.0, 0.5, 37.0),
    "stationary": (with_dead(85.0, start="stationary"), 1.0, 2.0, 37.0),
    "coarse bins": (with_dead(75.0, bins=100), 3.0, 1.0, 37.03),
    "synchronous": (with_dead(0.0, mode="synchronous"), 1.0, 1.0, 37.0),
    "synchronous, dead": (with_dead(75.0, mode="synchronous"), 1.0, 1.0, 37.0),
    "gated": (with_dead(45.0, mode="gated", gate_start_ns=80.03, gate_width_ns=40.0), 1.0, 1.0, 97.0),
    "bright background": (with_dead(20.0, cycles=10_000), 2.0, 30.0, 37.0),
    "two lobes": (
        PLAIN.replace(pulse=ml.SampledPulse(np.r_[np.hanning(40), 0.4 * np.hanning(60)], 0.05)),
        1.0,
        1.0,
        37.0,
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("name", SYSTEMS)
def test_unbiased_and_at_the_bound(name):
    """Means, variances and stated errors of 2000 exposures; the bound is computed from other code."""
    system, signal, background, delay = SYSTEMS[name]
    pixels = 2000
    cube = ml.simulate(ml.Flux(np.full((1, pixels), signal), background, delay), system, seed=7)[0, 0]
    estimate = ml.reconstruct(cube, system)
    assert not (estimate.flags & ~np.uint8(Flags.MISFIT)).any()
    bound = ml.cramer_rao(ml.Flux(signal, background, delay), system)
    lag = (estimate.delay_ns - delay + 0.5 * PERIOD) % PERIOD - 0.5 * PERIOD
    outcomes = {}
    for what, error, stated, least in (
        ("signal", estimate.signal - signal, estimate.signal_error, bound.signal),
        ("background", estimate.background - background, estimate.background_error, bound.background),
        ("delay", lag, estimate.delay_error_ns, bound.delay_ns),
    ):
        # second order, and places within a bin: 0.03 sd are allowed for
        z = max(abs(error.mean()) / least - 0.03, 0.0) * np.sqrt(pixels)
        outcomes[f"{what}, bias"] = 2 * stats.norm.sf(z)
        assert np.median(stated) == pytest.approx(least, rel=0.06)
        # "within 10 % of the bound": the sample deviation, less than which the bound is exceeded by chance at most
        square = (error.std() / (1.1 * least)) ** 2 * pixels
        outcomes[f"{what}, above 1.1 bounds"] = float(stats.chi2.sf(square, pixels - 1))
        square = (error.std() / (0.97 * least)) ** 2 * pixels
        outcomes[f"{what}, below the bound"] = float(stats.chi2.cdf(square, pixels - 1))
    require(outcomes, f"maximum likelihood, {name}")


@pytest.mark.full
@pytest.mark.parametrize(
    ("system", "signal", "bias"),
    [
        (PLAIN.replace(cycles=1000, detector=ml.Detector(dead_time_ns=75.0)), 5.6, 0.2),
        (with_dead(0.0, mode="synchronous", cycles=1000), 3.14, 0.12),
        (with_dead(150.0, start="stationary", cycles=1000), 5.6, 0.15),
    ],
)
def test_bias_is_taken_off(system, signal, bias):
    """Bright pixels of short exposures: the maximum stands too high; of second order up to 0.1 sd is left."""
    pixels, delay = 3000, 50.013
    cube = ml.simulate(ml.Flux(np.full((1, pixels), signal), signal, delay), system, seed=12)[0, 0]
    bound = float(ml.cramer_rao(ml.Flux(signal, signal, delay), system).signal)
    errors = {
        less: (ml.reconstruct(cube, system, MaximumLikelihood(less_bias=less)).signal - signal) / bound
        for less in (False, True)
    }
    assert errors[False].mean() > bias
    assert errors[True].std() < 0.98 * errors[False].std()
    z = max(abs(errors[True].mean()) - 0.1, 0.0) / errors[True].std() * np.sqrt(pixels)
    require({"bias": 2 * stats.norm.sf(z)}, "bias of the maximum")


def test_the_bound_knows_efficiency_and_dark_counts():
    """It is that of the light that the pixel sees, in units of the light that falls on it."""
    share, dark_hz = 0.4, 2e6
    dim = PLAIN.replace(detector=ml.Detector(dead_time_ns=75.0, detection_efficiency=share, dark_count_hz=dark_hz))
    detected = PLAIN.replace(detector=ml.Detector(dead_time_ns=75.0))
    dark = 1e-9 * dark_hz * PERIOD
    bound = ml.cramer_rao(ml.Flux(2.0, 0.5, 37.0), dim)
    same = ml.cramer_rao(ml.Flux(2.0 * share, 0.5 * share + dark, 37.0), detected)
    assert bound.signal * share == pytest.approx(float(same.signal), rel=1e-12)
    assert bound.background * share == pytest.approx(float(same.background), rel=1e-12)
    assert bound.depth_m == pytest.approx(float(same.depth_m), rel=1e-12)


def test_the_bound_needs_background():
    refused(r"background > 0 in each pixel", ml.cramer_rao, ml.Flux(1.0, 0.0, 37.0), PLAIN)


# few passes are left at the pulse, so that it matters what the ends of the exposure leave of them
ENDS = {
    "ends": (with_dead(75.0, cycles=1000), 10.0, 10.0, 50.013),
    "ends, stationary": (with_dead(75.0, start="stationary", cycles=1000), 10.0, 10.0, 50.013),
    "ends, two periods": (with_dead(185.0, cycles=600), 10.0, 1.0, 50.013),
}


@pytest.mark.full
@pytest.mark.parametrize("name", [*SYSTEMS, *ENDS])
def test_derivatives(name):
    """Gradient by finite differences; information as the variance of the gradient, and of other code's formula."""
    system, signal, background, delay = (SYSTEMS | ENDS)[name]
    pixels = 4000 if name in ENDS else 600
    cube = ml.simulate(ml.Flux(np.full((1, pixels), signal), background, delay), system, seed=11)[0, 0]
    at = np.array([1.1 * signal, 0.9 * background, delay + 0.07])
    h = cube[0]
    _, gradient, _ = log_likelihood(h, ml.Flux(*at), system)
    for k, step in enumerate(1e-4 * np.array([signal, background, system.bin_ns])):
        move = np.eye(3)[k] * step
        values = [log_likelihood(h, ml.Flux(*(at + sign * move)), system)[0] for sign in (1, -1)]
        slope = (values[0] - values[1]) / (2 * step)
        scale = np.sqrt(log_likelihood(h, ml.Flux(*at), system)[2][k, k])
        assert slope == pytest.approx(gradient[k], abs=2e-3 * scale, rel=1e-5)
    scores = np.array([log_likelihood(h, ml.Flux(signal, background, delay), system)[1] for h in cube])
    information = np.mean(
        [log_likelihood(h, ml.Flux(signal, background, delay), system)[2] for h in cube[:100]], axis=0
    )
    unit = np.sqrt(np.diag(information))
    whitened = np.linalg.solve(np.linalg.cholesky(information / np.outer(unit, unit)), (scores / unit).T)
    outcomes = {}
    for k in range(3):  # standard normal, were the information exact; 6 % is allowed for
        square = float(whitened[k] @ whitened[k])
        p = (stats.chi2.sf(square / 1.06, pixels), stats.chi2.cdf(square * 1.06, pixels))
        outcomes[f"score {k}"] = min(1.0, 2 * float(min(p)))
    require(outcomes, f"likelihood's gradient, {name}")


@pytest.mark.parametrize(
    ("dead", "background", "gate"),
    [(75.0, 30.0, {}), (20.3, 90.0, {}), (75.0, 30.0, {"mode": "gated", "gate_start_ns": 20.1, "gate_width_ns": 60.0})],
)
def test_background_in_one_sum_is_that_of_its_bins(dead: float, background: float, gate: dict):
    """The series of the bins without a pulse against each of them: up to a constant, at any delay and brightness."""
    system = with_dead(dead, **gate)
    record = recording_of(system)
    h = ml.simulate(ml.Flux(3.0, background, [[37.0]]), system, seed=3)[0, 0, 0].astype(float)
    places = ((s, f * background, d) for s in (0.5, 4.0) for f in (0.9, 1.05) for d in (2.0, 37.01, 97.0))
    at = np.array(list(places)) / [1.0, 1.0, PERIOD]
    series, whole = np.empty((2, len(at), 13))
    _core.histogram_log_likelihood(record, h, at, series, whole=False)
    _core.histogram_log_likelihood(record, h, at, whole, whole=True)
    assert (series[:, 0] - series[0, 0]) == pytest.approx(whole[:, 0] - whole[0, 0], abs=2e-5)
    scale = np.sqrt(np.maximum(whole[:, [4, 8, 12]], 1e-9))  # of a gradient: the root of its information
    assert (series[:, 1:4] - whole[:, 1:4]) / scale == pytest.approx(np.zeros((len(at), 3)), abs=1e-6)


def gaussian_samples(step: float) -> np.ndarray:
    return np.exp(-0.5 * np.arange(-6.0, 6.01, step) ** 2)


def echo_samples() -> np.ndarray:
    x = np.arange(100)
    return np.exp(-0.5 * ((x - 15) / 3) ** 2) + 0.2 * np.exp(-0.5 * ((x - 70) / 3) ** 2)


KINKS = {  # samples, their width in bins, S, B, dead time in periods, cycles
    "Gaussian, samples of 2 bins": (gaussian_samples(0.2), 2.0, 0.3, 0.3, 0.35, 2000),
    "Gaussian, samples of 4 bins": (gaussian_samples(0.4), 4.0, 0.3, 0.3, 0.35, 2000),
    "bright pulse with echo, samples of 1.46 bins": (echo_samples(), 1.46, 16.0, 0.05, 1.3, 1300),
    "edge of a decay over 20 bins": (np.exp(-np.arange(160) / 20.0), 1.0, 0.3, 0.3, 0.35, 2000),
}


def kinked(name: str, pixels: int, seed: int):
    values, width, signal, background, dead, cycles = KINKS[name]
    pulse = ml.SampledPulse(values, bin_ns=width * PERIOD / 500, origin="first")
    system = make_system(dead * PERIOD, cycles, 500, pulse=pulse)
    delay = PERIOD * np.random.default_rng(seed).random((1, pixels))
    flux = ml.Flux(signal, background, delay)
    return system, flux, ml.simulate(flux, system, seed=seed)[0]


@pytest.mark.parametrize("name", KINKS)
def test_samples_wider_than_a_bin_do_not_hold_the_maximum(name):
    """The likelihood has a kink wherever an edge of a bin meets one of a sample; the truth is never likelier."""
    system, flux, counts = kinked(name, 40, 21)
    estimate = ml.reconstruct(counts, system, MaximumLikelihood(less_bias=False))
    assert not (estimate.flags & ~np.uint8(Flags.MISFIT)).any()
    for p in range(40):
        hypotheses = ml.Flux(
            np.array([estimate.signal[0, p], flux.signal.flat[0]]),
            np.array([estimate.background[0, p], flux.background.flat[0]]),
            np.array([estimate.delay_ns[0, p], flux.delay_ns[0, p]]),
        )
        value, _, _ = log_likelihood(counts[0, p], hypotheses, system)
        assert value[0] > value[1] - 0.01


@pytest.mark.full
@pytest.mark.parametrize("name", KINKS)
def test_intervals_hold_with_samples_wider_than_a_bin(name):
    """Of 95 % intervals of delay, S and B, 93 to 97 % hold, 500 pixels each (level of the harness)."""
    pixels = 500
    system, flux, counts = kinked(name, pixels, 22)
    estimate = ml.reconstruct(counts, system)
    lag = (estimate.delay_ns - flux.delay_ns + 0.5 * PERIOD) % PERIOD - 0.5 * PERIOD
    outcomes = {}
    for what, error, stated in (
        ("delay", lag, estimate.delay_error_ns),
        ("signal", estimate.signal - flux.signal, estimate.signal_error),
        ("background", estimate.background - flux.background, estimate.background_error),
    ):
        known = np.isfinite(stated)
        assert known.mean() > 0.98
        hold = np.mean(np.abs(error[known]) < 1.96 * stated[known])
        z = max(abs(hold - 0.95) - 0.02, 0.0) / np.sqrt(0.95 * 0.05 / pixels)
        outcomes[f"{what}, {100 * hold:.1f} % hold"] = 2 * stats.norm.sf(z)
    require(outcomes, f"intervals, {name}")


GAUSSIAN = np.exp(-0.5 * (np.arange(-19.5, 20.0) / 2.5) ** 2)  # sigma of 2.5 samples


@pytest.mark.full
@pytest.mark.parametrize(
    ("pulse", "bins", "signal", "background", "cycles"),
    [
        (ml.GaussianPulse(sigma_ns=1.0), 10, 0.3, 0.3, 5000),
        (ml.GaussianPulse(sigma_ns=0.1), 200, 0.3, 0.3, 5000),
        (ml.GaussianPulse(sigma_ns=0.05), 200, 2.0, 0.3, 2000),
        (ml.GaussianPulse(sigma_ns=0.01), 200, 2.0, 0.3, 2000),
        (ml.GaussianPulse(sigma_ns=0.05), 200, 0.05, 0.02, 2000),
        (ml.SampledPulse(GAUSSIAN, 0.02), 200, 0.05, 0.02, 2000),
        (ml.SampledPulse(GAUSSIAN, 0.02), 50, 0.3, 0.3, 2000),
    ],
)
def test_intervals_hold_where_bins_are_wider_than_the_pulse(pulse, bins, signal, background, cycles):
    """Of 512 intervals of 95 % at least 90 % hold (false alarm 1e-6), delays are closer than the middle of any bin
    would be, and no estimate of S is that of another bin."""
    system = PLAIN.replace(pulse=pulse, bins=bins, cycles=cycles)
    delay = np.random.default_rng(6).uniform(30.0, 60.0, (8, 64))
    estimate = ml.reconstruct(ml.simulate(ml.Flux(signal, background, delay), system, seed=9)[0], system)
    for value, truth, error in (
        (estimate.signal, signal, estimate.signal_error),
        (estimate.background, background, estimate.background_error),
        (estimate.delay_ns, delay, estimate.delay_error_ns),
    ):
        assert (np.abs(value - truth) < 1.96 * error).mean() > 0.9
    assert np.abs((estimate.signal - signal) / estimate.signal_error).max() < 5.0
    assert (estimate.delay_ns - delay).std() < system.bin_ns / math.sqrt(12.0)


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in KINKS if not name.startswith("bright")])
def test_intervals_of_two_returns_hold_with_samples_wider_than_a_bin(name):
    """Of 95 % intervals of delays and signals, 92 to 98 % hold, 400 pixels each (level of the harness)."""
    system, _, _ = kinked(name, 1, 0)
    signals, background, pixels = np.array([0.3, 0.21]), 0.3, 400
    random = np.random.default_rng(23)
    first = random.uniform(0.0, 0.4, pixels)
    delays = PERIOD * np.stack([first, first + random.uniform(0.4, 0.5, pixels)])
    parts = (
        ml.Flux(np.full((1, pixels), signal), background if k == 0 else 0.0, delays[k])
        for k, signal in enumerate(signals)
    )
    estimate = ml.reconstruct(ml.simulate(ml.Flux.multi(*parts), system, seed=23)[0], system, returns=2).returns
    both = estimate.count[0] == 2
    assert both.mean() > 0.99
    lag = (estimate.delay_ns[0, both] - delays.T[both] + 0.5 * PERIOD) % PERIOD - 0.5 * PERIOD
    outcomes = {}
    for what, error, stated in (
        ("delay", lag, estimate.delay_error_ns[0, both]),
        ("signal", estimate.signal[0, both] - signals, estimate.signal_error[0, both]),
    ):
        hold = np.mean(np.abs(error) < 1.96 * stated)
        z = max(abs(hold - 0.95) - 0.03, 0.0) / np.sqrt(0.95 * 0.05 / both.sum())
        outcomes[f"{what}, {100 * hold:.1f} % hold"] = 2 * stats.norm.sf(z)
    require(outcomes, f"intervals of two returns, {name}")


def test_delay_wherever_the_pulse_is_narrow_or_wide():
    for sigma, bins in ((0.05, 500), (20.0, 200), (0.5, 64)):
        system = PLAIN.replace(pulse=ml.GaussianPulse(sigma_ns=sigma), bins=bins)
        delays = np.linspace(0.0, 99.9, 64)[None]
        estimate = ml.reconstruct(ml.simulate(ml.Flux(4.0, 0.5, delays), system, seed=2)[0], system)
        lag = (estimate.delay_ns - delays + 50.0) % 100.0 - 50.0
        # narrow pulses are lost inside of a bin: what is known of the delay is the bin
        assert np.abs(lag).max() < max(6.0 * estimate.delay_error_ns[np.isfinite(estimate.delay_error_ns)].max(), 0.25)


def test_pixels_without_signal_are_flagged():
    flux = ml.Flux(np.zeros((1, 4000)), 0.5, 0.0)
    cube = ml.simulate(flux, PLAIN.replace(cycles=400), seed=5)[0, 0]
    estimate = ml.reconstruct(cube, PLAIN.replace(cycles=400))
    missed = int((estimate.flags & Flags.NO_SIGNAL == 0).sum())
    require({"false alarms": float(stats.binom.sf(missed - 1, 4000, 0.015))}, "signal seen where there is none")
    assert (estimate.signal + estimate.background).mean() == pytest.approx(0.5, rel=0.01)  # the pulse takes what it can


def test_delays_of_pixels_without_signal_state_no_error():
    """Of returns too weak to be detected: 95 % intervals of the delay held in 56 to 65 %."""
    system = PLAIN.replace(
        cycles=40, bins=69, pulse=ml.GaussianPulse(sigma_ns=2.73), detector=ml.Detector(dead_time_ns=230.7)
    )
    cube = ml.simulate(ml.Flux(np.full((1, 300), 0.607), 1.738, 5.3), system, seed=1)[0]
    estimate = ml.reconstruct(cube, system)
    missed = (estimate.flags & Flags.NO_SIGNAL) > 0
    assert 0.5 < missed.mean() < 0.95
    assert np.isfinite(estimate.delay_ns).all()
    assert np.isnan(estimate.delay_error_ns[missed]).all()
    assert np.isnan(estimate.depth_error_m[missed]).all()
    assert np.isfinite(estimate.delay_error_ns[estimate.detected]).any()
    for value, truth, error in (
        (estimate.signal, 0.607, estimate.signal_error),
        (estimate.background, 1.738, estimate.background_error),
    ):  # false alarms: below 1e-7 where 95 % intervals hold in 90 %
        hold = np.abs(value - truth)[missed] < 1.96 * error[missed]
        assert stats.binom.cdf(hold.sum(), hold.size, 0.9) > 1e-7


def test_intervals_of_weak_returns():
    """Few photons: 95 % intervals of delay as the docs state them by significance, each at 1e-4."""
    system = make_system(75.0, 1000, 200, sigma_ns=1.0)
    random = np.random.default_rng(20261129)
    delay, signal = random.uniform(0.0, 100.0, 10_000), np.exp(random.uniform(np.log(1e-3), np.log(2e-2), 10_000))
    for background in (0.003, 0.01):  # 9 and 16 registrations
        estimate = ml.reconstruct(ml.simulate(ml.Flux(signal, background, delay), system, seed=17)[0, 0], system)
        hold = np.abs((estimate.delay_ns - delay + 50.0) % 100.0 - 50.0) < 1.96 * estimate.delay_error_ns
        for low, high, least in ((0.0, 4.0, 0.87), (4.0, 5.0, 0.92), (5.0, np.inf, 0.94)):
            some = hold[estimate.detected & (estimate.significance >= low) & (estimate.significance < high)]
            assert some.size > 300
            assert stats.binom.cdf(int(some.sum()), some.size, least) > 1e-4


@pytest.mark.parametrize("signal", [7.68513482, 3.49032099])
def test_systematic_error_where_the_likelihood_has_no_maximum(signal: float):
    """It was that of a negative variance, with a warning of NumPy's."""
    system = ml.System(
        period_ns=100.0,
        cycles=91,
        bins=203,
        pulse=ml.GaussianPulse(sigma_ns=1.0365372955101344),
        detector=ml.Detector(dead_time_ns=2023.9729027480025),
    )
    light = {7.68513482: (0.00052652, 76.39452778), 3.49032099: (0.00053626, 74.41908789)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bias, error = systematic_error(ml.Flux(signal, *light[signal]), system)
    at_maximum = signal > 5.0
    assert (np.isfinite(bias) == at_maximum).all()
    assert (np.isfinite(error) == at_maximum).all()


def test_empty_saturated_and_impossible_pixels():
    system = PLAIN.replace(cycles=100)
    cube = np.zeros((4, 500), np.uint16)
    cube[1, 200] = 1
    cube[2, 300] = 100  # fired in every period
    cube[3] = 50_000  # no pixel with this dead time can
    estimate = ml.reconstruct(cube, system)
    flags = Flags
    assert estimate.flags[0] == flags.EMPTY
    assert np.isnan(estimate.depth_m[0])
    assert estimate.signal[0] == 0.0
    assert estimate.flags[2] & flags.SATURATED
    assert estimate.flags[3] & flags.SATURATED
    assert not estimate.detected[0]
    for method in ("generalised_coates", "mchc", "matched_filter", "peak"):
        other = ml.reconstruct(cube, system, method)
        assert other.flags[0] & flags.EMPTY
        assert np.isnan(other.depth_m[0])


def test_threads_and_types_do_not_matter():
    flux = ml.Flux(np.geomspace(0.01, 10, 300)[None], 1.0, 50.0)
    cube = ml.simulate(flux, PLAIN, seed=1)[0]
    for method in METHODS.values():
        if PLAIN.detector.mode not in method.modes or method.of_images:
            continue
        single = ml.reconstruct(cube, PLAIN, method, threads=1)
        for other in (
            ml.reconstruct(cube, PLAIN, method, threads=3),
            ml.reconstruct(cube.astype(np.int64), PLAIN, method),
            ml.reconstruct(cube.astype(float), PLAIN, method),
        ):
            for name, values in single.maps().items():
                assert np.array_equal(values, getattr(other, name), equal_nan=True), (method.name, name)


COARSE = {  # bins in which light or armed periods change, and effects that the likelihood does not know
    "re-arms inside the pulse": (make_system(99.0, 10_000, 50, sigma_ns=1.0), 2.0, 2.0, 43.37),
    "two periods": (make_system(199.0, 10_000, 50, sigma_ns=1.0), 2.0, 2.0, 70.9),
    "bins of half a width": (make_system(75.0, 100_000, 200, sigma_ns=1.0), 10.0, 10.0, 43.37),
    "electronics": (
        make_system(50.0, 1000, 500, sigma_ns=1.0).replace(
            detector=ml.Detector(dead_time_ns=50.0, electronics_dead_time_ns=80.0)
        ),
        1.0,
        0.5,
        43.37,
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("name", COARSE)
def test_systematic_error_is_that_of_simulated_exposures(name):
    """Mean errors of 1024 exposures agree with the law's within 5 standard deviations of the mean, plus a tenth of a
    standard error for the second-order bias and a tenth of the error itself for the single step of scoring."""
    system, signal, background, delay = COARSE[name]
    light = ml.Flux(np.full((32, 32), signal), background, delay)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        estimate = ml.reconstruct(ml.simulate(light, system, seed=29)[0], system)
    assert any("bias the estimates by maximum likelihood: signal by" in str(each.message) for each in caught)
    bias, error = systematic_error(ml.Flux(signal, background, delay), system)
    assert np.abs(bias / error).max() > 1.0
    deviations = (estimate.signal - signal, estimate.background - background, estimate.delay_ns - delay)
    for deviation, b, e in zip(deviations, bias, error, strict=True):
        spread = deviation.std() / 32.0
        assert abs(deviation.mean() - b) < 5.0 * spread + 0.1 * e + 0.1 * abs(b)


@pytest.mark.filterwarnings("error")
def test_systematic_error_vanishes_in_narrow_bins():
    system, signal, background, delay = COARSE["re-arms inside the pulse"]
    fine = system.replace(bins=1600)
    bias, error = systematic_error(ml.Flux(signal, background, [delay, 80.0]), fine)
    assert bias.shape == error.shape == (2, 3)
    assert np.abs(bias / error).max() < 0.02
    ml.reconstruct(ml.simulate(ml.Flux(signal, background, delay), fine, seed=1)[0], fine)  # without a warning


def test_systematic_error_is_of_detectable_photons():
    system, *light = COARSE["re-arms inside the pulse"]
    dim = system.replace(detector=ml.Detector(dead_time_ns=99.0, detection_efficiency=0.2, dark_count_hz=1e5))
    np.testing.assert_array_equal(systematic_error(ml.Flux(*light), dim), systematic_error(ml.Flux(*light), system))


@pytest.mark.parametrize("flux", [ml.Flux(0.0, 1.0, 40.0), ml.Flux(1.0, 0.0, 40.0)])
def test_systematic_error_needs_signal_and_background(flux):
    refused(r"signal > 0|background > 0", systematic_error, flux, PLAIN)


def test_window_error_is_that_of_the_raw_estimate():
    """The joint law gives mean and spread of the window estimate that `peak` and `matched_filter` make."""
    system = PLAIN.replace(cycles=1000)
    cube = ml.simulate(ml.Flux(np.full((1, 4000), 1.0), 1.0, 37.0), system, seed=9)[0, 0]
    weights = window_weights(system, 37.0)
    mean, deviation = window_error(weights, ml.Flux(1.0, 1.0, 37.0), system)
    sample = cube @ weights
    z = (sample.mean() - mean) / deviation * np.sqrt(4000)
    square = sample.var() / deviation**2 * 4000
    require(
        {
            "mean": 2 * stats.norm.sf(abs(z)),
            "deviation": 2 * min(stats.chi2.sf(square, 3999), stats.chi2.cdf(square, 3999)),
        },
        "window estimate",
    )
    energy = system.pulse.bin_energy(37.0, PERIOD, system.bins)  # of S and B as light without dead time
    assert weights @ energy * system.cycles == pytest.approx(1.0, rel=1e-6)
    assert weights.sum() * system.cycles == pytest.approx(0.0, abs=1e-9)
    independent = np.sqrt(weights**2 @ cube.mean(0))  # what Poisson bins would have
    assert abs(independent / deviation - 1) > 0.02


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "coates"}, "'coates' is not for detectors of mode 'nonparalyzable'"),
        ({"cube": np.zeros((3, 7), np.uint16)}, r"cube must be \(..., 500\)"),
        ({"level": 0.0}, "level must be"),
        ({"system": with_dead(75.0, mode="paralyzable")}, "not for detectors of mode 'paralyzable'"),
        (
            {"system": with_dead(45.0, mode="gated", gate_start_ns=0.0, gate_width_ns=9.0, gate_step_ns=1.0)},
            "needs a gate that repeats",
        ),
        (
            {"system": PLAIN.replace(pulse=ml.GaussianPulse(sigma_ns=30.0)), "method": "matched_filter"},
            "use 'maximum_likelihood'",
        ),
        ({"system": with_dead(0.1), "method": "mchc"}, "at least one bin"),
    ],
)
def test_bad_input(change, message):
    arguments = {"cube": np.ones((2, 500), np.uint16), "system": PLAIN, **change}
    refused(message, ml.reconstruct, **arguments, error=(ValueError, TypeError))


def test_reflectivity_is_signal_over_level():
    depth = np.array([[1.0, 2.0, 4.0]])
    flux = ml.Flux([[4.0, 1.0, 0.25]], 0.1, PLAIN.delay_ns(depth))
    cube = ml.simulate(flux, PLAIN.replace(cycles=100_000), seed=1)[0]
    system = dataclasses.replace(PLAIN, cycles=100_000)
    absolute = ml.reconstruct(cube, system, level=4.0, attenuation="inverse_square")
    assert absolute.reflectivity == pytest.approx(np.ones((1, 3)), rel=0.05)
    relative = ml.reconstruct(cube, system)
    assert relative.reflectivity.mean() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("signal", "background", "dead", "cycles", "sigma", "start"),
    [
        (5.85, 3.7, 500.0, 1000, 5.0, "stationary"),  # 196 registrations, 20 armed periods and up to 5 hidden at an end
        (8.0, 0.5, 1000.0, 10_000, 5.0, "armed"),
        (1.1, 3.6, 2000.0, 18_514, 5.0, "stationary"),  # 21 and more numbers of hidden passes, in groups
        (0.3, 0.02, 75.0, 3000, 25.0, "armed"),  # a fifth of the pixels with a background of zero
        (2.0, 0.1, 75.0, 1000, 25.0, "armed"),
        (3.4, 0.25, 320.0, 157, 1.0, "stationary"),  # 40 registrations, one or two passes without one
        (3.4, 0.25, 620.0, 310, 1.0, "armed"),
        (3.4, 0.25, 1050.0, 525, 1.0, "armed"),
        (3.4, 0.25, 1050.0, 525, 1.0, "stationary"),
    ],
)
def test_intervals_hold_where_ends_hide_passes_and_where_background_is_zero(
    signal: float, background: float, dead: float, cycles: int, sigma: float, start: str
) -> None:
    """Of 95 %, at least 90 % of 400 pixels, at 1e-4, those without an upper limit left out.

    Also of those alone whose background is estimated as zero.
    """
    system = make_system(dead, cycles, 256, sigma_ns=sigma, start=start)
    delay = np.random.default_rng(9).uniform(0.0, 100.0, 400)
    counts = ml.simulate(ml.Flux(np.full(400, signal), background, delay), system, seed=9)[0, 0]
    estimate = ml.reconstruct(counts, system)
    assert estimate.signal_error is not None
    limited = np.isfinite(estimate.signal_error)
    assert limited.mean() > 0.98
    held = np.abs(estimate.signal - signal) < 1.96 * estimate.signal_error
    zero = np.isnan(estimate.background_error)
    late = np.abs((estimate.delay_ns - delay + 50.0) % 100.0 - 50.0) < 1.96 * estimate.delay_error_ns
    for some in (
        held[limited],
        held[zero & limited],
        late,
        (np.abs(estimate.background - background) < 1.96 * estimate.background_error)[~zero],
    ):
        assert stats.binom.cdf(int(some.sum()), some.size, 0.90) > 1e-4
