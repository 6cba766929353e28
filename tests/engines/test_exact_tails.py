"""Tails of pulses and dim light: the exact engine's waits have no lattice, its tails hold to 1e-10 of the energy.

Without background, with a dead time that ends before the next pulse, every pulse is alone: of S photons the first is in
a bin with the probability e^-F_j - e^-F_(j+1), F_j the photons before the bin's edge.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from harness.cases import Case, flux_of, make_system, measured_pulse, two_lobes
from harness.check import EVERYTHING, check
from harness.laws import first_arrival
from harness.ledger import require
from harness.pvalues import goodness, same_law
from numpy.typing import NDArray
from scipy import special, stats

import mars_lidar as ml
from mars_lidar.engines import ENGINES

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


def system(**changes: Any) -> ml.System:
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
    view = system(cycles=cycles)
    law = first_arrival(signal * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, pixels), signal), 0.0, DELAY), view, seed=17)
    require(tails(hist, law, pixels * view.cycles), f"tails, S = {signal:g}")


@pytest.mark.parametrize("signal", [100.0, 1000.0])
def test_early_tail_of_a_blinding_pulse(signal: float):
    """What registers is the tail: of 1000 photons 20 in 1e8 beyond -6.25 sigma; the tables ended once at 6.4."""
    view = system(bins=1600, cycles=1_500_000)
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
    view = system(detector=ml.Detector(dead_time_ns=40.0, **MODES[mode]), start=start)
    law = first_arrival(0.02 * view.pulse.bin_energy(DELAY, PERIOD, view.bins))
    hist = histogram(ml.Flux(np.full((1, 20), 0.02), 0.0, DELAY), view, seed=5)
    require(tails(hist, law, 20 * view.cycles), f"tails, {mode}, {start}")


@pytest.mark.full
def test_tails_of_several_returns():
    """Each of three, a dead time of 20 ns apart: 5e7 registrations of the first and of the second, 2e7 of the third."""
    view = system(detector=ml.Detector(dead_time_ns=12.0))
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
    view = system(detector=ml.Detector(dead_time_ns=PERIOD), cycles=6_000_000)
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
    view = system(cycles=cycles, detector=ml.Detector(dead_time_ns=0.0, mode="synchronous"), bins=1000)
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
    view = system(pulse=ml.SampledPulse(shape, 0.2), cycles=100_000_000 if signal == 0.01 else 2_000_000)
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
    view = system(pulse=ml.SampledPulse(np.ones(1), 10.0), bins=2000, cycles=200_000)
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
    view = system(detector=ml.Detector(dead_time_ns=10.0, **gate), cycles=cycles)
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
    view = system(bins=64)
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
    view = system(pulse=ml.GaussianPulse(sigma_ns=1e-4), bins=30_000, cycles=2_000_000, detector=detector)
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
    return first_arrival(10.0 * energy), edge, system(pulse=pulse, bins=bins, cycles=50_000)


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
    view = system(pulse=pulse, detector=ml.Detector(dead_time_ns=100.0 + late - early), cycles=200, bins=1000)
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
