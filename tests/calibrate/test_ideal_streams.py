"""Ideal streams of whatever light, jitter and clock: no false alarm, no small error on a wrong number; faults are told.

The streams of the sweep are the study's (`studies.streams`): every avalanche by the sequential engine, jitter and clock
put on outside of the package's engines.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from harness import ledger
from scipy import stats

import mars_lidar as ml
from mars_lidar.calibrate import inspect
from mars_lidar.calibrate.intervals import stream_of
from mars_lidar.calibrate.same_phase import _passes, same_phase
from studies.streams import cases as streams


def recorded(
    signal: float,
    background: float,
    period: float,
    dead: float,
    sigma: float,
    cycles: int,
    seed: int,
    jitter: float = 0.0,
    **effects: object,
) -> ml.Timestamps:
    """A stream of which nothing is told."""
    if jitter:
        effects["jitter"] = ml.Jitter(sigma_ns=jitter)
    made_by = ml.System(
        period_ns=period,
        cycles=cycles,
        bins=1024,
        pulse=ml.GaussianPulse(sigma_ns=sigma),
        detector=ml.Detector(dead_time_ns=dead, **effects),
    )
    light = ml.Flux(signal, background, 0.3 * period)
    return dataclasses.replace(ml.simulate_timestamps(light, made_by, seed=seed), info={})


def test_bright_pixels_have_no_afterpulses():
    """S = 6.22, B = 1.24 were told afterpulses or a second dead time in 5 of 5 streams."""
    for seed in range(5):
        times = recorded(6.22, 1.24, 119.6, 63.87, 1.61, 26_715, seed)
        assert inspect(times).problems == ()


@pytest.mark.parametrize("given", [None, 85.0])
def test_jitter_is_not_crosstalk(given):
    """Jittered intervals shorter than the dead time were told from 3 standard deviations of a difference on."""
    for seed, jitter in enumerate((0.1, 0.2, 0.5)):
        found = inspect(recorded(0.8, 0.1, 1e3 / 7.5, 85.0, 0.5, 100_000, seed, jitter), dead_time_ns=given)
        assert found.problems == ()
        light = found.calibration
        assert abs(light.jitter_ns - jitter) < 5.0 * light.jitter_error_ns or light.jitter_ns == 0.0
        assert light.jitter_ns > 0.0 or given or light.jitter_limit_ns > jitter


@pytest.mark.parametrize(
    ("share", "signal", "background", "dead"),
    [(0.01, 3.0, 1.0, 60.0), (0.02, 0.5, 0.2, 60.0), (0.03, 3.0, 1.0, 60.0), (0.05, 3.0, 1.0, 60.0)],
)
def test_jitter_of_percents_of_the_period(share, signal, background, dead):
    """Dead times of 54.6 and 31.9 for 60 ns, S and B off by up to 200 errors, converged."""
    found = ml.calibrate(recorded(signal, background, 100.0, dead, 1.0, 60_000, 3, 100.0 * share))
    assert found.dead_time_by == "edge"
    errors = found.errors
    scores = {
        "dead time": (found.dead_time_ns - dead) / found.dead_time_error_ns,
        "jitter": (found.jitter_ns - 100.0 * share) / found.jitter_error_ns,
        "S": (found.signal - signal) / errors["signal"],
        "B": (found.background - background) / errors["background"],
    }
    outcomes = {name: 2.0 * float(stats.norm.sf(abs(z))) for name, z in scores.items()}
    ledger.require(outcomes, f"jitter of {share:g} periods, S = {signal}")


def test_jitter_as_large_as_the_dead_time_is_not_known():
    """Records are out of order: no number of it, and a word, but no fault of the detector."""
    times = recorded(0.3, 4.0, 100.0, 8.0, 1.0, 20_000, 5, 5.0)
    found = ml.calibrate(times)
    assert math.isnan(found.dead_time_error_ns)
    assert all(math.isnan(error) for error in found.errors.values())
    assert any("dead time, jitter and light are not known" in text for text in found.unknown)
    assert inspect(times).problems == ()


def test_passes_are_counted_one_by_one():
    times = recorded(0.8, 0.3, 100.0, 30.0, 5.0, 40, 1).times_ns
    start, dt = times[:-1], np.diff(times)
    edges = np.array([31.0, 50.0, 80.0, 200.0])
    at = np.sort(((start + dt) / 100.0) % 1.0)
    expected = np.zeros((edges.size, at.size))
    for begin, interval in zip(start, dt, strict=True):
        for k, edge in enumerate(edges):
            last = min(interval, edges[k + 1] if k + 1 < edges.size else math.inf)
            if interval > edge:
                passed = 100.0 * (np.arange(60)[:, None] + at)
                expected[k] += ((passed >= begin + edge) & (passed <= begin + last + 1e-9)).sum(0)
    assert np.array_equal(_passes(start, dt, edges, at, 100.0), expected)


def test_scores_of_ages_are_standard_normal():
    """Of the first ages together, bright and dim, with jitter and without, whatever was known of the light: nothing."""
    scores = []
    for k, (signal, background, jitter) in enumerate([(6.0, 1.0, 0.0), (0.5, 0.2, 0.0), (3.0, 1.0, 3.0)] * 6):
        times = recorded(signal, background, 100.0, 60.0, 1.5, 6000, 100 + k, jitter)
        found = same_phase(stream_of(times), 60.0 + 8.5 * jitter + 1e-3, 300.0).first()[0]
        scores.append(found[[8, 20]])
    z = np.array(scores)
    outcomes = {f"age {k}": float(stats.kstest(z[:, k], "norm").pvalue) for k in range(2)}
    ledger.require(outcomes, "same phase")


@pytest.mark.parametrize(
    ("effects", "word"),
    [
        ({"afterpulsing": ml.Afterpulsing(probability=0.2, delay_ns=50.0)}, "afterpulses"),
        ({"electronics_dead_time_ns": 120.0}, "second one"),
    ],
)
def test_faults_are_still_told(effects, word):
    problems = " ".join(inspect(recorded(0.8, 0.3, 1e3 / 7.5, 85.0, 0.5, 250_000, 7, **effects)).problems)
    assert word in problems


def test_a_photon_within_the_dead_time_is_told():
    """Crosstalk in a jittered stream: intervals far below what jitter makes."""
    times = recorded(0.8, 0.3, 1e3 / 7.5, 85.0, 0.5, 60_000, 9, 0.2)
    more = np.sort(np.concatenate([times.times_ns, times.times_ns[::400] + 40.0]))
    place = np.floor(more / times.period_ns)
    wrong = dataclasses.replace(
        times,
        times_ns=more,
        cycle=place.astype(np.int32),
        bin=np.zeros(more.size, np.int32),
        offsets=np.array([0, more.size]),
    )
    assert "shorter than the dead time" in " ".join(inspect(wrong, dead_time_ns=85.0).problems)


def test_a_sweep_of_the_range():
    """Streams drawn over everything, short ones: no false alarm, no error exceeded by far."""
    found = [streams.outcome(one) for one in streams.drawn(16, 29, photons=4000.0)]
    assert [one.alarms for one in found if one.alarms] == []
    pulls = np.abs([value for one in found for value in one.pulls.values() if math.isfinite(value)])
    assert pulls.size > 30
    assert pulls.max() < 6.0
    ledger.require({"within 2": float(stats.binom.cdf(int((pulls < 2.0).sum()), pulls.size, 0.9545))}, "ideal streams")
