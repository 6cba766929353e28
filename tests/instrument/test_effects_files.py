"""Effects of the detector: what is refused, stored, shown, and given on the command line."""

import dataclasses

import numpy as np
import pytest
from harness import refused

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
from mars_lidar.instrument.effects import EFFECTS, FIELDS, LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.plot.views import predicted_counts
from tests.harness.command import fails, ok

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
ALL = dataclasses.replace(
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
        assert name in ALL.effects
        assert name in ENGINES["exact"].effects or name == "crosstalk"
        assert name in ENGINES["sequential"].effects
        assert ALL.without(name).effects == tuple(other for other in ALL.effects if other != name)


@pytest.mark.parametrize("engine", ["mars", "feedback", "auto", "renewal", "poisson"])
@pytest.mark.parametrize("name", EFFECTS)
def test_engines_refuse_what_they_do_not_do(engine, name):
    instrument = system(ALL.without(*(other for other in EFFECTS if other != name)))
    flux = ml.Flux(1.0, 0.5, 40.0)
    if name in ENGINES[engine].effects:
        assert ml.simulate(flux, instrument, engine=engine).sum() > 0
        return
    with pytest.raises(ValueError, match=f"'{engine}' does not do {name} of the detector.*use '(exact|seq)"):
        ml.simulate(flux, instrument, engine=engine)


@pytest.mark.parametrize("name", [name for name in EFFECTS if name not in LIGHT_EFFECTS])
def test_statistics_refuse_what_they_do_not_know(name):
    instrument, pixel = system(ALL.without(*(other for other in EFFECTS if other != name))), ml.Flux(1.0, 0.5, 50.0)
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
