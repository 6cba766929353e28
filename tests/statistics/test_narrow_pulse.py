"""Laws of pulses narrower than the bins of their grid, where a pulse meets itself a dead time later: right or refused.

Without background a pixel knows of a pulse's width, and of what the dead time misses of a whole number of periods, only
their ratio: the law of a pulse a thousand times as wide is the same one, on bins that resolve it.
"""

from typing import Any

import numpy as np
import pytest
from harness import require, system_of
from harness.pvalues import variance_score
from scipy import stats

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError, exposure_moments, mean_histogram
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure import refined_moments
from mars_lidar.table.entries import start_phases

PERIOD_NS = 100.0
WIDE = 1e-3
DARK = 1e-9  # background

Figures = tuple[float, float]


def system(
    dead: float, sigma: float, cycles: int = 50, start: str = "armed", mode: str = "nonparalyzable"
) -> ml.System:
    """Times in periods."""
    return system_of(dead, cycles, 2, sigma=sigma, start=start, mode=mode)


def by_count_law(*light: float, view: ml.System, delay_ns: float) -> Figures:
    law = ml.count_law(ml.Flux(*light, delay_ns), view, threads=1)
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-9)
    assert law.pmf @ law.support == pytest.approx(float(law.mean), rel=1e-6)
    return float(law.mean), float(law.variance)


def by_joint_law(*light: float, view: ml.System, delay_ns: float) -> Figures:
    law = ml.joint_law(ml.Flux(*light, delay_ns), view)
    return law.count_mean, law.count_variance


def by_histogram(*light: float, view: ml.System, delay_ns: float) -> Figures:
    return float(mean_histogram(ml.Flux(*light, delay_ns), view, threads=1).sum()), 1.0


def like_a_wide_one(law: Any, signal: float, whole: int, apart: float, sigma: float, **view: str) -> None:
    """The law of a pulse of `sigma` at several places, against that of a wide one; `apart` in sigma."""
    wide = system(whole + apart * WIDE, WIDE, **view)  # type: ignore[arg-type]
    mean, variance = law(signal, DARK, view=wide, delay_ns=50.0)
    narrow = system(whole + apart * sigma, sigma, **view)  # type: ignore[arg-type]
    for delay in (0.5, 0.5 + 2.0 * sigma, 0.3):
        result = law(signal, DARK, view=narrow, delay_ns=delay * PERIOD_NS)
        assert result[0] == pytest.approx(mean, abs=1e-4 * variance**0.5)
        assert result[1] == pytest.approx(variance, rel=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("sigma", [1e-6, 4e-6, 3e-5])
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(("signal", "whole"), [(1.0, 1), (8.0, 1), (8.0, 3)])
@pytest.mark.parametrize("law", [by_count_law, by_joint_law, by_histogram])
def test_dead_time_of_whole_periods(law: Any, signal: float, whole: int, start: str, sigma: float) -> None:
    """The count law has been off by one standard deviation and its variance by 20 %, unflagged, at sigma 1e-6."""
    like_a_wide_one(law, signal, whole, 0.0, sigma, start=start)


@pytest.mark.parametrize("sigma", [1e-6, 4e-6])
@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("whole", [1, 2])
@pytest.mark.parametrize("law", [by_count_law, by_histogram])
def test_whole_periods_paralyzable(law: Any, whole: int, start: str, sigma: float) -> None:
    """The count law's variance has been off by one half."""
    like_a_wide_one(law, 1.0, whole, 0.0, sigma, start=start, mode="paralyzable")


@pytest.mark.parametrize("apart", [0.5, 3.0, -3.0])
def test_near_whole_periods_paralyzable(apart: float) -> None:
    like_a_wide_one(by_histogram, 1.0, 1, apart, 1e-6, mode="paralyzable")


@pytest.mark.full
@pytest.mark.parametrize("sigma", [1e-6, 4e-6, 1e-5])
@pytest.mark.parametrize(("whole", "apart"), [(1, 0.5), (1, 3.0), (1, -40.0), (0, 2.0), (0, 30.0)])
@pytest.mark.parametrize("law", [by_count_law, by_joint_law])
def test_near_whole_periods(law: Any, whole: int, apart: float, sigma: float) -> None:
    """Equal bins must resolve the pulse: where those are too many, a refusal says what to use."""
    refusal = ""
    try:
        like_a_wide_one(law, 1.0, whole, apart, sigma)
    except ConvergenceError as error:
        refusal = str(error)
    assert not refusal or ("engine 'exact'" in refusal and "joint_law" not in refusal)  # which refuses it too


@pytest.mark.parametrize("delay", [0.0, 0.5, 0.5 + 2e-6])
def test_against_photon_by_photon_simulation(delay: float) -> None:
    view, shots = system(1.0, 1e-6), 40_000
    light = 1.5, 0.1, delay * PERIOD_NS
    counts = ml.simulate(ml.Flux(*light), view, engine="sequential", realizations=shots, seed=17).sum(-1).ravel()
    law = exposure_moments(ml.Flux(*light), view)
    mean, variance = float(law.mean), float(law.variance)
    require(
        {
            "mean": 2.0 * stats.norm.sf(abs(counts.mean() - mean) / np.sqrt(variance / shots)),
            "variance": 2.0 * stats.norm.sf(abs(variance_score(counts[:, None], variance)[0])),
        },
        f"a pulse of a millionth of a period at {delay}",
    )


def test_phases_of_a_table() -> None:
    """Where the exposure begins within the narrowest pulse: as the law at that delay has it."""
    view = system(1.0, 1e-6, cycles=200)
    signal, background = np.array([0.5, 2.0]), np.array([0.01, 0.1])
    cells = Cells.of(np.repeat(signal, 2), np.tile(background, 2), view)
    entries = refined_moments(cells, 1, tolerance=1e-4, threads=1)
    phases = start_phases(view, signal, background, entries.cumulants, entries.bins, threads=1)
    text = phases.correction.reshape(4, -1, 4)[:, :, :2]
    for node in range(0, phases.phase.size, 4):
        delay = (0.5 - phases.phase[node]) * PERIOD_NS
        moved = exposure_moments(ml.Flux(cells.signal, cells.background, delay), view).cumulants - entries.cumulants
        assert text[:, node] == pytest.approx(moved[:, :2], abs=1e-3)


def test_narrow_pulses_that_nothing_re_arms_within() -> None:
    """No more bins than before: a dead time apart from whole periods, no dead time, or no light in the pulse."""
    for dead, signal in ((0.5, 1.0), (0.0, 1.0), (1.0, 0.0), (2.3, 1.0)):
        cells = Cells.of(signal, 0.1, system(dead, 1e-6)).resolved(1)
        assert cells.follow == 0
        assert cells.first_bins(1) <= 2**14
