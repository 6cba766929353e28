"""The exact count law of a paralyzable pixel: closed forms, its own moments, the sequential engine."""

from math import comb, factorial

import numpy as np
import pytest
from harness import COUNTS, PERIOD_NS, Case, Law, check, make_system, pmf_of, random_cases, two_lobes, waveform_flux
from harness.paralyzable import paralyzable_moments
from scipy.integrate import quad

import mars_lidar as ml
from mars_lidar.engines import ENGINES
from mars_lidar.statistics import exposure_moments, mean_histogram


def view(dead: float, start: str = "armed", cycles: int = 40, *, sigma: float = 0.02, bins: int = 50) -> ml.System:
    return make_system(dead * PERIOD_NS, cycles, bins, sigma_ns=sigma * PERIOD_NS, start=start, mode="paralyzable")


def constant_rate_pmf(rate: float, dead: float, cycles: float, start: str) -> np.ndarray:
    """From E C(N, k): k registrations further apart than t_d, at the rate lambda e^(-lambda t_d) each.

    In an armed exposure the first of them may be the first arrival of all, before t_d.
    """
    r, most = rate * np.exp(-rate * dead), int(cycles / dead) + 1

    def ordered(k: int, room: float) -> float:
        """Integral over k registrations in `room`, the gaps between them taken out."""
        return r**k * max(room - (k - 1) * dead, 0.0) ** k / factorial(k) if k else 1.0

    chance = [1.0]
    for k in range(1, most + 1):
        if start == "stationary":
            chance.append(ordered(k, cycles))
            continue
        early = quad(
            lambda u, k=k: rate * np.exp(-rate * u) * ordered(k - 1, max(cycles - u - dead, 0.0)),
            0,
            dead,
            epsrel=1e-12,
            epsabs=1e-14,
        )[0]
        chance.append(early + ordered(k, cycles - dead))
    counts = range(most + 1)
    return np.array([sum((-1) ** (k - n) * comb(k, n) * chance[k] for k in counts[n:]) for n in counts])


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(("rate", "dead", "cycles"), [(1.3, 0.35, 5), (0.4, 2.7, 30), (4.0, 0.9, 12), (0.8, 1.0, 9)])
def test_pmf_at_a_constant_rate(rate: float, dead: float, cycles: int, start: str):
    expected = constant_rate_pmf(rate, dead, cycles, start)
    result = pmf_of(ml.count_law(ml.Flux(0.0, rate), view(dead, start, cycles), tolerance=1e-7))
    size = min(result.size, expected.size)
    assert expected.sum() == pytest.approx(1.0, abs=1e-9)
    assert result[:size] == pytest.approx(expected[:size], abs=1e-8)
    assert max(expected[size:].sum(), result[size:].sum()) < 1e-8


@pytest.mark.parametrize("case", random_cases(24, seed=77, photons=4e5, least=1000, most=3000), ids=lambda c: c.name)
def test_moments_are_the_closed_form_ones(case: Case):
    pixel = ml.Detector(dead_time_ns=case.system.detector.dead_time_ns, mode="paralyzable")
    system = case.system.replace(detector=pixel)
    flux = case.flux[0, 0]
    law = ml.count_law(flux, system, tolerance=1e-5)
    known = paralyzable_moments(flux, system)
    spread = np.sqrt(known.variance)
    assert abs(float(law.mean) - known.mean) < 3e-5 * min(spread, known.mean) + 1e-9
    assert float(law.variance) == pytest.approx(known.variance, rel=1e-4, abs=1e-8)
    own = exposure_moments(flux, system, tolerance=1e-5)
    assert 0.5 * np.abs(own.histogram - known.histogram).sum() < 3e-5 * known.mean
    # third and fourth cumulant came by series in s, the pmf by points on the circle
    n = law.support - law.mean
    third, fourth = law.pmf @ n**3, law.pmf @ n**4 - 3 * (law.pmf @ n**2) ** 2
    assert law.cumulants[2:] == pytest.approx([third, fourth], abs=1e-6 * max(spread, 1.0) ** 4)


@pytest.mark.parametrize("sigma", [1e-6, 1e-5, 1e-3])
@pytest.mark.parametrize("signal", [3.0, 30.0, 1000.0])
def test_the_first_photon_of_a_short_pulse_is_registered(sigma: float, signal: float):
    """However bright: a count of 1 - exp(-S) a period was 1e-13 where a pulse of 1000 photons was within a cell."""
    system = view(0.5, "stationary", 20, sigma=sigma)
    law = ml.count_law(ml.Flux(signal, 0.0, 25.0), system)
    assert float(law.mean) == pytest.approx(-20.0 * np.expm1(-signal), rel=1e-9)
    assert float(law.variance) == pytest.approx(-20.0 * np.expm1(-signal) * np.exp(-signal), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("bins", [1, 50, 1000])
def test_the_grid_of_the_histogram_is_not_the_one_of_the_moments(bins: int):
    """However many bins the histogram has, the laws keep their tolerance."""
    system, flux = view(0.45, cycles=500, sigma=0.01, bins=bins), ml.Flux(1.0, 1.0, 37.0)
    known, law = paralyzable_moments(flux, system), exposure_moments(flux, system, tolerance=1e-6)
    assert float(mean_histogram(flux, system).sum()) == pytest.approx(known.mean, rel=1e-5)
    assert [float(law.mean), float(law.variance)] == pytest.approx(known[:2], rel=1e-5)


@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_waveform(start: str):
    wave = two_lobes() / 12
    system = view(0.7, start)
    law = ml.count_law(ml.Flux(waveform=wave, background=0.3), system)
    case = Case(f"waveform, {start}", waveform_flux(wave, 0.3), system, 12_000)
    check(ENGINES["sequential"], case, Law(None, pmf_of(law)), {COUNTS})


def test_dead_times_round_one_bin_of_the_grid():
    """Below a bin G of the bin itself comes in, above it is a delay: no step where one becomes the other."""
    edge = 1.0 / 128
    dead = np.array([1e-4, 0.5 * edge, 0.999999 * edge, edge, 1.000001 * edge, 1.5 * edge])
    for d in dead:
        system = view(float(d), cycles=8, sigma=0.05)
        law, known = (
            ml.count_law(ml.Flux(4.0, 1.0, 50.0), system),
            paralyzable_moments(ml.Flux(4.0, 1.0, 50.0), system),
        )
        assert law.exposure is not None
        assert law.exposure.bins <= 256
        assert law.cumulants[:2] == pytest.approx(known[:2], rel=1e-4)
        assert law.pmf.sum() == pytest.approx(1.0, abs=1e-9)


def test_long_exposures_and_long_dead_times():
    a, b, c = (ml.count_law(ml.Flux(1.0, 0.3, 50.0), view(2.4, cycles=n)) for n in (200, 201, 100_000_000))
    assert c.cumulants == pytest.approx(a.cumulants + (b.cumulants - a.cumulants) * (100_000_000 - 200), rel=1e-6)
    assert c.pmf @ c.support == pytest.approx(float(c.mean), rel=1e-8)
    assert c.pmf.sum() == pytest.approx(1.0, abs=1e-5)
    long = ml.count_law(ml.Flux(0.01, 0.005, 50.0), view(300.25, cycles=2000))
    known = paralyzable_moments(ml.Flux(0.01, 0.005, 50.0), view(300.25, cycles=2000))
    assert long.cumulants[:2] == pytest.approx(known[:2], rel=1e-5)
    assert long.pmf @ long.support == pytest.approx(known.mean, rel=1e-5)


def test_dark_blinded_and_without_dead_time():
    dark = ml.count_law(ml.Flux(0.0, 0.0), view(0.5))
    assert dark.pmf[0] == 1.0
    assert dark.mean == 0.0
    # lambda t_d = 40: the first photon, and nothing ever after
    blinded = ml.count_law(ml.Flux(0.0, 80.0), view(0.5, cycles=10))
    assert pmf_of(blinded)[1] == pytest.approx(1.0, abs=1e-9)
    free = ml.count_law(ml.Flux(1.0, 0.5, 50.0), view(0.0))
    assert free.variance == pytest.approx(float(free.mean), rel=1e-9)
    cells = ml.count_law(ml.Flux(np.array([0.0, 1.0]), 0.2, 50.0), view(0.7))
    assert cells.pmf[0] @ cells.support[0] == pytest.approx(
        float(ml.count_law(ml.Flux(0.0, 0.2), view(0.7)).mean), rel=1e-8
    )
