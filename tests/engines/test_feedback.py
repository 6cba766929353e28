"""The feedback engine where it samples itself, against the dense covariance and the exact engine."""

from __future__ import annotations

import numpy as np
import pytest
from feedback_cases import SAMPLED, Sampler, case, drawn, kinds_of
from harness import (
    COUNTS,
    JOINT,
    PERIOD_NS,
    REFERENCE_NAMES,
    SHAPE,
    Case,
    Reference,
    bonferroni,
    check,
    flux_of,
    mean_vector,
    measured_pulse,
    require,
    waveform_flux,
)
from scipy import stats

from mars_lidar import Flux, joint_law
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import ENGINES

CLAIMS = {COUNTS, SHAPE, JOINT}


# The covariance in closed form, on dense matrices


def dense_law(request: Case, merge: int) -> tuple[FloatArray, FloatArray]:
    """Mean (bins,) and covariance (bins, bins) from an armed start: H = lambda (N_r + e - G H) + M.

    Solved on bins * merge equal cells.
    """
    system, flux = request.system, request.flux
    n = system.bins * merge
    photons = flux.background[0, 0] / n + flux.signal[0, 0] * system.pulse.bin_energy(flux.delay_ns[0, 0], PERIOD_NS, n)
    fire = -np.expm1(-photons)
    refire = np.where(photons > 1e-5, 1 - fire / np.maximum(photons, 1e-5), photons / 2)
    whole = int(system.dead_time_periods)
    rest = (system.dead_time_periods - whole) * n
    shift = int(rest + 1e-9)
    part = rest - shift
    j = np.arange(n)
    window, again = np.full((n, n), float(whole)), np.zeros((n, n))
    for back in range(1, shift + 1):
        window[j, (j - back) % n] += 1
    window[j, (j - shift - 1) % n] += part
    again[j, (j - shift) % n] += 1 - part
    again[j, (j - shift - 1) % n] += part
    response = np.linalg.inv(np.eye(n) + fire[:, None] * window - refire[:, None] * again)
    rate = response @ fire
    armed, rearmed = 1 - window @ rate, again @ rate
    noise = fire * (1 - fire) * armed + refire * (1 - refire) * rearmed
    below = np.concatenate([[0.0], np.cumsum(rate)])
    edges = np.arange(n + 1) / n

    def registered(y: FloatArray) -> FloatArray:  # within y before a period's edge
        periods = np.floor(y)
        return np.where(y > 0, (periods + 1) * below[-1] - np.interp(1 - (y - periods), edges, below), 0.0)

    blind = sum(registered(system.dead_time_periods - k - j / n) for k in range(whole + 1))
    mean = system.cycles * rate + response @ (fire * blind)
    covariance = system.cycles * (response * noise) @ response.T
    bins = (system.bins, merge)
    return mean.reshape(bins).sum(1), covariance.reshape(bins + bins).sum((1, 3))


DENSE = {
    "middle": case(1.0, 1.0, 0.6375, 4000),
    "bright": case(4.5, 1.0, 0.6375, 4000),
    "dim": case(0.1, 0.1, 0.6375, 20_000),
    "short dead time": case(2.0, 5.0, 0.1, 1000),
    "long dead time": case(1.0, 0.5, 1.53125, 4000),
    "slow": case(1.0, 7.0, 0.6375, 4000),
    "locked": case(8.0, 0.1, 0.9, 1_000_000),
    "whole period": case(0.8, 0.5, 1.0, 4000),
    "pulse at the edge": case(2.0, 0.5, 0.6375, 4000, delay=0.002),
    "bins of half counts": case(0.5, 0.05, 0.3, 1500),
    "1e7 cycles": case(1.0, 1.0, 0.6375, 10_000_000, items=2000),
    "1e8 cycles": case(0.3, 0.4, 0.6375, 100_000_000, items=2000),
    "1e8 cycles, long dead time": case(0.8, 0.3, 2.26, 100_000_000, items=2000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", DENSE)
def test_mean_and_covariance_are_those_of_the_closed_form(name: str):
    request = DENSE[name]
    mean, covariance = dense_law(request, 1 << int(kinds_of(request).max()))
    x = drawn(Sampler(), request).astype(float)
    peak = int(mean.argmax())
    near = np.arange(peak - 3, peak + 4) % mean.size
    weights = {"count": np.ones(mean.size), "window": np.isin(np.arange(mean.size), near).astype(float)}
    # the histogram without its mean in blocks, alternating: a direction in which neighbours repel
    weights["stripes"] = np.where(np.arange(mean.size) // 4 % 2, 1.0, -1.0)
    p = {}
    for about, w in weights.items():
        y, variance = x @ w, float(w @ covariance @ w)
        p[f"{about} mean"] = mean_vector(y, float(w @ mean), variance=variance)
        p[f"{about} variance"] = variance_test(y, variance)
    often = mean > 20
    p["bins"] = bonferroni([mean_vector(x[:, k], mean[k], variance=covariance[k, k]) for k in np.flatnonzero(often)])
    p["bin variances"] = bonferroni([variance_test(x[:, k], covariance[k, k]) for k in np.flatnonzero(often)])
    require(p, f"feedback, {name}, closed form")


def variance_test(y: FloatArray, variance: float) -> float:
    """p-value of a sample's variance, by the sample's own fourth moment."""
    square = (y - y.mean()) ** 2
    error = square.std() / np.sqrt(y.size)
    return float(2 * stats.norm.sf(abs(square.sum() / (y.size - 1) - variance) / error))


LONG = {
    "1e8 cycles, wide bins": case(1.0, 3.0, 0.37, 100_000_000, items=8000),
    "1e8 cycles, short dead time": case(0.6, 5.0, 0.13, 100_000_000, sigma=0.004, items=8000),
    "1e7 cycles, bright": case(8.0, 0.5, 0.6375, 10_000_000, items=8000),
    "1e7 cycles, two periods": case(2.0, 0.2, 2.26, 10_000_000, items=8000),
}


@pytest.mark.parametrize("name", LONG)
def test_means_of_long_exposures_are_a_small_part_of_their_errors_off(name: str):
    """The rule of the internal grid: 1/20 of a standard deviation in any bin, beside the sample's own error."""
    request = LONG[name]
    law = joint_law(
        Flux(
            float(request.flux.signal[0, 0]), float(request.flux.background[0, 0]), float(request.flux.delay_ns[0, 0])
        ),
        request.system,
        tolerance=1e-4,
    )
    x = drawn(Sampler(), request)
    off = (x.mean(0) - law.mean) / np.sqrt(law.variance)
    assert np.abs(off).max() < 0.05 + 5.5 / np.sqrt(len(x))  # 128 bins: 5e-6
    count = (x.sum(1).mean() - law.count_mean) / np.sqrt(law.count_variance)
    assert abs(count) < 0.05 + 5.5 / np.sqrt(len(x))


def test_few_counts_have_the_variance_of_their_means_too():
    """Followed to first order alone, quantiles lack the variance of mu: here 0.4 % of that of each bin."""
    request = case(2.0, 5.0, 0.1, 400, bins=512, items=20_000)
    law = joint_law(Flux(2.0, 5.0, float(request.flux.delay_ns[0, 0])), request.system, tolerance=1e-4)
    x = drawn(Sampler(), request)
    square = (((x - law.mean) ** 2) / law.variance).mean(1)  # a number for each exposure: bins depend on each other
    z = (square.mean() - 1.0) / (square.std() / np.sqrt(len(x)))
    require({"bin variances": float(2 * stats.norm.sf(abs(z)))}, "feedback, few counts, all bins together")


# The exact engine


AGAINST_EXACT = {
    "stationary": case(1.0, 1.0, 0.6375, 1000, start="stationary"),
    "stationary, long dead time": case(0.8, 0.3, 1.7, 1000, start="stationary"),
    "100 cycles": case(0.3, 0.3, 0.6375, 100, items=8000),
    "just below a period": case(1.0, 0.5, 0.996, 1500),
    "just above a period": case(2.0, 0.1, 1.004, 2000, start="stationary"),
    "one bin of dead time": case(2.0, 1.0, 0.0075, 500),
    "dead time below a bin": case(0.5, 0.5, 0.001, 500),
    "two lobes": case(2.0, 0.5, 0.3, 1000, pulse=SAMPLED),
    "narrow": case(2.0, 0.5, 0.6375, 1000, sigma=0.002),
    "wide": case(2.0, 0.5, 0.6375, 1000, sigma=0.2),
    "one bin": case(2.0, 0.5, 0.6375, 1000, bins=1),
    "seven bins": case(1.0, 1.0, 0.31, 1000, bins=7, items=8000),
    "background": case(0.0, 2.0, 0.45, 1000),
    "no background": case(1.5, 0.0, 0.45, 1000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", AGAINST_EXACT)
def test_law_is_that_of_exact(name: str):
    check(Sampler(), AGAINST_EXACT[name], ENGINES["exact"], CLAIMS)


@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_returns_and_waveforms(start: str):
    returns = case(0, 0, 0.6375, 1000, start=start)
    check(
        Sampler(),
        Case("returns", flux_of([1.0, 0.4, 0.8], 0.5, [0.2, 0.215, 0.9]), returns.system, 4000),
        ENGINES["exact"],
        CLAIMS,
    )
    wave = np.random.default_rng(3).exponential(size=300) ** 3
    check(
        Sampler(),
        Case("waveform", waveform_flux(1.5 * wave / wave.sum(), 0.3), returns.system, 4000),
        ENGINES["exact"],
        CLAIMS,
    )


def test_measured_pulse():
    pulse = measured_pulse("face_free_8ps", 10.0)
    check(Sampler(), case(3.0, 0.3, 0.8, 3000, pulse=pulse), ENGINES["exact"], CLAIMS)


FEW_ARMED = {"s02_bright", "s04_saturated", "s08_fewphotons", "s09_hw_bright", "s10_resonant"}  # given to exact


@pytest.mark.parametrize("name", sorted(set(REFERENCE_NAMES) - FEW_ARMED))
def test_reference_is_drawn_by_the_sampler(name: str):
    """The harness compares with the references; here, that it is not the exact engine that passes there."""
    request = Reference.load(name).case(photons=1e5)
    drawn(Sampler(), request)
