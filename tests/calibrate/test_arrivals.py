"""Detectors in constant light without a laser: streams drawn here from the hazard itself, not by the package."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from mars_lidar.calibrate import inspect_arrivals
from mars_lidar.cli import app

DEAD_NS, TAU_NS, PER_NS, NUMBER = 45.3, 30.0, 1e-3, 100_000
STREAMS = 30
LEVEL = 1e-4  # probability that a test fails where all is right


def arrivals(
    seed: int, *, afterpulses: float = 0.0, jitter_ns: float = 0.0, unit_ns: float = 0.0, number: int = NUMBER
) -> np.ndarray:
    """A renewal process: dead time, then the first of a photon and, with some probability, an afterpulse."""
    random = np.random.default_rng(seed)
    wait = random.exponential(1.0 / PER_NS, number)
    pulse = np.where(random.random(number) < afterpulses, random.exponential(TAU_NS, number), np.inf)
    times = np.cumsum(DEAD_NS + np.minimum(wait, pulse)) + jitter_ns * random.normal(size=number)
    return np.floor(times / unit_ns) * unit_ns if unit_ns else times


@pytest.mark.parametrize("unit_ns", [0.0, 0.004])
def test_an_ideal_detector(unit_ns):
    """Nothing is told of it, and the dead time is within its error: a mean excess, exponential."""
    score, rate = [], []
    for seed in range(STREAMS):
        found = inspect_arrivals(arrivals(seed, unit_ns=unit_ns), unit_ns=unit_ns)
        assert found.problems == ()
        assert found.afterpulse_probability == 0.0
        score.append((found.dead_time_ns - DEAD_NS) / found.dead_time_error_ns)
        rate.append((found.rate_per_s - 1e9 * PER_NS) / found.rate_error_per_s)
    # -1 + an exponential number, whose sum over the streams is a gamma one; the clock's unit is in the error too
    total = float(np.sum(np.asarray(score) + 1.0))
    assert min(stats.gamma.sf(total, STREAMS), stats.gamma.cdf(total, STREAMS)) > 0.5 * LEVEL
    assert stats.kstest(rate, "norm").pvalue > LEVEL


def test_afterpulses():
    score = []
    for seed in range(STREAMS):
        found = inspect_arrivals(arrivals(seed, afterpulses=0.03))
        assert found.afterpulse_probability > 0.0
        assert found.dead_time_ns == pytest.approx(DEAD_NS, abs=10.0 * found.dead_time_error_ns)
        seen = 0.03 * -np.expm1(-(found.afterpulse_until_ns - DEAD_NS) / TAU_NS)  # until that age
        score.append((found.afterpulse_probability - seen) / found.afterpulse_error)
    assert 2.0 * stats.norm.sf(abs(np.mean(score)) * np.sqrt(STREAMS)) > LEVEL
    assert stats.chi2.sf(float(np.var(score, ddof=1)) * (STREAMS - 1), STREAMS - 1) > LEVEL


def test_a_jitter_blurs_the_edge():
    middle, width = [], []
    for seed in range(STREAMS):
        found = inspect_arrivals(arrivals(seed, jitter_ns=1.0, number=200_000))
        assert found.afterpulse_probability == 0.0
        middle.append((found.dead_time_ns - DEAD_NS) / found.dead_time_error_ns)
        width.append(found.jitter_ns)
    assert 2.0 * stats.norm.sf(abs(np.mean(middle)) * np.sqrt(STREAMS)) > LEVEL
    assert np.mean(width) == pytest.approx(1.0, abs=5.0 * np.std(width, ddof=1) / np.sqrt(STREAMS))
    assert np.std(width, ddof=1) < 0.15


def test_a_coarse_clock():
    """1 ns: the dead time between two units by how their intervals are shared; 100 ns: not known, and said."""
    score = []
    for seed in range(12):
        found = inspect_arrivals(arrivals(seed, unit_ns=1.0, number=400_000), unit_ns=1.0)
        assert found.dead_time_error_ns < 0.1
        assert found.problems == ()
        score.append((found.dead_time_ns - DEAD_NS) / found.dead_time_error_ns)
    assert abs(np.mean(score)) < 1.0
    assert np.std(score) < 1.5
    found = inspect_arrivals(arrivals(1, unit_ns=100.0, afterpulses=0.02), unit_ns=100.0)
    assert np.isnan(found.dead_time_ns)
    assert np.isnan(found.afterpulse_probability)
    assert any("the clock's unit of 100 ns is too coarse" in text for text in found.unknown)


def test_what_is_no_constant_light():
    random = np.random.default_rng(5)
    pulsed = np.sort(random.integers(0, 100_000, 50_000) * 50.0 + random.normal(20.0, 0.5, 50_000))
    kept = [pulsed[0]]
    for time in pulsed[1:]:
        if time - kept[-1] > DEAD_NS:
            kept.append(time)
    told = " ".join(inspect_arrivals(np.asarray(kept)).problems)
    assert "repeat every 49.99" in told or "repeat every 50" in told
    half = arrivals(1)
    drift = np.concatenate([half, half[-1] + np.cumsum(DEAD_NS + random.exponential(700.0, NUMBER))])
    assert any("the rate is not constant" in text for text in inspect_arrivals(drift).problems)
    assert any(
        "shorter than the dead time of 60 ns" in text for text in inspect_arrivals(half, dead_time_ns=60).problems
    )
    with pytest.raises(ValueError, match="must have 100 intervals at least"):
        inspect_arrivals([1.0, 2.0])


def test_the_command_needs_no_period(tmp_path):
    path = tmp_path / "dark.npz"
    np.savez(path, times_ps=np.round(1e3 * arrivals(3, afterpulses=0.03)).astype(np.int64))
    runner = CliRunner()
    for command in ("inspect", "calibrate"):
        told = runner.invoke(app, [command, str(path)])
        assert told.exit_code == 0, told.output
        for words in ("none told: arrivals over", "dead time", "afterpulses", "give --period-ns"):
            assert words in told.output, words
    told = runner.invoke(app, ["calibrate", str(path), "-o", str(tmp_path / "a.yaml")])
    assert told.exit_code == 2
    assert "needs a laser period" in told.output
    assert runner.invoke(app, ["inspect", str(path), "--period-ns", "50"]).exit_code == 0
