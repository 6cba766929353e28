"""Histograms and joint laws of more bins than the statistics grid: against grids that have a bin for each of them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar.statistics import cells, joint
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.histogram import mean_histogram
from mars_lidar.statistics.tolerances import LAW, TOL

BINS = 150_001  # no grid of a power of two is a multiple of it


def view(dead: float, cycles: int, sigma: float, *, bins: int = BINS, start: Any = "armed") -> ml.System:
    """A system of period 100 ns, its dead time and pulse in periods."""
    return make_system(100.0 * dead, cycles, bins, sigma_ns=100.0 * sigma, start=start)


def spikes() -> np.ndarray:
    """97 steps with a spike ten times as bright as all others, and a dark part."""
    steps = np.random.default_rng(0).exponential(size=97)
    steps[20], steps[3] = 60.0, 0.0
    return 6.0 * steps / steps.sum()


PIXELS = {
    "smooth": (3.0, 0.5, view(0.33, 1000, 0.01), None),
    "warm": (3.0, 0.5, view(0.33, 1000, 0.01, start="stationary"), None),
    "locked": (20.0, 0.5, view(0.93, 3000, 0.003), None),
    "long": (6.0, 1.0, view(0.7, 10**8, 0.01, bins=2**18), None),
    "narrow": (0.3, 0.5, view(0.45, 1000, 1e-4), None),
    "steps": (None, 0.3, view(0.457, 10**6, 0.01), spikes()),
}


def flux_of(name: str) -> ml.Flux:
    """The light."""
    signal, background, _, waveform = PIXELS[name]
    return ml.Flux(signal, background, 33.3) if waveform is None else ml.Flux(waveform=waveform, background=background)


@pytest.mark.full
@pytest.mark.parametrize("name", PIXELS)
def test_mean_histogram(name: str, monkeypatch: pytest.MonkeyPatch):
    """Every bin as on a grid of its own, and the tolerance in total variation."""
    flux, system = flux_of(name), PIXELS[name][2]
    for method in ("exposure", "stationary"):
        result = ml.registration_pdf(flux, system, method)
        with monkeypatch.context() as patch:
            patch.setitem(vars(TOL), "many_bins", 2**20)
            longer = replace(LAW, recursion=1e9, one_pass=1e9)  # a reference may take its time
            patch.setattr("mars_lidar.statistics.histogram.LAW", longer)
            known = ml.registration_pdf(flux, system, method)
        assert 0.5 * np.abs(result - known).sum() < 1e-6
        assert np.abs(result - known).max() < 1e-4 * known.max()


@pytest.mark.full
@pytest.mark.parametrize("name", ["warm", "locked", "steps"])
def test_joint_law(name: str):
    """Variances of windows of one bin and of a fiftieth of the period, of every other bin, and a covariance."""
    flux, system = flux_of(name), PIXELS[name][2]
    n = system.bins
    law = ml.joint_law(flux, system)
    known, _ = joint._refined(Cells.of_flux(flux, system), n, 1e-3)
    assert law.grid_bins < n <= known.grid_bins
    peak = int(np.argmax(known.mean))
    echo = peak + round(system.dead_time_periods % 1.0 * n)
    windows = [np.roll(np.arange(n) < n // 50, start) for start in (peak, echo, n // 7)]
    windows.append(np.roll(np.arange(n) < 1, peak))
    windows.append(np.arange(n) % 2 == 0)
    w = np.array(windows, dtype=float)
    (mean, variance), (true_mean, true_variance) = law.window(w), known.window(w)
    np.testing.assert_allclose(variance, true_variance, rtol=5e-4)
    assert (np.abs(mean - true_mean) < 1e-3 * np.sqrt(true_variance)).all()
    pair = law.covariance_of(w[0], w[1]), known.covariance_of(w[0], w[1])
    assert abs(pair[0] - pair[1]) < 5e-4 * np.sqrt(true_variance[0] * true_variance[1])


def test_short_exposures():
    """An exposure that is run through: windows of whole coarse bins as the law of these bins has them."""
    system = view(3.923, 20, 0.009, bins=2**18)
    law, known = (
        ml.joint_law(ml.Flux(0.465, 2.72, 50.0), system),
        ml.joint_law(ml.Flux(0.465, 2.72, 50.0), system.replace(bins=256)),
    )
    assert law.settled == known.settled == -1
    windows = np.random.default_rng(1).integers(0, 2, (8, 256)).astype(float)
    fine = law.window(np.repeat(windows, 2**10, axis=-1))
    np.testing.assert_allclose(fine, known.window(windows), rtol=1e-3)
    direct = mean_histogram(ml.Flux(0.465, 2.72, 50.0), system)
    assert 0.5 * np.abs(law.mean - direct).sum() < 1e-4 * direct.sum()


def test_light_that_cells_do_not_see():
    """A pulse of many photons within a cell: the histogram has a grid of its own, the joint law says what to use."""
    system = view(0.45, 100, 2e-6)
    cell = Cells.of(8.0, 0.2, system, delay_ns=33.3)
    edges = np.arange(BINS + 1) / BINS
    light = cells.light_before(cell, edges)
    coarse = cells.light_before(cell, np.arange(2**15 + 1) / 2**15)
    assert cells.misplaced(coarse, edges, light) > 0.3
    histogram = mean_histogram(ml.Flux(8.0, 0.2, 33.3), system)
    known = mean_histogram(ml.Flux(8.0, 0.2, 33.3), system.replace(bins=1001))
    assert abs(histogram[: BINS // 2].sum() - known[:500].sum() - 0.5 * known[500]) < 1e-3 * known.sum()
    refused(r"use fewer bins, .*engine 'exact'", ml.joint_law, ml.Flux(8.0, 0.2, 33.3), system, error=ConvergenceError)


def test_covariances_of_all_bins_do_not_fit(monkeypatch: pytest.MonkeyPatch):
    """They say what to use, whatever memory the machine has."""
    monkeypatch.setattr("mars_lidar._base.resources.available_bytes", lambda: 2**36)
    law = ml.joint_law(ml.Flux(0.5, 0.2, 50.0), view(0.45, 100, 0.01))
    for ask in (law.covariance, law.lag, lambda: law.variance):
        refused("window", ask, error=MemoryError)
