"""The exact engine by itself: random numbers, extremes of flux, dead time and exposure, tails, waveforms, starts."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from harness.cases import PERIOD_NS, Case, flux_of, make_system, measured_pulse, two_lobes, waveform_flux
from harness.check import COUNTS, EVERYTHING, SHAPE, check
from harness.laws import Law, armed_count_pmf, first_arrival, law_of, pmf_of
from harness.ledger import require
from harness.pvalues import counts_against_law, goodness, same_law
from native_emulation import threefry, words_of_key
from numpy.typing import NDArray
from scipy import special, stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
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


def test_pulse_wraps_into_both_neighbouring_periods():
    """At delay 0 half of the pulse is at the end of the period; the same at any whole number of periods."""
    view = system(detector=dead(0.0))
    half = ml.simulate(ml.Flux(np.full((10, 10), 1.0), 0.0, 0.0), view)
    early, late = half[..., :200].sum(), half[..., 200:].sum()
    require({"halves": stats.binomtest(int(early), int(early + late)).pvalue}, "wrapped pulse")
    for whole in (100.0, -100.0, 4200.0):
        assert np.array_equal(half, ml.simulate(ml.Flux(np.full((10, 10), 1.0), 0.0, whole), view))


def test_histogram_type_changes_where_a_bin_could_overflow():
    """A dead time longer than a bin: one registration per period and bin."""
    assert system(cycles=65_535).histogram_dtype == np.uint16
    assert system(cycles=65_536).histogram_dtype == np.uint32
    locked = system(cycles=65_536, bins=1, detector=dead(1.0 - 1e-4), pulse=ml.GaussianPulse(sigma_ns=1e-3))
    count = ml.simulate(ml.Flux(1000.0, 0.0, 50.0), locked).item()
    assert count == 65_536


# Tails of pulses and dim light: the exact engine's waits have no lattice, its tails hold to 1e-10 of the energy.
#
# Without background, with a dead time that ends before the next pulse, every pulse is alone: of S photons the first
# is in a bin with the probability e^-F_j - e^-F_(j+1), F_j the photons before the bin's edge.


PERIOD = 100.0
# Sampled pulses begin abruptly; phases are float32, so an edge on a bin's edge would leak 2^-25 of a period.
DELAY = 50.003  # ns
EARLY = np.array([-np.inf, -6.5, -6.0, -5.5, -5.0, -4.5, -4.0])  # sigma
LATE = np.append(-EARLY[:1:-1], np.inf)
GATE: dict[str, Any] = {"mode": "gated", "gate_start_ns": 30.0, "gate_width_ns": 40.0}
MODES: dict[str, dict[str, Any]] = {
    "free running": {},
    "paralyzable": {"mode": "paralyzable"},
    "synchronous": {"mode": "synchronous"},
    "gated": GATE,
    "moving gate": GATE | {"gate_step_ns": 0.3, "gate_cycles": 7_000_000},
    "recorded": {"electronics_dead_time_ns": 45.0},  # through the recorder, which loses nothing here
    "afterpulsing": {"afterpulsing": ml.Afterpulsing(probability=1e-12, delay_ns=10.0)},  # through the traps
}


def tail_system(**changes: Any) -> ml.System:
    """Sigma 1 ns, bins of a quarter of it."""
    return make_system(40.0, 100_000_000, 400).replace(**changes)


def poisson_p(number: float, mean: float) -> float:
    """Two-sided, of a number of rare events."""
    return float(min(1.0, 2 * min(stats.poisson.cdf(number, mean), stats.poisson.sf(number - 1, mean))))


def histogram(flux: ml.Flux, view: ml.System, seed: int) -> NDArray[np.int64]:
    """(bins,) of all pixels together."""
    cube = ml.simulate(flux, view, seed=seed)
    return np.asarray(cube.sum((0, 1, 2), dtype=np.int64))


def windows(hist: NDArray[np.int64], expected: NDArray[np.float64], time: Any, edges: Any) -> dict[str, float]:
    """p-values of the numbers of registrations in windows of the tails; `time` (bins,) and `edges` in sigma."""
    inside = {f"{a:g} to {b:g} sigma": (time > a) & (time < b) for a, b in pairwise(edges)}
    return {name: poisson_p(float(hist[s].sum()), float(expected[s].sum())) for name, s in inside.items()}


def tails(hist: NDArray[np.int64], law: NDArray[np.float64], pulses: float, delay: float = DELAY) -> dict[str, float]:
    """p-values of the tails on either side and of the pulse between them, given the law of one pulse (bins,)."""
    centre = (np.arange(hist.size) + 0.5) * (PERIOD / hist.size) - delay
    core = np.abs(centre) < 4.0
    number, mean = float(hist[core].sum()), pulses * float(law[core].sum())
    p = {"core": float(2 * stats.norm.sf(abs(number - mean) / np.sqrt(mean)))}
    return p | windows(hist, pulses * law, centre, EARLY) | windows(hist, pulses * law, centre, LATE)


# photons of a pulse, and pixels and cycles for some 1e8 registrations, the dimmest 2e6
@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "pixels", "cycles"),
    [
        (1e-6, 20_000, 100_000_000),
        (1e-3, 1000, 100_000_000),
        (0.01, 100, 100_000_000),
        (0.02, 64, 80_000_000),
        (0.23, 64, 8_000_000),
        (1.0, 64, 2_500_000),
        (30.0, 64, 1_500_000),
    ],
)
def test_tails_of_a_dim_pulse(signal: float, pixels: int, cycles: int):
    """Waits of up to a million periods; before, 0.01 photons put hundreds beyond -6 sigma and none in -5.5 to -5."""
    view = tail_system(cycles=cycles)
    law = first_arrival(signal * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, pixels), signal), 0.0, DELAY), view, seed=17)
    require(tails(hist, law, pixels * view.cycles), f"tails, S = {signal:g}")


@pytest.mark.parametrize("signal", [100.0, 1000.0])
def test_early_tail_of_a_blinding_pulse(signal: float):
    """What registers is the tail: of 1000 photons 20 in 1e8 beyond -6.25 sigma; the tables ended once at 6.4."""
    view = tail_system(bins=1600, cycles=1_500_000)
    law = first_arrival(signal * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, 64), signal), 0.0, DELAY), view, seed=23)
    end = int(np.searchsorted(np.cumsum(law), 1e-4))
    expected = 64 * view.cycles * law
    outcomes = {"beyond -4": goodness(hist[:end], expected[:end], fixed_total=False, least=25)}
    outcomes |= windows(hist, expected, view.time_ns - DELAY, (-9.0, -6.5, -6.25, -6.0, -5.5))
    require(outcomes, f"early tail, S = {signal:g}")


STARTS = [(mode, "armed") for mode in MODES] + [
    (mode, "stationary") for mode in ("free running", "paralyzable", "synchronous", "gated")
]


@pytest.mark.full
@pytest.mark.parametrize(("mode", "start"), STARTS)
def test_tails_in_every_mode(mode: str, start: str):
    view = tail_system(detector=ml.Detector(dead_time_ns=40.0, **MODES[mode]), start=start)
    law = first_arrival(0.02 * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, 20), 0.02), 0.0, DELAY), view, seed=5)
    require(tails(hist, law, 20 * view.cycles), f"tails, {mode}, {start}")


@pytest.mark.full
def test_tails_of_several_returns():
    """Each of three, a dead time of 20 ns apart: 5e7 registrations of the first and of the second, 2e7 of the third."""
    view = tail_system(detector=ml.Detector(dead_time_ns=12.0))
    signals, delays = (0.02, 0.02, 0.008), (20.003, 50.003, 80.003)
    flux = ml.Flux.multi(*(ml.Flux(np.full((1, 25), s), 0.0, d) for s, d in zip(signals, delays, strict=True)))
    hist = histogram(flux, view, seed=5)
    for s, d in zip(signals, delays, strict=True):
        energy = view.pulse.bin_energy(d, PERIOD, view.bins)
        near = np.abs(view.time_ns - d) < 13.0
        outcomes = tails(np.where(near, hist, 0), first_arrival(s * energy), 25 * view.cycles, d)
        require(outcomes, f"tails, return at {d:g} ns")


def test_tails_after_a_dead_time_of_one_period():
    """Re-arming at the energy of the registration: uniform energies; before, 471 for 18 of 5.5e9 below -5.8 sigma."""
    view = tail_system(detector=ml.Detector(dead_time_ns=PERIOD), cycles=6_000_000)
    hist = histogram(ml.Flux(np.full((1, 64), 0.6), 0.0, DELAY), view, seed=2)
    law = view.pulse.bin_energy(DELAY, PERIOD, view.bins)
    outcomes = tails(hist, law, float(hist.sum()))
    del outcomes["core"]  # given the total
    require(outcomes, "tails, whole dead time")


@pytest.mark.parametrize("signal", [1.0, 100.0, 1000.0])
@pytest.mark.parametrize("part", [1.2, 1.6, 2.5, 6.0])
def test_armed_in_the_late_tail(signal: float, part: float):
    """Armed each period where `part` times what the engine draws afresh is left of the pulse."""
    remaining = part * min(2.0**-14, 2.0**-8 / signal)
    depth = -special.ndtri(remaining)
    cycles = 1_000_000 if signal == 1.0 else 300_000
    view = tail_system(cycles=cycles, detector=ml.Detector(dead_time_ns=0.0, mode="synchronous"), bins=1000)
    law = first_arrival(signal * view.pulse.bin_energy(PERIOD - depth, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, 64), signal), 0.0, PERIOD - depth), view, seed=4)
    expected = 64 * cycles * law
    require(
        {
            "late tail": goodness(hist[:200], expected[:200], fixed_total=False, least=25),
            "early half": goodness(hist[200:], expected[200:], fixed_total=False, least=25),
        },
        f"armed with {part:g} reaches left, S = {signal:g}",
    )


@pytest.mark.full
@pytest.mark.parametrize("signal", [0.01, 1.0])
def test_faint_parts_of_a_sampled_pulse(signal: float):
    """A pre-pulse of 1e-6 of the energy, one of 1e-7 and an after-pulse of 1e-6; before, 510 for 128 in the first."""
    shape = np.zeros(101)
    shape[[0, 10, 100]] = 1e-6, 1e-7, 1e-6
    shape[40:61] = np.exp(-0.5 * ((np.arange(21) - 10) / 3.0) ** 2)
    shape[40:61] *= (1.0 - 2.1e-6) / shape[40:61].sum()
    pixels = 120 if signal == 0.01 else 64
    view = tail_system(pulse=ml.SampledPulse(shape, 0.2), cycles=100_000_000 if signal == 0.01 else 2_000_000)
    law = first_arrival(signal * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, pixels), signal), 0.0, DELAY), view, seed=12)
    expected = pixels * view.cycles * law
    peak = int(np.argmax(law))
    lit = np.flatnonzero(law > 0)
    first, last = lit[0], lit[-1]
    parts = {
        "pre-pulse": slice(first - 1, first + 3),
        "fainter": slice(first + 4, peak - 30),
        "after-pulse": slice(last - 2, last + 2),
    }
    outcomes = {n: poisson_p(float(hist[s].sum()), float(expected[s].sum())) for n, s in parts.items()}
    outcomes["all"] = float(2 * stats.norm.sf(abs(hist.sum() - expected.sum()) / np.sqrt(expected.sum())))
    assert all(expected[s].sum() > 5 for s in parts.values())
    assert hist[law == 0].sum() <= 1e-6 * hist.sum()  # edges of samples are sharp to 2^-24 of a period
    require(outcomes, f"faint parts, S = {signal:g}")


def test_pulse_of_one_sample():
    """All energy in one sample has no edge near its middle: the tables make two of it."""
    view = tail_system(pulse=ml.SampledPulse(np.ones(1), 10.0), bins=2000, cycles=200_000)
    law = first_arrival(0.5 * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, 64), 0.5), 0.0, DELAY), view, seed=1)
    require({"bins": goodness(hist, 64 * view.cycles * law + 1e-9, fixed_total=False)}, "one sample")


@pytest.mark.full
@pytest.mark.parametrize(
    ("width", "background", "pixels", "cycles"),
    [
        (1e-5, 0.0105, 300, 100_000_000),
        (1.3e-5, 0.0105, 100, 100_000_000),
        (2e-5, 0.0105, 100, 100_000_000),
        (1e-5, 0.6, 100, 3_000_000),
        (1e-5, 100.0, 100, 1_000_000),
    ],
)
def test_short_gates(width: float, background: float, pixels: int, cycles: int):
    """Counts behind gates of 1e-5 of a period; before, 23 % too many at B = 0.0105."""
    gate = {"mode": "gated", "gate_start_ns": 61.7, "gate_width_ns": width * PERIOD}
    view = tail_system(detector=ml.Detector(dead_time_ns=10.0, **gate), cycles=cycles)
    counts = histogram(ml.Flux(np.zeros((1, pixels)), background, DELAY), view, seed=6).sum()
    mean = -np.expm1(-background * width) * pixels * cycles
    # edges are phases of 24 bits: half of one at most is amiss
    slack = 0.5 * 2.0**-24 / width * mean
    error = max(0.0, abs(counts - mean) - slack)
    require({"count": float(2 * stats.norm.sf(error / np.sqrt(mean)))}, f"gate of {width:g}, B = {background:g}")


@pytest.mark.full
@pytest.mark.parametrize(("faint", "bright"), [(5, 20), (20, 40)])
@pytest.mark.parametrize("photons", [2.0**-7, 0.01])
def test_faint_parts_of_a_dim_waveform(photons: float, faint: int, bright: int):
    """A part with 1e-6 of the energy; before, 37 or 255 for 78 by the place where pixels re-arm: a lattice of 2^-17."""
    wave = np.zeros((1, 100, 64))
    wave[..., faint], wave[..., bright] = 1e-6 * photons, (1 - 1e-6) * photons
    view = tail_system(bins=64)
    hist = histogram(ml.Flux(waveform=wave), view, seed=8)
    expected = 100 * view.cycles * first_arrival(wave[0, 0])
    outcomes = {"faint part": poisson_p(float(hist[faint]), float(expected[faint]))}
    outcomes["all"] = float(2 * stats.norm.sf(abs(hist.sum() - expected.sum()) / np.sqrt(expected.sum())))
    assert hist.sum() == hist[[faint, bright]].sum()
    require(outcomes, f"waveform of {photons:g} photons, parts {faint} and {bright}")


@pytest.mark.full
def test_afterpulses_have_no_lattice():
    """Releases some 100 periods after avalanches at one place: smooth over 30,000 bins, in runs of 30 of them."""
    detector = ml.Detector(
        dead_time_ns=30.0, afterpulsing=ml.Afterpulsing(probability=0.2, delay_ns=1e4, generations=1)
    )
    view = tail_system(pulse=ml.GaussianPulse(sigma_ns=1e-4), bins=30_000, cycles=2_000_000, detector=detector)
    hist = histogram(ml.Flux(np.full((1, 96), 0.5), 0.0, 10.003), view, seed=3)
    runs = hist[15_000:29_700].reshape(-1, 30).astype(float)  # where no dead time ends and no pulse is
    mean = runs.mean(1, keepdims=True)
    assert mean.min() > 100
    square = float(((runs - mean) ** 2 / mean).sum())
    require({"phases": float(stats.chi2.sf(square, runs.size - len(runs)))}, "afterpulses")


# Any pulse


def sampled_gaussian() -> ml.SampledPulse:
    """Sigma 1 ns in samples of 50 ps, down to 6.5 sigma: 1e-10 of the largest sample."""
    return ml.SampledPulse(np.exp(-0.5 * (0.05 * (np.arange(261) - 130)) ** 2), 0.05)


# pulse, and the part of its energy that is its early tail
PULSES = {
    "gaussian": (lambda: ml.GaussianPulse(sigma_ns=1.0), special.ndtr(-4.0)),
    "narrow": (lambda: ml.GaussianPulse(sigma_ns=1e-2), special.ndtr(-4.0)),
    "sampled gaussian": (sampled_gaussian, special.ndtr(-4.0)),
    "lobes": (lambda: ml.SampledPulse(two_lobes(), 0.2, "first"), 1e-3),
    "measured, two lobes": (lambda: measured_pulse("face_free_8ps", 10.0), 0.02),
    "measured": (lambda: measured_pulse("face_free_unimodal_8ps", 10.0), 0.02),
}


def tail_bins(pulse: ml.Pulse) -> int:
    """A quarter of sigma; a sample of the measured pulses."""
    if isinstance(pulse, ml.GaussianPulse):
        return int(400 / pulse.sigma_ns)
    return 12_500


def early_tail(name: str) -> tuple[np.ndarray, int, ml.System]:
    """P(first photon of a pulse of 10 in bin j) = e^-S F_j - e^-S F_(j+1), and the end of the early bins.

    The dead time ends long before the next pulse, without background: every period is alone.
    """
    make, part = PULSES[name]
    pulse = make()
    bins = tail_bins(pulse)
    energy = pulse.bin_energy(DELAY, 100.0, bins)
    edge = int(np.searchsorted(np.cumsum(energy), part))
    return first_arrival(10.0 * energy), edge, tail_system(pulse=pulse, bins=bins, cycles=50_000)


@pytest.mark.parametrize("name", PULSES)
def test_early_tail_is_the_first_arrival(name: str):
    """5e7 pulses of 10 photons; of a Gaussian, 1.6e4 register below -4 sigma, 140 below -5 sigma."""
    law, edge, view = early_tail(name)
    flux = ml.Flux(np.full((1, 40), 10.0), 0.0, DELAY)
    hist = ml.simulate(flux, view, realizations=25, seed=3).sum((0, 1, 2), dtype=np.int64)
    expected = 1000 * view.cycles * law
    outcomes = {
        "whole pulse": goodness(hist, expected, fixed_total=False),
        "early tail": goodness(hist[:edge], expected[:edge], fixed_total=False, least=25),
    }
    if "gaussian" in name:
        outcomes |= windows(hist, expected, view.time_ns - DELAY, (-6.0, -5.0, -4.5, -4.0))
    require(outcomes, f"early tail, {name}")


@pytest.mark.full
@pytest.mark.parametrize("name", ["gaussian", "measured, two lobes", "measured"])
def test_re_arming_inside_the_late_tail(name: str):
    """A dead time a little over a period: what registers early re-arms where 0.3 % of the pulse are left."""
    pulse = PULSES[name][0]()
    grid = np.linspace(*pulse.support_ns(), 20_001)
    early, late = np.interp([-np.log(0.5) / 10, 0.997], pulse.cumulative(grid), grid)
    view = tail_system(pulse=pulse, detector=ml.Detector(dead_time_ns=100.0 + late - early), cycles=200, bins=1000)
    case = Case(f"re-arming in the late tail, {name}", flux_of(10.0, 0.0), view, 3000)
    check(ENGINES["exact"], case, ENGINES["sequential"], EVERYTHING)
    fine = view.replace(bins=tail_bins(pulse))
    beyond = fine.time_ns > 50.0 + late
    flux = ml.Flux(np.full((1, 300), 10.0), 0.0, 50.0)
    exact, truth = (
        sum(
            ml.simulate(flux, fine, seed=1, first_realization=r, engine=e)[0, 0, :, beyond].sum(1, dtype=int)
            for r in range(number)
        )
        for e, number in (("exact", 80), ("sequential", 12))
    )
    assert truth.sum() > 500
    # single registrations in the tail are rare and far apart, so independent
    require({"bins in the tail": same_law(exact, truth, least=30)}, case.name)


# The exact engine for waveforms where its tables are hardest: edges that meet, parts of hardly any energy, sizes.


def view(dead: float, cycles: int = 20, bins: int = 64, mode: str = "nonparalyzable", start: str = "armed"):
    return make_system(100.0 * dead, cycles, bins, start=start, mode=mode)


def one_part(parts: int, at: int) -> np.ndarray:
    wave = np.zeros(parts)
    wave[at] = 1.0
    return wave


def steep(parts: int) -> np.ndarray:
    """Energies over twelve decades: cells with a thousand edges beside parts with a thousand cells."""
    return 10.0 ** -(12.0 * np.random.default_rng(parts).random(parts))


WAVES = {
    "one part": np.ones(1),
    "two parts": np.array([0.0, 1.0]),
    "first of many": one_part(777, 0),
    "last of many": one_part(777, 776),
    "dark ends": np.pad(np.ones(5), 300),
    "steep": steep(1000),
    "steep, more parts than 16 bits": steep(140_001),
}


@pytest.mark.full
@pytest.mark.parametrize("photons", [1e-6, 0.7, 1e3])
@pytest.mark.parametrize("name", WAVES)
def test_levels_agree_and_registrations_lie_where_there_is_light(name: str, photons: float):
    wave = photons * WAVES[name] / WAVES[name].sum()
    flux = ml.Flux(waveform=np.broadcast_to(wave, (1, 37, wave.size)))
    cycles = int(min(300 / photons, 1e8)) if photons < 1e3 else 20
    for dead, start in ((0.0, "armed"), (0.3, "armed"), (2.0, "stationary")):
        system = view(dead, cycles, 128, start=start)
        task = Task(flux, system, 2, 0, np.arange(37, dtype=np.uint32), 5, 1, None)
        first = None
        for level in _core.levels():
            engine = ExactEngine(level)
            records = engine.records(task, 0.0)
            out = np.empty((task.items, 128), system.histogram_dtype)
            engine.histogram(task, out)
            item = np.repeat(np.arange(task.items), np.diff(records.offsets))
            assert np.array_equal(np.bincount(item * 128 + records.bin, minlength=out.size), out.ravel())
            if first is None:
                first = records
                apart = np.diff(records.times)[item[1:] == item[:-1]]
                assert (apart >= dead - 1e-7).all()
                part = np.minimum(((records.times - records.cycle) * wave.size).astype(int), wave.size - 1)
                rounded = wave[np.maximum(part - 1, 0)] + wave[part] + wave[np.minimum(part + 1, wave.size - 1)]
                assert (rounded > 0).all()
                assert records.times.size > 100
            for what in ("times", "cycle", "bin", "offsets"):
                assert np.array_equal(getattr(records, what), getattr(first, what))


@pytest.mark.parametrize("parts", [3, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 65, 127, 2047, 2049])
def test_levels_agree_at_any_number_of_parts(parts: int):
    """Tables are filled in vectors, whose last one is not full."""
    wave = np.random.default_rng(parts).random((1, 9, parts)) ** 8
    flux = ml.Flux(waveform=2.0 * wave / wave.sum(-1, keepdims=True), background=np.linspace(0.0, 2.0, 9)[None])
    system = view(0.37, 300, parts)
    task = Task(flux, system, 2, 0, np.arange(9, dtype=np.uint32), parts, 1, None)
    cubes = []
    for level in _core.levels():
        cubes.append(np.empty((task.items, parts), system.histogram_dtype))
        ExactEngine(level).histogram(task, cubes[-1])
    assert all(np.array_equal(cube, cubes[0]) for cube in cubes)
    assert cubes[0].sum() > 2000


@pytest.mark.full
@pytest.mark.parametrize("parts", [64, 1024, 140_001])
def test_parts_have_their_energy_over_many_decades(parts: int):
    """First arrivals of armed periods, without re-arming: Coates 1968. In bins of the waveform's own order."""
    wave = 3.0 * steep(parts) / steep(parts).sum()
    system = view(0.0, 1, 64, "synchronous")
    edges = np.minimum(np.arange(65) * parts / 64, parts)
    photons = np.diff(np.interp(edges, np.arange(parts + 1), np.concatenate([[0.0], np.cumsum(wave)])))
    case = Case(f"first arrivals, {parts} parts", waveform_flux(wave), system, 400_000)
    check(ENGINES["exact"], case, Law(first_arrival(photons), None), {SHAPE})


def test_dim_parts_beside_a_bright_one():
    """Parts of 1e-6 of the energy, each of its own size: Poisson counts without a dead time."""
    wave = np.concatenate([[1e3], 1e-3 * np.linspace(0.2, 2.0, 255)])
    system = view(0.0, 1000, 256)
    cube = ml.simulate(ml.Flux(waveform=np.broadcast_to(wave, (1, 40, 256))), system, seed=1)
    counts = cube.sum((0, 1, 2)).astype(float)
    expected = 40 * 1000 * wave
    z = (counts[1:] - expected[1:]) / np.sqrt(expected[1:])
    require({"chi-square": 2 * min(stats.chi2.sf((z**2).sum(), 255), stats.chi2.cdf((z**2).sum(), 255))}, "dim parts")
    late = counts[129:].sum(), expected[129:].sum()
    require({"dim half": float(2 * stats.norm.sf(abs(late[0] - late[1]) / np.sqrt(late[1])))}, "dim parts")


@pytest.mark.parametrize("dead", [0.0, 0.37, 1.0])
def test_dim_and_bright_pixels_against_the_count_law(dead: float):
    """A million periods of 1e-5 photons, ten of a thousand."""
    for photons, cycles in ((1e-5, 1_000_000), (1e3, 10)):
        wave = photons * steep(500) / steep(500).sum()
        system = view(dead, cycles)
        case = Case(f"{photons:g} photons, t_d {dead:g}", waveform_flux(wave), system, 20_000 if dead else 4000)
        if dead:
            pmf = pmf_of(ml.count_law(ml.Flux(waveform=wave), system))
        else:
            mean = photons * cycles
            pmf = stats.poisson.pmf(np.arange(int(mean + 60 * mean**0.5 + 60)), mean)
        check(ENGINES["exact"], case, Law(None, pmf), {COUNTS})


# Stationary starts where registrations lock to a bright pulse and drift through it slowly.


WHOLE_GATE = {"mode": "gated", "gate_start_ns": 0.0, "gate_width_ns": PERIOD_NS}


@pytest.mark.full
@pytest.mark.parametrize("detector", [{}, WHOLE_GATE], ids=["free running", "gated"])
@pytest.mark.parametrize("dead", [0.9995, 2.0008])
def test_a_locked_pixel_starts_as_the_statistics_say(dead: float, detector: dict[str, object]):
    """A grid that blurs each turn by a part of a bin puts 0.001 registrations too many into each period."""
    system = make_system(dead * PERIOD_NS, 12, 64, sigma_ns=0.5, start="stationary", **detector)
    case = Case(f"locked, t_d {dead:g}", flux_of(20.0, 0.05, 0.37), system, 80_000)
    check(ENGINES["exact"], case, law_of(ml.Flux(20.0, 0.05, 37.0), system), {COUNTS, SHAPE})


@pytest.mark.full
def test_the_sequential_engine_begins_in_any_phase_of_a_slow_drift():
    """A round of the phase through the pulse took 200 turns, but began within 64: half too large a variance."""
    system = make_system(PERIOD_NS, 12, 64, start="stationary")
    case = Case("drift through a bright pulse", flux_of(200.0, 0.01, 0.37), system, 1000)
    check(ENGINES["sequential"], case, law_of(ml.Flux(200.0, 0.01, 37.0), system), {COUNTS})


@pytest.mark.parametrize("signal", [3.0, 160.0])
def test_a_state_that_depends_on_the_switching_on_is_refused(signal: float):
    """Two peaks, and a dead time that ends shortly before the one that was registered: a bright pixel stays with it."""
    samples = np.zeros(256)
    samples[:8] = samples[200:208] = 1.0
    system = make_system(4.964 * PERIOD_NS, 50, 64, pulse=ml.SampledPulse(samples, 0.1, "first"), start="stationary")
    flux = ml.Flux(signal, 0.1, 7.0)
    if signal < 10.0:  # it changes between the peaks every few registrations
        drawn = ml.simulate(flux, system, realizations=4000, seed=5)[:, 0, 0].mean(0)
        law = ml.mean_histogram(flux, system)
        assert np.abs(drawn - law).max() < 5.0 * np.sqrt(law.max() / 4000)
        return
    for engine in ("exact", "sequential"):
        with pytest.raises(ValueError, match=r"depends on when the detector was switched on.*start='armed'"):
            ml.simulate(flux, system, engine=engine, seed=5)
    assert ml.simulate(flux, system.replace(start="armed"), seed=5).sum() > 0


@pytest.mark.parametrize("light", ["pulses", "waveforms"])
def test_pixels_of_one_light_share_the_state_that_they_start_in(light: str):
    """In any order among others, with the bits that each has alone."""
    which = np.array([0, 1, 0, 2, 1, 0, 2, 2])
    signal, background = np.array([20.0, 30.0, 20.0])[which], np.array([0.5, 0.5, 0.8])[which]
    flux = ml.Flux(signal[None], background[None], 40.0)
    if light == "waveforms":
        shape = np.exp(-0.5 * ((np.arange(64) - 20.0) / 3.0) ** 2)
        flux = ml.Flux(waveform=signal[None, :, None] * shape / shape.sum(), background=background[None])
    system = make_system(97.0, 20, 64, sigma_ns=2.0, start="stationary")
    cube = ml.simulate(flux, system, realizations=3, seed=4).reshape(3, 8, 64)
    for k in range(8):
        alone = ml.simulate(flux[:, k : k + 1], system, realizations=3, seed=4, pixel_index=[[k]])
        assert np.array_equal(alone.reshape(3, 64), cube[:, k])
