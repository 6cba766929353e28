"""The exact law of the number of records behind electronics with a dead time: closed forms, the sequential engine."""

from typing import Any

import numpy as np
import pytest
from harness import COUNTS, PERIOD_NS, SHAPE, Case, Law, check, flux_of, make_system, pmf_of, two_lobes, waveform_flux

import mars_lidar as ml
from mars_lidar.engines import ENGINES
from mars_lidar.statistics import electronics_moments, mean_histogram


def view(dead: float, electronics: float, start: str = "armed", cycles: int = 40, **detector: Any) -> ml.System:
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
    result = pmf_of(ml.count_law(ml.Flux(0.0, rate), view(dead, electronics, cycles=cycles)))
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
    system = view(dead, electronics, start, cycles, **detector)
    case = Case(f"t_d {dead:g}, t_e {electronics:g}, {start}", flux_of(signal, background, 0.37), system, 4000)
    law = ml.count_law(ml.Flux(signal, background, 37.0), system)
    histogram = mean_histogram(ml.Flux(signal, background, 37.0), system)
    check(ENGINES["sequential"], case, Law(histogram, pmf_of(law)), {COUNTS, SHAPE})
    known = electronics_moments(ml.Flux(signal, background, 37.0), system)
    spread = float(np.sqrt(known.variance))
    assert abs(float(law.mean - known.mean)) < 1e-3 * spread
    assert float(law.variance) == pytest.approx(float(known.variance), rel=1e-3)


def test_waveform():
    wave = two_lobes() / 12
    system = view(0.3, 0.8)
    law = ml.count_law(ml.Flux(waveform=wave, background=0.3), system)
    case = Case("waveform", waveform_flux(wave, 0.3), system, 8000)
    check(ENGINES["sequential"], case, Law(None, pmf_of(law)), {COUNTS})


@pytest.mark.parametrize(("dead", "electronics"), [(0.7, 0.5), (0.7, 0.7), (0.0, 0.6)])
def test_where_one_of_the_two_has_no_effect(dead: float, electronics: float):
    plain = view(max(dead, electronics), 0.0)
    result, expected = (ml.count_law(ml.Flux(2.0, 0.3, 50.0), system) for system in (view(dead, electronics), plain))
    assert result.cumulants == pytest.approx(expected.cumulants, rel=1e-7)
    assert pmf_of(result) == pytest.approx(pmf_of(expected), abs=1e-12)


@pytest.mark.parametrize("mode", ["nonparalyzable", "gated"])
@pytest.mark.parametrize("electronics", [0.9, 2.5])
def test_electronics_behind_no_dead_time_begin_ready_for_either_start(electronics: float, mode: str):
    gate = {"gate_start_ns": 0.2 * PERIOD_NS, "gate_width_ns": 0.6 * PERIOD_NS} if mode == "gated" else {}
    system = view(0.0, electronics, "stationary", cycles=5, mode=mode, **gate)
    light = ml.Flux(2.0, 0.3, 0.5 * PERIOD_NS)
    law = ml.count_law(light, system)
    assert mean_histogram(light, system).sum() == pytest.approx(float(law.mean), rel=1e-6)
    case = Case("no dead time", flux_of(2.0, 0.3, 0.5), system, 4000)
    check(ENGINES["exact"], case, Law(None, pmf_of(law)), {COUNTS})


@pytest.mark.full
def test_long_exposures_and_cells():
    a, b, c = (ml.count_law(ml.Flux(2.0, 0.3, 50.0), view(0.4, 1.3, cycles=n)) for n in (400, 401, 1_000_000))
    slope = b.cumulants - a.cumulants
    assert c.cumulants[:2] == pytest.approx((a.cumulants + slope * (1_000_000 - 400))[:2], rel=1e-3)
    assert c.pmf @ c.support == pytest.approx(float(c.mean), rel=1e-9)
    both = ml.count_law(ml.Flux(np.array([0.0, 2.0]), np.array([0.0, 0.3]), 50.0), view(0.4, 1.3, cycles=400))
    assert both.mean == pytest.approx([0.0, float(a.mean)], abs=1e-6)
    assert both.pmf[0, 0] == 1.0
    assert pmf_of(ml.count_law(ml.Flux(1e-9, 1e-9, 50.0), view(0.4, 1.3)))[0] == pytest.approx(1.0, abs=1e-6)


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
    system = view(dead, electronics, start, 20_000, **detector)
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
    system = view(0.24, 0.95, "stationary", 10_000)
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
    slower = view(0.7, 0.5)
    same = ml.registration_pdf(ml.Flux(2.0, 0.3, 37.0), slower, "stationary")
    np.testing.assert_array_equal(
        same, ml.registration_pdf(ml.Flux(2.0, 0.3, 37.0), _without_electronics(slower), "stationary")
    )
    alone = ml.registration_pdf(ml.Flux(2.0, 0.3, 37.0), view(0.0, 0.7), "stationary")
    np.testing.assert_allclose(alone, same, rtol=1e-9)
    np.testing.assert_allclose(
        ml.registration_pdf(ml.Flux([0.0, 1.0], 0.0, 50.0), view(0.3, 0.7), "stationary")[0], 0.02
    )
