"""Statistics of paralyzable, synchronous and gated pixels: closed forms, plain recursions, the exact engine."""

from typing import Any

import numpy as np
import pytest
from harness import COUNTS, SHAPE, Law, check, first_arrival, pmf_of, refused
from harness.cases import PERIOD_NS, Case, flux_of, make_system, two_lobes
from harness.paralyzable import paralyzable_moments
from scipy import stats

import mars_lidar as ml
from mars_lidar.engines import ENGINES
from mars_lidar.statistics import ConvergenceError, PhaseChain, exposure_moments, mean_histogram
from mars_lidar.statistics.tolerances import TOL

DEAD = [0.0, 0.4, 1.0, 1.7, 5.02, 60.0]
GATES = {"gate": (0.303, 0.11), "wrapping gate": (0.9, 0.5), "narrow gate": (0.38, 0.002)}


def view(mode: str, dead: float, start: str = "armed", cycles: int = 40, **changes: Any) -> ml.System:
    extra = {}
    if mode in GATES:
        opens, width = GATES[mode]
        mode, extra = "gated", {"gate_start_ns": opens * PERIOD_NS, "gate_width_ns": width * PERIOD_NS}
    return make_system(dead * PERIOD_NS, cycles, 50, sigma_ns=2.0, start=start, mode=mode, **extra).replace(**changes)


def law_of(case: Case, flux: ml.Flux) -> Law:
    """What the statistics say about a case."""
    histogram = mean_histogram(flux, case.system)
    shape = ml.registration_pdf(flux, case.system)
    assert shape == pytest.approx(histogram / histogram.sum(), abs=1e-12)
    law = ml.count_law(flux, case.system)
    assert law.mean == pytest.approx(histogram.sum(), rel=1e-3)
    assert law.pmf @ law.support == pytest.approx(float(law.mean), rel=1e-6)
    if case.system.detector.mode == "paralyzable":  # the closed form of mean, variance and shape
        moments = paralyzable_moments(flux, case.system)
        assert law.cumulants[:2] == pytest.approx(moments[:2], rel=3e-5)
        assert np.abs(histogram - moments.histogram).sum() < 1e-4 * moments.mean
    return Law(histogram, pmf_of(law))


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", DEAD)
@pytest.mark.parametrize("mode", ["paralyzable", "synchronous", *GATES])
def test_statistics_are_those_of_the_exact_engine(mode: str, dead: float, start: str):
    system = view(mode, dead, start)
    signal, background = (1.5, 0.5) if dead < 2 else (0.05, 0.02)
    case = Case(f"{mode}, t_d {dead:g}, {start}", flux_of(signal, background, 0.37), system, 6000)
    law = law_of(case, ml.Flux(signal, background, 37.0))
    check(ENGINES["exact"], case, law, {COUNTS, SHAPE})


@pytest.mark.parametrize("mode", ["paralyzable", "synchronous", "wrapping gate"])
def test_waveforms(mode: str):
    wave = two_lobes() / 12
    case = Case(f"{mode}, waveform", flux_of_waveform(wave, 0.3), view(mode, 0.7), 6000)
    law = law_of(case, ml.Flux(waveform=wave, background=0.3))
    check(ENGINES["exact"], case, law, {COUNTS, SHAPE})


# Synchronous


def by_recursion(system: ml.System, early: float, total: float) -> np.ndarray:
    """P(N = n) (cycles + 1,): period after period, the chance of (armed here, n registrations before)."""
    whole, cycles = int(system.dead_time_periods), system.cycles
    soon, late = -np.expm1(-early), np.exp(-early) - np.exp(-total)
    steps = ((1, 0, np.exp(-total)), (whole + 1, 1, soon), (whole + 2, 1, late))
    armed = np.zeros((cycles + whole + 3, cycles + 2))
    armed[0, 0] = 1.0
    if system.start == "stationary":  # of the chain of periods left to wait
        turn = np.eye(whole + 2, k=-1)
        for step, _, chance in steps:
            turn[0, step - 1] += chance
        balance = np.vstack([turn.T - np.eye(whole + 2), np.ones(whole + 2)])
        armed[: whole + 2, 0] = np.linalg.lstsq(balance, np.eye(whole + 3)[-1], rcond=None)[0]
    done = np.zeros(cycles + 2)
    for n in range(cycles):
        for step, observed, chance in steps:
            moved = np.roll(armed[n], observed) * chance
            if n + step >= cycles:
                done += moved
            else:
                armed[n + step] += moved
    if system.start == "stationary":
        done += armed[cycles:].sum(0)
    return done[: cycles + 1]


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", [0.0, 0.4, 0.9, 1.0, 3.0, 3.7, 12.2, 70.5])
@pytest.mark.parametrize("rate", [0.05, 0.8, 4.0])
def test_synchronous_count_law(rate: float, dead: float, start: str):
    system = view("synchronous", dead, start, 60)
    law = ml.count_law(ml.Flux(0.0, rate), system)
    expected = by_recursion(system, rate * (1.0 - dead % 1.0), rate)
    pmf = np.zeros_like(expected)
    pmf[law.support] = law.pmf
    mean = expected @ np.arange(expected.size)
    assert expected.sum() == pytest.approx(1.0, abs=1e-9)
    assert pmf == pytest.approx(expected, abs=1e-9)
    assert law.mean == pytest.approx(mean, rel=1e-8)


@pytest.mark.parametrize(
    ("signal", "background", "dead", "cycles", "start"),
    [
        (1.0, 0.5, 1.5, 2000, "armed"),
        (0.3, 0.2, 40.3, 5000, "stationary"),
        (0.01, 0.01, 3.3, 20_000, "stationary"),
        (3.0, 1.0, 0.93, 1000, "armed"),
        (20.0, 1.0, 2.93, 1000, "stationary"),
    ],
)
def test_synchronous_law_by_its_transform(
    monkeypatch: pytest.MonkeyPatch, signal: float, background: float, dead: float, cycles: int, start: str
):
    system, laws = view("synchronous", dead, start, cycles), []
    for terms in (0, 10**18):
        monkeypatch.setitem(vars(TOL), "synchronous_terms", terms)
        law = ml.count_law(ml.Flux(signal, background, 37.0), system)
        laws.append(np.zeros(cycles + 1))
        laws[-1][law.support] = law.pmf
    assert laws[0] == pytest.approx(laws[1], abs=1e-11)


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", [0.4, 1.5, 300.25])
def test_synchronous_law_of_long_exposures(dead: float, start: str):
    """A renewal process: N / mu and N sigma^2 / mu^3 registrations, mu and sigma of the periods that one takes."""
    rate, cycles = 1.3, 10**8
    law = ml.count_law(ml.Flux(0.0, rate), view("synchronous", dead, start, cycles))
    q, late = -np.expm1(-rate), np.exp(-rate * (1 - dead % 1)) * -np.expm1(-rate * (dead % 1)) / -np.expm1(-rate)
    mu, spread = np.floor(dead) + 1 + (1 - q) / q + late, (1 - q) / q**2 + late * (1 - late)
    assert law.mean == pytest.approx(cycles / mu, abs=1.0)
    assert law.variance == pytest.approx(cycles * spread / mu**3, rel=1e-4, abs=0.3)
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-9)


def test_coates_inverts_the_synchronous_histogram():
    """r_i = ln[(N_r - sum_{k<i} n_k) / (N_r - sum_{k<=i} n_k)] of the mean histogram is the flux (Coates 1968)."""
    system = view("synchronous", 0.0, cycles=500)
    n = mean_histogram(ml.Flux(2.0, 0.7, 40.0), system)
    remaining = 500 - np.concatenate([[0.0], np.cumsum(n)])
    photons = 2.0 * system.pulse.bin_energy(40.0, PERIOD_NS, 50) + 0.7 / 50
    assert np.log(remaining[:-1] / remaining[1:]) == pytest.approx(photons, rel=1e-9)


# Gated


def test_gate_that_is_always_open_has_the_free_law():
    system = view("nonparalyzable", 0.6375)
    always = ml.Detector(dead_time_ns=63.75, mode="gated", gate_start_ns=20.0, gate_width_ns=100.0)
    for start in ("armed", "stationary"):
        a, b = (
            exposure_moments(ml.Flux(1.5, 0.5, 37.0), system.replace(detector=d, start=start))
            for d in (system.detector, always)
        )
        assert b.cumulants == pytest.approx(a.cumulants, rel=1e-7, abs=1e-7)
        assert b.histogram == pytest.approx(a.histogram, rel=1e-6, abs=1e-9)


def test_gate_shorter_than_the_dead_time():
    """One registration in each gate at most: Binomial, first arrivals behind the gate."""
    system = view("gate", 0.6, bins=1000)
    photons = 1.5 * system.pulse.bin_energy(37.0, PERIOD_NS, 1000) + 0.5 / 1000
    photons[:303], photons[413:] = 0.0, 0.0
    law = ml.count_law(ml.Flux(1.5, 0.5, 37.0), system)
    q = -np.expm1(-photons.sum())
    assert law.mean == pytest.approx(40 * q, rel=1e-5)
    assert law.variance == pytest.approx(40 * q * (1 - q), rel=1e-4)
    assert law.pmf == pytest.approx(stats.binom.pmf(law.support, 40, q), abs=1e-5)
    assert mean_histogram(ml.Flux(1.5, 0.5, 37.0), system) == pytest.approx(40 * first_arrival(photons), abs=1e-4)


# Refused


@pytest.mark.parametrize("mode", ["paralyzable", "synchronous", "gate"])
def test_what_does_not_treat_a_mode_says_so(mode: str):
    system = view(mode, 0.7)
    named = system.detector.mode
    calls = {
        "count_law of method 'mars'": lambda: ml.count_law(ml.Flux(1.0, 1.0, 50.0), system, "mars"),
        "count_law of method 'renewal'": lambda: ml.count_law(ml.Flux(1.0, 1.0, 50.0), system, "renewal"),
        "registration_pdf of method 'chain'": lambda: ml.registration_pdf(ml.Flux(1.0, 1.0, 50.0), system, "chain"),
        "holding_time_covariance": lambda: ml.holding_time_covariance(ml.Flux(1.0, 1.0, 50.0), system),
        "the chain of phases": lambda: PhaseChain.from_flux(ml.Flux(1.0, 1.0, 50.0), system),
    }
    if mode == "synchronous":
        calls["exposure_moments"] = lambda: exposure_moments(ml.Flux(1.0, 1.0, 50.0), system)
    for what, call in calls.items():
        with pytest.raises(ValueError) as error:
            call()
        message = str(error.value)
        assert what in message
        assert f"got {named!r}" in message
        assert "mean_histogram" in message or "count_law" in message


def test_moving_gates_are_refused():
    system = view("gate", 0.7)
    moving = ml.Detector(dead_time_ns=5.0, mode="gated", gate_start_ns=3.0, gate_width_ns=9.0, gate_step_ns=1.0)
    for call in (ml.count_law, mean_histogram, ml.registration_pdf, exposure_moments):
        with pytest.raises(ValueError, match=r"a gate that repeats every period, got gate_step_ns=1; .* simulated"):
            call(ml.Flux(1.0, 1.0, 50.0), system.replace(detector=moving))


def test_poisson_law_is_that_of_the_gated_arrivals():
    system = view("wrapping gate", 3.0)
    law = ml.count_law(ml.Flux(1.5, 0.5, 37.0), system, "poisson")
    inside = 0.5 * 0.5 + 1.5 * (stats.norm.cdf(3.0 / 2.0) + stats.norm.sf((90 - 37) / 2.0))
    assert law.mean == pytest.approx(40 * inside, rel=1e-9)


def test_long_dead_times_are_treated_and_sharp_tolerances_refused():
    assert mean_histogram(ml.Flux(1.0, 1.0, 50.0), view("paralyzable", 3e4)).sum() == pytest.approx(1.0)
    refused(r"tolerance must be", mean_histogram, ml.Flux(1.0, 1.0, 50.0), view("paralyzable", 1.0), tolerance=0.0)
    narrow = view("paralyzable", 0.3, pulse=ml.GaussianPulse(sigma_ns=1e-2))
    with pytest.raises(ConvergenceError, match=r"paralyzable statistics of S = 5.*more than 1e-09"):
        mean_histogram(ml.Flux(5.0, 1.0, 0.5 * narrow.period_ns), narrow, tolerance=1e-9)
