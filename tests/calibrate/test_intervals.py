"""What a stream tells without a model, against sums taken photon by photon."""

from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np
import pytest

import mars_lidar as ml
from mars_lidar.calibrate import summary
from mars_lidar.calibrate.armed_time import ArmedTime, armed_time
from mars_lidar.calibrate.calibration_fit import log_likelihood
from mars_lidar.calibrate.intervals import stream_of

PULSE = ml.GaussianPulse(sigma_ns=4.0)


def stream(dead_ns: float, start: str = "armed", cycles: int = 40, seed: int = 5, pixels: int = 1) -> ml.Timestamps:
    system = ml.System(
        period_ns=100.0, cycles=cycles, bins=16, pulse=PULSE, detector=ml.Detector(dead_time_ns=dead_ns), start=start
    )
    return ml.simulate_timestamps(ml.Flux(np.full((1, pixels), 0.6), 0.7, 97.0), system, seed=seed)


def watched(times: ml.Timestamps, hold_ns: float) -> list[tuple[float, float, bool]]:
    """Stretches of watching of one pixel, one by one: begin, end, and whether a photon ended it."""
    out = []
    begin = 0.0 if times.system is not None and times.system.start == "armed" else None
    for t in times.times_ns:
        if begin is not None and t > begin:
            out.append((begin, t, True))
        begin = t + hold_ns
    if begin is not None and times.cycles * 100.0 > begin:
        out.append((begin, times.cycles * 100.0, False))
    return out


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(("dead_ns", "hold_ns"), [(0.0, 0.0), (37.0, 37.0), (37.0, 60.0), (230.0, 230.0), (9.0, 212.5)])
def test_armed_passes_are_those_of_a_fine_clock(dead_ns, hold_ns, start):
    times = stream(dead_ns, start)
    bins, ticks = 16, 400
    passes, events = np.zeros(bins), np.zeros(bins)
    tick = 100.0 / (bins * ticks)
    middle = (np.arange(times.cycles * bins * ticks) + 0.5) * tick
    for begin, end, photon in watched(times, hold_ns):
        inside = middle[(middle >= begin) & (middle < end)]
        passes += np.bincount(((inside % 100.0) / 100.0 * bins).astype(int), minlength=bins) / ticks
        if photon:
            events[int(end % 100.0 / 100.0 * bins)] += 1
    found = armed_time(stream_of(times), hold_ns, bins)
    stretches = len(watched(times, hold_ns))
    assert found.passes == pytest.approx(passes, abs=2.5 * stretches / ticks)
    assert np.abs(found.passes - passes).mean() <= 1.0 / ticks * np.sqrt(stretches)
    assert np.array_equal(found.registrations, events)
    assert found.used == events.sum()
    assert found.used + found.left_out == len(times)


def test_the_likelihood_is_that_of_the_point_process():
    times = stream(37.0)
    bins = 2**17
    rate = 0.6 * PULSE.bin_energy(97.0, 100.0, bins) + 0.7 / bins

    def light(t):
        return 0.6 * PULSE.wrapped_cumulative(np.asarray(t) - 97.0, 100.0) + 0.7 * np.asarray(t) / 100.0

    def density(t):
        return (light(t + 1e-3) - light(t - 1e-3)) / 2e-3 * 100.0 / bins  # photons in a bin's width

    stretches = watched(times, 37.0)
    expected = sum(float(np.log(density(end))) for _, end, photon in stretches if photon)
    expected -= sum(float(light(end) - light(begin)) for begin, end, _ in stretches)
    found = log_likelihood(armed_time(stream_of(times), 37.0, bins), rate)
    assert found == pytest.approx(expected, abs=2e-3)


def test_pieces_add_up_and_empty_ones_count():
    many = stream(37.0, pixels=300, cycles=1)
    assert (many.counts == 0).any()
    together = armed_time(stream_of(many, pooled=True), 37.0, 8)
    parts = [armed_time(stream_of(many.pixel(0, k)), 37.0, 8) for k in range(300)]
    listed = armed_time(stream_of([many.pixel(0, k) for k in range(300)]), 37.0, 8)
    for total in (sum(part.passes for part in parts), listed.passes):
        assert together.passes == pytest.approx(total)
    assert np.array_equal(together.registrations, sum(part.registrations for part in parts))


def test_no_light_leaves_no_likelihood():
    seen = ArmedTime(np.array([1.0, 0.0]), np.ones(2), 1, 0, 0.0)
    assert log_likelihood(seen, np.array([0.0, 1.0])) == -np.inf
    assert seen.rate.tolist() == [1.0, 0.0]


def test_summary():
    times = stream(37.0, cycles=2000)
    found = summary(times)
    dt = np.sort(np.diff(times.times_ns))
    assert found.smallest_ns == pytest.approx(dt[:20])
    assert found.quantiles_ns == pytest.approx(np.quantile(dt, (0.01, 0.5, 0.99)))
    assert found.per_period == len(times) / 2000
    assert found.rate_per_s == pytest.approx(len(times) / 2000e-7)
    assert found.same_time == 0


def test_a_coarse_clock_is_spread_only_where_it_must(tmp_path):
    """Units that fill the bins evenly stay; else some bins would hold a unit more."""
    times = dataclasses.replace(stream(37.0, cycles=5000), info={"unit_ns": 100.0 / 48})
    units = np.floor(times.times_ns / (100.0 / 48))
    times = dataclasses.replace(times, times_ns=(units + 0.5) * (100.0 / 48))
    even = stream_of(times)
    assert even.units == 48
    assert even.pieces[0].times_ns is not None
    assert np.array_equal(even.pieces[0].times_ns, times.times_ns)
    uneven = stream_of(dataclasses.replace(times, bins=20))
    assert uneven.units == 0
    moved = uneven.pieces[0].times_ns - times.times_ns
    assert 0.4 * 100 / 48 < np.abs(moved).max() <= 0.5 * 100 / 48
    if importlib.util.find_spec("ptufile") is not None:
        stream(37.0, cycles=5000).save(tmp_path / "own.ptu")
        assert stream_of(ml.Timestamps.load(tmp_path / "own.ptu")).units == 2**15
    assert stream_of(stream(37.0)).units == 0


def test_bad_input():
    two = stream(37.0, pixels=2)
    with pytest.raises(ValueError, match=r"one pixel, got 1 x 2.*pooled=True"):
        stream_of(two)
    with pytest.raises(TypeError, match="times must be Timestamps"):
        stream_of([1, 2])
    with pytest.raises(TypeError, match="times must be Timestamps"):
        stream_of([])
    with pytest.raises(ValueError, match="laser period"):
        stream_of(dataclasses.replace(two, period_ns=np.nan))
    with pytest.raises(ValueError, match="share period and bins"):
        stream_of([two.pixel(0, 0), dataclasses.replace(two.pixel(0, 1), bins=32)])
