"""Pixels locked within one period: pieces of several laps, against the exact engine; and what an image may not hold."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from feedback_cases import GIVEN, Sampler, case, kinds_of
from harness import COUNTS, JOINT, SHAPE, Case, check, make_system, refused, task_of, waveform_flux

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines import ENGINES
from mars_lidar.engines.feedback import Reason

PERIOD_NS = 1e3 / 7.5


def locked(signal: float, background: float, dead: float, cycles: int, sigma: float, bins: int, **changes: Any) -> Case:
    return case(signal, background, dead, cycles, sigma=sigma, bins=bins, **changes)


LOCKED = {  # feedback failed in all of them before it had laps
    "S 8, dead time 0.93": locked(8.0, 1.0, 0.93, 20_000, 0.00375, 64),
    "S 4.6, B 7.7, dead time 0.964": locked(4.6, 7.7, 0.964, 100_003, 0.0032, 16, items=800),
    "S 6.94, dead time 0.887": locked(6.94, 1.45, 0.887, 20_003, 0.0064, 16),
    "S 20, dead time 0.97": locked(20.0, 2.0, 0.97, 20_000, 0.00375, 64, start="stationary"),
    "S 9, dim background, dead time 0.9": locked(9.0, 0.1, 0.9, 20_000, 0.01, 128),
    "S 67, stationary": locked(66.8, 1.0, 0.766, 20_000, 0.0023, 64, delay=0.98, start="stationary"),
    # counts of a variance of 0 to some, of pixels that keep to every second, third or fourth pulse: none was drawn
    "S 13, dead time 3.49": locked(12.7, 0.017, 3.488, 100_000, 0.003, 64),
    "S 81, dead time 2.77, stationary": locked(81.4, 0.5, 2.773, 100_000, 0.003, 64, start="stationary"),
    "S 13, dead time 1.785, stationary": locked(13.2, 0.03, 1.785, 100_000, 0.003, 64, start="stationary"),
    "S 22, dead time 1.725": locked(22.0, 0.4, 1.725, 100_000, 0.003, 64),
    # bins of less than one count per exposure, fired in bursts by exposures that are out of phase with the others
    "shadow of a bright pulse": locked(76.5, 2.08, 0.887, 100_007, 0.0047, 16, delay=0.66, items=6000),
    # armed again within the pulse; cells were too wide for what it then does
    "S 50, dead time 2.2 sigma": locked(50.0, 0.03, 0.034, 51_458, 0.0154, 128, start="stationary", items=2000),
    "S 100, dead time 5 sigma": locked(100.0, 5.0, 0.25, 20_000, 0.05, 64, delay=0.42, items=2000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", LOCKED)
def test_law_is_that_of_exact(name: str):
    check(Sampler(), LOCKED[name], ENGINES["exact"], {COUNTS, SHAPE, JOINT})


SYSTEM = make_system(0.97 * PERIOD_NS, 1_000_000, 1024, sigma_ns=0.5, period_ns=PERIOD_NS)


BACKGROUND = {  # the total swung for ever in a fifth of such pixels, or they took 0.1 s in laps
    "1.6 periods": case(1.0, 10.0, 1.6, 1_000_000, bins=64, items=2000),
    "1.6 periods, brighter": case(7.0, 18.0, 1.6, 10_000_000, bins=64, items=2000),
    "2.5 periods": case(1.0, 15.0, 2.5, 1_000_000, bins=64, items=2000),
    "below a period": case(5.0, 18.0, 0.7273, 10_000_000, bins=64, items=2000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", BACKGROUND)
def test_bright_background_settles_to_its_joint_law(name: str):
    """Every eigenmode of the covariance: mean and variance, and few exposures that are not drawn by the sweeps."""
    request, report = BACKGROUND[name], dict[str, float]()
    pixel = request.flux[0, 0]
    flux = ml.Flux(np.full((1, request.items), pixel.signal), pixel.background, pixel.delay_ns)
    x = ml.simulate(flux, request.system, engine="feedback", seed=4, report=report)[0, 0].astype(float)
    assert report[GIVEN] <= 0.01 * request.items
    law = ml.joint_law(pixel, request.system)
    size = np.sqrt(law.variance)
    value, mode = np.linalg.eigh(law.covariance() / np.outer(size, size))
    selected = value > 1e-3 * value.max()
    y = ((x - law.mean) / size) @ mode[:, selected] / np.sqrt(value[selected])
    assert np.abs(y.mean(0)).max() < 0.05 + 5.0 / np.sqrt(len(x))
    assert np.abs(y.var(0) - 1.0).max() < 0.05 + 5.0 * np.sqrt(2.0 / len(x))


# The kernel's own word


def statuses(request: Case, laps: int) -> np.ndarray[Any, Any]:
    task = task_of(request, 1, realizations=3)
    out = np.full((task.items, request.system.bins), 7, request.system.histogram_dtype)
    status = np.empty((3, task.pixel_index.size), np.uint8)
    kinds = np.ones(request.system.bins, np.uint8)
    every = np.arange(task.pixel_index.size)
    grids = np.array([every.size]), np.ascontiguousarray(kinds[None]), np.array([laps], np.int32)
    _core.feedback_histogram(task.job, task.pulse, out, every, status, *grids, 1)
    assert (out[(status != Reason.DRAWN).reshape(-1)] == 7).all(), "a refused row is not written"
    return status


def test_the_kernel_asks_for_laps():
    request = LOCKED["S 8, dead time 0.93"]
    asked = statuses(request, 1)
    laps = int(asked[0, 0]) - Reason.LAPS
    assert 3 <= laps <= 64
    assert (asked == asked[0, 0]).all()
    assert (statuses(request, laps) == Reason.DRAWN).all()
    assert (statuses(request, laps + 1) == asked).all(), "no other number than that of the pixel"
    short = replace(request, system=request.system.replace(cycles=2000))
    assert (statuses(short, 1) == Reason.LOCKED_IN_SHORT_EXPOSURE).all()


@pytest.mark.parametrize("laps", [0, 191])
def test_laps_are_checked(laps: int):
    refused("laps must be 1 to 190", statuses, LOCKED["S 8, dead time 0.93"], laps)


def test_reports_count_by_reason():
    report: dict[str, float] = {}
    flux = ml.Flux([[20.0, 1.0, 1.0]], [[2.0, 1.0, 400.0]], 60.0)
    ml.simulate(flux, SYSTEM.replace(cycles=3000), engine="feedback", seed=1, report=report)
    assert report[GIVEN] == 2
    assert report[f"{GIVEN}, locked in short exposure"] == 1
    assert report[f"{GIVEN}, slow sweeps"] == 1
    assert report["exposures drawn again by exact"] == 0


# Light that is constant on parts


def test_smooth_light_needs_no_cuts():
    fog = np.exp(-np.arange(1024) / 300.0) * (1.0 - np.exp(-np.arange(1024) / 40.0))
    request = Case("fog", waveform_flux(fog / fog.sum(), 0.1), case(0, 0, 0.6375, 10_000).system.replace(bins=1024), 1)
    assert (kinds_of(request) == 0).all()


def test_a_pixel_that_re_arms_just_before_the_next_pulse_is_drawn_whatever_the_exposure():
    """1e8 cycles and 14 laps: exact took 0.6 s for each such pixel, because the judged variance had not converged.

    32 exposures; the mean count may be 4.5 standard errors and 0.05 standard deviations off.
    """
    system = make_system(99.6, 100_000_000, 512, sigma_ns=0.1)
    flux, report = ml.Flux(5.824, 4.044, 30.0), {}
    counts = ml.simulate(flux, system, engine="feedback", realizations=32, seed=1, report=report)[:, 0, 0].sum(-1)
    assert report["pixels given to exact"] == report["exposures drawn again by exact"] == 0.0
    law = ml.count_law(flux, system)
    deviation = float(np.ravel(law.variance)[0]) ** 0.5
    assert abs(counts.mean() - float(np.ravel(law.mean)[0])) < (4.5 / 32**0.5 + 0.05) * deviation
