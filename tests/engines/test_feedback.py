"""The feedback engine where it samples itself, against the dense covariance and the exact engine; the auto engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import mars_lidar as ml
from harness import (
    COUNTS,
    JOINT,
    PERIOD_NS,
    REFERENCE_NAMES,
    SHAPE,
    Case,
    Reference,
    bonferroni,
    check,
    flux_of,
    mean_vector,
    measured_pulse,
    require,
    task_of,
    two_lobes,
    waveform_flux,
)
from mars_lidar import Detector, GaussianPulse, SampledPulse, System, _core
from mars_lidar.engines import ENGINES
from mars_lidar.engines.auto import AutoEngine, expected_registrations
from mars_lidar.engines.base import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import MOST_BINS, FeedbackEngine, internal_bins

CLAIMS = {COUNTS, SHAPE, JOINT}
GIVEN = "pixels given to exact"
FloatArray = NDArray[np.float64]


class Sampler(FeedbackEngine):
    """The feedback engine that fails where it would give a pixel to the exact engine."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        super().histogram(task, out)
        assert task.report[GIVEN] == 0


def case(
    signal: float, background: float, dead: float, cycles: int, *, delay: float = 0.37, sigma: float = 0.01,
    items: int = 4000, **changes: Any,
) -> Case:  # fmt: skip
    system = System(
        period_ns=PERIOD_NS, cycles=cycles, bins=128, pulse=GaussianPulse(sigma_ns=sigma * PERIOD_NS),
        detector=Detector(dead_time_ns=dead * PERIOD_NS),
    ).replace(**changes)  # fmt: skip
    name = f"S {signal:g}, B {background:g}, t_d {dead:g}, {cycles} cycles, {system.start}"
    return Case(name, flux_of(signal, background, delay), system, items)


def drawn(engine: Any, request: Case, seed: int = 1) -> NDArray[np.int64]:
    task = task_of(request, seed)
    out = np.empty((task.items, request.system.bins), request.system.histogram_dtype)
    engine.histogram(task, out)
    return out.astype(np.int64)


# The covariance in closed form, on dense matrices


def dense_law(request: Case, merge: int) -> tuple[FloatArray, FloatArray]:
    """Mean (bins,) and covariance (bins, bins) from an armed start: H = lambda (N_r + e - G H) + M.

    Solved on bins * merge internal bins.
    """
    system, flux = request.system, request.flux
    n = system.bins * merge
    photons = flux.background[0, 0] / n + flux.signal[0, 0] * system.pulse.bin_energy(
        flux.delay_ns[0, 0], PERIOD_NS, n
    )
    fire = -np.expm1(-photons)
    refire = np.where(photons > 1e-5, 1 - fire / np.maximum(photons, 1e-5), photons / 2)
    whole = int(system.dead_time_periods)
    rest = (system.dead_time_periods - whole) * n
    shift = int(rest + 1e-9)
    part = rest - shift
    j = np.arange(n)
    window, again = np.full((n, n), float(whole)), np.zeros((n, n))
    for back in range(1, shift + 1):
        window[j, (j - back) % n] += 1
    window[j, (j - shift - 1) % n] += part
    again[j, (j - shift) % n] += 1 - part
    again[j, (j - shift - 1) % n] += part
    response = np.linalg.inv(np.eye(n) + fire[:, None] * window - refire[:, None] * again)
    rate = response @ fire
    armed, rearmed = 1 - window @ rate, again @ rate
    noise = fire * (1 - fire) * armed + refire * (1 - refire) * rearmed
    below = np.concatenate([[0.0], np.cumsum(rate)])
    edges = np.arange(n + 1) / n

    def registered(y: FloatArray) -> FloatArray:  # within y before a period's edge
        periods = np.floor(y)
        return np.where(y > 0, (periods + 1) * below[-1] - np.interp(1 - (y - periods), edges, below), 0.0)

    blind = sum(registered(system.dead_time_periods - k - j / n) for k in range(whole + 1))
    mean = system.cycles * rate + response @ (fire * blind)
    covariance = system.cycles * (response * noise) @ response.T
    bins = (system.bins, merge)
    return mean.reshape(bins).sum(1), covariance.reshape(bins + bins).sum((1, 3))


DENSE = {
    "middle": case(1.0, 1.0, 0.6375, 4000),
    "bright": case(4.5, 1.0, 0.6375, 4000),
    "dim": case(0.1, 0.1, 0.6375, 20_000),
    "short dead time": case(2.0, 5.0, 0.1, 1000),
    "long dead time": case(1.0, 0.5, 1.53125, 4000),
    "slow": case(1.0, 7.0, 0.6375, 4000),
    "locked": case(8.0, 0.1, 0.9, 2000),
    "whole period": case(0.8, 0.5, 1.0, 4000),
    "pulse at the edge": case(2.0, 0.5, 0.6375, 4000, delay=0.002),
    "bins of half counts": case(0.5, 0.05, 0.3, 1500),
    "1e7 cycles": case(1.0, 1.0, 0.6375, 10_000_000, items=2000),
    "1e8 cycles": case(0.3, 0.4, 0.6375, 100_000_000, items=2000),
    "1e8 cycles, long dead time": case(0.8, 0.3, 2.26, 100_000_000, items=2000),
}


@pytest.mark.parametrize("name", DENSE)
def test_mean_and_covariance_are_those_of_the_closed_form(name: str):
    request = DENSE[name]
    merge = int(internal_bins(request.flux, request.system)[0, 0]) // request.system.bins
    mean, covariance = dense_law(request, merge)
    x = drawn(Sampler(), request).astype(float)
    count = x.sum(1)
    peak = int(mean.argmax())
    near = np.arange(peak - 3, peak + 4) % mean.size
    weights = {"count": np.ones(mean.size), "window": np.isin(np.arange(mean.size), near).astype(float)}
    # the histogram without its mean in blocks, alternating: a direction in which neighbours repel
    weights["stripes"] = np.where(np.arange(mean.size) // 4 % 2, 1.0, -1.0)
    p = {}
    for about, w in weights.items():
        y, variance = x @ w, float(w @ covariance @ w)
        p[f"{about} mean"] = mean_vector(y, float(w @ mean), variance=variance)
        p[f"{about} variance"] = variance_test(y, variance)
    often = mean > 20
    p["bins"] = bonferroni([mean_vector(x[:, k], mean[k], variance=covariance[k, k]) for k in np.flatnonzero(often)])
    p["bin variances"] = bonferroni([variance_test(x[:, k], covariance[k, k]) for k in np.flatnonzero(often)])
    assert count.size == request.items
    require(p, f"feedback, {name}, closed form")


def variance_test(y: FloatArray, variance: float) -> float:
    """p-value of a sample's variance, by the sample's own fourth moment."""
    square = (y - y.mean()) ** 2
    error = square.std() / np.sqrt(y.size)
    return float(2 * stats.norm.sf(abs(square.sum() / (y.size - 1) - variance) / error))


# The exact engine


SAMPLED = SampledPulse(two_lobes(), 0.1, "centroid")
AGAINST_EXACT = {
    "stationary": case(1.0, 1.0, 0.6375, 1000, start="stationary"),
    "stationary, long dead time": case(0.8, 0.3, 1.7, 1000, start="stationary"),
    "100 cycles": case(1.0, 1.0, 0.6375, 100, items=8000),
    "few armed": case(9.0, 0.1, 0.9, 300),
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


@pytest.mark.parametrize("name", AGAINST_EXACT)
def test_law_is_that_of_exact(name: str):
    check(Sampler(), AGAINST_EXACT[name], ENGINES["exact"], CLAIMS)


@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_returns_and_waveforms(start: str):
    returns = case(0, 0, 0.6375, 1000, start=start)
    check(
        Sampler(),
        Case("returns", flux_of([1.0, 0.4, 0.8], 0.5, [0.2, 0.215, 0.9]), returns.system, 4000),
        ENGINES["exact"],
        CLAIMS,
    )
    wave = np.random.default_rng(3).exponential(size=300) ** 3
    check(
        Sampler(),
        Case("waveform", waveform_flux(1.5 * wave / wave.sum(), 0.3), returns.system, 4000),
        ENGINES["exact"],
        CLAIMS,
    )


def test_measured_pulse():
    pulse = measured_pulse("face_free_8ps", 10.0)
    check(Sampler(), case(3.0, 0.3, 0.8, 600, pulse=pulse), ENGINES["exact"], CLAIMS)


@pytest.mark.parametrize("name", sorted(set(REFERENCE_NAMES) - {"s04_saturated", "s08_fewphotons"}))
def test_reference_is_drawn_by_the_sampler(name: str):
    """The harness compares with the references; here, that it is not the exact engine that passes there."""
    request = Reference.load(name).case(photons=1e5)
    drawn(Sampler(), request)


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
    assert not same[flux.background < 5].any()


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        (case(1.0, 1.0, 0.6375, 99), "short exposure"),
        (case(1.0, 1.0, 2.5, 299), "short for its dead time"),
        (case(6.0, 0.05, 0.99, 2000), "bright echo"),
        (case(1.0, 0.05, 0.99, 999), "short exposure with an echo"),
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


def test_internal_bins():
    fine = case(1.0, 1.0, 0.6375, 1000)
    assert internal_bins(fine.flux, fine.system)[0, 0] == 384  # 0.26 sigma
    bright = case(8.0, 1.0, 0.6375, 1000)
    assert internal_bins(bright.flux, bright.system)[0, 0] == 768
    longer = fine.system.replace(cycles=100_000_000)
    assert internal_bins(fine.flux, longer)[0, 0] > 2 * 384
    dark = case(0.0, 1.0, 0.6375, 1000)
    assert internal_bins(dark.flux, dark.system)[0, 0] == 128
    short = case(0.0, 1.0, 1e-6, 1000)
    assert internal_bins(short.flux, short.system)[0, 0] > MOST_BINS


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
        for name in ("scalar", level)
    ]
    assert np.array_equal(*same)
    assert report["pixels sampled"] > 0.5 * flux.background.size


class Sampling(FeedbackEngine):
    """The sampled pixels only: rows of the others stay 0."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        out[...] = 0
        rest = self.sample(task, out, np.arange(task.pixel_index.size))
        task.report["pixels sampled"] = float(task.pixel_index.size - rest.size)


@pytest.mark.parametrize("engine", ["feedback", "auto"])
def test_parts_threads_and_order(engine: str):
    flux, system = mixture(3000)
    whole = ml.simulate(flux, system, engine=engine, realizations=5, seed=3, threads=1)
    index = np.arange(66).reshape(6, 11)
    random = np.random.default_rng(0)
    for threads in (1, 2, 3):
        rows, columns, run = (slice(*np.sort(random.choice(n + 1, 2, replace=False))) for n in (6, 11, 5))
        part = ml.simulate(
            flux[rows, columns], system, engine=engine, realizations=run.stop - run.start, threads=threads,
            first_realization=int(run.start), pixel_index=index[rows, columns], seed=3,
        )  # fmt: skip
        assert np.array_equal(part, whole[run, rows, columns])


def test_level_must_run_here():
    with pytest.raises(ValueError, match="level must be one that this processor runs, got 'mmx'"):
        drawn(FeedbackEngine("mmx"), case(1.0, 1.0, 0.6375, 1000, items=4))


def test_progress_runs_once_to_its_end():
    flux, system = mixture()
    seen: list[float] = []
    ml.simulate(flux, system, engine="feedback", realizations=40, progress=lambda done, of: seen.append(done / of))
    assert seen[-1] == 1.0
    assert seen == sorted(seen)


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
    with pytest.raises(ValueError, match="draws histograms only"):
        ml.simulate_timestamps(flux, system, engine=AutoEngine())
