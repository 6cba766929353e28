"""System and Detector: frozen, comparable, written and read without loss, what follows from them."""

import dataclasses
import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import make_system, measured_pulse, refused, two_lobes
from instrument.test_effects import EVERY_EFFECT
from scipy import integrate, stats

import mars_lidar as ml
from mars_lidar.instrument.presets import INSTRUMENTS, PRESETS, sourced
from mars_lidar.instrument.pulse import pulse_from_dict
from tests.harness.command import ok

SAMPLED = ml.SampledPulse([0.0, 1.0, 0.1, 1 / 3], 0.7, "centroid")
GATED = ml.Detector(
    dead_time_ns=30.0,
    mode="gated",
    gate_start_ns=83.0,
    gate_width_ns=31.0,
    gate_step_ns=-7.3,
    gate_cycles=3,
    jitter=ml.SampledJitter([0.0, 1, 2.5, 1], 0.05, "centroid"),
    afterpulsing=ml.Afterpulsing(probability=0.5, delays=(0.0, 3.0, 0.0, 1.0), bin_ns=37.0, generations=2),
    crosstalk=ml.Crosstalk(probability=0.1, kernel=[[0, 1, 0], [1, 0, 2], [0, 1, 0]]),
)
KINDS: dict[str, dict[str, Any]] = {
    "gaussian": {},
    "sampled": {"pulse": SAMPLED, "start": "stationary"},
    "every effect": {"detector": EVERY_EFFECT},
    "moving gate": {"detector": GATED},
}


@pytest.fixture(params=KINDS)
def any_system(request: pytest.FixtureRequest, system: ml.System) -> ml.System:
    return system.replace(**KINDS[request.param])


def test_frozen_hashable_printable(any_system: ml.System):
    with pytest.raises(dataclasses.FrozenInstanceError):
        any_system.cycles = 5  # type: ignore[misc]
    same = ml.System.from_dict(any_system.to_dict())
    assert same == any_system
    assert hash(same) == hash(any_system)
    assert len({same, any_system, any_system.replace(cycles=7)}) == 2
    assert "cycles=200" in repr(any_system)
    assert pickle.loads(pickle.dumps(any_system)) == any_system


def test_dictionary_is_plain_data(any_system: ml.System):
    data = any_system.to_dict()
    assert json.loads(json.dumps(data)) == data
    assert list(data) == ["period_ns", "cycles", "bins", "pulse", "detector", "start"]


def test_json_reads_back_to_the_same_bits(any_system: ml.System):
    odd = any_system.replace(period_ns=0.1 + 0.2 + 100, cycles=7)
    odd = odd.replace(detector=dataclasses.replace(odd.detector, dead_time_ns=20.0 + 1 / 3))
    again = ml.System.from_json(odd.to_json())
    assert again == odd
    assert again.period_ns.hex() == odd.period_ns.hex()
    assert "\n" not in odd.to_json()


@pytest.mark.parametrize("suffix", [".json", ".yaml", ".yml"])
def test_files(any_system: ml.System, tmp_path: Path, suffix: str):
    path = tmp_path / f"system{suffix}"
    any_system.save(path)
    assert ml.System.load(path) == any_system
    assert ml.System.load(str(path)) == any_system


def test_start_may_be_left_out(system: ml.System):
    data = system.to_dict()
    del data["start"]
    assert ml.System.from_dict(data).start == "armed"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": 1}, "unknown key 'colour'; allowed: period_ns"),
        ({"bins": "8"}, "bins must be an integer"),
        ({"detector": {"dead_time_ns": 5.0, "gain": 1}}, "detector has unknown key 'gain'"),
        ({"detector": 5.0}, "detector must be a mapping"),
        ({"pulse": {"kind": "square"}}, "kind 'gaussian' or 'sampled', got"),
        ({"pulse": {"kind": "gaussian"}}, "one of sigma_ns and fwhm_ns, got neither"),
        ({"pulse": {"kind": "gaussian", "sigma_ns": 1.0, "fwhm_ns": 2.0}}, "one of sigma_ns and fwhm_ns, got both"),
        ({"pulse": {"kind": "gaussian", "sigma": 1.0}}, "unknown key 'sigma'"),
        ({"pulse": {"kind": "sampled", "values": [1.0]}}, "must give bin_ns"),
        ({"pulse": 0.5}, "pulse must be a mapping"),
    ],
)
@pytest.mark.parametrize("way", ["dict", "json", "yaml"])
def test_bad_descriptions(system: ml.System, tmp_path: Path, change: dict, message: str, way: str):
    data = system.to_dict() | change
    if way == "dict":
        with pytest.raises((ValueError, TypeError)) as error:
            ml.System.from_dict(data)
        assert message in str(error.value)
        return
    path = tmp_path / f"bad.{way}"
    path.write_text(json.dumps(data))  # which is YAML too
    with pytest.raises(ValueError) as error:
        ml.System.load(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("field", ["period_ns", "cycles", "bins", "pulse", "detector"])
def test_missing_key_is_named(system: ml.System, field: str):
    data = system.to_dict()
    del data[field]
    refused(f"system must give {field}", ml.System.from_dict, data)
    refused("dead_time_ns", ml.Detector.from_dict, {}, error=(ValueError, TypeError))


def test_fwhm_in_a_file(system: ml.System):
    data = system.to_dict() | {"pulse": {"kind": "gaussian", "fwhm_ns": 1.0}}
    assert ml.System.from_dict(data).pulse == ml.GaussianPulse.from_fwhm(fwhm_ns=1.0)


@pytest.mark.parametrize("name", ["system.txt", "system", "system.toml"])
def test_suffix_is_checked(system: ml.System, tmp_path: Path, name: str):
    refused(r"path must end in one of \.json, \.yaml, \.yml", system.save, tmp_path / name)
    refused(r"path must end in one of \.json, \.yaml, \.yml", ml.System.load, tmp_path / name)


def test_broken_file_is_named(tmp_path: Path):
    path = tmp_path / "broken.json"
    path.write_text("{")
    refused(r"broken\.json", ml.System.load, path)
    refused("", ml.System.load, tmp_path / "absent.json", error=FileNotFoundError)


def test_numpy_scalars_are_taken(system: ml.System):
    same = system.replace(period_ns=np.float64(system.period_ns), cycles=np.int32(200), bins=np.uint8(64))
    assert same == system
    assert type(same.cycles) is int
    assert ml.Detector(dead_time_ns=np.float32(0.5)).dead_time_ns == 0.5


def test_derived_quantities(system: ml.System):
    assert system.bin_ns == pytest.approx(2.083333333)
    assert system.exposure_ns == pytest.approx(200 * 133.3333333)
    assert system.dead_time_periods == pytest.approx(0.6375)
    assert system.unambiguous_range_m == pytest.approx(19.98616387)
    assert system.time_ns.shape == (64,)
    assert system.time_ns[0] == pytest.approx(0.5 * system.bin_ns)
    assert system.delay_ns(1.0) == pytest.approx(6.671281904)
    assert system.depth_m(system.delay_ns([[3.0, 25.0]])) == pytest.approx(np.array([[3.0, 25.0]]))  # not wrapped
    assert np.isnan(system.delay_ns(np.nan))


@pytest.mark.parametrize(
    ("dead", "bins", "cycles", "most"),
    [
        (0.0, 64, 1, math.inf),
        (50.0, 64, 1000, 1000),  # one a period
        (50.0, 1, 1000, 2001),  # floor(1000 x 100 / 50) + 1 in all
        (1000.0, 64, 1000, 101),  # every tenth period, and one at the start
        (0.4, 100, 10, 30),  # three in a bin of 1 ns
        (2e4, 64, 100, 1),
        (1e7, 64, 100, 1),
    ],
)
def test_most_registrations_of_a_bin(system: ml.System, dead: float, bins: int, cycles: int, most: float):
    view = make_system(dead, cycles, bins, pulse=system.pulse)
    assert view.max_bin_count == most
    assert view.histogram_dtype == (np.uint16 if most <= 65535 else np.uint32)


def test_bound_on_a_bin_is_never_exceeded():
    """Blinding light: the bound is reached, not passed."""
    for dead, bins in ((30.0, 7), (12.5, 8), (0.7, 100), (250.0, 4)):
        view = make_system(dead, 50, bins)
        cube = ml.simulate(ml.Flux(np.zeros((4, 4)), 1e5, 0.0), view)
        assert cube.max() <= view.max_bin_count


def test_numbers_with_an_exponent_are_numbers(tmp_path):
    """PyYAML reads YAML 1.1, where 1e2 is text; 1e3 is a whole number of cycles, 1.5e0 is none."""
    text = "period_ns: 1e2\ncycles: {}\nbins: 64\npulse: {{kind: gaussian, sigma_ns: 5E-1}}\n"
    text += "detector: {{dead_time_ns: 4.2e+1, dark_count_hz: 1e5}}\n"
    file = tmp_path / "spad.yaml"
    file.write_bytes(b"\xef\xbb\xbf" + text.format(100).replace("\n", "\r\n").encode())  # as Windows writes it
    system = ml.System.load(file)
    assert (system.period_ns, system.pulse.sigma_ns) == (100.0, 0.5)
    assert (system.detector.dead_time_ns, system.detector.dark_count_hz) == (42.0, 1e5)
    file.write_text(text.format("1e3"))
    assert ml.System.load(file).cycles == 1000
    file.write_text(text.format("15e-1"))
    refused(r"spad\.yaml.*: cycles must be an integer.*got 1\.5", ml.System.load, file)


# Pulses: energy, origin, wrapping, and that the sampler's tables agree with the distribution function.


RECORD = np.array([0.0, 3.0, 9.0, 4.0, 0.0, 0.0, 1.0, 2.0, 0.0])
PULSES = {
    "gaussian": ml.GaussianPulse(sigma_ns=1.7),
    "wide": ml.GaussianPulse(sigma_ns=30.0),
    "peak": ml.SampledPulse(RECORD, 2.0),
    "centroid": ml.SampledPulse(RECORD, 2.0, "centroid"),
    "first": ml.SampledPulse(RECORD, 2.0, "first"),
    "whole period": ml.SampledPulse(np.arange(1.0, 51.0), 2.0, "first"),
    "one sample": ml.SampledPulse([5.0], 3.0),
    "lobes": ml.SampledPulse(two_lobes(), 0.4, "centroid"),
}


@pytest.mark.parametrize("name", PULSES)
def test_serialises_hashes_compares(name: str):
    pulse = PULSES[name]
    same = pulse_from_dict(pulse.to_dict())
    assert same == pulse
    assert hash(same) == hash(pulse)
    assert pickle.loads(pickle.dumps(pulse)) == pulse
    assert pulse != ml.GaussianPulse(sigma_ns=0.123)
    assert pulse != "pulse"
    assert "Pulse(" in repr(pulse)


def test_frozen():
    sampled, gaussian = PULSES["peak"], PULSES["gaussian"]
    with pytest.raises(AttributeError):
        gaussian.sigma_ns = 2.0
    with pytest.raises(AttributeError):
        sampled.bin_ns = 2.0
    with pytest.raises(AttributeError):
        del sampled.values
    with pytest.raises(ValueError, match="read-only"):
        sampled.values[0] = 5.0
    source = RECORD.copy()
    copy = ml.SampledPulse(source, 2.0)
    source[:] = 1.0
    assert copy == sampled  # the caller's array is the caller's


def test_full_width_at_half_maximum():
    pulse = ml.GaussianPulse.from_fwhm(fwhm_ns=2.0)
    assert pulse.fwhm_ns == pytest.approx(2.0)
    assert pulse.sigma_ns == pytest.approx(2.0 / 2.354820045)
    density = stats.norm(scale=pulse.sigma_ns).pdf
    assert density(1.0) == pytest.approx(0.5 * density(0.0))


@pytest.mark.parametrize("name", PULSES)
def test_cumulative_energy(name: str):
    pulse = PULSES[name]
    low, high = pulse.support_ns()
    t = np.linspace(low - 1.0, high + 1.0, 4001)
    energy = pulse.cumulative(t)
    assert np.all(np.diff(energy) >= 0)
    assert energy[0] == pytest.approx(0.0, abs=1e-16)
    assert energy[-1] == pytest.approx(1.0, abs=1e-15)
    assert pulse.cumulative(low) == pytest.approx(0.0, abs=1e-16)
    assert pulse.cumulative(high) == pytest.approx(1.0, abs=1e-15)
    assert pulse.cumulative(low + 1e-3) > 0


@pytest.mark.parametrize("name", PULSES)
@pytest.mark.parametrize("delay", [0.0, 0.3, 50.0, 99.9, 250.0, -1e4])
def test_bin_energies(name: str, delay: float):
    """They sum to one and wrap: checked against a sum over neighbouring periods."""
    pulse = PULSES[name]
    energy = pulse.bin_energy(delay, 100.0, 64)
    assert energy.shape == (64,)
    assert energy.min() >= -1e-15
    assert energy.sum() == pytest.approx(1.0, abs=1e-12)
    edges = np.linspace(0.0, 100.0, 65) - delay % 100.0
    direct = sum(np.diff(pulse.cumulative(edges + 100.0 * k)) for k in range(-5, 6))
    assert energy == pytest.approx(direct, abs=1e-11)


def test_bin_energies_of_many_delays():
    pulse = PULSES["lobes"]
    delays = np.array([[1.0, 20.0, 99.0], [5.0, 6.0, 7.0]])
    energy = pulse.bin_energy(delays, 100.0, 32)
    assert energy.shape == (2, 3, 32)
    assert np.array_equal(energy[1, 0], pulse.bin_energy(5.0, 100.0, 32))


@pytest.mark.parametrize("name", PULSES)
@pytest.mark.parametrize("bins", [64, 5000])
def test_bins_that_the_pulse_does_not_reach_have_no_energy(name: str, bins: int):
    """The energies are the differences at all edges to the last bit."""
    pulse, delays = PULSES[name], np.array([0.0, 0.3, 50.0, 99.9, 250.0, -1e4])
    edges = np.linspace(0.0, 100.0, bins + 1) - delays[:, None]
    direct = np.diff(pulse.wrapped_cumulative(edges, 100.0), axis=-1)
    assert np.array_equal(pulse.bin_energy(delays, 100.0, bins), direct)


def test_gaussian_energy_is_that_of_the_density():
    energy = ml.GaussianPulse(sigma_ns=1.7).bin_energy(20.0, 100.0, 50)
    for k in (0, 8, 9, 10, 14):
        exact = integrate.quad(stats.norm(20.0, 1.7).pdf, 2.0 * k, 2.0 * k + 2, epsabs=1e-14)[0]
        assert energy[k] == pytest.approx(exact, abs=1e-12)


def test_lower_tail_is_relatively_accurate():
    assert ml.GaussianPulse(sigma_ns=2.0).cumulative(-16.0) == pytest.approx(stats.norm.cdf(-8.0), rel=1e-9)


@pytest.mark.parametrize(("origin", "first_edge"), [("peak", -2.5), ("first", 0.0)])
def test_origin(origin: str, first_edge: float):
    """What a return at delay 0 does: with "peak" the centre of the largest sample is at 0."""
    pulse = ml.SampledPulse(RECORD, 1.0, origin)
    energy = pulse.bin_energy(-first_edge, 100.0, 100)
    assert energy[:9] * RECORD.sum() == pytest.approx(RECORD, abs=1e-9)


def test_cyclic_record_is_put_together_again():
    """A rising edge stored at the end of the array: the same pulse, however the record was rotated."""
    smooth = np.exp(-0.5 * ((np.arange(40) - 20) / 3.0) ** 2) * (1 + 0.3 * (np.arange(40) > 20))
    for origin in ("peak", "centroid"):
        expected = ml.SampledPulse(smooth, 0.5, origin).bin_energy(30.0, 100.0, 1000)
        for rotation in (1, 17, 20, 39):
            rolled = ml.SampledPulse(np.roll(smooth, rotation), 0.5, origin)
            assert rolled.bin_energy(30.0, 100.0, 1000) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("floor", [0.0, 1e-3])
def test_decay_longer_than_half_of_its_record_stays_behind_its_peak(floor: float):
    """Cut opposite its peak, a third of this response would come before it."""
    decay = np.where(np.arange(200) < 20, 0.0, np.exp(-(np.arange(200) - 20.0) / 60.0))
    record = decay + floor * np.random.default_rng(5).random(200)
    given = ml.SampledPulse(record, 0.1, "first").bin_energy(30.0 - 2.05, 100.0, 1000)
    assert ml.SampledPulse(record, 0.1).bin_energy(30.0, 100.0, 1000) == pytest.approx(given, abs=1e-12)


def test_centroid_is_the_mean_of_a_compact_pulse():
    record = np.zeros(200)
    record[80:87] = [1, 4, 9, 5, 3, 1, 1]
    pulse = ml.SampledPulse(record, 0.1, "centroid")
    t = np.linspace(-5, 5, 200_001)
    mean = np.sum(0.5 * (t[1:] + t[:-1]) * np.diff(pulse.cumulative(t)))
    assert mean == pytest.approx(0.0, abs=2e-3)  # circular, so not to the last digit


@pytest.mark.parametrize(
    "values", [np.float32(RECORD), RECORD.astype(int), RECORD.tolist(), 1e200 * RECORD, 1e-200 * RECORD]
)
def test_scale_and_type_of_the_record_do_not_matter(values):
    expected = PULSES["peak"].bin_energy(20.0, 100.0, 50)
    assert ml.SampledPulse(values, 2.0).bin_energy(20.0, 100.0, 50) == pytest.approx(expected, abs=1e-12)


def test_bool_records_are_taken_as_numbers():
    assert ml.SampledPulse([False, True], 1.0).support_ns() == (-0.5, 0.5)


def test_empty_ends_are_left_out():
    pulse = ml.SampledPulse([0, 0, 1, 2, 0, 1, 0], 1.0, "first")
    assert pulse.support_ns() == (2.0, 6.0)
    assert pulse.cumulative([1.9, 2.0, 3.0, 4.5, 6.0]) == pytest.approx([0, 0, 0.25, 0.75, 1.0])


def test_record_as_long_as_the_period_is_taken():
    """To rounding: 3 x 0.1 is more than 0.3."""
    system = make_system(0.0, 1, 3, pulse=ml.SampledPulse([1, 2, 3], 0.1), period_ns=0.3)
    assert ml.simulate(ml.Flux(5.0, 0.0, 0.1), system, seed=1).sum() > 0


@pytest.mark.parametrize("name", ["face_free_8ps", "face_free_unimodal_8ps"])
def test_measured_records(name: str):
    for origin in ("peak", "centroid", "first"):
        pulse = measured_pulse(name, 10.0, origin)
        assert pulse.bin_energy(3.3, 100.0, 5000).sum() == pytest.approx(1.0, abs=1e-12)
        assert pulse_from_dict(pulse.to_dict()) == pulse
    low, high = measured_pulse(name, 10.0).support_ns()
    assert -5.0 <= low < 0 < high <= 5.0


def test_only_the_abstract_pulse_is_abstract():
    refused("", ml.Pulse, error=TypeError)


@pytest.mark.parametrize("share", [0.3, 0.5, 1.0])
def test_wide_trains_by_frequency_are_those_by_pulses(share: float):
    """The Fourier series of a wide Gaussian's train against the sum over its pulses, the same origin included."""
    pulse, period = ml.GaussianPulse(sigma_ns=10.0 * share), 10.0
    t = np.linspace(-25.0, 25.0, 1001)
    by_pulses = ml.Pulse.wrapped_cumulative(pulse, t, period)
    np.testing.assert_allclose(
        pulse.wrapped_cumulative(t, period), by_pulses, atol=2e-14, rtol=0.0
    )  # 19 pulses round more
    assert pulse.wrapped_cumulative(t + period, period) - pulse.wrapped_cumulative(t, period) == pytest.approx(1.0)


# Instruments by name: every value has a source or says that it is assumed, and the documentation has them all.


ROOT = Path(__file__).resolve().parents[2]


def test_the_documentation_is_the_declaration():
    lines = ["| name | field | value | source |", "|---|---|---|---|"]
    for name in INSTRUMENTS:
        label = f"`{name}`"
        for field, (value, source) in sourced(name).items():
            lines.append(f"| {label} | `{field}` | {value if isinstance(value, str) else f'{value:.6g}'} | {source} |")
            label = ""
    assert "\n".join(lines) in (ROOT / "docs/detectors.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_of_a_detector_can_be_written(tmp_path, name):
    path = tmp_path / "system.yaml"
    ok("init", "--preset", name, path)
    assert ml.System.load(path).detector == ml.Detector.preset(name)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_a_file_of_it_is_that_system(tmp_path, name):
    for _, source in sourced(name).values():
        assert source.startswith("assumption") or len(source) > len("DS000000")
    path = tmp_path / "system.yaml"
    ok("init", "--preset", name, path)
    system = ml.System.load(path)
    assert system.detector == ml.Detector.preset(name)
    if "laser" in INSTRUMENTS[name]:
        assert system == ml.System.preset(name)
    else:
        refused("is a detector, without a laser", ml.System.preset, name)
    text = path.read_text()
    assert all(source in text for _, source in sourced(name).values())
    few = system.replace(cycles=min(system.cycles, 1000))
    counts = ml.simulate(ml.Flux([[1.0]], 0.01, 2.0), few, seed=1)
    assert counts.sum() > 0


def test_what_the_pixels_of_a_one_bit_camera_hold():
    system = ml.System.preset("swissspad2-like")
    counts = ml.simulate(ml.Flux([[5.0]], 1.0, 2.0), system, realizations=20, seed=2)
    assert (counts.sum(-1) == 1).all()


def test_unknown_names_are_told():
    refused("swissspad2-like", ml.System.preset, "spad")
