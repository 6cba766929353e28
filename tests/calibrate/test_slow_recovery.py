"""Streams of pixels that recover slowly: the likelihood with their sensitivity, what `inspect` tells, `validate`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness import require
from scipy import stats

import mars_lidar as ml
from mars_lidar.calibrate import inspect, inspect_arrivals
from mars_lidar.calibrate.armed_time import Sensitivity, armed_time
from mars_lidar.calibrate.intervals import Piece, Stream, stream_of
from mars_lidar.calibrate.slow_recovery import slow_recovery

PERIOD_NS = 100.0


def stream(signal: float, background: float, cycles: int, seed: int, **detector: float) -> ml.Timestamps:
    system = ml.System(
        period_ns=PERIOD_NS,
        cycles=cycles,
        bins=256,
        pulse=ml.GaussianPulse(sigma_ns=0.5),
        detector=ml.Detector(**detector),  # type: ignore[arg-type]
    )
    return ml.simulate_timestamps(ml.Flux(signal, background, 37.0), system, seed=seed)


def bare(times: ml.Timestamps) -> ml.Timestamps:
    return replace(times, info={name: value for name, value in times.info.items() if name != "system"})


@pytest.mark.parametrize("recovery_ns", [0.05, 3.0, 70.0, 5e4])
@pytest.mark.parametrize("hold_off_ns", [30.0, 41.5])
@pytest.mark.parametrize("bins", [1, 5, 32])
def test_passes_are_weighted_by_the_sensitivity(recovery_ns: float, hold_off_ns: float, bins: int):
    """Against sums of integrals over every pass of every bin, one by one."""
    random = np.random.default_rng(3)
    times = np.cumsum(31.0 + random.exponential(90.0, 12))
    pieces = (Piece(times, times[-1] + 410.0, True), Piece(times[:4] + 7.0, times[3] + 20.0, False))
    law = Sensitivity(30.0, recovery_ns)
    seen = armed_time(Stream(pieces, PERIOD_NS, 20, bins, 0.0, 0), hold_off_ns, bins, law)
    width, expected = PERIOD_NS / bins, np.zeros(bins)
    for piece in pieces:
        stretches = [
            (t, t + hold_off_ns, e) for t, e in zip(piece.times_ns, [*piece.times_ns[1:], piece.end_ns], strict=True)
        ]
        if piece.armed:
            stretches.append((-np.inf, 0.0, piece.times_ns[0]))
        for since, opens, closes in stretches:
            for number in range(int(opens // width), int(closes // width) + 1):
                a, b = max(opens, number * width), min(closes, (number + 1) * width)
                if b > a:
                    fades = [np.exp(-(t - since - 30.0) / recovery_ns) for t in (a, b)]
                    expected[number % bins] += (b - a - recovery_ns * (fades[0] - fades[1])) / width
    np.testing.assert_allclose(seen.passes, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("signal", "background", "dead", "recovery"),
    [(0.5, 0.3, 40.0, 20.0), (2.0, 1.0, 250.0, 60.0), (3.0, 0.2, 0.0, 9.0)],
)
def test_the_light_is_unbiased_and_its_errors_hold(signal: float, background: float, dead: float, recovery: float):
    """Mean of the standard scores, and their squares by chi-square, of 40 streams."""
    scores = []
    for seed in range(40):
        found = ml.calibrate(stream(signal, background, 20_000, seed, dead_time_ns=dead, recovery_ns=recovery))
        assert found.converged
        assert not found.simulated  # the likelihood is exact
        scores.append((found.parameters[:3] - [background, signal, 37.0]) / np.sqrt(np.diag(found.covariance)[:3]))
    each = np.array(scores)
    p = {f"mean {k}": float(2 * stats.norm.sf(abs(each[:, k].mean()) * np.sqrt(40))) for k in range(3)}
    square = (each**2).sum(0)
    p |= {f"spread {k}": float(2 * min(stats.chi2.cdf(square[k], 40), stats.chi2.sf(square[k], 40))) for k in range(3)}
    require(p, f"{signal}, {background}, {dead}, {recovery}")


def test_a_free_shape_and_another_effect():
    times = stream(1.0, 0.5, 100_000, 5, dead_time_ns=40.0, recovery_ns=20.0)
    free = ml.calibrate(times, pulse="free")
    assert abs(free.total - 1.5) < 5.0 * free.total_error
    jittered = replace(ml.System.from_dict(times.info["system"]).detector, jitter=ml.Jitter(sigma_ns=0.1))
    system = ml.System.from_dict(times.info["system"]).replace(detector=jittered)
    times = ml.simulate_timestamps(ml.Flux(1.0, 0.5, 37.0), system, seed=6)
    found = ml.calibrate(times)  # by simulation, as the likelihood of both is not known
    assert found.simulated
    errors = np.sqrt(np.diag(found.covariance)[:3])
    assert (np.abs(found.parameters[:3] - [0.5, 1.0, 37.0]) < 5.0 * errors).all()


@pytest.mark.parametrize(
    ("dead", "recovery", "cycles", "known"),
    [(250.0, 60.0, 80_000, False), (40.0, 5.0, 60_000, False), (40.0, 20.0, 60_000, True), (40.0, 5.0, 30_000, True)],
)
def test_inspect_tells_the_time_constant(dead: float, recovery: float, cycles: int, known: bool):
    times = stream(0.5, 1.0, cycles, 1, dead_time_ns=dead, recovery_ns=recovery)
    found = inspect(times, dead_time_ns=dead if known else None)
    assert found.slow is not None
    assert abs(found.slow.recovery_ns - recovery) < 5.0 * found.slow.recovery_error_ns < recovery
    assert abs(found.slow.dead_time_ns - dead) < 0.05 * recovery
    assert str(found.slow) in found.problems
    assert "recovery_ns of the detector" in str(found.slow)
    light = found.calibration
    if not known:  # the dead time, and the light, of a pixel that recovers so
        assert light.edge_fits
        assert light.dead_time_by == "recovery"
        assert abs(light.dead_time_ns - dead) < 5.0 * light.dead_time_error_ns < recovery
        assert abs(light.total - 1.5) < 5.0 * light.total_error < 0.1
        assert not found.unknown


@pytest.mark.parametrize(
    "detector",
    [
        {"dead_time_ns": 40.0},
        {"dead_time_ns": 40.0, "jitter": ml.Jitter(sigma_ns=1.0)},
        {"dead_time_ns": 30.0, "electronics_dead_time_ns": 45.0},
        {"dead_time_ns": 40.0, "mode": "paralyzable"},
        {"dead_time_ns": 40.0, "afterpulsing": ml.Afterpulsing(probability=0.2, delay_ns=30.0)},
    ],
    ids=lambda told: ", ".join(told),
)
def test_inspect_takes_nothing_else_for_a_recovery(detector: dict):
    times = stream(0.5, 0.7, 150_000, 1, **detector)
    found = inspect(times)
    assert found.slow is None
    assert not any("sensitivity" in text for text in found.problems)


def test_inspect_arrivals_tells_it():
    """Constant light, no laser."""
    times = stream(0.0, 0.6, 100_000, 2, dead_time_ns=30.0, recovery_ns=8.0)
    (told,) = inspect_arrivals(times.times_ns).problems
    assert told.startswith("a slow recovery: the sensitivity returns as 1 - exp(-u / r), r = ")
    found = slow_recovery(Stream((Piece(times.times_ns, 1e7, False),), PERIOD_NS, 1, 1, 0.0, 0))
    assert found is not None
    assert abs(found.recovery_ns - 8.0) < 5.0 * found.recovery_error_ns < 2.0
    assert slow_recovery(stream_of(stream(0.0, 0.6, 300, 2, dead_time_ns=30.0))) is None  # too few


@pytest.mark.parametrize(
    ("signal", "background", "dead", "recovery"),
    [(0.5, 0.3, 40.0, 20.0), (2.0, 1.0, 250.0, 60.0), (0.5, 2.0, 40.0, 5.0)],
)
def test_validate_rejects_without_it_and_accepts_with_it(
    signal: float, background: float, dead: float, recovery: float
):
    times = stream(signal, background, 60_000, 1, dead_time_ns=dead, recovery_ns=recovery)
    told = ml.System.from_dict(times.info["system"])
    plain = told.replace(detector=told.detector.without("recovery_ns"))
    unknown = bare(times)
    refused = ml.validate(unknown, ml.calibrate(unknown, plain), cycles=500, simulated=500)
    assert not refused.consistent
    assert {"recovery, chi²"} <= {check.name for check in refused.failed}
    light = ml.calibrate(unknown, told)
    assert ml.validate(unknown, light, cycles=500, detector=told.detector, simulated=500).consistent
    assert ml.validate(times, cycles=500, simulated=500).consistent  # by the system that the stream tells
    off = replace(told.detector, recovery_ns=1.5 * recovery)
    wrong = ml.calibrate(unknown, told.replace(detector=off))
    assert not ml.validate(unknown, wrong, cycles=500, detector=off, simulated=500).consistent
