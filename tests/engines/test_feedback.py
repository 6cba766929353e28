"""The feedback engine where it samples itself, against the closed form of the covariance and the exact engine."""

import numpy as np
import pytest
from feedback_cases import SAMPLED, Sampler, case, drawn
from harness.cases import Case, flux_of, measured_pulse, waveform_flux
from harness.check import COUNTS, JOINT, SHAPE, check
from harness.joint import JointLaw
from harness.ledger import require
from harness.reference import REFERENCE_NAMES, Reference
from scipy import stats

from mars_lidar import Flux, joint_law
from mars_lidar.engines import ENGINES

CLAIMS = {COUNTS, SHAPE, JOINT}


# The covariance in closed form


CLOSED = {
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
@pytest.mark.parametrize("name", CLOSED)
def test_mean_and_covariance_are_those_of_the_closed_form(name: str):
    check(Sampler(), CLOSED[name], JointLaw.of(CLOSED[name]), CLAIMS)


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
