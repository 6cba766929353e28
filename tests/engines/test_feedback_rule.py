"""Which pixels the feedback engine gives to the exact one, its bits, and the auto engine's choice."""

from typing import Any

import numpy as np
import pytest
from feedback_cases import GIVEN, SAMPLED, Sampler, case, drawn, kinds_of
from harness import PERIOD_NS, Case, flux_of, make_system, refused, require, task_of, two_lobes, waveform_flux
from instrument.effect_checks import bits_do_not_depend
from numpy.typing import NDArray
from scipy import stats

import mars_lidar as ml
from mars_lidar import Detector, System, _core
from mars_lidar.engines.auto import AutoEngine
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import Check, FeedbackEngine, Grids, cells_of, expected_registrations, least_power
from mars_lidar.engines.tolerances import TOL

# What is given to other engines


def mixture(cycles: int = 600, **changes: Any) -> tuple[ml.Flux, System]:
    """Dim and bright pixels, some of them beyond the sampler."""
    y, x = np.mgrid[:6, :11]
    signal = np.where((x + y) % 5 == 0, 0.0, 0.01 * 2.0 ** ((3 * x + 7 * y) % 11))
    background = 0.02 * 4.0 ** ((x + 5 * y) % 7)
    system = case(0, 0, 0.6375, cycles, bins=50, **changes).system
    return ml.Flux(signal, background, 9.7 * x - 31.3 * y), system


def test_refused_pixels_have_the_bits_of_exact():
    flux, system = mixture()
    report: dict[str, float] = {}
    cube = ml.simulate(flux, system, engine="feedback", realizations=3, seed=5, report=report)
    exact = ml.simulate(flux, system, realizations=3, seed=5)
    same = (cube == exact).all((0, 3))
    assert same.sum() == report[GIVEN] > 3
    assert same[flux.background > 40].all()
    assert not same[(flux.background < 5) & (flux.signal < 0.5)].any()


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        (case(1.0, 1.0, 0.6375, 99), "short exposure"),
        (case(1.0, 1.0, 2.5, 299), "short for its dead time"),
        (case(5.0, 1.0, 0.6375, 1000), "few armed after the pulse"),
        (case(1.0, 6.0, 0.6375, 200), "ghosts beside a narrow count"),
        (case(3.0, 3.0, 3.5, 1000), "count hardly varies"),
        (case(1.0, 40.0, 0.6375, 1000), "slow sweeps"),
        (case(1.0, 1.0, 1e-6, 1000), "bins"),
    ],
)
def test_what_the_rule_refuses(request_: Case, why: str):
    given = task_of(request_, 1, realizations=2)
    out = np.empty((given.items, request_.system.bins), request_.system.histogram_dtype)
    FeedbackEngine().histogram(given, out)
    assert given.report[GIVEN] == 4, why
    again = np.empty_like(out)
    ExactEngine().histogram(given, again)
    assert np.array_equal(out, again)


def test_no_dead_time_is_poisson_at_any_length():
    request = case(0.5, 0.5, 0.0, 100_000_000, items=2000)
    x = drawn(Sampler(), request)
    mean = 1e8 * (0.5 / 128 + 0.5 * request.system.pulse.bin_energy(37.0, PERIOD_NS, 128))
    z = (x.sum(0) - 2000 * mean) / np.sqrt(2000 * mean)
    require({"bins": float(stats.chi2.sf(z @ z, z.size))}, "feedback, no dead time")


VARIANCES = {  # S, B, delay, t_d, sigma (ns of 100), cycles, bins, start; they were 1.15 to 8 times too large
    "bright background": (0.0, 100.9, 86.3, 7.98, 9.7, 23_394, 24, "armed"),
    "two bins": (0.03, 40.9, 99.9, 52.743, 0.49, 1_530, 2, "armed"),
    "whole period, narrow pulse": (2.89, 2e-6, 53.77, 100.0, 0.063, 15_476, 64, "armed"),
    "whole period, narrower than any bin": (2.9, 0.05, 53.77, 100.0, 0.006, 30_000, 16, "armed"),
    "constant light, nearly three periods": (0.0, 4.08, 0.0, 299.944, 0.05, 9_975_432, 4, "stationary"),
}


LONG = "whole period, narrower than any bin"


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.full] * (name == LONG)) for name in VARIANCES])
def test_the_count_has_the_variance_of_its_law(name):
    """4,000 exposures: 2.2 % is one standard error of the variance, 4.5 of them fail (7e-6)."""
    signal, background, delay, dead, sigma, cycles, bins, start = VARIANCES[name]
    system = make_system(dead, cycles, bins, sigma_ns=sigma, start=start)
    flux = ml.Flux(signal, background, delay)
    report: dict[str, float] = {}
    cube = ml.simulate(flux, system, engine="feedback", realizations=4_000, seed=5, report=report)
    assert report["pixels given to exact"] == 0
    variance = float(np.ravel(ml.count_law(flux, system).variance)[0])
    assert abs(cube.sum(-1).var(ddof=1) / variance - 1.0) < 4.5 * (2.0 / 4_000) ** 0.5


@pytest.mark.parametrize("signal", [13.0, 16.0, 20.0, 50.0, 898.0])
def test_a_bright_pulse_across_the_edge_of_a_bin_leaves_little_behind_it(signal):
    """Behind the edge register those that the first half of the pulse has left, e^(-S/2) of all, nearly Poisson.

    4,000 exposures; the mean and the variance may be 4.5 standard errors (7e-6) and 0.05 of the law's deviation off.
    Up to 12 of 25,881 too many were there (S = 50), or a fifth too few (16).
    """
    system = make_system(20.0, 25_881, 8, sigma_ns=0.0288)
    counts = ml.simulate(ml.Flux(signal, 4e-6, 50.0), system, engine="feedback", realizations=4_000, seed=4)[:, 0, 0]
    far, law = counts[:, 4], 25_881 * np.exp(-0.5 * signal)
    light = 4e-6 * 25_881 / 8 + law  # of the background too
    assert abs(far.mean() - light) < (4.5 / 4_000**0.5 + 0.05) * light**0.5
    assert far.var() < (1.0 + 4.5 * ((2.0 + 1.0 / light) / 4_000) ** 0.5 + 0.05) * light
    assert abs(counts.sum(-1).mean() - 25_881.06) < 0.2


def off(request: Case, kinds: NDArray[np.uint8]) -> float:
    """Distance of a grid's mean histogram from that of one of half its cells' width."""
    check = Check.of(task_of(request, 1, realizations=1), np.arange(1), kinds)
    return float(check.distance[0]) / TOL.richardson


def test_bins_are_cut_where_light_and_its_echo_are():
    request = case(1.0, 1.0, 0.6375, 100_000_000)
    kinds = kinds_of(request)
    pulse, echo = np.arange(60, 69), np.arange(60, 69) + 82 - 128  # counted from half a period before the return
    dark = np.setdiff1d(np.arange(128), np.concatenate([np.arange(57, 72), np.arange(57, 74) + 81 - 128]))
    assert kinds[pulse].min() > kinds[dark].max()
    assert kinds[echo].max() > kinds[dark].max()
    shorter = kinds_of(case(1.0, 1.0, 0.6375, 1000))
    assert 128 <= cells_of(shorter) < 2 * 128 < cells_of(kinds)


GRIDS = {
    "dim": case(0.1, 0.1, 0.6375, 10_000_000),
    "own echo": case(3.0, 0.5, 0.996, 100_000),
    "bright echo": case(8.0, 0.05, 1.01, 100_000),
    "spike in a long record": case(10.0, 0.5, 0.6, 1_000_000, pulse=ml.SampledPulse(np.r_[[1e-4] * 99, 0.2], 0.5)),
    "returns": Case("two", flux_of([1.0, 0.5], 0.3, [0.2, 0.4]), case(0, 0, 0.6375, 1_000_000).system, 1),
    "waveform": Case("lobes", waveform_flux(two_lobes(), 0.1), case(0, 0, 0.6375, 1_000_000).system, 1),
}


@pytest.mark.parametrize("name", GRIDS)
def test_the_mean_is_that_of_a_finer_grid_and_no_cell_is_cut_in_vain(name: str):
    kinds = kinds_of(GRIDS[name])
    assert off(GRIDS[name], kinds) <= TOL.mean_distance
    assert off(GRIDS[name], np.maximum(kinds, 1) - 1) > TOL.mean_distance / 4


def test_powers_are_the_least_that_are_not_below():
    """At powers of two and the next double on either side, where a rounded logarithm may be off by one."""
    for octaves in (1, 2, 5):
        for k in range(-9, 9):
            power = 2.0 ** (octaves * k)
            ratios = np.array([np.nextafter(power, 0.0), power, np.nextafter(power, np.inf)])
            assert least_power(octaves, ratios, -10, 10).tolist() == [k, k, k + 1]
    assert least_power(2, np.array([0.0, 1e9]), 1, 4).tolist() == [1, 4]


def test_laps_are_foreseen_where_few_are_armed():
    task = task_of(case(20.0, 0.5, 0.93, 100_000), 1, realizations=1)
    assert Grids.checked(task, np.arange(1)).laps()[0] >= 3
    task = task_of(case(1.0, 1.0, 0.6375, 100_000), 1, realizations=1)
    assert Grids.checked(task, np.arange(1)).laps()[0] == 1


def test_flat_light_needs_no_cuts():
    assert (kinds_of(case(0.0, 1.0, 0.6375, 1000)) == 0).all()
    short = task_of(case(0.0, 1.0, 1e-6, 1000), 1, realizations=1)
    assert Grids.checked(short, np.arange(1)).of[0] == -1


# Bits


KINDS = ("short", "long", "sampled", "whole periods", "returns", "waveform")


def image(kind: str) -> tuple[ml.Flux, System]:
    cycles = {"long": 20_000_000, "whole periods": 6000}.get(kind, 600)
    flux, system = mixture(cycles, start="stationary" if kind == "sampled" else "armed")
    flux = flux if kind != "long" else ml.Flux(flux.signal, np.minimum(flux.background, 1.0), flux.delay_ns)
    if kind == "sampled":
        system = system.replace(pulse=SAMPLED)
    elif kind == "whole periods":
        system = system.replace(detector=Detector(dead_time_ns=200.0))
        flux = ml.Flux(np.minimum(flux.signal, 1.0), np.minimum(flux.background, 0.1), flux.delay_ns)
    elif kind == "returns":
        flux = ml.Flux.multi(flux, ml.Flux(0.3 * flux.signal, 0.1, flux.delay_ns + 20.0))
    elif kind == "waveform":
        wave = flux.signal[..., None] * np.roll(two_lobes(), 7) / two_lobes().sum()
        flux = ml.Flux(waveform=wave, background=flux.background)
    return flux, system


@pytest.mark.parametrize("level", _core.levels())
@pytest.mark.parametrize("kind", KINDS)
def test_levels_give_the_same_bits(kind: str, level: str):
    flux, system = image(kind)
    report: dict[str, float] = {}
    if kind == "long":
        flux = flux[:, :8][flux.shape[0] // 2 :]
    same = [
        ml.simulate(flux, system, engine=Sampling(name), realizations=2, seed=7, report=report)
        for name in (_core.levels()[-1], level)
    ]
    assert np.array_equal(*same)
    assert report["pixels sampled"] > 0.5 * flux.background.size


class Sampling(FeedbackEngine):
    """The sampled pixels only: rows of the others stay 0."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        out[...] = 0
        rest = self.sample(task, out, np.arange(task.pixel_index.size))
        task.report["pixels sampled"] = float(task.pixel_index.size - rest.pixels.size)


@pytest.mark.parametrize("engine", ["feedback", "auto"])
def test_parts_and_threads(engine: str):
    bits_do_not_depend(*mixture(3000), engine)


def test_level_must_run_here():
    with pytest.raises(ValueError, match="level must be one that this processor runs, got 'mmx'"):
        drawn(FeedbackEngine("mmx"), case(1.0, 1.0, 0.6375, 1000, items=4))


@pytest.mark.full
@pytest.mark.parametrize("engine", ["feedback", "auto"])
def test_progress_runs_once_to_its_end(engine: str):
    flux, system = mixture()
    recorded: list[float] = []
    ml.simulate(flux, system, engine=engine, realizations=3000, progress=lambda done, of: recorded.append(done / of))
    assert len(recorded) > 1  # every 50 ms, and at the end
    assert recorded[-1] == 1.0
    assert recorded == sorted(recorded)


# The choice


def test_auto_takes_the_cheaper_engine():
    flux, system = mixture(3000)
    report: dict[str, float] = {}
    cube = ml.simulate(flux, system, engine="auto", seed=5, report=report)
    feedback = ml.simulate(flux, system, engine="feedback", seed=5)
    exact = ml.simulate(flux, system, seed=5)
    by_feedback = (cube == feedback).all((0, 3)) & ~(cube == exact).all((0, 3))
    by_exact = (cube == exact).all((0, 3))
    assert (by_feedback | by_exact).all()
    assert report["pixels drawn by feedback"] == by_feedback.sum() > 10
    assert report["pixels drawn by exact"] == by_exact.sum() > 10
    registrations = expected_registrations(flux, system)
    assert registrations[by_feedback].min() > 4 * system.bins


def test_auto_is_exact_for_short_exposures():
    flux, system = mixture(50)
    assert np.array_equal(ml.simulate(flux, system, engine="auto", seed=5), ml.simulate(flux, system, seed=5))


def test_auto_draws_no_timestamps():
    flux, system = mixture(50)
    refused("draws histograms only", ml.simulate_timestamps, flux, system, engine=AutoEngine())


@pytest.mark.parametrize("engine", ["feedback", "auto"])
@pytest.mark.parametrize("bins", [1, 2, 3, 4096])
@pytest.mark.parametrize("dead_ns", [0.0, 1e-9, 1e-3, 0.5])
def test_no_dead_time_is_too_short_for_few_bins(dead_ns: float, bins: int, engine: str):
    """Cells that would have to be narrower than the kernels can make them are left to exact."""
    system = make_system(dead_ns, 7568, bins, sigma_ns=4.0)
    exact = ml.simulate(ml.Flux(18.5, 0.6, [[30.0] * 40]), system, seed=3).sum(-1).mean()
    drawn = ml.simulate(ml.Flux(18.5, 0.6, [[30.0] * 40]), system, seed=4, engine=engine).sum(-1).mean()
    assert abs(drawn - exact) < 6.0 * np.sqrt(2.0 * exact / 40)
