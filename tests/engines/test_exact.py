"""The exact engine by itself: random numbers, extremes of flux, dead time and exposure."""

import numpy as np
import pytest
from harness.cases import Case, flux_of, make_system, two_lobes
from harness.check import EVERYTHING, check
from harness.laws import armed_count_pmf
from harness.ledger import require
from harness.pvalues import counts_against_law, goodness
from native_emulation import threefry, words_of_key
from scipy import stats

import mars_lidar as ml
from mars_lidar.engines import ENGINES
from mars_lidar.instrument.tolerances import TOL

GAUSSIAN = ml.GaussianPulse(sigma_ns=1.0)
LONGEST = TOL.cycles


def system(**changes: object) -> ml.System:
    """Period 100 ns, bins of a quarter of the pulse's sigma."""
    return make_system(50.0, 1000, 400, pulse=GAUSSIAN).replace(**changes)


def dead(periods: float) -> ml.Detector:
    return ml.Detector(dead_time_ns=100.0 * periods)


@pytest.mark.full
@pytest.mark.parametrize(
    ("counter", "key", "rounds", "expected"),
    [
        ((0, 0), (0, 0), 20, (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, 20, (0x1CB996FC, 0xBB002BE7)),
        ((0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344), 20, (0xC4923A9C, 0x483DF7A0)),
        ((0, 0), (0, 0), 13, (0x9D1C5EC6, 0x8BD50731)),
    ],
)
def test_threefry_known_answers(counter, key, rounds, expected):
    """Random123's kat_vectors (Salmon et al. 2011)."""
    assert threefry(counter, key, rounds) == expected


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ((0, 0), [0x514676C3, 0x08A809DF, 0x30349D2B, 0xFB52C520]),
        ((0x243F6A88, 0x85A308D3), [0x6A16794C, 0x44D5F881, 0xA32282E9, 0xDD93E1AE]),
        ((0xFFFFFFFF,) * 2, [0xC7053320, 0xDB48177E, 0xB7B300C7, 0x8D4E1C21]),
    ],
)
def test_words_of_a_key_known_answers(key, expected):
    """Those of `sfc32::seed(Uint64)` in PractRand itself, the key as one number, the first word low."""
    assert words_of_key(key, 4) == expected


# Dim pixels: waits of millions of periods


@pytest.mark.parametrize("photons", [1e-6, 1e-3, 0.01])
def test_phases_of_a_dim_background_have_no_lattice(photons: float):
    view = system(cycles=int(100 / photons), bins=4096)
    times = ml.simulate_timestamps(ml.Flux(np.zeros((1, 15_000)), photons, 0.0), view, seed=1)
    n, mean = len(times), 1.5e6 / (1.0 + 0.5 * photons)
    phase = times.times_ns / 100.0 - times.cycle
    require(
        {
            "number": 2 * stats.norm.sf(abs(n - mean) / np.sqrt(mean)),
            "phases over 4096 bins": goodness(np.bincount(times.bin, minlength=4096), np.full(4096, n / 4096)),
            "cycles": goodness(np.bincount(times.cycle // (view.cycles // 500), minlength=500), np.full(500, n / 500)),
            # 16 cells inside each 2^-16 of a period: what a coarse wait would leave empty
            "fine phases": goodness(np.bincount((phase * 2**20).astype(int) % 16, minlength=16), np.full(16, n / 16)),
            "parity of the cycle": stats.binomtest(int((times.cycle % 2).sum()), n).pvalue,
        },
        f"background of {photons:g} photons per period",
    )


@pytest.mark.parametrize("photons", [1e-6, 1e-3])
@pytest.mark.parametrize("name", ["gaussian", "lobes", "waveform"])
def test_phases_of_a_dim_signal_have_no_lattice(name: str, photons: float):
    pulse = {"gaussian": ml.GaussianPulse(sigma_ns=5.0), "lobes": ml.SampledPulse(two_lobes(), 0.8, "first")}.get(name)
    view = system(cycles=int(100 / photons), pulse=pulse or GAUSSIAN, bins=1)
    if name == "waveform":
        wave = two_lobes()
        flux = ml.Flux(waveform=np.broadcast_to(wave / wave.sum() * photons, (1, 15_000, 120)))
    else:
        flux = ml.Flux(np.full((1, 15_000), photons), 0.0, 30.0)
    times = ml.simulate_timestamps(flux, view, seed=2)
    phase = times.times_ns - 100.0 * times.cycle
    if name == "waveform":
        below = np.interp(phase, np.linspace(0, 100, 121), np.concatenate([[0.0], np.cumsum(wave)]) / wave.sum())
    else:
        below = pulse.wrapped_cumulative(phase - 30.0, 100.0) - pulse.wrapped_cumulative(-30.0, 100.0)
    n = len(times)
    cells = np.minimum((below * 1024).astype(int), 1023)
    require(
        {
            "number": 2 * stats.norm.sf(abs(n - 1.5e6) / np.sqrt(1.5e6)),
            "energy over 1024 cells": goodness(np.bincount(cells, minlength=1024), np.full(1024, n / 1024)),
        },
        f"{name} of {photons:g} photons per period",
    )


@pytest.mark.parametrize("cycles", [100_000_000, LONGEST])
@pytest.mark.parametrize("t_d", [0.0, 0.6, 200.9])
def test_long_exposures(cycles: int, t_d: float):
    """100 photons in an exposure: the whole count law, where cycles are counted in hundreds of millions."""
    rate = 100.0 / cycles
    view = system(cycles=cycles, bins=8, detector=dead(t_d))
    counts = ml.simulate(ml.Flux(np.zeros((100, 200)), rate, 0.0), view, seed=4).sum(-1)
    require({"count law": counts_against_law(counts, armed_count_pmf(rate, t_d, cycles, 220))}, f"{cycles} cycles")


@pytest.mark.parametrize("t_d", [1e-3, 0.6375, 5.0, 200.9, 1000.25])
@pytest.mark.parametrize("rate", [0.3, 1000.0])
def test_count_law_at_extreme_dead_times(rate: float, t_d: float):
    cycles = 10 if t_d < 1 and rate > 1 else 2009
    view = system(cycles=cycles, bins=8, detector=dead(t_d))
    counts = ml.simulate(ml.Flux(np.zeros((50, 40)), rate, 0.0), view, seed=4).sum(-1)
    most = int(min(rate * cycles * 2 + 100, cycles / t_d + 2))
    law = armed_count_pmf(rate, t_d, cycles, most)
    require({"count law": counts_against_law(counts, law)}, f"rate {rate:g}, dead time {t_d:g}")


@pytest.mark.full
@pytest.mark.parametrize("t_d", [0.0, 0.1, 0.6375, 3.0])
def test_a_thousand_photons_per_period(t_d: float):
    """Such a signal registers at -3 sigma and earlier, such a background within a thousandth of a period."""
    case = Case(f"flux 2000, t_d {t_d:g}", flux_of(1000.0, 1000.0), system(cycles=4, detector=dead(t_d)), 600)
    check(ENGINES["exact"], case, ENGINES["sequential"], EVERYTHING)


# Nothing, little, a great many


@pytest.mark.parametrize("cycles", [1000, LONGEST])
def test_no_photons_no_counts(cycles: int):
    nothing = ml.Flux(np.zeros((2, 3)), 0.0, np.nan)
    for start in ("armed", "stationary"):
        for t_d in (0.0, 0.5, 7.0):
            view = system(start=start, detector=dead(t_d), cycles=cycles, bins=4)
            assert not ml.simulate(nothing, view).any()
            assert not ml.simulate(ml.Flux(waveform=np.zeros(9)), view).any()
            assert len(ml.simulate_timestamps(nothing, view)) == 0


def test_dark_pixels_among_bright_ones_stay_dark():
    signal = np.zeros((8, 16))
    signal[::2, ::3] = 50.0
    cube = ml.simulate(ml.Flux(signal, 0.0, 30.0), system(cycles=300), realizations=2)
    assert np.array_equal(cube.sum((0, -1)) > 0, signal > 0)


def test_without_background_all_is_in_the_pulse():
    cube = ml.simulate(ml.Flux(np.full((4, 8), 3.0), 0.0, 50.0), system())
    assert cube[..., 160:240].sum() == cube.sum() > 0  # +-10 sigma
    lobes = system(pulse=ml.SampledPulse(two_lobes(), 0.5, "first"), bins=200)
    cube = ml.simulate(ml.Flux(np.full((4, 8), 3.0), 0.0, 20.0), lobes)
    dark = lobes.pulse.bin_energy(20.0, 100.0, 200) == 0
    assert dark.sum() > 60
    assert not cube[..., dark].any()  # the gap of the pulse included


def test_pulse_wraps_into_both_neighbouring_periods():
    """At delay 0 half of the pulse is at the end of the period; the same at any whole number of periods."""
    view = system(detector=dead(0.0))
    half = ml.simulate(ml.Flux(np.full((10, 10), 1.0), 0.0, 0.0), view)
    early, late = half[..., :200].sum(), half[..., 200:].sum()
    require({"halves": stats.binomtest(int(early), int(early + late)).pvalue}, "wrapped pulse")
    for whole in (100.0, -100.0, 4200.0):
        assert np.array_equal(half, ml.simulate(ml.Flux(np.full((10, 10), 1.0), 0.0, whole), view))


def test_dead_time_is_kept():
    for t_d in (0.01, 0.6375, 1.0, 3.2, 40.9):
        for start in ("armed", "stationary"):
            view = system(detector=dead(t_d), start=start, cycles=3000)
            times = ml.simulate_timestamps(ml.Flux([[3.0, 30.0]], 0.5, 20.0), view, seed=1)
            for x in range(2):
                gap = np.diff(times.pixel(0, x).times_ns) / 100.0
                assert gap.min() >= t_d - 3e-7  # phases are float32
                assert gap.min() < t_d + 0.6  # and it is not much more than that


def test_counts_beyond_uint16():
    """4000 registrations of one bin a period: uint16 would wrap after 17 of them."""
    view = system(cycles=40, bins=1, detector=ml.Detector(dead_time_ns=0.0125))
    assert view.histogram_dtype == np.uint32
    count = ml.simulate(ml.Flux(0.0, 4000.0), view, seed=1).item()
    x = 4000.0 * 0.000125
    mean, variance = 160_000 / (1 + x), 160_000 / (1 + x) ** 3
    require({"count": 2 * stats.norm.sf(abs(count - mean) / np.sqrt(variance))}, "uint32")


def test_histogram_type_changes_where_a_bin_could_overflow():
    """A dead time longer than a bin: one registration per period and bin."""
    assert system(cycles=65_535).histogram_dtype == np.uint16
    assert system(cycles=65_536).histogram_dtype == np.uint32
    locked = system(cycles=65_536, bins=1, detector=dead(1.0 - 1e-4), pulse=ml.GaussianPulse(sigma_ns=1e-3))
    count = ml.simulate(ml.Flux(1000.0, 0.0, 50.0), locked).item()
    assert count == 65_536
