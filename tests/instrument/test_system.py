"""System and Detector: frozen, comparable, written and read without loss, what follows from them."""

import dataclasses
import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import make_system, refused
from instrument.test_effects_files import ALL

import mars_lidar as ml

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
    "every effect": {"detector": ALL},
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
    refused(r"path must end in \.json, \.yaml or \.yml", system.save, tmp_path / name)
    refused(r"path must end in \.json, \.yaml or \.yml", ml.System.load, tmp_path / name)


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


def test_type_depends_on_the_system_only(system: ml.System):
    assert system.histogram_dtype == np.uint16
    assert system.replace(detector=ml.Detector(dead_time_ns=0.0)).histogram_dtype == np.uint32


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
