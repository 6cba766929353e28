"""Laws anywhere in the declared domain: right, or a refusal that says what to use. What was found wrong, by name."""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from harness import refused, require, system_of
from harness.pvalues import variance_score
from scipy import integrate, special, stats

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError, exposure_moments, mean_histogram
from mars_lidar.statistics import joint as pixel_module
from mars_lidar.statistics import moments as moments_module
from mars_lidar.statistics import pmf as pmf_module
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.joint_grid import FoldedGrid, relative_residual
from mars_lidar.statistics.moments import refined_moments
from mars_lidar.statistics.tolerances import LAW
from mars_lidar.table.entries import start_phases
from tests.domain.judge import Predictions, refusal
from tests.domain.systems import draw

PERIOD_NS = 100.0


def view(dead: float, cycles: int = 1000, sigma: float = 0.01, start: str = "armed", **changes: Any) -> ml.System:
    """Times in periods."""
    return system_of(dead, cycles, sigma=sigma, start=start).replace(**changes)


# A warmed-up clock: many background photons in a dead time


@pytest.mark.full
@pytest.mark.parametrize(
    ("background", "dead", "cycles"), [(1000.0, 1.9999, 1), (999.0, 0.9997, 1), (300.0, 4.98256, 3), (80.0, 2.5, 20)]
)
def test_warm_start_of_a_bright_clock(background: float, dead: float, cycles: int):
    """The mean of a stationary renewal process is that of its rate; the first has raised."""
    law = ml.count_law(ml.Flux(0.0, background), view(dead, cycles, start="stationary"))
    mean = background * cycles / (1.0 + background * dead)
    assert law.mean == pytest.approx(mean, rel=1e-6)
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-9)
    assert law.pmf @ law.support == pytest.approx(mean, rel=1e-6)
    if dead > cycles:  # one at most
        assert law.variance == pytest.approx(mean * (1.0 - mean), rel=1e-6)


@pytest.mark.parametrize(
    ("signal", "background", "dead", "sigma"),
    [
        (205.648, 6.66524, 0.999856070836575, 0.013763629840558421),
        (26.3463, 0.00914578, 4.988590445664314, 0.002),
        (28.4588, 241.234, 1.99982, 0.177),
        (64.86, 0.45, 0.999978, 0.00446),
    ],
)
def test_stationary_shapes_of_locked_pixels(signal: float, background: float, dead: float, sigma: float):
    """Rate and shape: armed + blind = 1, each bin's registrations at least those of the pixel armed a dead time ago."""
    system = view(dead, sigma=sigma, bins=32)
    shape = ml.registration_pdf(ml.Flux(signal, background, 30.0), system, "stationary")
    assert shape.sum() == pytest.approx(1.0, abs=1e-9)
    assert shape.min() >= 0.0
    other = ml.registration_pdf(ml.Flux(signal, background, 30.0), view(dead + 3.0, sigma=sigma, bins=32), "stationary")
    np.testing.assert_allclose(other, shape, atol=1e-6)  # whole periods only wait


@pytest.mark.parametrize(
    ("signal", "background", "dead", "sigma", "bins"),
    [
        (100.233, 0.605444, 0.9920625, 0.0007026, 8192),
        (128.69, 0.389, 0.999986716, 0.000223, 16384),
        (41.8, 0.49668, 0.94463536, 0.0002337, 16384),
        (1e-6, 1000.0, 0.5, 1.0, 1024),
    ],
)
def test_factors_of_locked_pixels(signal: float, background: float, dead: float, sigma: float, bins: int):
    """Where the held window is behind the pulse the residual is rounding; elsewhere it was up to 8."""
    grid = FoldedGrid.of(Cells.of(signal, background, view(dead, sigma=sigma), delay_ns=50.0), bins)
    grid.direct = True
    assert grid.state.sum() > 0.0
    assert grid.residual < 1e-11


@pytest.mark.parametrize(("signal", "background", "dead"), [(1.0, 0.5, 0.6375), (20.0, 0.1, 0.97), (5.0, 1.0, 2.003)])
def test_factors_of_the_feedback_equation(signal: float, background: float, dead: float):
    """The factors, whose full row is put back, and the sweeps solve the same equations, forward and transposed."""
    cells = Cells.of(signal, background, view(dead), delay_ns=33.0)
    swept, direct = FoldedGrid.of(cells, 512), FoldedGrid.of(cells, 512)
    direct.direct = True
    np.testing.assert_allclose(direct.state, swept.state, rtol=1e-7, atol=1e-12)
    weights = np.random.default_rng(1).normal(size=(3, 512))
    a, b = direct.adjoint(weights), swept.adjoint(weights)
    np.testing.assert_allclose(a, b, atol=1e-7 * np.abs(b).max())
    assert direct.residual < 1e-9


def test_stationary_shape_without_a_dead_time():
    """The light itself, whatever the width of the pulse."""
    system = view(0.0, 1, 1e-6, bins=2)
    shape = ml.registration_pdf(ml.Flux(1.0, 1e-6, 30.0), system, "stationary")
    np.testing.assert_allclose(shape, [(1.0 + 5e-7) / (1.0 + 1e-6), 5e-7 / (1.0 + 1e-6)], rtol=1e-9)


# Wide laws


def test_the_law_of_a_hundred_million_periods():
    """125 s once: at t_d = t_r registrations are a renewal process of whole periods and the phase of one photon."""
    law = ml.count_law(ml.Flux(5.0, 1.0, 50.0), view(1.0, 10**8, 0.00375))
    assert law.mean == pytest.approx(6.0 * 1e8 / 7.0, abs=1.0)
    assert law.variance == pytest.approx(float(law.cumulants[1]))
    offset = law.support - law.mean
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-6)
    assert law.pmf @ offset == pytest.approx(0.0, abs=1e-3 * math.sqrt(law.variance))
    assert law.pmf @ offset**2 == pytest.approx(float(law.variance), rel=1e-4)
    normal = stats.norm.pdf(law.support, law.mean, math.sqrt(law.variance))
    assert 0.5 * np.abs(law.pmf - normal).sum() < 1e-3


@pytest.mark.parametrize(
    ("signal", "background", "dead", "sigma", "cycles", "delay", "start"),
    [
        (137.457, 0.0353754, 0.807282, 0.0, 333_063, 99.9, "stationary"),
        (40.5466, 1.10649, 0.90280658, 0.0002292, 344_109, 62.7048, "armed"),
        (45.1075, 0.0371614, 0.98639176, 0.0001644, 959_778, 0.0, "armed"),
    ],
)
def test_locked_laws_of_many_periods(
    signal: float, background: float, dead: float, sigma: float, cycles: int, delay: float, start: str
):
    """A count that is all but certain: its pmf errs in probability, not in shares of its variance of 1e-4 and less."""
    pulse: Any = ml.SampledPulse(np.random.default_rng(0).exponential(size=20), bin_ns=1.0)
    if sigma:
        pulse = ml.GaussianPulse(sigma_ns=sigma * PERIOD_NS)
    law = ml.count_law(ml.Flux(signal, background, delay), view(dead, cycles, start=start, pulse=pulse))
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-7)
    assert law.pmf @ (law.support - law.mean) == pytest.approx(0.0, abs=1e-6)


# Darkness, dead times beyond the exposure


def test_darkness():
    system = view(12127.27, 121_892, bins=24_393)
    law = ml.count_law(ml.Flux(waveform=np.zeros(100)), system)
    assert law.mean == law.variance == 0.0
    np.testing.assert_array_equal(law.pmf, [1.0])
    assert mean_histogram(ml.Flux(waveform=np.zeros(100)), system).sum() == 0.0
    assert not ml.joint_law(ml.Flux(0.0, 0.0), view(0.6, 100)).covariance().any()
    some = ml.count_law(ml.Flux([0.0, 1.0], [0.0, 0.5], 50.0), view(0.6, 100))
    np.testing.assert_allclose(
        some.cumulants[1], ml.count_law(ml.Flux(1.0, 0.5, 50.0), view(0.6, 100)).cumulants, rtol=1e-10
    )
    np.testing.assert_array_equal(some.cumulants[0], 0.0)
    assert some.pmf[0, 0] == 1.0


@pytest.mark.parametrize(("cycles", "dead"), [(1, 1e6), (2, 925_385.5), (38, 147_009.02), (1000, 1000.5)])
def test_one_registration_at_most(cycles: int, dead: float):
    system = view(dead, cycles)
    law, joint = ml.count_law(ml.Flux(0.02, 0.001, 50.0), system), ml.joint_law(ml.Flux(0.02, 0.001, 50.0), system)
    chance = -math.expm1(-0.021 * cycles)
    np.testing.assert_allclose(law.pmf[:2], [1.0 - chance, chance], atol=1e-9)
    assert joint.count_mean == pytest.approx(chance, rel=1e-6)
    assert joint.count_variance == pytest.approx(chance * (1.0 - chance), rel=1e-5)


# Laws that would take longer than two seconds


# The joint law of an exposure that forgets its start long before its end


def test_joint_law_known_to_settle(monkeypatch: pytest.MonkeyPatch):
    """Given up after some 50 of 300 periods, the fall of the distance so far tells when it is within the tolerance."""
    system = view(2.04, 10**7)
    law = ml.joint_law(ml.Flux(4.0, 0.1, 50.0), system)
    monkeypatch.setattr(pixel_module, "LAW", replace(LAW, transient=100_000))
    early = ml.joint_law(ml.Flux(4.0, 0.1, 50.0), system)
    assert early.settled == pytest.approx(law.settled, rel=0.1)
    assert early.settled != law.settled
    assert early.count_variance == pytest.approx(law.count_variance, rel=1e-9)
    np.testing.assert_allclose(early.mean, law.mean, rtol=1e-9)
    for cycles in (800, 10**5):  # not within a third of the exposure; a pixel that has told nothing yet
        with pytest.raises(ConvergenceError, match="engine 'exact'"):
            ml.joint_law(ml.Flux(6.0, 0.05, 50.0), view(1.97, cycles, bins=1024, sigma=0.002))


# Refusals


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "background", "dead", "cycles", "sigma", "start"),
    [
        (219.457, 208.209, 6.000022, 4_381_356, 0.05, "armed"),
        (3.21, 24.75, 7.785, 14_893_667, 3.17e-4, "stationary"),
        (1.7, 6.3, 367_230.6, 10**7, 0.001, "stationary"),
    ],
)
def test_refusals_say_what_to_use(signal: float, background: float, dead: float, cycles: int, sigma: float, start: str):
    system = view(dead, cycles, sigma, start)
    message = r"; use .*joint_law.*simulate it with engine 'exact'"
    shapes = () if start == "stationary" else (mean_histogram, ml.registration_pdf)  # every period has the same one
    for law in (ml.count_law, *shapes):
        refused(message, law, ml.Flux(signal, background, 50.0), system, error=(ConvergenceError, MemoryError))


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "dead", "cycles", "sigma", "start"),
    [(1.0, 1e-6, 1, 1e-6, "stationary"), (1000.0, 1e-6, 2, 1e-6, "armed")],
)
def test_work_of_refused_laws(
    monkeypatch: pytest.MonkeyPatch, signal: float, dead: float, cycles: int, sigma: float, start: str
):
    """A refusal comes before the budget is spent: the light of each grid is in it, and the periods run."""
    done: list[float] = []
    run = moments_module._run

    def recorded(cells: Cells, bins: int, *arguments: Any) -> Any:
        result = run(cells, bins, *arguments)
        done.append(float(bins) * (10.0 + min(cycles, max(int(result.settled[0]), 1))))
        return result

    monkeypatch.setattr(moments_module, "_run", recorded)
    with pytest.raises(ConvergenceError, match="the limit of a law"):
        ml.count_law(ml.Flux(signal, 0.0, 50.0), view(dead, cycles, sigma, start))
    assert sum(done) <= LAW.recursion


def test_a_law_that_is_refused_is_to_be_had_elsewhere(monkeypatch: pytest.MonkeyPatch):
    system = view(2.04, 20_000)
    expected = exposure_moments(ml.Flux(4.0, 0.1, 50.0), system)
    monkeypatch.setattr("mars_lidar.statistics.count_laws.LAW", replace(LAW, recursion=1e4, one_pass=1e4))
    refused("exposure_moments, which may take", ml.count_law, ml.Flux(4.0, 0.1, 50.0), system, error=ConvergenceError)
    assert exposure_moments(ml.Flux(4.0, 0.1, 50.0), system).mean == expected.mean
    assert ml.joint_law(ml.Flux(4.0, 0.1, 50.0), system).count_mean == pytest.approx(float(expected.mean), rel=1e-6)


def test_a_dead_time_of_many_periods_is_refused_before_the_work():
    """What is remembered of it does not fit near the processor, where a step costs six times as much.

    A like one was refused after 14 s; now no pass over the periods begins.
    """
    system = view(60_000.3, 60_000_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mars_lidar.statistics.moments.native_light", None)
        refused("joint_law", ml.count_law, ml.Flux(4.0, 0.13, 50.0), system, error=ConvergenceError)


def test_counts_far_from_zero_are_unwrapped_at_once():
    """Law of some 1e9 counts of a detector without dead time but in name: a Poisson law, to its far end.

    Unwrapping by subtraction took a minute for 1e11 counts.
    """
    law = ml.count_law(ml.Flux(0.0, 1000.0), view(1e-12, 1_000_000))
    first, p = law.support[0], law.pmf
    known = stats.poisson.pmf(first + np.arange(p.size), 1e9)
    assert np.abs(p - known).max() < 1e-3 * known.max()


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", [0.0, 1e-4, 0.5, 1.0, 1e6])
@pytest.mark.parametrize(("signal", "background"), [(0.0, 0.0), (1000.0, 1000.0), (1e-6, 0.0), (0.0, 1e-6)])
def test_corners(signal: float, background: float, dead: float, start: str):
    """One period, two bins: no flux, much of it, no dead time, a million periods of it."""
    system = view(dead, 1, start=start, bins=2)
    total = signal + background
    law = ml.count_law(ml.Flux(signal, background, 50.0), system)
    if total == 0.0:
        mean = 0.0
    elif dead == 0.0:
        mean = total
    elif start == "armed" and dead >= 1.0:
        mean = -math.expm1(-total)
    elif start == "stationary" and dead in (1.0, 1e6):
        mean = total / (1.0 + dead * total)
    else:
        mean = float(law.mean)
    assert law.mean == pytest.approx(mean, rel=1e-5, abs=1e-300)
    assert law.pmf.sum() == pytest.approx(1.0, abs=1e-8)
    assert law.pmf.min() >= 0.0
    histogram = mean_histogram(ml.Flux(signal, background, 50.0), system)
    assert histogram.sum() == pytest.approx(mean, rel=1e-4, abs=1e-300)
    if start == "stationary" and dead == 1e6 and total > 0.0:  # a million periods of history
        refused("use exposure_moments", ml.joint_law, ml.Flux(signal, background, 50.0), system, error=ConvergenceError)
    else:
        joint = ml.joint_law(ml.Flux(signal, background, 50.0), system)
        assert joint.count_mean == pytest.approx(mean, rel=1e-3, abs=1e-300)
    for method in ("exposure", "stationary"):
        shape = ml.registration_pdf(ml.Flux(signal, background, 50.0), system, method)  # type: ignore[arg-type]
        assert shape.sum() == pytest.approx(1.0, abs=1e-9)


# Histograms of many bins


@pytest.mark.full
@pytest.mark.parametrize("bins", [2**16, 2**18])
def test_joint_law_of_many_bins(bins: int):
    """Sweeps over many bins stop at the rounding that these add up: the law of an ordinary pixel has been refused."""
    system = view(0.33, bins=bins)
    law, known = (
        ml.joint_law(ml.Flux(2.0, 0.1, 50.0), system),
        exposure_moments(ml.Flux(2.0, 0.1, 50.0), system.replace(bins=2)),
    )
    assert law.count_mean == pytest.approx(float(known.mean), rel=1e-7)
    assert law.count_variance == pytest.approx(float(known.variance), rel=1e-5)
    assert law.mean.reshape(2, -1).sum(-1) == pytest.approx(known.histogram, rel=1e-6)


# Paralyzable pixels over 1e8 cycles


def test_sum_of_a_locked_paralyzable_histogram():
    """One registration in a pulse, all but certainly: 25 of 1e8 were missing where the standard deviation is 21."""
    signal, background, dead, sigma, cycles = 13.633258958387843, 2.438748405257062e-6, 0.01560524, 0.00340945, 10**8
    flux = ml.Flux(signal, background, 48.73361176147202)
    system = system_of(dead, cycles, 20, sigma=sigma, start="stationary", mode="paralyzable")
    law = ml.count_law(flux, system)
    total = mean_histogram(flux, system).sum()
    assert total == pytest.approx(float(law.mean), abs=1e-3 * math.sqrt(law.variance))

    def rate(t: float) -> float:  # in units of the pulse's standard deviation
        within = special.ndtr(t) - special.ndtr(t - dead / sigma)
        arrivals = signal * stats.norm.pdf(t) + background * sigma
        return float(arrivals * math.exp(-signal * within - background * dead))

    edges = np.arange(-9, 15)
    near = sum(integrate.quad(rate, low, high, epsabs=1e-15)[0] for low, high in pairwise(edges))
    far = background * math.exp(-background * dead) * (1.0 - 23.0 * sigma)
    assert total == pytest.approx(cycles * (near + far), abs=0.01)


def test_law_of_the_rarest_counts():
    """Five registrations in 1e14 cycles: what a cycle adds to the transform is below the rounding of its value."""
    random = np.random.default_rng(191)
    values = random.exponential(size=random.integers(2, 60)) ** 2
    width = 6.0 * 0.89668936297419 / values.size
    peak = int(np.argmax(values)) + 0.5
    first = math.ceil(peak - 0.5 * values.size)  # the record begins opposite its peak, to which the delay refers
    pulse = ml.SampledPulse(np.roll(values, -first), bin_ns=width, origin="first")
    system = system_of(1.8447915165050697, 10**8, 3, pulse=pulse, start="stationary", mode="paralyzable")
    delay = 26.156558173394107 + (first - peak) * width
    law = ml.count_law(ml.Flux(30.691961747883113, 0.012734252622743272, delay), system)
    assert law.mean == pytest.approx(4.58244e-6, rel=1e-5)
    assert law.pmf @ law.support == pytest.approx(float(law.mean), rel=1e-7)
    assert law.pmf[2] == pytest.approx(0.5 * law.mean**2, rel=0.01)


# A sweep: whatever is not refused agrees with all else


def test_a_warm_state_that_is_not_found_is_refused():
    """Nothing solved was taken for a solution: a uniform shape, and exposures that began armed (signal 1000, just below
    a lock)."""
    system = view(0.9997565745952581, 1, 0.011089244157797067, "stationary", bins=1430)
    flux = ml.Flux(1000.0, 0.1484680065940475, 0.890211598817147 * PERIOD_NS)
    assert relative_residual(np.ones(3), np.zeros(3)) == math.inf
    assert relative_residual(np.zeros(3), np.zeros(3)) == 0.0
    for law in (
        lambda: ml.registration_pdf(flux, system, "stationary"),
        lambda: mean_histogram(flux, system),
        lambda: ml.count_law(flux, system),
        lambda: ml.joint_law(flux, system),
    ):
        refused(r"engine 'exact'", law, error=ConvergenceError)


@pytest.mark.full
@pytest.mark.parametrize("first", range(0, 48, 8))
def test_random_systems(first: int):
    """Laws of systems of the sweep agree with each other and with closed forms; refusals say what to do."""
    for number in range(first, first + 8):
        case = draw(20_000, number)
        if case.system.dead_time_periods > 300.0 or case.system.bins > 4096:  # right, but slow: `tests.domain`
            continue
        for name, law in Predictions(case).steps():
            wrong = []
            try:
                wrong = [check for check in law() if check.p < 1.0]
            except (ValueError, ConvergenceError, MemoryError) as error:
                if not refusal(error):
                    raise
            assert not wrong, (case.facts(), name, wrong)


def test_stationary_histograms_of_any_bins() -> None:
    """Of a pixel locked to every third pulse: 4096 bins were refused where 16 were computed in .05 s."""
    light = ml.Flux(71.9, 0.342, 37.0)
    systems = [view(2.54833, 1127, 0.00203, "stationary", bins=bins) for bins in (16, 4096)]
    coarse, fine = (mean_histogram(light, system) for system in systems)
    law = exposure_moments(light, systems[0])
    assert coarse.sum() == pytest.approx(float(law.mean), abs=1e-4 * float(law.std))
    assert coarse == pytest.approx(law.histogram, abs=1e-4 * float(law.mean))
    assert fine.reshape(16, -1).sum(1) == pytest.approx(coarse, abs=1e-4 * float(law.mean))


# Laws of pulses narrower than the bins of their grid, where a pulse meets itself a dead time later: right or refused.
#
# Without background a pixel knows of a pulse's width, and of what the dead time misses of a whole number of periods,
# only their ratio: the law of a pulse a thousand times as wide is the same one, on bins that resolve it.


WIDE = 1e-3
DARK = 1e-9  # background

Figures = tuple[float, float]


def system(dead: float, sigma: float, cycles: int = 50, start: str = "armed", **detector: Any) -> ml.System:
    """Times in periods."""
    return system_of(dead, cycles, 2, sigma=sigma, start=start, **detector)


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


SIMULATED: dict[str, tuple[tuple[float, float, float], ml.System, str]] = {
    **{
        f"a pulse of a millionth of a period at {delay}": ((1.5, 0.1, delay), system(1.0, 1e-6), "sequential")
        for delay in (0.0, 0.5, 0.5 + 2e-6)
    },
    "stationary, at most one count": (
        (0.648, 0.208, 0.2815),
        system(24.745, 0.00628, 20, "stationary", jitter=ml.Jitter(sigma_ns=0.000355 * PERIOD_NS)),
        "exact",
    ),
    "stationary, two or three counts": ((6.19, 0.0637, 0.0), system(28.504, 0.0689, 60, "stationary"), "exact"),
}


@pytest.mark.parametrize("name", SIMULATED)
def test_moments_are_those_of_a_simulation(name: str) -> None:
    (signal, background, delay), view, engine = SIMULATED[name]
    flux, shots = ml.Flux(signal, background, delay * PERIOD_NS), 40_000
    counts = ml.simulate(flux, view, engine=engine, realizations=shots, seed=17).sum(-1).ravel()
    law = exposure_moments(flux, view)
    mean, variance = float(law.mean), float(law.variance)
    require(
        {
            "mean": 2.0 * stats.norm.sf(abs(counts.mean() - mean) / np.sqrt(variance / shots)),
            "variance": 2.0 * stats.norm.sf(abs(variance_score(counts[:, None], variance)[0])),
        },
        name,
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


@pytest.mark.parametrize("lattice", [1, 2, 3])
def test_laws_on_a_lattice_take_all_points(monkeypatch: pytest.MonkeyPatch, lattice: int):
    """Counts that come in pairs have a second peak of the transform at -1, as narrow as the first."""
    system, variance = view(0.5, 10_000), 3000.0 * lattice**2

    def transform(cells: Cells, re: np.ndarray, im: np.ndarray, *_: Any) -> tuple[np.ndarray, np.ndarray]:
        value = np.exp(0.3 * cells.system.cycles * ((re + 1j * im) ** lattice - 1.0))
        return value.real, value.imag

    monkeypatch.setattr(pmf_module, "characteristic", transform)
    size = 2 * math.ceil(8 * math.sqrt(variance))
    result = pmf_module._narrow(Cells.of(1.0, 1.0, system), size, 128, 1, variance, pmf_module.Remaining())
    assert (result is not None) == (lattice == 1)


def test_narrow_pulses_that_nothing_re_arms_within() -> None:
    """No more bins than before: a dead time apart from whole periods, no dead time, or no light in the pulse."""
    for dead, signal in ((0.5, 1.0), (0.0, 1.0), (1.0, 0.0), (2.3, 1.0)):
        cells = Cells.of(signal, 0.1, system(dead, 1e-6)).resolved(1)
        assert cells.follow == 0
        assert cells.first_bins(1) <= 2**14
