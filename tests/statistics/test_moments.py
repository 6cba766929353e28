"""Exact moments of a finite exposure (docs/theory_exposure.md): closed forms, order, settling, extremes."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from harness import constant_rate_moments, make_system, refused, system_of

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.statistics import ConvergenceError, PhaseChain, joint
from mars_lidar.statistics import cells as cells_module
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.histogram import mean_histogram
from mars_lidar.statistics.moments import exposure_moments, native_light, stationary_histogram
from mars_lidar.statistics.tolerances import LAW, MOMENTS, TOL


def on_grid(signal, background, system, n, *, level="", settle=True, delay_ns=None):
    """Cumulants (4,) on one grid of n bins, and after how many periods they settled."""
    cells = Cells.of(signal, background, system, delay_ns=delay_ns)
    whole = math.floor(system.dead_time_periods)
    position = (system.dead_time_periods - whole) * n
    grid = _core.ExposureGrid(
        cycles=system.cycles,
        max_periods=10**9,
        whole=whole,
        bins=n,
        out_bins=1,
        shift=math.floor(position),
        fraction=position % 1.0,
        stationary=system.start == "stationary",
        tolerance=1e-12 if settle else -1.0,
    )
    cumulants, rates = np.empty((1, 4)), np.empty((1, 4))
    settled = np.empty(1, np.int64)
    _core.exposure_moments(
        grid=grid,
        light=native_light(cells, n),
        cumulants=cumulants,
        cumulant_rates=rates,
        histogram=np.empty((1, 1)),
        histogram_rate=np.empty((1, 1)),
        settled=settled,
        threads=1,
        level=level,
    )
    return cumulants[0], int(settled[0])


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("total", "dead", "cycles"),
    [
        (2.0, 0.6375, 1000),
        (2.0, math.pi / 5, 1000),
        (20.0, 0.3137, 1000),
        (0.01, 2.3, 1000),
        (5.0, 1.7321, 2000),
        (3.0, 0.0123, 100),
        (3.0, 1e-4, 100),
        (30.0, 0.001, 10),
        (1e-6, 0.7, 10**6),
        (0.5, 11.3, 20000),
    ],
)
def test_constant_rate(total, dead, cycles, start):
    result = exposure_moments(ml.Flux(0.0, total), system_of(dead, cycles=cycles, start=start), tolerance=1e-6)
    mean, variance = constant_rate_moments(total, dead, cycles, stationary=start == "stationary")
    assert result.mean == pytest.approx(mean, rel=1e-9)
    assert result.variance == pytest.approx(variance, rel=1e-6)
    np.testing.assert_allclose(result.histogram, mean / 64, rtol=5e-3 if start == "armed" else 1e-9)
    assert result.histogram.sum() == pytest.approx(result.mean, rel=1e-12)


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", [0.6375, 0.633333, 1.62, 2.0])
def test_order_of_convergence(dead, start):
    system = system_of(dead, sigma=0.02, cycles=40, start=start)
    values = np.array([on_grid(3.0, 0.7, system, n, delay_ns=33.3)[0] for n in (64, 128, 256, 2048)])
    errors = np.abs(values[:3, :2] - values[3, :2])
    order = 0.5 * np.log2(errors[0] / errors[2])  # over a factor of four: a single step may cancel errors
    assert (order > 2.9).all(), (order, errors)
    assert (errors[2] < 2e-6).all()


def test_sampled_pulse_converges_at_second_order():
    pulse = ml.SampledPulse(np.array([1.0, 5.0, 2.0, 0.5]), 1.3)
    system = system_of(0.6375, pulse=pulse, cycles=40)
    errors = []
    exact = on_grid(3.0, 0.7, system, 16384, delay_ns=33.3)[0][0]
    for n in (128, 512, 2048):
        errors.append(abs(on_grid(3.0, 0.7, system, n, delay_ns=33.3)[0][0] - exact))
    assert errors[2] < errors[0] / 100
    assert errors[2] < 1e-5


@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_no_dead_time_is_poisson_and_small_ones_lead_there(start):
    system = system_of(0.0, start=start)
    result = exposure_moments(ml.Flux(1.5, 0.5, 30.0), system)
    np.testing.assert_allclose(result.cumulants, 2000.0, rtol=1e-14)
    energy = 1.5 * system.pulse.bin_energy(30.0, 100.0, 64) + 0.5 / 64
    np.testing.assert_allclose(result.histogram, 1000 * energy, rtol=1e-10, atol=1e-12)
    tiny = exposure_moments(ml.Flux(1.5, 0.5, 30.0), system_of(1e-9, start=start))
    np.testing.assert_allclose(tiny.cumulants, 2000.0, rtol=1e-4)
    np.testing.assert_allclose(tiny.histogram, result.histogram, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("whole", [1, 3])
def test_dead_time_of_whole_periods_does_not_distort(whole):
    system = system_of(float(whole), start="stationary", sigma=0.01)
    result = exposure_moments(ml.Flux(2.0, 1.0, 50.0), system)
    rate = (2.0 * system.pulse.bin_energy(50.0, 100.0, 64) + 1.0 / 64) / (1 + 3.0 * whole)
    np.testing.assert_allclose(result.histogram, 1000 * rate, rtol=1e-5, atol=1e-9)


def test_single_registration():
    """An exposure shorter than the dead time registers once or not at all."""
    result = exposure_moments(ml.Flux(0.7, 0.4, 99.9), system_of(5.5, cycles=4))
    p = -math.expm1(-4 * 1.1)
    exact = [p, p * (1 - p), p * (1 - p) * (1 - 2 * p), p * (1 - p) * (1 - 6 * p * (1 - p))]
    np.testing.assert_allclose(result.cumulants, exact, rtol=1e-10)
    assert result.settled == -1


@pytest.mark.parametrize(("dead", "cycles"), [(0.6372, 700), (1.9, 900), (0.0004, 300), (10.9, 20000)])
def test_extrapolation_equals_running_to_the_end(dead, cycles):
    system = system_of(dead, cycles=cycles, sigma=0.02)
    fast, settled = on_grid(2.0, 0.8, system, 128)
    slow, never = on_grid(2.0, 0.8, system, 128, settle=False)
    assert never == -1
    assert settled == -1 or settled >= 3 * (math.floor(dead) + 1)
    np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-9)


def test_settling_is_not_deceived_by_long_dead_times():
    """For t_d = 10.9 periods nothing happens for periods on end, again and again: far from settled."""
    system = system_of(10.9, cycles=100_000, sigma=0.02)
    result, settled = on_grid(2.0, 0.8, system, 128)
    assert settled > 1000
    # many periods blind, then a wait: mean rate 1 / (t_d + mean wait), as the stationary state says
    cells = Cells.of(2.0, 0.8, system)
    rate = stationary_histogram(cells, 1, tolerance=1e-4, threads=1)[0, 0]
    assert result[0] / 100_000 == pytest.approx(rate, rel=1e-4)


def test_millions_of_cycles_by_rates():
    short, long = (exposure_moments(ml.Flux(1.0, 1.0, 50.0), system_of(0.6375, cycles=n)) for n in (10**3, 10**7))
    np.testing.assert_allclose(long.cumulants, short.cumulants + (10**7 - 10**3) * short.cumulant_rates, rtol=1e-9)
    np.testing.assert_allclose(long.histogram, short.histogram + (10**7 - 10**3) * short.histogram_rate, rtol=1e-9)
    assert 0 < short.settled < 100


def test_stationary_start():
    system = system_of(1.6375, start="stationary", bins=128)
    result = exposure_moments(ml.Flux(1.0, 0.5, 30.0), system)
    cells = Cells.of(1.0, 0.5, system, delay_ns=30.0)
    rate = stationary_histogram(cells, 128, tolerance=1e-6, threads=1)[0]
    np.testing.assert_allclose(result.histogram, 1000 * rate, rtol=1e-6)
    chain = PhaseChain.from_flux(ml.Flux(1.0, 0.5, 30.0), system, bins=8192).stationary()
    assert 0.5 * np.abs(chain.pdf.reshape(128, -1).sum(-1) - rate / rate.sum()).sum() < 2e-4
    assert chain.rate == pytest.approx(rate.sum(), rel=1e-5)
    # the mean does not depend on the delay, the shape moves with it; the variance depends on the phase at
    # which the exposure begins and ends, but the more cycles the less
    moved = exposure_moments(ml.Flux(1.0, 0.5, 30.0 + 100.0 * 17 / 128), system)
    assert moved.mean == pytest.approx(result.mean, rel=1e-6)
    assert moved.variance == pytest.approx(result.variance, rel=1e-3)
    np.testing.assert_allclose(moved.cumulant_rates, result.cumulant_rates, rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(moved.histogram, np.roll(result.histogram, 17), rtol=1e-5)
    armed = exposure_moments(ml.Flux(1.0, 0.5, [30.0, 80.0]), system.replace(start="armed"))
    assert abs(armed.mean[0] - armed.mean[1]) > 0.01


def test_locked_pixels_keep_their_digits():
    """Mean 1000, variance 0.045 and below: nothing is lost by cancellation, nothing is negative."""
    values = [on_grid(10.0, 0.1, system_of(0.976562), n)[0] for n in (1024, 2048)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-8)
    assert values[1][1] == pytest.approx(0.045129528, rel=1e-7)
    # almost a Bernoulli variable each period, almost never 0: the cumulants are those of -Poisson
    assert values[1][2] == pytest.approx(-values[1][1], rel=2e-3)
    locked = exposure_moments(ml.Flux(300.0, 1e-3, 50.0), system_of(0.9))
    assert locked.mean == pytest.approx(1000.0, abs=1e-9)
    assert 0.0 <= locked.variance < 1e-11


@pytest.mark.parametrize("level", ["avx2", "avx512"])
def test_vector_levels_agree(level):
    system = system_of(0.6372, cycles=200)
    narrowest = on_grid(1.3, 0.6, system, 256, level=_core.levels()[-1])[0]
    if level not in _core.levels():
        pytest.skip(f"this processor does not run {level}")
    np.testing.assert_allclose(on_grid(1.3, 0.6, system, 256, level=level)[0], narrowest, rtol=1e-11)


def test_convergence_errors_name_the_cell(monkeypatch):
    monkeypatch.setitem(vars(TOL), "most_bins", 256)
    with pytest.raises(ConvergenceError, match=r"S = 200, B = 1 .* still move"):
        exposure_moments(ml.Flux([200.0], 1.0, 50.0), system_of(0.001, bins=1, sigma=0.05), tolerance=1e-8)
    monkeypatch.undo()
    monkeypatch.setattr(cells_module, "MOMENTS", replace(MOMENTS, one_pass=1))
    slow = system_of(1.97, cycles=10**6, bins=1)
    with pytest.raises(ConvergenceError, match=r"S = 10, B = 0.01 .*does not repeat"):
        exposure_moments(ml.Flux(10.0, 0.01, 50.0), slow)


def test_history_that_cannot_fit_is_refused():
    with pytest.raises(MemoryError, match=r"t_d = 900000 periods.*GiB"):
        exposure_moments(ml.Flux(1.0, 1.0, 50.0), system_of(900_000.0, cycles=10**6))


def test_progress_can_stop_the_run():
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        exposure_moments(ml.Flux(np.linspace(0.1, 1, 64), 1.0, 50.0), system_of(0.6), progress=stop)


# Histograms and joint laws of more bins than the statistics grid: against grids that have a bin for each of them.


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
    light = cells_module.light_before(cell, edges)
    coarse = cells_module.light_before(cell, np.arange(2**15 + 1) / 2**15)
    assert cells_module.misplaced(coarse, edges, light) > 0.3
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
