"""The bias of a detector's effects, taken off by simulation: for a fitted width, several returns, a free shape."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from harness import ledger
from scipy import stats

import mars_lidar as ml

PERIOD, BINS, SIGMA, NUMBER = 1e3 / 7.5, 512, 0.5, 4
DETECTORS = {
    "afterpulses": ml.Detector(dead_time_ns=85.0, afterpulsing=ml.Afterpulsing(probability=0.05, delay_ns=100.0)),
    "electronics": ml.Detector(dead_time_ns=50.0, electronics_dead_time_ns=85.0),
    "paralyzable": ml.Detector(dead_time_ns=40.0, mode="paralyzable"),
    "afterpulses, jitter": ml.Detector(
        dead_time_ns=85.0,
        jitter=ml.Jitter(sigma_ns=0.3),
        afterpulsing=ml.Afterpulsing(probability=0.05, delay_ns=100.0),
    ),
}
ROW = np.ones((1, NUMBER))
ONE = ml.Flux(0.8 * ROW, 0.5, 40.0)
TWO = ml.Flux.multi(ml.Flux(0.8 * ROW, 0.0 * ROW, 40.0), ml.Flux(0.3 * ROW, 0.5 * ROW, 46.0))


def streams(detector: ml.Detector, light: ml.Flux, cycles: int = 30_000) -> tuple[ml.System, ml.Timestamps]:
    system = ml.System(
        period_ns=PERIOD, cycles=cycles, bins=BINS, pulse=ml.GaussianPulse(sigma_ns=SIGMA), detector=detector
    )
    return system, dataclasses.replace(ml.simulate_timestamps(light, system, seed=61), info={})


def sides(square: float, number: int) -> float:
    return float(2 * min(stats.chi2.sf(square, number), stats.chi2.cdf(square, number)))


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("kind", ["fitted width", "two returns"])
def test_returns(kind, name):
    detector = DETECTORS[name]
    system, times = streams(detector, TWO if kind == "two returns" else ONE)
    jitter = 0.0 if detector.jitter is None else detector.jitter.std_ns
    if kind == "two returns":
        truth, arguments = [0.5, 0.8, 0.3, 40.0, 46.0], {"returns": 2}
    else:
        truth, arguments = [0.5, 0.8, 40.0, math.hypot(SIGMA, jitter)], {"pulse": "gaussian"}
    scores, plain = [], []
    for k in range(NUMBER):
        found = ml.calibrate(times.pixel(0, k), system, **arguments)
        assert found.converged
        assert found.simulated == 4.0
        scores.append((found.parameters - truth) / np.sqrt(np.diag(found.covariance)))
        without = ml.calibrate(
            times.pixel(0, k),
            dead_time_ns=max(detector.dead_time_ns, 85.0 * (jitter > 0)),
            jitter_ns=jitter,
            **arguments,
        )
        plain.append((without.background - 0.5) / without.errors["background"])
    z = np.array(scores)
    outcomes = {f"bias {k}": float(2 * stats.norm.sf(abs(v) / math.sqrt(NUMBER))) for k, v in enumerate(z.sum(0))}
    outcomes |= {f"scatter {k}": sides(float(v), NUMBER) for k, v in enumerate((z**2).sum(0))}
    ledger.require(outcomes, f"{name} told, {kind}")
    assert abs(np.mean(plain)) > 2.5  # there was a bias to be taken off


@pytest.mark.parametrize("name", DETECTORS)
def test_free_shape(name):
    detector = DETECTORS[name]
    system, times = streams(detector, ONE)
    jitter = 0.0 if detector.jitter is None else detector.jitter.std_ns
    pulse = ml.GaussianPulse(sigma_ns=math.hypot(SIGMA, jitter))
    light = 0.8 * pulse.bin_energy(40.0, PERIOD, BINS) + 0.5 / BINS
    totals, bins = [], np.zeros(BINS)
    for k in range(NUMBER):
        found = ml.calibrate(times.pixel(0, k), system, pulse="free")
        assert found.converged
        assert found.simulated == 4.0
        assert found.waveform is not None
        totals.append((found.total - 1.3) / found.total_error)
        bins += (found.waveform - light) / np.sqrt(1.25 * light / found.armed.passes)
    outcomes = {
        "total": float(2 * stats.norm.sf(abs(sum(totals)) / math.sqrt(NUMBER))),
        "scatter": sides(float(np.square(totals).sum()), NUMBER),
        "bins": sides(float((bins**2).sum() / NUMBER), BINS),
    }
    ledger.require(outcomes, f"{name} told, free shape")


def test_what_was_found_fits(tmp_path):
    detector = DETECTORS["afterpulses, jitter"]
    system, times = streams(detector, ONE, 50_000)
    one = times.pixel(0, 0)
    for arguments in ({"pulse": "gaussian"}, {"pulse": "free"}):
        found = ml.calibrate(one, system, **arguments)
        judged = ml.validate(one, found, cycles=500, detector=detector, simulated=400)
        assert judged.consistent, judged.failed
