"""The verdict: a stream of the model's passes, others do not, and the command says so."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import yaml
from harness import ledger
from typer.testing import CliRunner

import mars_lidar as ml
from mars_lidar.calibrate import inspect
from mars_lidar.cli import app
from mars_lidar.statistics.distance import Pmf

SYSTEM = ml.System(
    period_ns=100.0,
    cycles=60_000,
    bins=64,
    pulse=ml.GaussianPulse(sigma_ns=1.0),
    detector=ml.Detector(dead_time_ns=65.0),
)
LIGHT = ml.Flux(0.9, 0.4, 37.0)


@pytest.fixture(scope="module")
def times() -> ml.Timestamps:
    return ml.simulate_timestamps(LIGHT, SYSTEM, seed=21)


def run(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_the_cut_is_that_of_the_definition(times):
    found = ml.validate(times, cycles=300)
    counts = np.bincount(times.cycle // 300, minlength=200)
    assert np.array_equal(found.counts, counts)
    assert found.realizations == 200
    assert found.histogram == pytest.approx(np.bincount(times.bin, minlength=64) / 200)
    assert found.system.start == "stationary"
    law = ml.count_law(
        found.calibration.signal, found.calibration.background, found.system, delay_ns=found.calibration.delay_ns
    )
    measured, first = Pmf.of_counts(counts), int(law.support[0])
    inside = np.array([measured.on(k, k)[0] for k in law.support])
    rest = 1.0 - inside.sum()
    assert found.total_variation == pytest.approx(0.5 * (np.abs(inside - law.pmf).sum() + rest), abs=1e-9)
    assert found.predicted.first == first
    window = ml.joint_law(
        found.calibration.signal, found.calibration.background, found.system, delay_ns=found.calibration.delay_ns
    ).window(found.window)[1]
    check = next(one for one in found.checks if one.name == "window variance")
    assert check.predicted == pytest.approx(window)
    marked = found.window[times.bin]
    assert check.measured == pytest.approx(np.bincount(times.cycle[marked] // 300, minlength=200).var(ddof=1))


def test_streams_of_the_model_pass():
    """Every test's p-value enters the account; the verdict at 1 % fails for at most 2 of 8 streams (p = 5e-5)."""
    verdicts = []
    for seed in range(8):
        times = ml.simulate_timestamps(LIGHT, SYSTEM.replace(cycles=20_000), seed=300 + seed)
        found = ml.validate(times, cycles=100)
        verdicts.append(found.consistent)
        ledger.require({check.name: check.p for check in found.checks}, f"validate, seed {seed}")
    assert verdicts.count(False) <= 2


def test_total_variation_is_at_the_floor(times):
    found = ml.validate(times, cycles=60)
    mean, high = found.total_variation_floor
    assert found.total_variation < high
    assert 0.7 * mean < found.total_variation < 1.35 * mean
    assert found.kl < found.kl_floor[1]
    assert 0.7 < found.shape_variation / found.shape_floor < 1.4


@pytest.mark.parametrize(
    ("change", "by"),
    [
        ({"dead_time_ns": 60.0}, "recovery, chi²"),
        ({"dead_time_ns": 70.0}, "short"),
        ({"pulse": ml.GaussianPulse(sigma_ns=1.3)}, "histogram, chi²"),
    ],
)
def test_a_wrong_model_fails(times, change, by):
    light = ml.calibrate(times, **change)
    found = ml.validate(times, light, cycles=300)
    assert not found.consistent
    if by == "short":
        assert light.too_short > 100
    else:
        assert by in {check.name for check in found.failed}


def test_light_of_another_stream_fails(times):
    other = ml.simulate_timestamps(ml.Flux(0.9, 0.45, 37.0), SYSTEM, seed=22)
    found = ml.validate(times, ml.calibrate(other), cycles=300)
    assert {"mean count", "histogram, chi²"} <= {check.name for check in found.failed}


def test_inspection_tells_what_does_not_fit(times):
    bare = dataclasses.replace(times, info={})
    good = inspect(times)
    assert good.problems == ()
    assert abs(good.calibration.dead_time_ns - 65.0) < 5 * good.calibration.dead_time_error_ns
    assert good.phase_histogram.sum() == len(times)
    assert good.interval_histogram.sum() <= len(times) - 1
    problems = " ".join(inspect(bare, dead_time_ns=70.0).problems)
    assert "shorter than the dead time of 70 ns" in problems
    again = dataclasses.replace(
        bare, times_ns=bare.times_ns / 100.0 * 97.3, period_ns=97.3 * 0.987, cycles=int(60_000 / 0.987) + 1
    )
    assert "flat" in " ".join(inspect(again).problems)
    half = bare.cycle % 2 == 0
    kept = half | (bare.cycle > 30_000)
    changing = dataclasses.replace(
        bare,
        times_ns=bare.times_ns[kept],
        cycle=bare.cycle[kept],
        bin=bare.bin[kept],
        offsets=np.array([0, int(kept.sum())]),
    )
    assert "not constant" in " ".join(inspect(changing).problems)
    twice = dataclasses.replace(
        bare,
        times_ns=np.repeat(bare.times_ns, 2),
        cycle=np.repeat(bare.cycle, 2),
        bin=np.repeat(bare.bin, 2),
        offsets=np.array([0, 2 * len(bare)]),
    )
    assert "exactly the time of the one before" in " ".join(inspect(twice).problems)


def test_bad_input(times):
    with pytest.raises(ValueError, match="at least 20 realizations of a stream of 60,000 periods, got 10,000: 6"):
        ml.validate(times, cycles=10_000)
    with pytest.raises(TypeError, match="calibration must be a Calibration"):
        ml.validate(times, 0.9, cycles=100)
    with pytest.raises(ValueError, match="level must be"):
        ml.validate(times, cycles=100, level=0.0)
    with pytest.raises(ValueError, match="must leave at least 3 registrations, got 1 of 42,533 later than 1e\\+07 ns"):
        ml.validate(times, ml.calibrate(times, hold_off_ns=1e7), cycles=100)
    light = ml.calibrate(times)
    with pytest.raises(ValueError, match="must have the period that was calibrated, 100 ns, got 50"):
        ml.validate(dataclasses.replace(times, period_ns=50.0), light, cycles=100)


def test_commands(tmp_path, times):
    source = tmp_path / "lab.npz"
    times.save(source)
    done = run("inspect", source, "-o", tmp_path / "look.png")
    assert done.exit_code == 0, done.output
    for words in ("period 100 ns (10 MHz), 60,000 periods", "by the smallest interval", "does not fit   nothing"):
        assert words in done.output
    done = run("calibrate", source, "-o", tmp_path / "lab.yaml")
    assert done.exit_code == 0, done.output
    assert "by Rapp" in done.output
    assert yaml.safe_load((tmp_path / "lab.yaml").read_text())["detector"]["dead_time_ns"] == 65.0
    done = run("validate", source, "--cycles", 300, "-o", tmp_path / "fit.png")
    assert done.exit_code == 0, done.output
    assert "the model fits" in done.output
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("look.png", "fit.png"))
    done = run("validate", source, "--cycles", 300, "--dead-time-ns", 60)
    assert done.exit_code == 1
    assert "does NOT fit" in done.output
    for arguments in (
        ("validate", source, "--cycles", 300, "-o", tmp_path / "fit.png"),
        ("validate", source, "--cycles", 300, "--free", "--pulse-sigma-ns", 1),
        ("validate", source, "--cycles", 30_000),
        ("inspect", source, "--pixel", "a"),
        ("inspect", source, "--pixel", "0,1"),
        ("inspect", tmp_path / "none.ptu"),
        ("calibrate", source, "--free", "-o", tmp_path / "other.yaml"),
        ("calibrate", source, "--hold-off-ns", 3),
    ):
        assert run(*arguments).exit_code == 2, arguments
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.png", "lab.npz", "lab.yaml", "look.png"]


@pytest.mark.parametrize(
    ("light", "dead", "cycles"),
    [
        (ml.Flux(0.01, 0.001, 37.0), 65.0, 20),  # most realizations have no photon
        (ml.Flux(0.0, 0.4, 37.0), 65.0, 200),
        (ml.Flux(0.9, 0.0, 37.0), 65.0, 200),
        (ml.Flux(50.0, 5.0, 37.0), 65.0, 200),
        (ml.Flux(0.9, 0.4, 37.0), 0.0, 200),
        (ml.Flux(0.9, 0.4, 37.0), 1000.0, 200),  # counts of 18 or 19
        (ml.Flux(0.9, 0.4, 37.0), 1000.0, 5),  # shorter than the dead time
    ],
)
def test_extreme_streams_of_the_model_pass(light: ml.Flux, dead: float, cycles: int):
    system = SYSTEM.replace(cycles=20_000, detector=ml.Detector(dead_time_ns=dead))
    times = ml.simulate_timestamps(light, system, seed=41)
    found = ml.validate(times, cycles=cycles)
    assert found.consistent, found.failed
    assert found.total_variation <= 1.5 * found.total_variation_floor[1]
    assert all(0.0 <= check.p <= 1.0 for check in found.checks)
