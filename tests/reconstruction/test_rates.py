"""Corrections of histograms, against mean histograms that are known exactly."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from harness import make_system, refused, require
from scipy import stats
from scipy.stats import binom

import mars_lidar as ml
from mars_lidar.reconstruction import METHODS, ChainCorrection, Coates, GeneralisedCoates
from mars_lidar.statistics import mean_histogram

PERIOD = 100.0


def system_of(dead_ns: float, *, bins: int = 500, **more) -> ml.System:
    return make_system(dead_ns, bins=bins, period_ns=PERIOD, **more)


def photons(system: ml.System, signal: float, background: float, delay_ns: float) -> np.ndarray:
    return signal * system.pulse.bin_energy(delay_ns, PERIOD, system.bins) + background / system.bins


def recursion(rate: np.ndarray, cycles: int, shift: int) -> np.ndarray:
    """Mean histogram of an armed exposure on bins whose registrations re-arm at a uniform place `shift` bins later.

    Written from section 5 of the model: A = P(armed), bin by bin through the whole exposure, no period folded.
    """
    n = rate.size
    past = np.zeros(n * cycles)
    armed = 1.0
    for t in range(n * cycles):
        rearmed = past[t - shift] if t >= shift else 0.0
        fired = -np.expm1(-rate[t % n])
        after = armed * (1.0 - fired) + rearmed * fired / rate[t % n]
        past[t] = armed + rearmed - after
        armed = after
    return past.reshape(cycles, n).sum(0)


@pytest.mark.parametrize(("shift", "cycles"), [(7, 400), (23, 400), (64, 400), (64 * 3 + 5, 400)])
def test_generalised_coates_inverts_the_recursion(shift, cycles):
    """Exactly, but for the exposure's ends, which are known on average over the cycles."""
    n = 64
    system = system_of(shift / n * PERIOD, bins=n, cycles=cycles, sigma_ns=3.0)
    rate = photons(system, 1.5, 1.0, 37.0)
    mean = recursion(rate, cycles, shift)
    error = np.abs(GeneralisedCoates().rates(mean, system) / rate - 1.0).max()
    careless = GeneralisedCoates().rates(mean, system.replace(start="stationary"))
    assert error < 3e-4
    assert error < 0.2 * np.abs(careless / rate - 1.0).max()


@pytest.mark.parametrize("dead_ns", [0.0, 0.3, 7.0, 64.04, 99.97, 100.0, 237.77])
@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_generalised_coates_inverts_the_exact_mean(dead_ns, start):
    """The mean histogram in continuous time, any dead time: what is left is the flux's change inside of bins."""
    error = []
    for bins in (250, 1000):
        system = system_of(dead_ns, bins=bins, cycles=2000, start=start)
        rate = photons(system, 1.0, 1.0, 37.0)
        mean = mean_histogram(ml.Flux(1.0, 1.0, 37.0), system, tolerance=1e-6)
        error.append(np.abs(GeneralisedCoates().rates(mean, system) - rate).sum() / rate.sum())
    assert error[1] < 2e-4
    assert error[1] < 0.25 * error[0] + 2e-5


@pytest.mark.parametrize(("dead_ns", "cycles"), [(0.0, 1), (0.0, 1000), (64.0, 1000), (237.0, 1000)])
def test_coates_inverts_the_exact_mean(dead_ns, cycles):
    system = system_of(dead_ns, cycles=cycles, mode="synchronous")
    rate = photons(system, 1.0, 0.5, 37.0)
    mean = mean_histogram(ml.Flux(1.0, 0.5, 37.0), system)
    result = Coates().rates(mean, system)
    assert np.abs(result / rate - 1.0).max() < (1e-9 if dead_ns == 0 else 1e-3)


@pytest.mark.parametrize(
    ("method", "signal", "background", "cycles", "least"),
    [
        ("coates", 0.5, 0.5, 500, 0.95),
        ("coates", 3.0, 0.5, 500, 0.95),  # 15 passes reach the period's end
        ("coates", 4.0, 0.4, 300, 0.90),  # 3.7 pass: a third of the errors were those of a period without photons
        ("coates", 1.0, 5.0, 3000, 0.95),
        ("generalised_coates", 3.0, 0.5, 300, 0.95),
    ],
)
def test_errors_of_windows_hold_where_few_passes_are_armed(method, signal, background, cycles, least):
    """Of 1000 pixels `least` of the 95 % intervals of S and B contain them, as far as chance (1e-4) allows."""
    mode, dead = ("synchronous", 0.0) if method == "coates" else ("nonparalyzable", 80.0)
    system = system_of(dead, bins=200, cycles=cycles, sigma_ns=1.0, mode=mode, start="armed")
    delay = 32.0 + np.random.default_rng(1).uniform(-0.25, 0.25, (1, 1000))
    counts = ml.simulate(ml.Flux(np.full_like(delay, signal), background, delay), system, seed=1, threads=1)[0]
    maps = ml.reconstruct(counts, system, method, threads=1)
    usual = maps.flags == 0
    assert usual.mean() > 0.9
    for value, error, truth in (
        (maps.signal, maps.signal_error, signal),
        (maps.background, maps.background_error, background),
    ):
        within = np.abs(value - truth)[usual] < 1.96 * error[usual]
        assert binom.cdf(within.sum(), within.size, least) > 1e-4
        assert (np.abs(value - truth)[usual] < 5.0 * error[usual]).mean() > 0.998


def test_tails_of_the_pulse_beyond_its_window_are_no_background():
    """B was 0.0074 to 0.011 too high, up to three of its errors: 0.3 % of S lie outside of the window."""
    system = system_of(45.0, bins=200, cycles=3109, mode="gated", gate_start_ns=20.0, gate_width_ns=60.0, sigma_ns=1.0)
    for background in (0.0, 0.02):  # the law of the mean histogram shares nothing with the estimate
        mean = mean_histogram(ml.Flux(2.23, background, 50.0), system, tolerance=1e-7)
        maps = ml.reconstruct(np.round(1e9 * mean), system.replace(cycles=3109 * 10**9), "generalised_coates")
        assert float(maps.signal) == pytest.approx(2.23, abs=1e-3)
        assert float(maps.background) == pytest.approx(background, abs=1e-4)
    cube = ml.simulate(ml.Flux(np.full((1, 1000), 2.23), 0.05, 50.0), system, seed=20261127)[0]
    maps = ml.reconstruct(cube, system, "generalised_coates")
    outcomes = {}
    for name, truth in (("signal", 2.23), ("background", 0.05)):
        error, stated = getattr(maps, name) - truth, getattr(maps, f"{name}_error")
        outcomes[f"{name}, mean"] = 2.0 * stats.norm.sf(abs(error.mean()) / error.std() * np.sqrt(error.size))
        outcomes[f"{name}, intervals"] = binom.cdf((np.abs(error) < 1.96 * stated).sum(), error.size, 0.93)
    require(outcomes, "window of a gated pulse")


def test_bias_of_wide_bins_is_stated():
    """The warning states the error that 1000 exposures have on average, and stays away in bins a quarter as wide."""
    said = {}
    for bins in (62, 248):
        system = system_of(205.9, bins=bins, cycles=6299, sigma_ns=2.0)
        cube = ml.simulate(ml.Flux(np.full((1, 1000), 4.4), 0.87, 40.3), system, seed=2)[0]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            maps = ml.reconstruct(cube, system, "generalised_coates")
        said[bins] = "".join(str(each.message) for each in caught)
        bias = ((maps.signal - 4.4) / maps.signal_error).mean()
        if bins == 62:
            assert bias < -1.5
            assert float(said[62].split("signal by ")[1].split(",")[0]) == pytest.approx(bias, abs=0.3)
        else:
            assert abs(bias) < 0.3
    assert "the bins of 1.6129 ns bias the estimates by generalised coates" in said[62]
    assert not said[248]


def test_no_error_of_a_background_without_registrations():
    """And the bins in which no pass was armed say nothing of the light."""
    system = system_of(0.0, bins=100, cycles=50, sigma_ns=1.0, mode="synchronous")
    counts = np.zeros(100)
    counts[40] = 20
    maps = ml.reconstruct(counts, system, "coates")
    assert maps.background == 0.0
    assert np.isnan(maps.background_error)
    assert maps.signal_error > 0.0
    counts[:] = [1, *[0] * 38, 8, 40, *[0] * 59]  # from bin 41 on one pass, then none
    counts[60] = 1
    maps = ml.reconstruct(counts, system, "coates")
    before = -np.log1p(-1 / 50) / 62 * 100  # B of bins 0 to 60, at least
    assert float(maps.background) > before


def test_coates_is_the_textbook_formula():
    system = system_of(0.0, bins=4, cycles=100, sigma_ns=5.0, mode="synchronous")
    h = np.array([10, 20, 0, 30])
    result = Coates().rates(h, system)
    assert result == pytest.approx(np.log([100 / 90, 90 / 70, 1.0, 70 / 40]), abs=1e-12)
    assert np.isinf(Coates().rates([10, 90, 0, 0], system)[1])


@pytest.mark.parametrize("method", ["generalised_coates", "mchc"])
def test_a_bin_that_always_registered_is_saturated_in_spite_of_rounding(method):
    """With 1000 cycles armed passes are whole thousandths, and sums of them may exceed an equal count by 1e-13."""
    system = make_system(75.0, 1000, 1024, period_ns=400 / 3, sigma_ns=0.5)
    delay = np.random.default_rng(9).uniform(0.0, 400 / 3, 1000)
    cube = ml.simulate(ml.Flux(np.full(1000, 10.0), 10.0, delay), system, seed=9)
    maps = ml.reconstruct(cube, system, method)
    known = maps.flags & ml.reconstruction.Flags.SATURATED == 0
    assert 0.5 < known.mean() < 0.7
    assert maps.signal[known].max() < 1e4
    rates = GeneralisedCoates().rates(cube, system)
    assert np.array_equal(np.isinf(rates).any(-1), ~known)


def test_a_gate_that_stays():
    system = system_of(45.0, mode="gated", gate_start_ns=80.03, gate_width_ns=40.0)
    mean = mean_histogram(ml.Flux(1.0, 1.0, 95.0), system, tolerance=1e-6)
    result = GeneralisedCoates().rates(mean, system)
    rate = photons(system, 1.0, 1.0, 95.0)
    inside = np.r_[402:500, 0:99]
    assert np.abs(result[inside] / rate[inside] - 1.0).max() < 2e-3
    assert not result[102:398].any()


def test_mchc_has_the_histogram_as_its_fixed_point():
    """On a long exposure it agrees with generalised Coates, which finds the same rates by another way."""
    for dead_ns in (23.0, 64.04, 237.77):
        system = system_of(dead_ns, cycles=10**6)
        rate = photons(system, 1.0, 1.0, 37.0)
        mean = mean_histogram(ml.Flux(1.0, 1.0, 37.0), system, tolerance=1e-6)
        result = ChainCorrection(tolerance=1e-9).rates(mean, system)
        assert np.abs(result - rate).sum() / rate.sum() < 1e-3
        known = ChainCorrection(tolerance=1e-9).rates(mean, system, total=2.0)
        assert known.sum() == pytest.approx(2.0, rel=1e-12)
        assert np.abs(known - rate).sum() / rate.sum() < 1e-3


def test_one_cycle_of_an_armed_pixel():
    """Nothing lies before the exposure: the correction is Coates' own where one photon fills the period."""
    free = system_of(99.0, bins=50, cycles=1, sigma_ns=5.0)
    clock = system_of(0.0, bins=50, cycles=1, sigma_ns=5.0, mode="synchronous")
    mean = np.linspace(0.0, 0.015, 50)
    assert GeneralisedCoates().rates(mean, free)[:49] == pytest.approx(Coates().rates(mean, clock)[:49], abs=1e-12)


@pytest.mark.parametrize(
    "effect",
    [{"electronics_dead_time_ns": 80.0}, {"jitter": ml.Jitter(sigma_ns=0.5)}, {"max_events_per_period": 1}],
    ids=["electronics", "jitter", "limit"],
)
def test_what_no_method_knows_of_the_detector_is_told(effect):
    plain = make_system(50.0, 100, 100, detection_efficiency=0.5)
    cube = ml.simulate(ml.Flux(1.0, 0.5, 37.0), plain)
    ml.reconstruct(cube, plain)  # no word of an efficiency
    odd = plain.replace(detector=ml.Detector(dead_time_ns=50.0, **effect))
    with pytest.warns(UserWarning, match=next(iter(effect))):
        ml.reconstruct(cube, odd)
    refused(f"cramer_rao does not do {next(iter(effect))}", ml.cramer_rao, ml.Flux(1.0, 0.5, 37.0), odd)


# The centre of mass of the counts: unbiased to a hundredth of a bin, with the spread of a mean, where light is dim.


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
