"""Detector modes: same seed, same bits; what is refused, stored, and shown."""

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from harness import make_system, refused
from instrument.effect_checks import bits_do_not_depend
from test_reproducibility import image

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import Engine
from mars_lidar.plot.views import predicted_counts
from tests.harness.command import fails, ok

GATE = {"mode": "gated", "gate_start_ns": 83.0, "gate_width_ns": 31.0}
MOVING = GATE | {"gate_step_ns": -7.3, "gate_cycles": 3}
DETECTORS: dict[str, dict[str, Any]] = {
    "paralyzable": {"mode": "paralyzable"},
    "synchronous": {"mode": "synchronous"},
    "gated": GATE,
    "moving": MOVING,
}
# Start of the SHA-256 of the cubes (2 realizations, seed 2**63 + 1), as little-endian uint32; see
# test_reproducibility.py.
LIGHTS = ("gaussian", "returns", "sampled", "waveform", "whole periods")
OTHER_LIGHTS = ("stationary", "stationary waveform", "long dead time")  # no start of a moving gate is stationary
BITS = """
paralyzable 195c64d00133 0746b1a76141 414db86b0651 bbf85cb92979 95832b01433d 9cb3fca214e0 8dbfe198298a b1c2de556d0f
synchronous 5e2fb06ab885 2f1c241ef0d2 0f1db204f2eb e23bb5c64d7f 30365f65cb2c fac5eb740995 12cdfd8f949c 434dfebbb61e
gated 1ccd551675ad c2337b2c598a 4801bac9c25c 96f0446f147c 89c8e0890dda fa61095eae92 dd4589e48507 7d1f00c9c48d
moving 012d4c326ae5 5b03b7940810 8cffb1cccbc7 c2e7cf93ecb5 ffa11c61a6ed
"""
GOLDEN = {
    f"{mode} {kind}": bits
    for mode, *row in map(str.split, BITS.strip().splitlines())
    for kind, bits in zip(LIGHTS + OTHER_LIGHTS * (mode != "moving"), row, strict=True)
}
KINDS = [tuple(name.split(" ", 1)) for name in GOLDEN]


def scene(mode: str, kind: str) -> tuple[ml.Flux, ml.System]:
    flux, system = image(kind)
    dead = 23.75 if mode == "paralyzable" and kind != "whole periods" else system.detector.dead_time_ns
    return flux, system.replace(detector=ml.Detector(dead_time_ns=dead, **DETECTORS[mode]))


@pytest.mark.full
@pytest.mark.parametrize(("mode", "kind"), KINDS)
def test_golden_bits(mode: str, kind: str):
    """The committed bits."""
    flux, system = scene(mode, kind)
    cube = ml.simulate(flux, system, realizations=2, seed=2**63 + 1)
    assert hashlib.sha256(cube.astype("<u4").tobytes()).hexdigest()[:12] == GOLDEN[f"{mode} {kind}"]


@pytest.mark.parametrize("engine", ["exact", "sequential"])
@pytest.mark.parametrize(("mode", "kind"), KINDS)
def test_threads_parts_and_timestamps(engine: str, mode: str, kind: str):
    flux, system = scene(mode, kind)
    bits_do_not_depend(
        flux, system.replace(cycles=min(system.cycles, 40)) if engine == "sequential" else system, engine
    )


@pytest.mark.parametrize(("mode", "kind"), KINDS)
def test_rules_hold_for_every_registration(mode: str, kind: str):
    """Never closer than the dead time; one a period; inside of the gate."""
    flux, system = scene(mode, kind)
    times = ml.simulate_timestamps(flux, system, seed=9)
    period, slack = system.period_ns, 2e-4  # phases have 24 bits
    if mode != "synchronous":
        apart = np.diff(times.times_ns)
        inside = np.ones(apart.size, bool)
        inside[times.offsets[1:-1][times.offsets[1:-1] < len(times)] - 1] = False
        assert np.all(apart[inside] >= system.detector.dead_time_ns - slack * 10)
    for k in range(times.offsets.size - 1):
        cycle = times.cycle[times.offsets[k] : times.offsets[k + 1]]
        if mode == "synchronous":
            assert np.all(np.diff(cycle) >= max(1, np.ceil(system.dead_time_periods)))
    if system.detector.mode == "gated":
        detector = system.detector
        turns = times.cycle // detector.gate_cycles
        opens = detector.gate_start_ns + detector.gate_step_ns * turns
        since = (times.times_ns - opens + slack) % period
        assert np.all(since < detector.gate_width_ns + 2 * slack)


@pytest.mark.parametrize(
    ("changes", "kind", "fragments"),
    [
        ({"dead_time_ns": -0.1}, ValueError, ["dead_time_ns", "[0, inf)", "got -0.1"]),
        ({"mode": "gate"}, ValueError, ["mode", "'nonparalyzable'", "'paralyzable'", "'synchronous'", "got 'gate'"]),
        ({"mode": "paralysable"}, ValueError, ["mode", "'nonparalyzable'", "'gated'", "got 'paralysable'"]),
        ({"gate_start_ns": 5.0}, ValueError, ["gate_start_ns", "'gated'", "'nonparalyzable'", "got 5.0"]),
        ({"mode": "paralyzable", "gate_width_ns": 5.0}, ValueError, ["gate_width_ns", "'gated'", "'paralyzable'"]),
        ({"mode": "synchronous", "gate_step_ns": 0.0}, ValueError, ["gate_step_ns", "'gated'", "'synchronous'"]),
        ({"mode": "synchronous", "gate_cycles": 1}, ValueError, ["gate_cycles", "'gated'", "'synchronous'"]),
        ({"mode": "gated"}, ValueError, ["'gated'", "gate_start_ns"]),
        ({"mode": "gated", "gate_start_ns": 1.0}, ValueError, ["'gated'", "gate_width_ns"]),
        (GATE | {"gate_width_ns": 0.0}, ValueError, ["gate_width_ns", "(0, inf)", "got 0.0"]),
        (MOVING | {"gate_cycles": 0}, ValueError, ["gate_cycles", "[1, ", "got 0"]),
        (GATE | {"gate_cycles": 5}, ValueError, ["gate_cycles", "gate_step_ns", "gate_cycles=5"]),
    ],
)
def test_bad_detectors(changes: dict[str, Any], kind: type[Exception], fragments: list[str]):
    message = refused("", ml.Detector, error=kind, **{"dead_time_ns": 5.0} | changes)
    assert all(fragment in message for fragment in fragments), message


def test_bad_combinations(system: ml.System, flux: ml.Flux):
    wide = ml.Detector(dead_time_ns=5.0, **GATE | {"gate_width_ns": 140.0})
    thin = ml.Detector(dead_time_ns=5.0, **GATE | {"gate_width_ns": 1e-3})
    for gate, got in ((wide, "140"), (thin, r"0\.001")):
        refused(rf"gate_width_ns must lie in \[0\.00133333, 133\.333\] ns .* got {got}", system.replace, detector=gate)
    moving = ml.Detector(dead_time_ns=5.0, **MOVING)
    with pytest.raises(ValueError, match=r"start must be 'armed' with a gate that moves.*gate_step_ns=-7\.3"):
        system.replace(detector=moving, start="stationary")
    with pytest.raises(ValueError, match=r"'poisson' needs a gate that repeats.*use 'exact' or 'sequential'"):
        ml.simulate(flux, system.replace(detector=moving), engine="poisson")
    long = system.replace(detector=ml.Detector(dead_time_ns=1e6, mode="paralyzable"), cycles=10**8)
    refused(r"2\.15e\+09 expected arrivals of mode 'paralyzable'", ml.simulate, ml.Flux(100.0, 0.0, 5.0), long)


def test_engines_say_what_they_do(system: ml.System, flux: ml.Flux):
    class Plain(Engine):
        name, description = "plain", "for this test"

        def histogram(self, task, out):
            out[:] = 1

    assert ml.simulate(flux, system, engine=Plain()).sum() > 0
    gated = system.replace(detector=ml.Detector(dead_time_ns=5.0, **GATE))
    with pytest.raises(ValueError, match=r"'plain' is not for detectors of mode 'gated'.*use 'exact' or 'sequential'"):
        ml.simulate(flux, gated, engine=Plain())
    for mode in ("paralyzable", "synchronous", "gated"):
        able = {name for name, engine in ENGINES.items() if mode in engine.modes}
        assert able >= {"exact", "sequential", "poisson"}


@pytest.mark.parametrize("mode", DETECTORS)
def test_stored_and_read_back(tmp_path, system: ml.System, flux: ml.Flux, mode: str):
    view = system.replace(detector=ml.Detector(dead_time_ns=1 / 3, **DETECTORS[mode]))
    for suffix in ("zarr", "h5", "npz"):
        path = tmp_path / f"cube.{suffix}"
        io.simulate_to(path, flux, view, seed=5)
        with io.load(path) as cube:
            assert cube.system == view
            assert io.verify(cube)
            predicted = predicted_counts(cube, 0, 1)
            assert (predicted is None) == (mode == "moving")
            if predicted is not None:
                assert predicted.shape == (view.bins,)


def test_plain_detectors_are_written_as_before():
    assert ml.Detector(dead_time_ns=5.0).to_dict() == {"dead_time_ns": 5.0, "mode": "nonparalyzable"}


def test_starts_and_steps_wrap(system: ml.System):
    """A gate one period later, or moved by a period more, is the same gate."""
    flux = ml.Flux(np.ones((4, 4)), 0.5, 60.0)
    instrument = ml.Detector(dead_time_ns=20.0, **GATE | {"gate_start_ns": 20.0, "gate_step_ns": 3.0})
    period = system.period_ns
    for start, step in ((20.0 + period, 3.0), (20.0 - 2 * period, 3.0), (20.0, 3.0 - period)):
        other = replace(instrument, gate_start_ns=start, gate_step_ns=step)
        a, b = (ml.simulate(flux, system.replace(detector=d), seed=1).astype(int) for d in (instrument, other))
        # the last bit of a gate's edge may differ, and with it a photon in a million
        assert np.abs(a - b).sum() <= 4


@pytest.mark.parametrize(("dead", "most"), [(0.0, 70), (63.75, 70), (100.0, 70), (250.0, 24)])
def test_most_registrations_of_a_synchronous_bin(dead: float, most: int):
    view = make_system(dead, 70, 1, mode="synchronous")
    assert view.max_bin_count == most
    assert ml.simulate(ml.Flux(0.0, 1e5, 0.0), view).max() <= most
    assert view.replace(cycles=65_535).histogram_dtype == np.uint16


@pytest.mark.full
def test_command_line(tmp_path):
    small = ["simulate", "--scene", "room", "--size", 8, "--cycles", 20, "--bins", 32, "--no-picture"]
    gate = ["--mode", "gated", "--gate-start-ns", 30, "--gate-width-ns", 20, "--gate-step-ns", 5, "--gate-cycles", 2]
    ok(*small, *gate, "-o", tmp_path / "a.zarr")
    with io.load(tmp_path / "a.zarr") as cube:
        detector = cube.system.detector
        assert detector == ml.Detector(
            dead_time_ns=75.0, mode="gated", gate_start_ns=30.0, gate_width_ns=20.0, gate_step_ns=5.0, gate_cycles=2
        )
        cube.system.save(tmp_path / "gated.yaml")
    printed = ok("info", tmp_path / "a.zarr").output
    assert "gated" in printed
    assert "20 ns from 30 ns of each period, moved by 5 ns every 2 periods" in printed
    # a file's gate: kept with its mode, replaced in part, dropped with another mode
    file = ["--system", tmp_path / "gated.yaml"]
    for given, expected in (
        (["--gate-width-ns", 10], replace(detector, gate_width_ns=10.0)),
        (["--dead-time-ns", 3], replace(detector, dead_time_ns=3.0)),
        (["--mode", "synchronous"], ml.Detector(dead_time_ns=75.0, mode="synchronous")),
    ):
        ok(*small, *file, *given, "-o", tmp_path / "b.zarr", "--overwrite")
        with io.load(tmp_path / "b.zarr") as cube:
            assert cube.system.detector == expected
    fails("--gate-start-ns belongs to mode 'gated'", *small, "--gate-start-ns", 3, "-o", tmp_path / "c.zarr")
