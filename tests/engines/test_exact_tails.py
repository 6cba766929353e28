"""Tails of the pulse: where a bright pulse registers, and where a pixel re-arms inside one."""

from __future__ import annotations

import numpy as np
import pytest
from harness import (
    EVERYTHING,
    Case,
    check,
    first_arrival,
    flux_of,
    goodness,
    make_system,
    measured_pulse,
    require,
    same_law,
    two_lobes,
)
from scipy import special, stats

import mars_lidar as ml
from mars_lidar.engines import ENGINES

GAUSSIAN = ml.GaussianPulse(sigma_ns=1.0)
# Sampled pulses begin abruptly; phases are float32, so an edge on a bin's edge would leak 2^-25 of a period.
DELAY_NS = 50.003


def system(**changes: object) -> ml.System:
    """Period 100 ns, bins of a quarter of the pulse's sigma."""
    return make_system(50.0, 1000, 400, pulse=GAUSSIAN).replace(**changes)


def sampled_gaussian() -> ml.SampledPulse:
    """Sigma 1 ns in samples of 50 ps, down to 6.5 sigma: 1e-10 of the largest sample."""
    return ml.SampledPulse(np.exp(-0.5 * (0.05 * (np.arange(261) - 130)) ** 2), 0.05)


# pulse, and the part of its energy that is its early tail
PULSES = {
    "gaussian": (lambda: GAUSSIAN, special.ndtr(-4.0)),
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

    Half a period of dead time ends long before the next pulse, without background: every period is alone.
    """
    make, part = PULSES[name]
    pulse = make()
    bins = tail_bins(pulse)
    energy = pulse.bin_energy(DELAY_NS, 100.0, bins)
    edge = int(np.searchsorted(np.cumsum(energy), part))
    return first_arrival(10.0 * energy), edge, system(pulse=pulse, bins=bins, cycles=50_000)


@pytest.mark.parametrize("name", PULSES)
def test_early_tail_is_the_first_arrival(name: str):
    """5e7 pulses of 10 photons; of a Gaussian, 1.6e4 register below -4 sigma, 140 below -5 sigma."""
    law, edge, view = early_tail(name)
    flux = ml.Flux(np.full((1, 40), 10.0), 0.0, DELAY_NS)
    hist = ml.simulate(flux, view, realizations=25, seed=3).sum((0, 1, 2), dtype=np.int64)
    expected = 1000 * view.cycles * law
    outcomes = {
        "whole pulse": goodness(hist, expected, fixed_total=False),
        "early tail": goodness(hist[:edge], expected[:edge], fixed_total=False, least=25),
    }
    if "gaussian" in name:
        for a, b in ((-6.0, -5.0), (-5.0, -4.5), (-4.5, -4.0)):
            inside = (view.time_ns > DELAY_NS + a) & (view.time_ns < DELAY_NS + b)
            number, mean = hist[inside].sum(), expected[inside].sum()
            p = 2 * min(stats.poisson.cdf(number, mean), stats.poisson.sf(number - 1, mean))
            outcomes[f"{a:g} to {b:g} sigma"] = min(1.0, p)
    require(outcomes, f"early tail, {name}")


@pytest.mark.full
@pytest.mark.parametrize("name", ["gaussian", "sampled gaussian", "measured, two lobes"])
def test_early_tail_agrees_with_the_sequential_engine(name: str):
    _, edge, view = early_tail(name)
    flux = ml.Flux(np.full((1, 8), 10.0), 0.0, DELAY_NS)
    exact, truth = (
        ml.simulate(flux, view.replace(cycles=c), engine=engine, seed=5).sum((0, 1, 2), dtype=np.int64)
        for engine, c in (("exact", 5_000_000), ("sequential", 200_000))
    )
    rest = [np.append(h[:edge], h[edge:].sum()) for h in (exact, truth)]
    require(
        {"early tail": same_law(*rest, least=20), "whole pulse": same_law(exact, truth)},
        f"sequential, {name}",
    )


@pytest.mark.parametrize(("depth", "signal"), [(3.0, 100.0), (4.0, 1000.0), (5.0, 1000.0)])
def test_arming_inside_the_late_tail(depth: float, signal: float):
    """Armed `depth` sigma after the peak: the rest of the pulse, then the early part of the next one."""
    view = system(cycles=1, detector=ml.Detector(dead_time_ns=200.0), pulse=ml.GaussianPulse(sigma_ns=2.0))
    tau = 100.0 - 2.0 * depth
    times = ml.simulate_timestamps(ml.Flux(np.full((1000, 1000), signal), 0.0, tau), view, seed=1)
    energy = view.pulse.wrapped_cumulative(np.linspace(0.0, 100.0, 401) - tau, 100.0)
    law = first_arrival(signal * np.diff(energy))
    hist = np.bincount(times.bin, minlength=400)
    late = signal * special.ndtr(-depth)
    assert 1e6 * -np.expm1(-late) == pytest.approx(1e6 * law[:100].sum(), rel=1e-6)
    require(
        {
            "late tail": goodness(hist[:100], 1e6 * law[:100] + 1e-12, fixed_total=False, least=25),
            "all": goodness(hist, 1e6 * law + 1e-12, fixed_total=False),
        },
        f"armed at {depth:g} sigma",
    )


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
