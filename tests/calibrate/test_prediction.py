"""Detectors with effects: light without bias by simulation, streams that fit when told, and do not when not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from harness import ledger
from scipy import stats
from typer.testing import CliRunner

import mars_lidar as ml
from mars_lidar.cli import app
from mars_lidar.statistics.distance import Pmf, two_sample_g_test

PLAIN = ml.System(
    period_ns=100.0,
    cycles=100_000,
    bins=64,
    pulse=ml.GaussianPulse(sigma_ns=1.0),
    detector=ml.Detector(dead_time_ns=65.0),
)
TRUTH = np.array([0.5, 0.9, 37.0])
LIGHT = ml.Flux(TRUTH[1], TRUTH[0], TRUTH[2])
DETECTORS = {
    "jitter": ml.Detector(dead_time_ns=65.0, jitter=ml.Jitter(sigma_ns=0.5)),
    "afterpulses": ml.Detector(dead_time_ns=65.0, afterpulsing=ml.Afterpulsing(probability=0.2, delay_ns=80.0)),
    "electronics": ml.Detector(dead_time_ns=40.0, electronics_dead_time_ns=65.0),
    "paralyzable": ml.Detector(dead_time_ns=30.0, mode="paralyzable"),
}


def recorded(detector: ml.Detector, seed: int) -> ml.Timestamps:
    times = ml.simulate_timestamps(LIGHT, PLAIN.replace(detector=detector), seed=seed)
    return dataclasses.replace(times, info={})


@pytest.mark.parametrize("name", DETECTORS)
def test_a_detector_that_is_told_fits(name: str):
    """The calibrated light is the true one, and every test's p-value enters the account."""
    detector = DETECTORS[name]
    times = recorded(detector, seed=31)
    light = ml.calibrate(times, PLAIN.replace(detector=detector))
    assert light.converged
    assert light.simulated == (0.0 if name == "jitter" else 4.0)
    z = (np.array([light.background, light.signal, light.delay_ns]) - TRUTH) / np.sqrt(np.diag(light.covariance))
    found = ml.validate(times, light, cycles=250, detector=detector, simulated=1000)
    outcomes = {check.name: check.p for check in found.checks}
    outcomes |= {f"light {k}": float(2 * stats.norm.sf(abs(v))) for k, v in enumerate(z)}
    ledger.require(outcomes, f"validate, {name} told")
    assert found.consistent
    assert found.prediction.recovery is not None
    assert found.total_variation < 1.5 * found.total_variation_floor[0]
    plain = ml.calibrate(times, pulse=light.pulse, dead_time_ns=light.dead_time_ns)
    assert not ml.validate(times, plain, cycles=250).consistent


def test_simulated_prediction_is_that_of_the_laws():
    """A detector with a limit that never acts has no law: what is simulated instead agrees with the exact one."""
    detector = dataclasses.replace(PLAIN.detector, max_events_per_period=60)
    times = recorded(PLAIN.detector, seed=33)
    light = ml.calibrate(times, PLAIN)
    drawn = ml.validate(times, light, cycles=300, detector=detector, simulated=2000).prediction
    exact = ml.validate(times, light, cycles=300).prediction
    assert drawn.simulated == 2000
    assert exact.simulated == 0
    assert "simulated" in drawn.words
    size = drawn.simulated
    z = [
        (drawn.mean - exact.mean) / np.sqrt(exact.variance / size),
        (drawn.variance / exact.variance - 1) / np.sqrt(2 / size),
        (drawn.window_variance / exact.window_variance - 1) / np.sqrt(2 / size),
    ]
    outcomes = {f"moment {k}": float(2 * stats.norm.sf(abs(v))) for k, v in enumerate(z)}
    square = float((((drawn.histogram - exact.histogram) ** 2) / (exact.bin_variance / size)).sum())
    # bins are correlated: the variance of the sum of squares is 2 tr C^2 of their correlations, at most some times 2 n
    outcomes["histogram"] = float(stats.chi2.sf(square / 3.0, exact.histogram.size / 3.0))
    ledger.require(outcomes, "prediction by simulation against the laws")


def test_two_samples_of_one_law():
    random = np.random.default_rng(5)
    p = [
        two_sample_g_test(
            Pmf.of_counts(random.poisson(30.0, 500)), 500, Pmf.of_counts(random.poisson(30.0, 2000)), 2000
        )
        for _ in range(300)
    ]
    ledger.require({"uniform": float(stats.kstest(p, "uniform").pvalue)}, "two-sample G-test")
    off = two_sample_g_test(
        Pmf.of_counts(random.poisson(32.0, 500)), 500, Pmf.of_counts(random.poisson(30.0, 2000)), 2000
    )
    assert off < 1e-4


def test_bad_input_and_the_command(tmp_path):
    times = recorded(DETECTORS["jitter"], seed=35)
    light = ml.calibrate(times, pulse="gaussian", dead_time_ns=65.0)
    for detector, message in (
        (ml.Detector(dead_time_ns=0.0, mode="synchronous"), "must be free-running"),
        (ml.Detector(dead_time_ns=65.0, max_events_per_exposure=3), "max_events_per_exposure"),
        (ml.Detector(dead_time_ns=65.0, jitter=ml.Jitter(sigma_ns=5.0)), "must be less than the recorded pulse"),
        (ml.Detector(dead_time_ns=65.0, jitter=ml.Jitter(sigma_ns=0.2, tail_ns=1.0, tail_fraction=0.1)), "Gaussian"),
    ):
        with pytest.raises(ValueError, match=message):
            ml.validate(times, light, cycles=500, detector=detector)
    with pytest.raises(TypeError, match="detector must be a Detector"):
        ml.validate(times, light, cycles=500, detector="spad")
    with pytest.raises(ValueError, match="simulated must be"):
        ml.validate(times, light, cycles=500, simulated=10)
    system = tmp_path / "lab.yaml"
    PLAIN.replace(detector=DETECTORS["jitter"]).save(system)
    times.save(tmp_path / "lab.npz")
    done = CliRunner().invoke(
        app, ["validate", str(tmp_path / "lab.npz"), "--cycles", "500", "--system", str(system), "--simulated", "500"]
    )
    assert done.exit_code == 0, done.output
    assert "prediction     exact laws; recovery simulated" in done.output
    assert "jitter         sigma 0.5 ns, given; the recorded pulse holds it" in done.output


def test_options_of_the_detector(tmp_path):
    """Single options say what a system file says, and replace its values; a simulated stream tells its own."""

    def rows(command: str, *arguments: object) -> dict[str, str]:
        done = CliRunner().invoke(app, [command, str(tmp_path / "lab.npz"), *(str(one) for one in arguments)])
        assert done.exit_code == 0, done.output
        return {line[:15].strip(): line[15:] for line in done.output.splitlines()}

    detector = DETECTORS["electronics"]
    system = PLAIN.replace(detector=detector)
    recorded(detector, seed=37).save(tmp_path / "lab.npz")
    system.save(tmp_path / "lab.yaml")
    PLAIN.save(tmp_path / "plain.yaml")
    shape = ("--pulse-sigma-ns", 1.0)
    single = ("--dead-time-ns", 40, "--electronics-dead-time-ns", 65)
    by_file = rows("calibrate", "--system", tmp_path / "lab.yaml")
    assert "105 ns" in by_file["hold-off"]
    assert rows("calibrate", *single, *shape) == by_file
    assert rows("calibrate", "--system", tmp_path / "plain.yaml", *single, "-o", tmp_path / "out.yaml")
    assert ml.System.load(tmp_path / "out.yaml").detector == detector
    told = rows("validate", "--cycles", 500, "--simulated", 500, *single, *shape)
    assert "by 512 simulated realizations" in told["prediction"]
    whole = ml.simulate_timestamps(LIGHT, system, seed=37)
    assert ml.validate(whole, cycles=500).system.detector == detector
    for arguments, message in (
        (("--electronics-dead-time-ns", 65), "needs its dead time: give --dead-time-ns or --system"),
        (("--mode", "gated", "--dead-time-ns", 65), "--mode must be nonparalyzable or paralyzable"),
        (("--afterpulse-probability", 0.1, "--dead-time-ns", 65), "--afterpulse-delay-ns belong together"),
        (("--crosstalk", 0.1), "No such option"),
    ):
        done = CliRunner().invoke(app, ["calibrate", str(tmp_path / "lab.npz"), *(str(one) for one in arguments)])
        assert done.exit_code == 2
        assert message in done.output + done.stderr
