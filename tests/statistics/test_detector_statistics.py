"""Statistics of paralyzable, synchronous and gated pixels and behind electronics: closed forms, recursions, engines."""

from math import comb, factorial
from typing import Any

import numpy as np
import pytest
from harness import COUNTS, SHAPE, Law, check, first_arrival, pmf_of, refused
from harness.cases import PERIOD_NS, Case, flux_of, make_system, random_cases, two_lobes, waveform_flux
from harness.laws import paralyzable_moments
from scipy import stats
from scipy.integrate import quad

import mars_lidar as ml
from mars_lidar.engines import ENGINES
from mars_lidar.statistics import ConvergenceError, PhaseChain, electronics_moments, exposure_moments, mean_histogram
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


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("mode", ["paralyzable", "synchronous", "wrapping gate"])
def test_waveforms(mode: str, start: str):
    wave = two_lobes() / 12
    case = Case(f"{mode}, waveform, {start}", waveform_flux(wave, 0.3), view(mode, 0.7, start), 6000)
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


# The exact law of the number of records behind electronics with a dead time: closed forms, the sequential engine.


def electronics_view(
    dead: float, electronics: float, start: str = "armed", cycles: int = 40, **detector: Any
) -> ml.System:
    return make_system(
        dead * PERIOD_NS,
        cycles,
        50,
        sigma_ns=3.0,
        start=start,
        electronics_dead_time_ns=electronics * PERIOD_NS,
        **detector,
    )


def test_law_at_a_constant_rate():
    """For t_d < t_e < 2 t_d at most one avalanche goes unseen between two records.

    So the time between them is t_e + E, if none is, or U + t_d + E with U the time of the unseen one, exponential from
    t_d on and before t_e; E is exponential, and the first record is E after an armed start.
    """
    rate, dead, electronics, cycles = 1.4, 0.7, 1.2, 12
    parts = 4096  # of a period
    edges = np.arange(cycles * parts + 1) / parts
    wait = np.diff(-np.exp(-rate * edges))
    unseen = np.diff(-np.exp(-rate * np.clip(edges - dead, 0.0, electronics - dead)))
    none = np.zeros_like(wait)
    none[round(electronics * parts)] = np.exp(-rate * (electronics - dead))
    # a sum of k numbers that are anywhere in their parts is k / 2 parts larger than the sum of the parts
    size = 2 * wait.size
    between = np.fft.rfft(np.roll(unseen, round(dead * parts)) + none, size) * np.fft.rfft(wait, size)
    step = np.fft.irfft(between, size)[: wait.size]
    record, reached = wait, []
    while record.sum() > 1e-12:
        reached.append(record.sum())
        record = np.fft.irfft(np.fft.rfft(record, size) * np.fft.rfft(step, size), size)[: wait.size]
    expected = -np.diff([1.0, *reached, 0.0])
    result = pmf_of(ml.count_law(ml.Flux(0.0, rate), electronics_view(dead, electronics, cycles=cycles)))
    assert result[: expected.size] == pytest.approx(expected[: result.size], abs=2e-3)
    assert result.sum() == pytest.approx(1.0, abs=1e-12)
    mean = expected @ np.arange(expected.size)
    assert result @ np.arange(result.size) == pytest.approx(mean, abs=3e-3)


@pytest.mark.full
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("signal", "background", "dead", "electronics", "cycles", "detector"),
    [
        (2.0, 0.3, 0.4, 1.3, 60, {}),
        (3.0, 0.2, 0.1, 0.35, 60, {}),
        (1.0, 0.3, 1.7, 2.05, 100, {}),
        (0.3, 0.1, 0.3, 5.05, 100, {}),
        (1.5, 0.1, 0.95, 1.9, 100, {}),
        (1.5, 0.8, 0.3, 0.9, 60, {"mode": "gated", "gate_start_ns": 20.0, "gate_width_ns": 40.0}),
        (1.5, 0.5, 0.3, 0.9, 60, {"dark_count_hz": 1e6, "jitter": ml.Jitter(sigma_ns=1.0)}),
    ],
)
def test_law_of_the_sequential_engine(
    signal: float, background: float, dead: float, electronics: float, cycles: int, detector: dict[str, Any], start: str
):
    system = electronics_view(dead, electronics, start, cycles, **detector)
    case = Case(f"t_d {dead:g}, t_e {electronics:g}, {start}", flux_of(signal, background, 0.37), system, 4000)
    law = ml.count_law(ml.Flux(signal, background, 37.0), system)
    histogram = mean_histogram(ml.Flux(signal, background, 37.0), system)
    check(ENGINES["sequential"], case, Law(histogram, pmf_of(law)), {COUNTS, SHAPE})
    known = electronics_moments(ml.Flux(signal, background, 37.0), system)
    spread = float(np.sqrt(known.variance))
    assert abs(float(law.mean - known.mean)) < 1e-3 * spread
    assert float(law.variance) == pytest.approx(float(known.variance), rel=1e-3)


def test_waveform_behind_electronics():
    wave = two_lobes() / 12
    system = electronics_view(0.3, 0.8)
    law = ml.count_law(ml.Flux(waveform=wave, background=0.3), system)
    case = Case("waveform", waveform_flux(wave, 0.3), system, 8000)
    check(ENGINES["sequential"], case, Law(None, pmf_of(law)), {COUNTS})


@pytest.mark.parametrize(("dead", "electronics"), [(0.7, 0.5), (0.7, 0.7), (0.0, 0.6)])
def test_where_one_of_the_two_has_no_effect(dead: float, electronics: float):
    plain = electronics_view(max(dead, electronics), 0.0)
    result, expected = (
        ml.count_law(ml.Flux(2.0, 0.3, 50.0), system) for system in (electronics_view(dead, electronics), plain)
    )
    assert result.cumulants == pytest.approx(expected.cumulants, rel=1e-7)
    assert pmf_of(result) == pytest.approx(pmf_of(expected), abs=1e-12)


@pytest.mark.parametrize("mode", ["nonparalyzable", "gated"])
@pytest.mark.parametrize("electronics", [0.9, 2.5])
def test_electronics_behind_no_dead_time_begin_ready_for_either_start(electronics: float, mode: str):
    gate = {"gate_start_ns": 0.2 * PERIOD_NS, "gate_width_ns": 0.6 * PERIOD_NS} if mode == "gated" else {}
    system = electronics_view(0.0, electronics, "stationary", cycles=5, mode=mode, **gate)
    light = ml.Flux(2.0, 0.3, 0.5 * PERIOD_NS)
    law = ml.count_law(light, system)
    assert mean_histogram(light, system).sum() == pytest.approx(float(law.mean), rel=1e-6)
    case = Case("no dead time", flux_of(2.0, 0.3, 0.5), system, 4000)
    check(ENGINES["exact"], case, Law(None, pmf_of(law)), {COUNTS})


@pytest.mark.full
def test_long_exposures_and_cells():
    a, b, c = (
        ml.count_law(ml.Flux(2.0, 0.3, 50.0), electronics_view(0.4, 1.3, cycles=n)) for n in (400, 401, 1_000_000)
    )
    slope = b.cumulants - a.cumulants
    assert c.cumulants[:2] == pytest.approx((a.cumulants + slope * (1_000_000 - 400))[:2], rel=1e-3)
    assert c.pmf @ c.support == pytest.approx(float(c.mean), rel=1e-9)
    both = ml.count_law(
        ml.Flux(np.array([0.0, 2.0]), np.array([0.0, 0.3]), 50.0), electronics_view(0.4, 1.3, cycles=400)
    )
    assert both.mean == pytest.approx([0.0, float(a.mean)], abs=1e-6)
    assert both.pmf[0, 0] == 1.0
    assert pmf_of(ml.count_law(ml.Flux(1e-9, 1e-9, 50.0), electronics_view(0.4, 1.3)))[0] == pytest.approx(
        1.0, abs=1e-6
    )


@pytest.mark.full
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("signal", "background", "dead", "electronics", "detector"),
    [
        (3.16, 0.12, 0.24, 0.95, {}),  # the case of Rapp's code: t_d < t_e below one period
        (2.0, 0.3, 0.4, 1.3, {}),
        (1.0, 0.3, 1.7, 2.05, {}),
        (0.3, 0.1, 0.3, 5.05, {}),
        (1.5, 0.1, 0.95, 1.9, {}),
        (1.5, 0.8, 0.3, 0.9, {"mode": "gated", "gate_start_ns": 20.0, "gate_width_ns": 40.0}),
        (1.5, 0.5, 0.3, 0.9, {"jitter": ml.Jitter(sigma_ns=1.0)}),
    ],
)
def test_stationary_shape_is_that_of_long_exposures(
    signal: float, background: float, dead: float, electronics: float, detector: dict[str, Any], start: str
):
    """Against the recursion of a long exposure, and against records of the sequential engine once it is warm."""
    system = electronics_view(dead, electronics, start, 20_000, **detector)
    shape = ml.registration_pdf(ml.Flux(signal, background, 37.0), system, "stationary")
    assert shape.sum() == pytest.approx(1.0, abs=1e-12)
    assert shape.min() >= 0.0
    long = ml.registration_pdf(ml.Flux(signal, background, 37.0), system, "exposure")
    assert 0.5 * np.abs(shape - long).sum() < 1e-3
    again = ml.registration_pdf(ml.Flux(signal, background, 37.0), system.replace(cycles=3), "stationary")
    np.testing.assert_allclose(again, shape, rtol=1e-9)  # whatever the exposure
    free = ml.registration_pdf(ml.Flux(signal, background, 37.0), _without_electronics(system), "stationary")
    assert 0.5 * np.abs(shape - free).sum() > 5e-3  # the electronics do something


def _without_electronics(system: ml.System) -> ml.System:
    return system.replace(detector=system.detector.without("electronics_dead_time_ns"))


def test_stationary_shape_of_the_sequential_engine():
    """Every bin within its error of some 2 million records, and of the law's tolerance; 50 bins, 4e-8 each."""
    system = electronics_view(0.24, 0.95, "stationary", 10_000)
    flux = flux_of(3.16, 0.12, 0.37)
    drawn = ml.simulate(flux, system, engine="sequential", realizations=50, seed=20_264).reshape(-1, 50)
    shape = ml.registration_pdf(ml.Flux(3.16, 0.12, 37.0), system, "stationary")
    observed = drawn.sum(0).astype(float)
    assert 0.5 * np.abs(observed / observed.sum() - shape).sum() < 3e-3
    # bins of an exposure are correlated: errors from the scatter between exposures
    share = drawn / drawn.sum(1, keepdims=True)
    error = share.std(0, ddof=1) / np.sqrt(len(share))
    z = (share.mean(0) - shape) / np.hypot(error, 1e-3 * shape)  # the law's own tolerance
    assert np.abs(z).max() < 5.5


def test_stationary_shape_where_electronics_do_nothing():
    slower = electronics_view(0.7, 0.5)
    same = ml.registration_pdf(ml.Flux(2.0, 0.3, 37.0), slower, "stationary")
    np.testing.assert_array_equal(
        same, ml.registration_pdf(ml.Flux(2.0, 0.3, 37.0), _without_electronics(slower), "stationary")
    )
    alone = ml.registration_pdf(ml.Flux(2.0, 0.3, 37.0), electronics_view(0.0, 0.7), "stationary")
    np.testing.assert_allclose(alone, same, rtol=1e-9)
    np.testing.assert_allclose(
        ml.registration_pdf(ml.Flux([0.0, 1.0], 0.0, 50.0), electronics_view(0.3, 0.7), "stationary")[0], 0.02
    )


# The exact count law of a paralyzable pixel: closed forms, its own moments, the sequential engine.


def paralyzable_view(
    dead: float, start: str = "armed", cycles: int = 40, *, sigma: float = 0.02, bins: int = 50
) -> ml.System:
    return make_system(dead * PERIOD_NS, cycles, bins, sigma_ns=sigma * PERIOD_NS, start=start, mode="paralyzable")


def constant_rate_pmf(rate: float, dead: float, cycles: float, start: str) -> np.ndarray:
    """From E C(N, k): k registrations further apart than t_d, at the rate lambda e^(-lambda t_d) each.

    In an armed exposure the first of them may be the first arrival of all, before t_d.
    """
    r, most = rate * np.exp(-rate * dead), int(cycles / dead) + 1

    def ordered(k: int, room: float) -> float:
        """Integral over k registrations in `room`, the gaps between them taken out."""
        return r**k * max(room - (k - 1) * dead, 0.0) ** k / factorial(k) if k else 1.0

    chance = [1.0]
    for k in range(1, most + 1):
        if start == "stationary":
            chance.append(ordered(k, cycles))
            continue
        early = quad(
            lambda u, k=k: rate * np.exp(-rate * u) * ordered(k - 1, max(cycles - u - dead, 0.0)),
            0,
            dead,
            epsrel=1e-12,
            epsabs=1e-14,
        )[0]
        chance.append(early + ordered(k, cycles - dead))
    counts = range(most + 1)
    return np.array([sum((-1) ** (k - n) * comb(k, n) * chance[k] for k in counts[n:]) for n in counts])


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(("rate", "dead", "cycles"), [(1.3, 0.35, 5), (0.4, 2.7, 30), (4.0, 0.9, 12), (0.8, 1.0, 9)])
def test_pmf_at_a_constant_rate(rate: float, dead: float, cycles: int, start: str):
    expected = constant_rate_pmf(rate, dead, cycles, start)
    result = pmf_of(ml.count_law(ml.Flux(0.0, rate), paralyzable_view(dead, start, cycles), tolerance=1e-7))
    size = min(result.size, expected.size)
    assert expected.sum() == pytest.approx(1.0, abs=1e-9)
    assert result[:size] == pytest.approx(expected[:size], abs=1e-8)
    assert max(expected[size:].sum(), result[size:].sum()) < 1e-8


@pytest.mark.parametrize("case", random_cases(24, seed=77, photons=4e5, least=1000, most=3000), ids=lambda c: c.name)
def test_moments_are_the_closed_form_ones(case: Case):
    pixel = ml.Detector(dead_time_ns=case.system.detector.dead_time_ns, mode="paralyzable")
    system = case.system.replace(detector=pixel)
    flux = case.flux[0, 0]
    law = ml.count_law(flux, system, tolerance=1e-5)
    known = paralyzable_moments(flux, system)
    spread = np.sqrt(known.variance)
    assert abs(float(law.mean) - known.mean) < 3e-5 * min(spread, known.mean) + 1e-9
    assert float(law.variance) == pytest.approx(known.variance, rel=1e-4, abs=1e-8)
    own = exposure_moments(flux, system, tolerance=1e-5)
    assert 0.5 * np.abs(own.histogram - known.histogram).sum() < 3e-5 * known.mean
    # third and fourth cumulant came by series in s, the pmf by points on the circle
    n = law.support - law.mean
    third, fourth = law.pmf @ n**3, law.pmf @ n**4 - 3 * (law.pmf @ n**2) ** 2
    assert law.cumulants[2:] == pytest.approx([third, fourth], abs=1e-6 * max(spread, 1.0) ** 4)


@pytest.mark.parametrize("sigma", [1e-6, 1e-5, 1e-3])
@pytest.mark.parametrize("signal", [3.0, 30.0, 1000.0])
def test_the_first_photon_of_a_short_pulse_is_registered(sigma: float, signal: float):
    """However bright: a count of 1 - exp(-S) a period was 1e-13 where a pulse of 1000 photons was within a cell."""
    system = paralyzable_view(0.5, "stationary", 20, sigma=sigma)
    law = ml.count_law(ml.Flux(signal, 0.0, 25.0), system)
    assert float(law.mean) == pytest.approx(-20.0 * np.expm1(-signal), rel=1e-9)
    assert float(law.variance) == pytest.approx(-20.0 * np.expm1(-signal) * np.exp(-signal), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("bins", [1, 50, 1000])
def test_the_grid_of_the_histogram_is_not_the_one_of_the_moments(bins: int):
    """However many bins the histogram has, the laws keep their tolerance."""
    system, flux = paralyzable_view(0.45, cycles=500, sigma=0.01, bins=bins), ml.Flux(1.0, 1.0, 37.0)
    known, law = paralyzable_moments(flux, system), exposure_moments(flux, system, tolerance=1e-6)
    assert float(mean_histogram(flux, system).sum()) == pytest.approx(known.mean, rel=1e-5)
    assert [float(law.mean), float(law.variance)] == pytest.approx(known[:2], rel=1e-5)


def test_dead_times_round_one_bin_of_the_grid():
    """Below a bin G of the bin itself comes in, above it is a delay: no step where one becomes the other."""
    edge = 1.0 / 128
    dead = np.array([1e-4, 0.5 * edge, 0.999999 * edge, edge, 1.000001 * edge, 1.5 * edge])
    for d in dead:
        system = paralyzable_view(float(d), cycles=8, sigma=0.05)
        law, known = (
            ml.count_law(ml.Flux(4.0, 1.0, 50.0), system),
            paralyzable_moments(ml.Flux(4.0, 1.0, 50.0), system),
        )
        assert law.exposure is not None
        assert law.exposure.bins <= 256
        assert law.cumulants[:2] == pytest.approx(known[:2], rel=1e-4)
        assert law.pmf.sum() == pytest.approx(1.0, abs=1e-9)


def test_long_exposures_and_long_dead_times():
    a, b, c = (ml.count_law(ml.Flux(1.0, 0.3, 50.0), paralyzable_view(2.4, cycles=n)) for n in (200, 201, 100_000_000))
    assert c.cumulants == pytest.approx(a.cumulants + (b.cumulants - a.cumulants) * (100_000_000 - 200), rel=1e-6)
    assert c.pmf @ c.support == pytest.approx(float(c.mean), rel=1e-8)
    assert c.pmf.sum() == pytest.approx(1.0, abs=1e-5)
    long = ml.count_law(ml.Flux(0.01, 0.005, 50.0), paralyzable_view(300.25, cycles=2000))
    known = paralyzable_moments(ml.Flux(0.01, 0.005, 50.0), paralyzable_view(300.25, cycles=2000))
    assert long.cumulants[:2] == pytest.approx(known[:2], rel=1e-5)
    assert long.pmf @ long.support == pytest.approx(known.mean, rel=1e-5)


def test_dark_blinded_and_without_dead_time():
    dark = ml.count_law(ml.Flux(0.0, 0.0), paralyzable_view(0.5))
    assert dark.pmf[0] == 1.0
    assert dark.mean == 0.0
    # lambda t_d = 40: the first photon, and nothing ever after
    blinded = ml.count_law(ml.Flux(0.0, 80.0), paralyzable_view(0.5, cycles=10))
    assert pmf_of(blinded)[1] == pytest.approx(1.0, abs=1e-9)
    free = ml.count_law(ml.Flux(1.0, 0.5, 50.0), paralyzable_view(0.0))
    assert free.variance == pytest.approx(float(free.mean), rel=1e-9)
    cells = ml.count_law(ml.Flux(np.array([0.0, 1.0]), 0.2, 50.0), paralyzable_view(0.7))
    assert cells.pmf[0] @ cells.support[0] == pytest.approx(
        float(ml.count_law(ml.Flux(0.0, 0.2), paralyzable_view(0.7)).mean), rel=1e-8
    )
