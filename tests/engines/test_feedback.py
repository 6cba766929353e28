"""The feedback engine where it samples itself, against the closed form of the covariance and the exact engine."""

from typing import Any

import numpy as np
import pytest
from harness import COUNTS, JOINT, REFERENCE_NAMES, SHAPE, JointLaw, Reference, check, require, task_of
from harness.cases import PERIOD_NS, Case, flux_of, make_system, measured_pulse, two_lobes, waveform_flux
from instrument.effect_checks import bits_do_not_depend
from numpy.typing import NDArray
from scipy import stats

import mars_lidar as ml
from mars_lidar import Detector, Flux, SampledPulse, System, _core, joint_law
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import Check, FeedbackEngine, Grids, KindArray, expected_registrations
from mars_lidar.engines.tolerances import TOL

GIVEN = "pixels given to exact"
SAMPLED = SampledPulse(two_lobes(), 0.1, "centroid")


class Sampler(FeedbackEngine):
    """The feedback engine that fails where it would give a pixel to the exact engine."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        super().histogram(task, out)
        assert task.report[GIVEN] == 0


def case(
    signal: float,
    background: float,
    dead: float,
    cycles: int,
    *,
    delay: float = 0.37,
    sigma: float = 0.01,
    items: int = 4000,
    **changes: Any,
) -> Case:
    system = make_system(dead * PERIOD_NS, cycles, 128, sigma_ns=sigma * PERIOD_NS).replace(**changes)
    name = f"S {signal:g}, B {background:g}, t_d {dead:g}, {cycles} cycles, {system.start}"
    return Case(name, flux_of(signal, background, delay), system, items)


def kinds_of(request: Case) -> KindArray:
    """Halvings of the bins in the engine's grid of the case's one pixel."""
    grids = Grids.checked(task_of(request, 1, realizations=1), np.arange(1))
    return grids.kinds[grids.of[0]]


def drawn(engine: Any, request: Case, seed: int = 1) -> NDArray[np.int64]:
    task = task_of(request, seed)
    out = np.empty((task.items, request.system.bins), request.system.histogram_dtype)
    engine.histogram(task, out)
    return out.astype(np.int64)


CLAIMS = {COUNTS, SHAPE, JOINT}


# The covariance in closed form


CLOSED = {
    "middle": case(1.0, 1.0, 0.6375, 4000),
    "bright": case(4.5, 1.0, 0.6375, 4000),
    "dim": case(0.1, 0.1, 0.6375, 20_000),
    "short dead time": case(2.0, 5.0, 0.1, 1000),
    "long dead time": case(1.0, 0.5, 1.53125, 4000),
    "slow": case(1.0, 7.0, 0.6375, 4000),
    "locked": case(8.0, 0.1, 0.9, 1_000_000),
    "whole period": case(0.8, 0.5, 1.0, 4000),
    "pulse at the edge": case(2.0, 0.5, 0.6375, 4000, delay=0.002),
    "bins of half counts": case(0.5, 0.05, 0.3, 1500),
    "1e7 cycles": case(1.0, 1.0, 0.6375, 10_000_000, items=2000),
    "1e8 cycles": case(0.3, 0.4, 0.6375, 100_000_000, items=2000),
    "1e8 cycles, long dead time": case(0.8, 0.3, 2.26, 100_000_000, items=2000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", CLOSED)
def test_mean_and_covariance_are_those_of_the_closed_form(name: str):
    check(Sampler(), CLOSED[name], JointLaw.of(CLOSED[name]), CLAIMS)


def test_few_counts_have_the_variance_of_their_means_too():
    """Followed to first order alone, quantiles lack the variance of mu: here 0.4 % of that of each bin."""
    request = case(2.0, 5.0, 0.1, 400, bins=512, items=20_000)
    law = joint_law(Flux(2.0, 5.0, float(request.flux.delay_ns[0, 0])), request.system, tolerance=1e-4)
    x = drawn(Sampler(), request)
    square = (((x - law.mean) ** 2) / law.variance).mean(1)  # a number for each exposure: bins depend on each other
    z = (square.mean() - 1.0) / (square.std() / np.sqrt(len(x)))
    require({"bin variances": float(2 * stats.norm.sf(abs(z)))}, "feedback, few counts, all bins together")


# The exact engine


AGAINST_EXACT = {
    "stationary": case(1.0, 1.0, 0.6375, 1000, start="stationary"),
    "stationary, long dead time": case(0.8, 0.3, 1.7, 1000, start="stationary"),
    "100 cycles": case(0.3, 0.3, 0.6375, 100, items=8000),
    "just below a period": case(1.0, 0.5, 0.996, 1500),
    "just above a period": case(2.0, 0.1, 1.004, 2000, start="stationary"),
    "one bin of dead time": case(2.0, 1.0, 0.0075, 500),
    "dead time below a bin": case(0.5, 0.5, 0.001, 500),
    "two lobes": case(2.0, 0.5, 0.3, 1000, pulse=SAMPLED),
    "narrow": case(2.0, 0.5, 0.6375, 1000, sigma=0.002),
    "wide": case(2.0, 0.5, 0.6375, 1000, sigma=0.2),
    "one bin": case(2.0, 0.5, 0.6375, 1000, bins=1),
    "seven bins": case(1.0, 1.0, 0.31, 1000, bins=7, items=8000),
    "background": case(0.0, 2.0, 0.45, 1000),
    "no background": case(1.5, 0.0, 0.45, 1000),
}


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("light", ["returns", "waveform"])
def test_returns_and_waveforms(light: str, start: str):
    wave = np.random.default_rng(3).exponential(size=300) ** 3
    flux = flux_of([1.0, 0.4, 0.8], 0.5, [0.2, 0.215, 0.9])
    if light == "waveform":
        flux = waveform_flux(1.5 * wave / wave.sum(), 0.3)
    system = case(0, 0, 0.6375, 1000, start=start).system
    check(Sampler(), Case(light, flux, system, 4000), ENGINES["exact"], CLAIMS)


def test_measured_pulse():
    pulse = measured_pulse("face_free_8ps", 10.0)
    check(Sampler(), case(3.0, 0.3, 0.8, 3000, pulse=pulse), ENGINES["exact"], CLAIMS)


FEW_ARMED = {"s02_bright", "s04_saturated", "s08_fewphotons", "s09_hw_bright", "s10_resonant"}  # given to exact


@pytest.mark.parametrize("name", sorted(set(REFERENCE_NAMES) - FEW_ARMED))
def test_reference_is_drawn_by_the_sampler(name: str):
    """The harness compares with the references; here, that it is not the exact engine that passes there."""
    request = Reference.load(name).case(photons=1e5)
    drawn(Sampler(), request)


# Pixels locked within one period: pieces of several laps, against the exact engine; and what an image may not hold.


PAPER_PERIOD_NS = 1e3 / 7.5


def locked(signal: float, background: float, dead: float, cycles: int, sigma: float, bins: int, **changes: Any) -> Case:
    return case(signal, background, dead, cycles, sigma=sigma, bins=bins, **changes)


LOCKED = {  # feedback failed in all of them before it had laps
    "S 8, dead time 0.93": locked(8.0, 1.0, 0.93, 20_000, 0.00375, 64),
    "S 4.6, B 7.7, dead time 0.964": locked(4.6, 7.7, 0.964, 100_003, 0.0032, 16, items=800),
    "S 6.94, dead time 0.887": locked(6.94, 1.45, 0.887, 20_003, 0.0064, 16),
    "S 20, dead time 0.97": locked(20.0, 2.0, 0.97, 20_000, 0.00375, 64, start="stationary"),
    "S 9, dim background, dead time 0.9": locked(9.0, 0.1, 0.9, 20_000, 0.01, 128),
    "S 67, stationary": locked(66.8, 1.0, 0.766, 20_000, 0.0023, 64, delay=0.98, start="stationary"),
    # counts of a variance of 0 to some, of pixels that keep to every second, third or fourth pulse: none was drawn
    "S 13, dead time 3.49": locked(12.7, 0.017, 3.488, 100_000, 0.003, 64),
    "S 81, dead time 2.77, stationary": locked(81.4, 0.5, 2.773, 100_000, 0.003, 64, start="stationary"),
    "S 13, dead time 1.785, stationary": locked(13.2, 0.03, 1.785, 100_000, 0.003, 64, start="stationary"),
    "S 22, dead time 1.725": locked(22.0, 0.4, 1.725, 100_000, 0.003, 64),
    # bins of less than one count per exposure, fired in bursts by exposures that are out of phase with the others
    "shadow of a bright pulse": locked(76.5, 2.08, 0.887, 100_007, 0.0047, 16, delay=0.66, items=6000),
    # armed again within the pulse; cells were too wide for what it then does
    "S 50, dead time 2.2 sigma": locked(50.0, 0.03, 0.034, 51_458, 0.0154, 128, start="stationary", items=2000),
    "S 100, dead time 5 sigma": locked(100.0, 5.0, 0.25, 20_000, 0.05, 64, delay=0.42, items=2000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", AGAINST_EXACT | LOCKED)
def test_law_is_that_of_exact(name: str):
    check(Sampler(), (AGAINST_EXACT | LOCKED)[name], ENGINES["exact"], CLAIMS)


SYSTEM = make_system(0.97 * PAPER_PERIOD_NS, 1_000_000, 1024, sigma_ns=0.5, period_ns=PAPER_PERIOD_NS)


BACKGROUND = {  # the total swung for ever in a fifth of such pixels, or they took 0.1 s in laps
    "1.6 periods": case(1.0, 10.0, 1.6, 1_000_000, bins=64, items=2000),
    "1.6 periods, brighter": case(7.0, 18.0, 1.6, 10_000_000, bins=64, items=2000),
    "2.5 periods": case(1.0, 15.0, 2.5, 1_000_000, bins=64, items=2000),
    "below a period": case(5.0, 18.0, 0.7273, 10_000_000, bins=64, items=2000),
}


@pytest.mark.full
@pytest.mark.parametrize("name", BACKGROUND)
def test_bright_background_settles_to_its_joint_law(name: str):
    """Every eigenmode of the covariance: mean and variance, and few exposures that are not drawn by the sweeps."""
    request, report = BACKGROUND[name], dict[str, float]()
    pixel = request.flux[0, 0]
    flux = ml.Flux(np.full((1, request.items), pixel.signal), pixel.background, pixel.delay_ns)
    x = ml.simulate(flux, request.system, engine="feedback", seed=4, report=report)[0, 0].astype(float)
    assert report[GIVEN] <= 0.01 * request.items
    law = ml.joint_law(pixel, request.system)
    size = np.sqrt(law.variance)
    value, mode = np.linalg.eigh(law.covariance() / np.outer(size, size))
    selected = value > 1e-3 * value.max()
    y = ((x - law.mean) / size) @ mode[:, selected] / np.sqrt(value[selected])
    assert np.abs(y.mean(0)).max() < 0.05 + 5.0 / np.sqrt(len(x))
    assert np.abs(y.var(0) - 1.0).max() < 0.05 + 5.0 * np.sqrt(2.0 / len(x))


def test_reports_count_by_reason():
    report: dict[str, float] = {}
    flux = ml.Flux([[20.0, 1.0, 1.0]], [[2.0, 1.0, 400.0]], 60.0)
    ml.simulate(flux, SYSTEM.replace(cycles=3000), engine="feedback", seed=1, report=report)
    assert report[GIVEN] == 2
    assert report[f"{GIVEN}, locked in short exposure"] == 1
    assert report[f"{GIVEN}, slow sweeps"] == 1
    assert report["exposures drawn again by exact"] == 0


def test_a_pixel_that_re_arms_just_before_the_next_pulse_is_drawn_whatever_the_exposure():
    """1e8 cycles and 14 laps: exact took 0.6 s for each such pixel, because the judged variance had not converged.

    32 exposures; the mean count may be 4.5 standard errors and 0.05 standard deviations off.
    """
    system = make_system(99.6, 100_000_000, 512, sigma_ns=0.1)
    flux, report = ml.Flux(5.824, 4.044, 30.0), {}
    counts = ml.simulate(flux, system, engine="feedback", realizations=32, seed=1, report=report)[:, 0, 0].sum(-1)
    assert report["pixels given to exact"] == report["exposures drawn again by exact"] == 0.0
    law = ml.count_law(flux, system)
    deviation = float(np.ravel(law.variance)[0]) ** 0.5
    assert abs(counts.mean() - float(np.ravel(law.mean)[0])) < (4.5 / 32**0.5 + 0.05) * deviation


# Bins near any pulse and its echoes: means and variances against the joint law; dead times next to whole periods.


ITEMS = 3000
BIN = PERIOD_NS / 100.0


def reflection() -> ml.SampledPulse:
    """A peak, and 40 % of it 14 % of a period later."""
    t = np.arange(60) * 0.3
    record = np.exp(-0.5 * ((t - 2.0) / 0.3) ** 2) + 0.4 * np.exp(-0.5 * ((t - 16.0) / 0.3) ** 2)
    return ml.SampledPulse(record, 0.3 * BIN, "first")


def peaky(seed: int) -> ml.SampledPulse:
    return ml.SampledPulse(np.random.default_rng(seed).uniform(size=30) ** 5, 0.3 * BIN, "first")


def spike() -> ml.SampledPulse:
    record = np.full(3000, 0.95 / 2999)
    record[100] = 0.05
    return ml.SampledPulse(record, 0.01 * BIN, "first")


def lit(signal: float, background: float, dead: float, delay: float, **changes: Any) -> Case:
    made = {"bins": 100, "delay": delay, "items": ITEMS, "cycles": 1_000_000} | changes
    return case(signal, background, dead, **made)


PULSES = {  # all of them wrong before grids were judged: bins off by .5 to 3.7 standard deviations, or
    "reflection": lit(2.0, 0.13, 0.141, 0.3, pulse=reflection()),
    "reflection, a period more": lit(2.0, 0.13, 1.141, 0.3, pulse=reflection()),
    "thirty samples": lit(2.0, 0.13, 0.04, 0.3, pulse=peaky(1)),
    "thirty others, a period more": lit(2.0, 0.13, 1.07, 0.3, pulse=peaky(2)),
    "spike in a long record": lit(10.0, 0.5, 0.6, 0.2, pulse=spike(), bins=64),
    # with 12 to 22 % too little variance in the bins behind the pulse
    "bright": lit(15.5, 0.0162, 1.1805, 0.54348, sigma=0.012),
    "bright, two periods": lit(15.5, 0.0162, 2.1805, 0.54348, sigma=0.012),
    "bright, short dead time": lit(15.5, 0.0162, 0.185, 0.54348, sigma=0.012),
    "more background": lit(15.5, 0.2, 1.1805, 0.54348, sigma=0.012),
    # 26 % too little in bins of 2,000 cells, armed again by the background of one
    "bright, measured, 2e7 cycles": lit(
        58.8, 0.0241, 1.21565, 0.7416, pulse=peaky(4), bins=64, cycles=20_000_000, start="stationary"
    ),
    # or given to the exact engine
    "bright, next to a period": lit(8.0, 0.5, 1.01, 0.4),
}


LONG = {
    "1e8 cycles, wide bins": case(1.0, 3.0, 0.37, 100_000_000, items=8000),
    "1e8 cycles, short dead time": case(0.6, 5.0, 0.13, 100_000_000, sigma=0.004, items=8000),
    "1e7 cycles, bright": case(8.0, 0.5, 0.6375, 10_000_000, items=8000),
    "1e7 cycles, two periods": case(2.0, 0.2, 2.26, 10_000_000, items=8000),
}


@pytest.mark.parametrize("name", [*LONG, *(pytest.param(name, marks=pytest.mark.full) for name in PULSES)])
def test_bins_have_the_mean_and_variance_of_the_joint_law(name: str):
    """Every bin: mean to 1/20 of a standard deviation, variance to 3 %, beside the error of the sample at 5.5 sigma."""
    request = (PULSES | LONG)[name]
    law = ml.joint_law(request.flux[0, 0], request.system, tolerance=1e-4)
    x = drawn(Sampler(), request).astype(float)
    slack = 0.05 + 5.5 / np.sqrt(len(x))
    selected = law.mean > 0.1
    assert np.abs((x.mean(0) - law.mean)[selected] / np.sqrt(law.variance[selected])).max() < slack
    assert abs(x.sum(1).mean() - law.count_mean) < slack * np.sqrt(law.count_variance)
    many = law.mean > 20.0
    spread = x[:, many].var(0) / law.variance[many] - 1.0
    assert np.abs(spread).max() < 0.03 + 5.5 * np.sqrt(2.0 / len(x))
    together = spread.mean() / np.sqrt(2.0 / len(x) / many.sum())
    assert stats.norm.sf(abs(together)) > 1e-6 or abs(spread.mean()) < 0.01


@pytest.mark.parametrize("engine", ["feedback", "auto"])
def test_dead_times_next_to_whole_periods(engine: str):
    """1,605 of 2,770 such pixels raised an error about the number of laps, and lost their image."""
    random = np.random.default_rng(1)
    for k in range(12):
        apart = float(10.0 ** random.uniform(-9.0, -2.0)) * (1 if k % 3 else -1)
        whole, bins = 1 + k % 3, int(2 ** random.integers(1, 13))
        system = make_system(100.0 * (whole + apart), 8000 if bins > 600 else int(random.integers(8000, 60_000)), bins)
        signal, background = np.exp(random.uniform([[[-2.0]], [[-4.0]]], [[[1.5]], [[1.0]]], (2, 1, 3)))
        flux = ml.Flux(signal, background, random.uniform(0.0, 100.0, (1, 3)))
        counts = ml.simulate(flux, system, engine=engine, seed=k).sum(-1)
        expected = system.cycles / (1.0 / flux.total + system.detector.dead_time_ns / 100.0)
        assert (np.abs(counts[0] / expected - 1.0) < 0.5).all(), (apart, whole, bins)


# Which pixels the feedback engine gives to the exact one, its bits, and the auto engine's choice.


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


NARROWEST = "whole period, narrower than any bin"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.full] * (name == NARROWEST)) for name in VARIANCES]
)
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


@pytest.mark.parametrize("engine", ["feedback", "auto"])
@pytest.mark.parametrize("bins", [1, 2, 3, 4096])
@pytest.mark.parametrize("dead_ns", [0.0, 1e-9, 1e-3, 0.5])
def test_no_dead_time_is_too_short_for_few_bins(dead_ns: float, bins: int, engine: str):
    """Cells that would have to be narrower than the kernels can make them are left to exact."""
    system = make_system(dead_ns, 7568, bins, sigma_ns=4.0)
    exact = ml.simulate(ml.Flux(18.5, 0.6, [[30.0] * 40]), system, seed=3).sum(-1).mean()
    drawn = ml.simulate(ml.Flux(18.5, 0.6, [[30.0] * 40]), system, seed=4, engine=engine).sum(-1).mean()
    assert abs(drawn - exact) < 6.0 * np.sqrt(2.0 * exact / 40)
