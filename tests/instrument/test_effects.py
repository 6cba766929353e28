"""Effects of the detector in the engines: against each other, closed forms, and their definitions event by event."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from harness import COUNTS, EVERYTHING, JOINT, SHAPE, JointLaw, Law, armed_count_pmf, check, require, task_of
from harness.cases import PERIOD_NS, Case, flux_of, waveform_flux
from instrument.effect_checks import bits_do_not_depend
from scipy import stats

import mars_lidar as ml
from mars_lidar import Detector, GaussianPulse, Jitter, SampledJitter, System
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import PhaseRecords, Records
from mars_lidar.statistics import electronics_moments, mean_histogram

TAIL = Jitter(sigma_ns=1.0, tail_ns=6.0, tail_fraction=0.3)
SAMPLED = SampledJitter([5.0, 1, 0, 0, 2, 7, 1, 0, 0, 3], 2.5)
CODES = (1.0, 0.3, 0.0, 2.0, 1.7, 0.5, 1.0, 1.0)
MODES: dict[str, dict[str, Any]] = {
    "nonparalyzable": {},
    "paralyzable": {},
    "synchronous": {},
    "gated": {"gate_start_ns": 20.0, "gate_width_ns": 50.0},
}
ALL = {
    "jitter": TAIL,
    "code_density": CODES,
    "electronics_dead_time_ns": 41.0,
    "max_events_per_period": 1,
    "max_events_per_exposure": 30,
    "detection_efficiency": 0.6,
    "dark_count_hz": 2e6,
}
EACH: dict[str, dict[str, Any]] = {
    "tail": {"jitter": TAIL},
    "sampled": {"jitter": SAMPLED},
    "codes": {"code_density": CODES},
    "electronics": {"electronics_dead_time_ns": 83.0},
    "long electronics": {"electronics_dead_time_ns": 283.0},
    "per period": {"max_events_per_period": 2},
    "per exposure": {"max_events_per_exposure": 7},
    "all": ALL,
}


def pixel(effects: dict[str, Any], mode: str = "nonparalyzable", dead: float = 17.0) -> Detector:
    return Detector(dead_time_ns=dead, mode=mode, **MODES[mode], **effects)  # type: ignore[arg-type]


def case_of(detector: Detector, items: int = 3000, wave: bool = False, **changes: Any) -> Case:
    pulse = GaussianPulse(sigma_ns=2.0)
    system = System(period_ns=PERIOD_NS, cycles=40, bins=64, pulse=pulse, detector=detector).replace(**changes)
    flux = flux_of(1.2, 0.8, 0.37)
    if wave:
        flux = waveform_flux(1.2 * pulse.bin_energy(37.0, PERIOD_NS, 320), 0.8)
    kind = "waveform" if wave else "pulse"
    return Case(f"{', '.join(detector.effects)}, {detector.mode}, {kind}, {system.start}", flux, system, items)


def records_of(case: Case, engine: str = "exact", seed: int = 3) -> Records | PhaseRecords:
    return ENGINES[engine].records(task_of(case, seed), 0.0)


CASES = [(name, "nonparalyzable", k % 2 == 1) for k, name in enumerate(EACH)]
CASES += [("all", mode, k % 2 == 0) for k, mode in enumerate(list(MODES)[1:])]


@pytest.mark.parametrize(("name", "mode", "wave"), CASES)
def test_exact_and_sequential_agree(name: str, mode: str, wave: bool):
    start = "stationary" if name == "long electronics" else "armed"
    case = case_of(pixel(EACH[name], mode), wave=wave, start=start)
    check(ENGINES["exact"], case, ENGINES["sequential"], EVERYTHING)


@pytest.mark.parametrize("engine", ["exact", "sequential"])
def test_efficiency_thins_and_dark_counts_add(engine: str):
    """Detected photons and dark counts together are Poisson: the closed law of the constant rate."""
    detector = pixel({"detection_efficiency": 0.25, "dark_count_hz": 3e6}, dead=30.0)
    case = dataclasses.replace(case_of(detector, 8000), flux=flux_of(0.0, 2.0))
    rate = 0.25 * 2.0 + 3e6 * PERIOD_NS * 1e-9
    law = Law(count_pmf=armed_count_pmf(rate, 0.3, 40.0, 60))
    check(ENGINES[engine], case, law, {COUNTS})


@pytest.mark.parametrize("engine", ["exact", "mars", "feedback", "poisson", "renewal", "auto"])
def test_efficiency_and_dark_counts_are_a_flux(engine: str):
    case = case_of(pixel({"detection_efficiency": 0.6, "dark_count_hz": 2e6}))
    flux, system = case.flux.detected(case.system), case.system.detected()
    assert np.allclose(flux.background, 0.6 * 0.8 + 0.2)
    assert np.allclose(flux.signal, 0.72)
    whole = ml.simulate(case.flux, case.system, engine=engine, seed=5, threads=1)
    assert np.array_equal(whole, ml.simulate(flux, system, engine=engine, seed=5, threads=1))
    means = (
        ml.count_law(ml.Flux(1.2, 0.8, 0.5 * case.system.period_ns), case.system).mean,
        ml.count_law(ml.Flux(0.72, 0.68, 0.5 * system.period_ns), system).mean,
    )
    assert means[0] == pytest.approx(means[1], rel=1e-12)


def by_definition(times: np.ndarray, offsets: np.ndarray, detector: Detector, first: int) -> list[int]:
    """Places of the registrations that are recorded, one after the other, as the documentation says."""
    selected = []
    for low, high in itertools.pairwise(offsets):
        last, number, in_period, period = -np.inf, 0, 0, -1
        for k in range(low, high):
            if times[k] - last < detector.electronics_dead_time_ns / PERIOD_NS:
                continue
            last = times[k]
            if int(times[k]) != period:
                period, in_period = int(times[k]), 0
            if in_period == (detector.max_events_per_period or first):
                continue
            if number == (detector.max_events_per_exposure or first):
                continue
            in_period, number = in_period + 1, number + 1
            selected.append(k)
    return selected


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("wave", [False, True])
def test_records_are_those_of_the_definition(mode: str, wave: bool):
    """The same registrations with and without; the definition, in plain Python, finds the records among them."""
    for limits in ({}, {"max_events_per_period": 1, "max_events_per_exposure": 9}):
        detector = pixel({"electronics_dead_time_ns": 61.0} | limits, mode)
        plain = records_of(case_of(detector.without(*detector.effects), 400, wave))
        result = records_of(case_of(detector, 400, wave))
        selected = by_definition(plain.times, plain.offsets, detector, 2**31)
        assert 0 < len(selected) < plain.times.size
        assert np.array_equal(result.times, plain.times[selected])
        assert np.array_equal(result.bin, plain.bin[selected])


@pytest.mark.parametrize("engine", ["exact", "waveform", "sequential"])
@pytest.mark.parametrize("jitter", [Jitter(sigma_ns=0.4), TAIL, SAMPLED])
def test_jitter_has_its_law_and_moves_nothing_else(engine: str, jitter: Jitter | SampledJitter):
    """Same registrations, each moved by a number of the law, round the exposure; in order of time."""
    wave, engine = engine == "waveform", "sequential" if engine == "sequential" else "exact"
    dead = 95.0  # far longer than the jitter: order tells which record is which registration's
    plain = records_of(case_of(pixel({}, dead=dead), wave=wave), engine)
    moved = records_of(case_of(pixel({"jitter": jitter}, dead=dead), wave=wave), engine)
    assert np.array_equal(plain.offsets, moved.offsets)
    item = np.repeat(np.arange(plain.offsets.size - 1), np.diff(plain.offsets))
    inside = np.diff(item) == 0
    assert (np.diff(moved.times)[inside] >= 0.0).all()
    assert moved.times.min() >= 0.0
    assert moved.times.max() < 40.0
    assert np.array_equal(np.floor(moved.times), moved.cycle)
    # not the exposures with a record that goes round their end, which changes the order
    turned = np.unique(item[np.abs(moved.times - plain.times) > 0.5])
    away = (plain.times > 1.0) & (plain.times < 38.0) & ~np.isin(item, turned)
    shift = (moved.times - plain.times)[away] * PERIOD_NS
    assert away.sum() > 20_000
    p = stats.kstest(shift, jitter.cumulative).pvalue
    pairs = stats.spearmanr(shift[:-1], shift[1:]).pvalue  # two records share a draw
    size = np.abs(shift - np.median(shift))
    sizes = stats.spearmanr(size[:-1], size[1:]).pvalue  # and Gaussian ones a radius
    require({"jitter": p, "independence": pairs, "independence of sizes": sizes}, f"{engine}, {jitter}")


@pytest.mark.full
@pytest.mark.parametrize(
    ("effects", "mode"),
    [
        ({"jitter": TAIL}, "nonparalyzable"),
        ({"jitter": SAMPLED, "code_density": CODES}, "paralyzable"),
        ({"code_density": CODES}, "gated"),
        ({"jitter": Jitter(sigma_ns=0.5), "electronics_dead_time_ns": 83.0}, "nonparalyzable"),
    ],
)
def test_mean_histogram_of_records(effects: dict[str, Any], mode: str):
    case = case_of(pixel(effects, mode), 20_000)
    expected = mean_histogram(ml.Flux(1.2, 0.8, 37.0), case.system)
    assert expected[2::8].max() == 0.0 or "code_density" not in effects  # the missing code
    check(ENGINES["exact"], case, Law(histogram=expected), {SHAPE})


@pytest.mark.parametrize(
    "effects", [{"jitter": Jitter(sigma_ns=0.04, tail_ns=1.3, tail_fraction=0.1)}, {"code_density": CODES}]
)
def test_records_of_bright_light_in_wide_bins(effects: dict[str, Any]):
    """Of bright light the first photon comes at the front of each lobe, within a part of a bin."""
    lobes = np.random.default_rng(3).exponential(size=130) ** 3
    lobes[np.arange(130) % 5 > 2] = 0.0
    detector, pulse = Detector(dead_time_ns=14.66, **effects), ml.SampledPulse(lobes, 0.273, "first")
    system = System(period_ns=PERIOD_NS, cycles=50, bins=480, pulse=pulse, detector=detector)
    case = Case("bright", flux_of(35.0, 1e-4, 0.2528), system, 20_000)
    law = mean_histogram(ml.Flux(35.0, 1e-4, 0.2528 * PERIOD_NS), system)
    check(ENGINES["exact"], case, Law(histogram=law), {SHAPE})


@pytest.mark.parametrize(
    ("dead", "electronics", "start", "cycles"),
    [(17.0, 83.0, "armed", 40), (60.0, 130.0, "stationary", 60), (0.0, 70.0, "armed", 40)],
)
def test_electronics_dead_time_statistics(dead: float, electronics: float, start: str, cycles: int):
    detector = pixel({"electronics_dead_time_ns": electronics}, dead=dead)
    case = case_of(detector, 20_000, start=start, cycles=cycles)
    result = electronics_moments(ml.Flux(1.2, 0.8, 37.0), case.system)
    law = Law(histogram=result.histogram, count_moments=(float(result.mean), float(result.variance)))
    check(ENGINES["exact"], case, law, {COUNTS, SHAPE})


def test_electronics_dead_time_in_bins_narrower_than_the_pulse():
    """Cells of the kernel are wider than these bins, which the pulse fills unevenly."""
    detector = pixel({"electronics_dead_time_ns": 130.0}, dead=45.0)
    case = case_of(detector, 20_000, cycles=120, bins=1280)
    result = electronics_moments(ml.Flux(1.2, 0.8, 37.0), case.system)
    assert result.bins < 1280
    check(ENGINES["exact"], case, Law(histogram=result.histogram), {SHAPE})


def test_electronics_dead_time_of_an_undisturbed_pixel_in_the_long_run():
    """Extrapolated once the state repeats: the same as run through, and linear in the exposure."""
    means = []
    for cycles in (200, 400, 800):
        system = case_of(pixel({"electronics_dead_time_ns": 83.0}), cycles=cycles).system
        result = electronics_moments(ml.Flux(1.2, 0.8, 0.5 * system.period_ns), system, tolerance=0.05)
        means.append((float(result.mean), float(result.variance)))
        assert result.histogram.sum() == pytest.approx(result.mean)
    steps = np.diff(means, axis=0)
    assert steps[1] == pytest.approx(2.0 * steps[0], rel=1e-6)


@pytest.mark.parametrize("effects", [{"jitter": TAIL, "code_density": CODES}, {"jitter": SAMPLED}])
def test_joint_law_of_records(effects: dict[str, Any]):
    case = case_of(pixel(effects, dead=60.0), 20_000)
    oracle = JointLaw.of(case)
    check(ENGINES["exact"], case, oracle, {COUNTS, SHAPE, JOINT})
    full = oracle.law.covariance()
    assert np.allclose(np.diag(full), oracle.law.lag(0), rtol=1e-6)
    assert np.allclose(full[np.arange(64), (np.arange(64) + 1) % 64], oracle.law.lag(1), atol=1e-6 * full.max())
    assert oracle.law.count_variance == pytest.approx(float(full.sum()), rel=1e-6)


def test_mars_draws_jittered_records():
    case = case_of(pixel({"jitter": TAIL}), 6000)
    law = Law(histogram=mean_histogram(ml.Flux(1.2, 0.8, 37.0), case.system))
    check(ENGINES["mars"], case, law, {SHAPE})


def test_jitter_leaves_the_count_law_alone():
    plain, moved = (case_of(pixel(effects)).system for effects in ({}, {"jitter": TAIL, "code_density": CODES}))
    assert (
        ml.count_law(ml.Flux(1.2, 0.8, 0.5 * plain.period_ns), plain).mean
        == ml.count_law(ml.Flux(1.2, 0.8, 0.5 * moved.period_ns), moved).mean
    )


@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("wave", [False, True])
def test_bits_do_not_depend_on_level_threads_and_parts(name: str, mode: str, wave: bool):
    random = np.random.default_rng(2)
    flux = ml.Flux(random.uniform(0, 3, (5, 40)), random.uniform(0, 2, (5, 40)), random.uniform(0, 100, (5, 40)))
    if wave:
        flux = ml.Flux(waveform=random.exponential(0.05, (5, 40, 64)), background=flux.background)
    system = case_of(pixel(EACH[name], mode)).system
    bits_do_not_depend(flux, system)


def test_off_is_the_ideal_pixel():
    off = Detector(
        dead_time_ns=17.0,
        detection_efficiency=1.0,
        dark_count_hz=0.0,
        electronics_dead_time_ns=0.0,
        jitter=None,
        code_density=None,
        max_events_per_period=None,
        max_events_per_exposure=None,
    )
    assert off == Detector(dead_time_ns=17.0)
    assert off.to_dict() == {"dead_time_ns": 17.0, "mode": "nonparalyzable"}
    assert off.effects == ()
    assert task_of(case_of(off), 1).system.detector is off


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("wave", [False, True])
def test_a_recorder_that_changes_nothing_gives_the_plain_bits(mode: str, wave: bool):
    plain = case_of(pixel({}, mode), wave=wave)
    idle = case_of(pixel({"max_events_per_exposure": 100_000, "code_density": (1.0, 1.0)}, mode), wave=wave)
    a, b = (ml.simulate(case.flux, case.system, seed=4, realizations=50) for case in (plain, idle))
    assert np.array_equal(a, b)
