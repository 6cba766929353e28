"""Effects of the detector in the engines: against each other, closed forms, and their definitions event by event."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from harness import COUNTS, EVERYTHING, JOINT, SHAPE, JointLaw, Law, armed_count_pmf, check, refused, require, task_of
from harness.cases import PERIOD_NS, Case, flux_of, waveform_flux
from instrument.effect_checks import bits_do_not_depend
from scipy import stats

import mars_lidar as ml
from mars_lidar import (
    Afterpulsing,
    Crosstalk,
    Detector,
    GaussianPulse,
    Jitter,
    SampledJitter,
    System,
    dark_count_map,
    io,
)
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import PhaseRecords, Records
from mars_lidar.instrument.effects import EFFECTS, FIELDS, LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.plot.views import predicted_counts
from mars_lidar.statistics import electronics_moments, mean_histogram
from tests.harness.command import fails, ok

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


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("wave", [False, True])
def test_a_recorder_that_changes_nothing_gives_the_plain_bits(mode: str, wave: bool):
    plain = case_of(pixel({}, mode), wave=wave)
    idle = case_of(pixel({"max_events_per_exposure": 100_000, "code_density": (1.0, 1.0)}, mode), wave=wave)
    a, b = (ml.simulate(case.flux, case.system, seed=4, realizations=50) for case in (plain, idle))
    assert np.array_equal(a, b)


# Effects of the detector: what is refused, stored, shown, and given on the command line.


REAL = Detector(
    dead_time_ns=20.0,
    detection_efficiency=0.3,
    dark_count_hz=1e4,
    electronics_dead_time_ns=60.0,
    max_events_per_period=2,
    max_events_per_exposure=50,
    jitter=Jitter(sigma_ns=0.1, tail_ns=0.3, tail_fraction=0.2),
    code_density=(1.2, 0.8),
)
EVERY_EFFECT = dataclasses.replace(
    REAL,
    afterpulsing=Afterpulsing(probability=0.1, delay_ns=30.0),
    twilight_ns=1.0,
    recovery_ns=2.0,
    crosstalk=Crosstalk(probability=0.1),
)


def system(detector: Detector = REAL, **changes: object) -> System:
    pulse = GaussianPulse(sigma_ns=0.5)
    return System(period_ns=100.0, cycles=50, bins=32, pulse=pulse, detector=detector).replace(**changes)


def test_every_effect_is_a_field_and_some_engine_does_it():
    assert set(EFFECTS) == set(FIELDS)
    for name in EFFECTS:
        assert name in EVERY_EFFECT.effects
        assert name in ENGINES["exact"].effects or name == "crosstalk"
        assert name in ENGINES["sequential"].effects
        assert EVERY_EFFECT.without(name).effects == tuple(other for other in EVERY_EFFECT.effects if other != name)


@pytest.mark.parametrize("engine", ["mars", "feedback", "auto", "renewal", "poisson"])
@pytest.mark.parametrize("name", EFFECTS)
def test_engines_refuse_what_they_do_not_do(engine, name):
    instrument = system(EVERY_EFFECT.without(*(other for other in EFFECTS if other != name)))
    flux = ml.Flux(1.0, 0.5, 40.0)
    if name in ENGINES[engine].effects:
        assert ml.simulate(flux, instrument, engine=engine).sum() > 0
        return
    with pytest.raises(ValueError, match=f"'{engine}' does not do {name} of the detector.*use '(exact|seq)"):
        ml.simulate(flux, instrument, engine=engine)


@pytest.mark.parametrize("name", [name for name in EFFECTS if name not in LIGHT_EFFECTS])
def test_statistics_refuse_what_they_do_not_know(name):
    instrument, pixel = (
        system(EVERY_EFFECT.without(*(other for other in EFFECTS if other != name))),
        ml.Flux(1.0, 0.5, 50.0),
    )
    refusing = ["holding_time_covariance"]
    if name not in TIMING_EFFECTS:
        refusing += ["joint_law", "exposure_moments"]
        if name != "electronics_dead_time_ns":
            refusing += ["count_law", "mean_histogram", "registration_pdf"]
    for law in refusing:
        with pytest.raises(ValueError, match=f"{law}.* does not do {name} of the detector.*'(exact|sequential)'"):
            getattr(ml.statistics, law)(pixel, instrument)
    refused(f"a table does not do {name}", ml.Table.build, instrument, [0.5, 1.0], [0.5, 1.0])


def test_electronics_dead_time_has_statistics_for_some_modes_only():
    gated = Detector(dead_time_ns=20.0, electronics_dead_time_ns=60.0, mode="paralyzable")
    with pytest.raises(ValueError, match="count_law of method 'exact' does not do electronics_dead_time_ns"):
        ml.count_law(ml.Flux(1.0, 0.5, 50.0), system(gated))
    with pytest.raises(ValueError, match="mean_histogram does not do electronics_dead_time_ns"):
        ml.statistics.mean_histogram(ml.Flux(1.0, 0.5, 50.0), system(gated))
    alike = Detector(dead_time_ns=60.0, electronics_dead_time_ns=60.0)
    assert alike.effects == ()  # registrations are that far apart anyway


@pytest.mark.parametrize(
    ("field", "value", "error"),
    [
        ("detection_efficiency", 0.0, "detection_efficiency must be a finite number in \\(0, 1\\], got 0.0"),
        ("detection_efficiency", 1.5, "detection_efficiency"),
        ("max_events_per_period", 0, "max_events_per_period must be an integer in \\[1"),
        ("jitter", 0.1, "jitter must be of type Jitter or SampledJitter, got 0.1"),
        ("code_density", [1.0], "code_density must be 2 to"),
        ("code_density", [1.0, -1.0], "non-negative"),
        ("code_density", [0.0, 0.0], "positive and finite sum, got a sum of 0"),
    ],
)
def test_bad_values(field, value, error):
    refused(error, Detector, **{"dead_time_ns": 10.0, field: value}, error=(ValueError, TypeError))


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: Jitter(sigma_ns=0.0), "sigma_ns"),
        (lambda: Jitter(sigma_ns=1.0, tail_ns=1.0), "belong together"),
        (lambda: Jitter(sigma_ns=1.0, tail_ns=1.0, tail_fraction=1.1), "tail_fraction"),
        (lambda: SampledJitter([0.0, 0.0], 0.1), "positive and finite sum"),
        (lambda: system(Detector(dead_time_ns=1.0, jitter=Jitter(sigma_ns=6.0))), "1/20 period"),
        (lambda: system(Detector(dead_time_ns=1.0, jitter=SampledJitter([1.0] * 3, 40.0))), "span at most the laser"),
        (lambda: system(Detector(dead_time_ns=1.0, code_density=(1.0, 2.0, 1.0))), "divides the 32 bins"),
        (lambda: system(Detector(dead_time_ns=1.0, electronics_dead_time_ns=1e9)), "at most 1048576 periods"),
        (lambda: Detector.from_dict({"dead_time_ns": 1.0, "jitter": {"kind": "cauchy"}}), "'gaussian' or 'sampled'"),
        (lambda: Detector.from_dict({"dead_time_ns": 1.0, "jitter": {"kind": "gaussian"}}), "one of sigma_ns and fwhm"),
        (lambda: Detector.from_dict({"dead_time_ns": 1.0, "dark_counts": 1.0}), "unknown key 'dark_counts'"),
    ],
)
def test_bad_jitter_and_systems(make, error):
    refused(error, make, error=(ValueError, TypeError))


def test_dark_count_maps():
    """Log-normal pixels and hot ones; efficiency does not reduce them."""
    rates = dark_count_map((200, 300), median_hz=50.0, spread=0.4, hot_fraction=0.03, hot_factor=200.0, seed=1)
    assert np.array_equal(
        rates, dark_count_map((200, 300), median_hz=50.0, spread=0.4, hot_fraction=0.03, hot_factor=200.0, seed=1)
    )
    hot = rates > 50.0 * np.sqrt(200.0)
    assert hot.mean() == pytest.approx(0.03, abs=4 * np.sqrt(0.03 * 0.97 / rates.size))
    assert np.median(rates[~hot]) == pytest.approx(50.0, rel=0.02)
    assert np.log(rates[~hot]).std() == pytest.approx(0.4, rel=0.02)
    instrument = system(Detector(dead_time_ns=1.0, detection_efficiency=0.25))
    flux = ml.Flux(np.ones((200, 300)), 0.5, 10.0).with_dark_counts(rates, instrument)
    assert np.allclose(flux.detected(instrument).background, 0.125 + rates * 1e-7, rtol=1e-12)
    for bad in (-1.0, np.ones((2, 3)), np.nan):
        refused("rate_hz", flux.with_dark_counts, bad, instrument)


def test_dark_counts_are_in_the_gate_only():
    gated = Detector(dead_time_ns=0.0, mode="gated", gate_start_ns=25.0, gate_width_ns=50.0, dark_count_hz=2e6)
    cube = ml.simulate(ml.Flux(np.zeros((1, 500)), 0.0), system(gated))[0, 0].sum(0)
    assert cube[:8].sum() == cube[24:].sum() == 0
    expected = 500 * 50 * 0.2 * 0.5
    assert abs(cube.sum() - expected) < 6 * np.sqrt(expected)


def test_command_line(tmp_path):
    """Flags and file give the same detector; the cube remembers it, says it, and can be made again."""
    np.save(tmp_path / "codes.npy", np.array([1.2, 0.8]))
    flags = (
        "--dead-time-ns 20 --detection-efficiency 0.3 --dark-count-hz 1e4 --electronics-dead-time-ns 60 "
        "--max-events-per-period 2 --max-events-per-exposure 50 --jitter-fwhm-ns 0.2 --jitter-tail-ns 0.3 "
        f"--jitter-tail-fraction 0.2 --code-density-file {tmp_path / 'codes.npy'} --cycles 50 --bins 32"
    ).split()
    scene = ("simulate", "--scene", "room", "--size", 8, "--no-picture", "-o")
    ok(*scene, tmp_path / "a.npz", *flags)
    with io.load(tmp_path / "a.npz") as cube:
        detector = cube.system.detector
        cube.system.save(tmp_path / "spad.yaml")
        counts = np.asarray(cube.histogram)
    jitter = Jitter.from_fwhm(fwhm_ns=0.2, tail_ns=0.3, tail_fraction=0.2)
    assert detector == Detector(**{**vars(REAL), "jitter": jitter})
    ok(*scene, tmp_path / "b.npz", "--system", tmp_path / "spad.yaml")
    with io.load(tmp_path / "b.npz") as cube:
        assert np.array_equal(np.asarray(cube.histogram), counts)
    output = ok("info", tmp_path / "a.npz", "--verify").output
    for text in ("detection_efficiency 0.3", "electronics_dead_time_ns 60", "code_density of 2 values", "every count"):
        assert text in output


@pytest.mark.full
def test_pictures(tmp_path):
    """With what has a predicted mean, and with what has none."""
    both = ("--jitter-fwhm-ns", 2.0, "--electronics-dead-time-ns", 90), ("--max-events-per-period", 1)
    for k, flags in enumerate(both):
        ok("simulate", "--scene", "room", "--size", 8, "--bins", 64, "-o", tmp_path / f"{k}.npz", *flags)
        assert (tmp_path / f"{k}.png").exists()


def test_the_poisson_engine_draws_detected_photons(tmp_path):
    instrument = system(Detector(dead_time_ns=20.0, detection_efficiency=0.5, dark_count_hz=1e6))
    io.simulate_to(tmp_path / "a.npz", ml.Flux(1.0, 0.5, 40.0), instrument, engine="poisson")
    with io.load(tmp_path / "a.npz") as cube:
        assert predicted_counts(cube, 0, 0).sum() == pytest.approx(50 * (0.75 + 0.1))


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (("--detection-efficiency", 2), "--detection-efficiency must be"),
        (("--jitter-tail-ns", 1), "need --jitter-fwhm-ns"),
        (("--jitter-fwhm-ns", 100), "sigma_ns of a jitter must lie in"),
        (("--jitter-bin-ns", 1), "belongs to --jitter-file"),
        (("--jitter-file", "no.npy"), "needs --jitter-bin-ns"),
        (("--jitter-file", "no.npy", "--jitter-bin-ns", 1), "no.npy"),
        (("--jitter-file", "no.npy", "--jitter-bin-ns", 1, "--jitter-fwhm-ns", 1), "give the jitter once"),
        (("--code-density-file", "no.txt"), "no.txt does not exist"),
        (("--max-events-per-period", 1, "--engine", "feedback"), "does not do max_events_per_period"),
    ],
)
def test_command_line_errors(tmp_path, arguments, error):
    fails(error, "simulate", "--scene", "room", "--size", 8, "-o", tmp_path / "x.npz", *arguments)
    assert not (tmp_path / "x.npz").exists()
