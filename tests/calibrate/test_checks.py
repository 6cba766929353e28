"""The tests of a validation as statistics: uniform where the model holds, however it was fitted; and their power.

Independent oracles: the exact laws for the response to a photon more, and simulated streams of the model.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from harness import ledger
from scipy import stats

import mars_lidar as ml
from mars_lidar.calibrate.light_error import responses
from mars_lidar.statistics import mean_histogram
from mars_lidar.statistics.distance import Pmf, g_test

SYSTEM = ml.System(
    period_ns=100.0,
    cycles=20_000,
    bins=64,
    pulse=ml.GaussianPulse(sigma_ns=1.0),
    detector=ml.Detector(dead_time_ns=65.0),
)
LIGHT = ml.Flux(0.9, 0.4, 37.0)
STREAMS = 20


@pytest.mark.parametrize(("signal", "background", "dead"), [(0.9, 0.4, 65.0), (0.1, 0.02, 85.0), (2.0, 1.0, 130.0)])
def test_response_to_a_photon_is_that_of_the_laws(signal: float, background: float, dead: float):
    """Variance and derivatives of the count, and of a bin's mean, from h against the exact laws."""
    system = ml.System(
        period_ns=100.0,
        cycles=1000,
        bins=1024,
        pulse=ml.GaussianPulse(sigma_ns=2.0),
        detector=ml.Detector(dead_time_ns=dead),
        start="stationary",
    )
    energy = system.pulse.bin_energy(37.0, 100.0, 1024)
    rate = signal * energy + background / 1024
    one = (np.arange(1024) == 400).astype(float)
    mean, h = responses(rate, dead / 100.0, np.stack([np.ones(1024), one]))
    exact = mean_histogram(signal, background, system, delay_ns=37.0) / 1000
    assert mean == pytest.approx(exact, rel=2e-3, abs=1e-9)
    # per period of a long exposure: what another thousand add
    short, long = (
        float(ml.count_law(signal, background, system.replace(cycles=c), delay_ns=37.0).variance) for c in (1000, 2000)
    )
    assert float((h[0] ** 2 * mean).sum()) == pytest.approx((long - short) / 1000, rel=1e-3)
    for change, slope in (((1e-3, 0.0), energy), ((0.0, 1e-3), np.full(1024, 1 / 1024))):
        more, less = (
            mean_histogram(signal + s * change[0], background + s * change[1], system, delay_ns=37.0)
            for s in (1.0, -1.0)
        )
        moved = (more - less) / 2e-3 / 1000
        got = (h * mean / rate) @ slope
        assert got[0] == pytest.approx(moved.sum(), rel=2e-3)
        assert got[1] == pytest.approx(moved[400], rel=1e-2, abs=1e-7)


@pytest.fixture(scope="module")
def streams() -> list[ml.Timestamps]:
    row = ml.Flux(np.full((1, 2 * STREAMS), 0.9), 0.4, 37.0)
    times = ml.simulate_timestamps(row, SYSTEM, seed=501)
    return [times.pixel(0, k) for k in range(2 * STREAMS)]


@pytest.mark.parametrize("way", ["own", "hold-off", "free", "another stream"])
def test_tests_are_uniform_under_the_model(streams, way: str):
    """Kolmogorov-Smirnov over streams for each test; more than 4 refused of 20 at 1 % has probability 1e-6.

    Where the light is another photons', the mean count is off by more than its sampling error: chi-square of its
    scores with what is told.
    """
    found = []
    for k in range(STREAMS):
        times = streams[k]
        if way == "another stream":
            light = ml.calibrate(streams[STREAMS + k], hold_off_ns=250.0)
        else:
            light = ml.calibrate(
                times, pulse="free" if way == "free" else None, hold_off_ns=250.0 if way == "hold-off" else None
            )
        found.append(ml.validate(times, light, cycles=100))
    assert sum(not one.consistent for one in found) <= 4
    for k, check in enumerate(found[0].checks):
        p = np.array([one.checks[k].p for one in found])
        # what is fitted has less than its share of errors: p near 1 is right, more near 0 is not ("greater")
        alternative = "greater" if check.name == "mean count" and way in ("own", "free") else "two-sided"
        ledger.require({check.name: float(stats.kstest(p, "uniform", alternative=alternative).pvalue)}, f"null, {way}")
    if way in ("hold-off", "another stream"):
        means = [next(check for check in one.checks if check.name == "mean count") for one in found]
        sampling = [np.sqrt(one.prediction.variance / one.realizations) for one in found]
        assert all(check.error > 1.5 * alone for check, alone in zip(means, sampling, strict=True))
        square = float(np.square([check.score for check in means]).sum())
        both = 2.0 * min(stats.chi2.sf(square, STREAMS), stats.chi2.cdf(square, STREAMS))
        ledger.require({"scores of the mean": float(both)}, f"null, {way}")
    ratio = np.array([one.total_variation / one.total_variation_floor[0] for one in found])
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / np.sqrt(STREAMS)


@pytest.mark.parametrize(
    ("detector", "by"),
    [
        (ml.Detector(dead_time_ns=65.0, afterpulsing=ml.Afterpulsing(probability=0.05, delay_ns=80.0)), "trend"),
        (ml.Detector(dead_time_ns=50.0, electronics_dead_time_ns=65.0), "unseen"),
        (ml.Detector(dead_time_ns=65.0, mode="paralyzable"), "unseen"),
    ],
)
def test_slow_departures_are_seen(detector: ml.Detector, by: str):
    """Effects that only shift a fitted background, in a weak one."""
    light = ml.Flux(0.8, 0.1, 37.0)
    times = ml.simulate_timestamps(light, SYSTEM.replace(cycles=600_000, detector=detector), seed=77)
    times = dataclasses.replace(times, info={})
    found = ml.validate(times, ml.calibrate(times, pulse=SYSTEM.pulse, dead_time_ns=65.0), cycles=2000)
    assert any(by in check.name for check in found.failed), found.checks


def test_count_test_leaves_the_mean_out():
    random = np.random.default_rng(6)
    counts = random.poisson(40.3, (300, 400))
    law = Pmf(0, stats.poisson.pmf(np.arange(120), 40.0))
    p = [g_test(law, Pmf.of_counts(row), 400, any_mean=True) for row in counts]
    ledger.require({"uniform": float(stats.kstest(p, "uniform").pvalue)}, "G-test of any mean")
    wide = random.negative_binomial(40, 0.5, 400)
    assert g_test(law, Pmf.of_counts(wide), 400, any_mean=True) < 1e-6
