"""Every engine through the one harness: an independent simulator, closed forms, the sequential engine.

A new engine is one line in CLAIMS.
"""

from dataclasses import replace

import numpy as np
import pytest
from harness.cases import PERIOD_NS, Case, flux_of, make_system, measured_pulse, random_cases, two_lobes, waveform_flux
from harness.check import COUNTS, INTERVALS, JOINT, SHAPE, check
from harness.laws import JointLaw, Law, armed_count_pmf, constant_rate_moments, first_arrival, stationary_count_pmf
from harness.ledger import require
from harness.pvalues import two_mean_vectors
from harness.reference import REFERENCE_NAMES, Reference
from harness.sample import draw
from scipy import stats

from mars_lidar import Detector, GaussianPulse, SampledPulse
from mars_lidar.engines import ANY_SYSTEM, ENGINES

CLAIMS = {
    "exact": {COUNTS, SHAPE, JOINT, INTERVALS},
    "sequential": {COUNTS, SHAPE, JOINT, INTERVALS},
    "mars": {COUNTS, SHAPE},  # its bins are multinomial given the count: the joint law is known to be wrong
    "poisson": {COUNTS, SHAPE, JOINT},
    "feedback": {COUNTS, SHAPE, JOINT},
    "auto": {COUNTS, SHAPE, JOINT},
    "renewal": set(),  # a baseline whose count law is wrong on purpose: tests/engines/test_renewal.py
}
WITHOUT_DEAD_TIME = {"poisson"}  # the law of the arrivals, whatever the detector
TRUTH = "sequential"
WITH_DEAD_TIME = sorted(engine for engine in set(CLAIMS) - WITHOUT_DEAD_TIME if CLAIMS[engine])
RANDOM = random_cases(40, seed=2024, photons=2.5e6)


def constant_rate(rate: float, dead: float, cycles: int, items: int, start: str = "armed") -> Case:
    system = make_system(dead * PERIOD_NS, cycles, 16, start=start)
    name = f"constant rate {rate:g}, t_d {dead:g}, {cycles} cycles, {start}"
    return Case(name, flux_of(0.0, rate), system, items)


def pulsed(signal: float, background: float, dead: float, *, items: int = 6000, **changes: object) -> Case:
    system = make_system(dead * PERIOD_NS, 200, 64, sigma_ns=2.0).replace(**changes)
    name = f"S {signal:g}, B {background:g}, t_d {dead:g}, {system.cycles} cycles, {system.start}"
    return Case(name, flux_of(signal, background, 0.37), system, items)


def photons_per_bin(case: Case) -> np.ndarray:
    """Expected photons of one period in each bin (bins,), from the pulse's own distribution function."""
    flux, system = case.flux, case.system
    total = np.full(system.bins, flux.background[0, 0] / system.bins)
    if flux.waveform is not None:
        wave = flux.waveform[0, 0]
        below = np.concatenate([[0.0], np.cumsum(wave)])
        edges = np.linspace(0.0, 1.0, system.bins + 1)
        return total + np.diff(np.interp(edges, np.linspace(0.0, 1.0, wave.size + 1), below))
    for s, tau in zip(flux.returns_signal[:, 0, 0], flux.returns_delay_ns[:, 0, 0], strict=True):
        total += s * system.pulse.bin_energy(tau, system.period_ns, system.bins)
    return total


def poisson_law(case: Case) -> Law:
    mean = case.system.cycles * photons_per_bin(case)
    most = int(stats.poisson.isf(1e-12, mean.sum()))
    return Law(mean, stats.poisson.pmf(np.arange(most), mean.sum()), independent_poisson=True)


def test_every_engine_is_tested():
    assert set(CLAIMS) == set(ENGINES)


# An independent simulator


@pytest.mark.full
@pytest.mark.parametrize("name", REFERENCE_NAMES)
@pytest.mark.parametrize("engine", WITH_DEAD_TIME)
def test_reference(engine: str, name: str):
    reference = Reference.load(name)
    case = reference.case(photons=8e6 if engine == TRUTH else 3e7)
    check(ENGINES[engine], case, reference, CLAIMS[engine] - {INTERVALS})


# The closed-form covariance of the histogram


JOINT_ENGINES = [name for name in WITH_DEAD_TIME if JOINT in CLAIMS[name]]


@pytest.mark.full
@pytest.mark.parametrize("case", RANDOM[::2], ids=lambda case: case.name)
@pytest.mark.parametrize("engine", JOINT_ENGINES)
def test_random_system_has_the_joint_law(engine: str, case: Case):
    check(ENGINES[engine], case, JointLaw.of(case), CLAIMS[engine] - {INTERVALS}, seed=3)


# Closed forms


SOURCES = {
    "gaussian": pulsed(1.5, 0.5, 0.0),
    "wide": pulsed(1.5, 0.5, 0.0, pulse=GaussianPulse(sigma_ns=30.0)),
    "narrow": pulsed(1.5, 0.5, 0.0, pulse=GaussianPulse(sigma_ns=2e-4)),
    "two lobes": pulsed(1.5, 0.5, 0.0, pulse=SampledPulse(two_lobes(), 0.3, "centroid")),
    "whole period": pulsed(1.5, 0.5, 0.0, pulse=SampledPulse(two_lobes(), PERIOD_NS / 120, "first")),
    "returns": replace(pulsed(0, 0, 0.0), flux=flux_of([1.0, 0.4, 0.1], 0.5, [0.2, 0.21, 0.9])),
    "waveform": replace(pulsed(0, 0, 0.0), flux=waveform_flux(two_lobes() / 15, 0.1)),
    "one sample": replace(pulsed(0, 0, 0.0), flux=waveform_flux([1.5])),
    "background": pulsed(0.0, 1.5, 0.0),
    "bright": pulsed(700.0, 300.0, 0.0, cycles=3, items=3000),
}


@pytest.mark.full
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("engine", ANY_SYSTEM)
def test_without_dead_time_everything_is_poisson(engine: str, source: str):
    case = SOURCES[source]
    if source == "narrow":  # all in one bin: the pulse must not straddle an edge
        case = replace(case, flux=flux_of(1.5, 0.5, 24.5 / 64))
    check(ENGINES[engine], case, poisson_law(case), CLAIMS[engine])


@pytest.mark.parametrize("engine", sorted(WITHOUT_DEAD_TIME))
@pytest.mark.parametrize("dead", [0.6375, 3.0])
def test_the_law_of_the_arrivals_ignores_the_dead_time(engine: str, dead: float):
    case = pulsed(1.5, 0.5, dead)
    check(ENGINES[engine], case, poisson_law(case), CLAIMS[engine])


@pytest.mark.full
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("rate", "dead", "cycles"), [(0.05, 0.1, 200), (1.0, 0.6375, 100), (6.0, 2.3, 40), (20.0, 0.3, 20), (2.0, 90.7, 50)]
)
@pytest.mark.parametrize("engine", WITH_DEAD_TIME)
def test_constant_rate(engine: str, rate: float, dead: float, cycles: int, start: str):
    if engine == TRUTH and start == "stationary" and rate * dead > 100:
        pytest.skip("the sequential engine's warm-up would draw 60,000 photons an exposure")
    case = constant_rate(rate, dead, cycles, 8000, start)
    most = int(cycles / max(dead, 1e-9)) + 2 if rate * dead > 0.1 else int(rate * cycles * 10)
    most = min(most, int(rate * cycles + 12 * np.sqrt(rate * cycles)) + 20)
    pmf = armed_count_pmf if start == "armed" else stationary_count_pmf
    # the closed moments leave out a term that vanishes as exp(-2 pi^2 n / (1 + x)^2) after n registrations
    x = rate * dead
    settled = 2 * np.pi**2 * rate * cycles / (1 + x) ** 3 > 15
    moments = constant_rate_moments(rate, dead, cycles, stationary=start == "stationary") if settled else None
    flat = np.full(16, cycles * rate / (1 + x) / 16) if start == "stationary" else None
    check(ENGINES[engine], case, Law(flat, pmf(rate, dead, cycles, most), moments), CLAIMS[engine])


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "background", "periods"), [(1.0, 0.2, 1), (5.0, 0.2, 3), (8.0, 0.02, 50), (0.1, 0, 2)]
)
@pytest.mark.parametrize("engine", WITH_DEAD_TIME)
def test_dead_time_of_whole_periods_does_not_distort(engine: str, signal: float, background: float, periods: int):
    """r = lambda / (1 + k Lambda), exactly, from a stationary start."""
    items = max(400, 1200 // periods) if engine == TRUTH else 12_000
    case = pulsed(signal, background, float(periods), cycles=4 * periods + 3, start="stationary", items=items)
    photons = photons_per_bin(case)
    law = Law(case.system.cycles * photons / (1 + periods * photons.sum()))
    check(ENGINES[engine], case, law, CLAIMS[engine])


@pytest.mark.full
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("engine", WITH_DEAD_TIME)
def test_one_registration_at_most(engine: str, start: str):
    """A dead time longer than the exposure.

    Armed: some number of periods without photons, then the law of the first arrival. Stationary:
    r = lambda / (1 + 9 Lambda) throughout.
    """
    items = 4000 if engine == TRUTH and start == "stationary" else 40_000
    case = pulsed(0.6, 0.1, 9.0, cycles=7, start=start, items=items)
    photons = photons_per_bin(case)
    total = photons.sum()
    if start == "armed":
        histogram = first_arrival(photons) / -np.expm1(-total) * -np.expm1(-7 * total)
    else:
        histogram = 7 * photons / (1 + 9 * total)
    observed = histogram.sum()
    check(ENGINES[engine], case, Law(histogram, np.array([1 - observed, observed])), CLAIMS[engine])
    assert draw(ENGINES[engine], case, 2).counts.max() <= 1


@pytest.mark.parametrize(("signal", "dead"), [(2.0, 0.6375), (6.0, 0.93), (0.5, 0.1)])
@pytest.mark.parametrize("engine", WITH_DEAD_TIME)
def test_a_whole_period_of_dead_time_leaves_the_stationary_shape(engine: str, signal: float, dead: float):
    """If the rate r(t) is stationary for t_d, r(t) / (1 + N) is for t_d + t_r; N registrations a period."""
    items = 2000 if engine == TRUTH else 12_000
    short = pulsed(signal, 0.3, dead, cycles=100, start="stationary", items=items)
    long = pulsed(signal, 0.3, dead + 1, cycles=100, start="stationary", items=items)
    a, b = (draw(ENGINES[engine], case, seed).cube.astype(float) for case, seed in ((short, 1), (long, 2)))
    pooled = (a.sum(0) + b.sum(0)) / (a.sum() + b.sum())
    excess = [x - pooled * x.sum(1, keepdims=True) for x in (a, b)]
    per_period = a.sum() / items / 100
    mean, error = b.sum(1).mean(), b.sum(1).std() / np.sqrt(items)
    slope = 1 / (1 + per_period) ** 2  # of N / (1 + N), for the error of the first mean
    error = np.hypot(error, slope * a.sum(1).std() / np.sqrt(items))
    require(
        {
            "shape": two_mean_vectors(*excess),
            "scale": 2 * stats.norm.sf(abs(mean - 100 * per_period / (1 + per_period)) / error),
        },
        f"{engine}, whole period added to {dead:g}",
    )


# The sequential engine


@pytest.mark.full
@pytest.mark.parametrize("case", RANDOM, ids=lambda case: case.name)
@pytest.mark.parametrize("engine", sorted(set(WITH_DEAD_TIME) - {TRUTH}))
def test_random_system(engine: str, case: Case):
    check(ENGINES[engine], case, ENGINES[TRUTH], CLAIMS[engine])


@pytest.mark.parametrize("case", RANDOM[::4], ids=lambda case: case.name)
@pytest.mark.parametrize("engine", sorted(WITHOUT_DEAD_TIME))
def test_random_system_without_dead_time(engine: str, case: Case):
    case = replace(case, system=case.system.replace(detector=Detector(dead_time_ns=0.0)))
    check(ENGINES[engine], case, ENGINES[TRUTH], CLAIMS[engine])


@pytest.mark.full
@pytest.mark.parametrize("name", ["face_free_8ps", "face_free_unimodal_8ps"])
@pytest.mark.parametrize(("origin", "start"), [("peak", "armed"), ("centroid", "stationary"), ("first", "armed")])
@pytest.mark.parametrize("engine", sorted(set(WITH_DEAD_TIME) - {TRUTH}))
def test_measured_pulse(engine: str, name: str, origin: str, start: str):
    pulse = measured_pulse(name, 10.0, origin)
    case = pulsed(4.0, 0.3, 0.8, pulse=pulse, bins=512, cycles=80, start=start, items=4000)
    check(ENGINES[engine], case, ENGINES[TRUTH], CLAIMS[engine])


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "dead", "cycles"),
    [(10.0, 0.99, 100), (10.0, 1.9999, 100), (3.0, 1.0, 150), (3.0, 2.0, 150), (1000.0, 0.6375, 4), (30.0, 1e-3, 15)],
)
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("engine", sorted(set(WITH_DEAD_TIME) - {TRUTH}))
def test_hard_system(engine: str, signal: float, dead: float, cycles: int, start: str):
    """Locked to the laser, hardly locked, saturated, many registrations in one pulse."""
    warm_up = 0 if start == "armed" else 300 * (1 + dead)
    items = int(min(4000, max(1000, 4e6 / (signal * (cycles + warm_up))))) // 4 * 4
    if signal > 100 and start == "stationary":
        pytest.skip("the sequential engine's warm-up would draw 500,000 photons an exposure")
    check(
        ENGINES[engine],
        pulsed(signal, 0.05, dead, cycles=cycles, start=start, items=items),
        ENGINES[TRUTH],
        CLAIMS[engine],
    )
