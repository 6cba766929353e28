"""Instruments by name: every value has a source or says that it is assumed, and the documentation has them all."""

from pathlib import Path

import pytest
from harness import refused

import mars_lidar as ml
from mars_lidar.instrument.presets import INSTRUMENTS, PRESETS, sourced
from tests.harness.command import ok

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
