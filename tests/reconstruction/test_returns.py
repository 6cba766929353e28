"""Several returns of a pixel: their number, their errors, and the level of the test, by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from harness import make_system, refused, require
from scipy import optimize, stats

import mars_lidar as ml
from mars_lidar.reconstruction import Flags, MaximumLikelihood, returns_bound

SYSTEM = make_system(75.3, 4000, 500, sigma_ns=0.5)
SIGMA, DELAY = 0.5, 37.013
GATED = {"mode": "gated", "gate_start_ns": 20.03, "gate_width_ns": 50.0}


def with_dead(dead_ns: float, cycles: int = 4000, **detector) -> ml.System:
    return SYSTEM.replace(cycles=cycles, detector=ml.Detector(dead_time_ns=dead_ns, **detector))


def pixel(signals, background: float, delays, pixels: int = 1) -> ml.Flux:
    """Alike pixels of several returns."""
    parts = [
        ml.Flux(np.full(pixels, s), background if k == 0 else 0.0, at)
        for k, (s, at) in enumerate(zip(signals, delays, strict=True))
    ]
    return ml.Flux.multi(*parts)


def drawn(system: ml.System, signals, background: float, delays, pixels: int, seed: int = 1) -> np.ndarray:
    return ml.simulate(pixel(signals, background, delays, pixels), system, seed=seed)[0, 0]


ALONE = {
    "dim": (with_dead(0.0), 0.01, 0.01),
    "few photons": (with_dead(75.3), 0.02, 0.002),
    "bright": (with_dead(75.3), 3.0, 1.0),
    "few passes": (with_dead(75.3, 1000), 5.0, 5.0),
    "much background": (with_dead(20.0), 1.0, 20.0),
    "more than a period": (with_dead(253.3, 10_000), 2.0, 0.5),
    "below one bin": (with_dead(0.1), 1.0, 1.0),
    "synchronous": (with_dead(75.0, mode="synchronous"), 2.0, 2.0),
    "gated": (with_dead(45.0, **GATED), 1.0, 1.0),
}


@pytest.mark.full
@pytest.mark.parametrize("name", ALONE)
@pytest.mark.parametrize("level", [0.01, 0.1])
def test_no_more_returns_than_there_are(name: str, level: float) -> None:
    """One return more is seen in at most the stated share of the pixels, wherever in the period it may be."""
    system, signal, background = ALONE[name]
    pixels = 2000 if level < 0.05 else 500
    delay = np.random.default_rng(3).uniform(25.0, 65.0, pixels)
    cube = drawn(system, (signal,), background, (delay,), pixels)
    estimate = ml.reconstruct(cube, system, MaximumLikelihood(false_alarm=level), returns=2)
    first, more = int((estimate.returns.count > 0).sum()), int((estimate.returns.count > 1).sum())
    assert first > 0.98 * pixels
    # an upper bound by its making; 1.1 of it is allowed for what a histogram hides of bright pixels
    require({"more": float(stats.binom.sf(more - 1, first, 1.1 * level))}, f"returns that are not there, {name}")
    single = ml.reconstruct(cube, system)
    alone = estimate.returns.count == 1
    assert np.array_equal(estimate.returns.delay_ns[alone, 0], single.delay_ns[alone])
    assert np.array_equal(estimate.returns.signal_error[alone, 0], single.signal_error[alone], equal_nan=True)


@pytest.mark.full
def test_the_level_is_not_far_from_what_is_stated() -> None:
    """The bound of the level is a near one: a test that never errs would show nothing dim."""
    cube = drawn(SYSTEM, (1.0,), 1.0, (DELAY,), 2000)
    estimate = ml.reconstruct(cube, SYSTEM, MaximumLikelihood(false_alarm=0.2), returns=2)
    more = int((estimate.returns.count > 1).sum())
    require({"level": float(stats.binom.cdf(more, 2000, 0.1))}, "level of the test of a second return")


PAIRS = {
    "two of a kind": (SYSTEM, (0.5, 0.5), 0.5, 1.5),
    "far apart": (SYSTEM, (0.5, 0.5), 0.5, 20.0),
    "faint beside bright": (SYSTEM, (2.0, 0.5), 0.5, 3.0),
    "few photons": (SYSTEM, (0.03, 0.03), 0.02, 3.0),
    "no dead time": (with_dead(0.0), (1.0, 0.3), 1.0, 2.0),
    "more than a period": (with_dead(253.3, 8000), (0.5, 1.0), 0.5, 2.0),
    "synchronous": (with_dead(75.0, mode="synchronous"), (0.5, 0.5), 0.5, 3.0),
    "gated": (with_dead(45.0, **GATED), (0.5, 0.5), 1.0, 2.0),
}


@pytest.mark.full
@pytest.mark.parametrize("name", PAIRS)
def test_both_are_found_and_their_errors_hold(name: str) -> None:
    """Where two are seen in nearly every exposure: no bias, spread at the bound of other code, intervals that hold."""
    system, signals, background, apart = PAIRS[name]
    pixels, delay = 1500, DELAY + SIGMA * np.array([0.0, apart])
    cube = drawn(system, signals, background, delay, pixels, seed=5)
    estimate = ml.reconstruct(cube, system, returns=3).returns
    both = estimate.count == 2
    assert both.mean() > 0.97
    assert np.isnan(estimate.depth_m[both, 2]).all()
    assert (estimate.false_alarm[both, :2] < 0.01).all()
    bound = returns_bound(pixel(signals, background, delay), system)
    outcomes = {}
    count = int(both.sum())
    for what, error, stated, least in (
        ("delay", estimate.delay_ns[both, :2] - delay, estimate.delay_error_ns[both, :2], bound.delay_ns),
        ("signal", estimate.signal[both, :2] - signals, estimate.signal_error[both, :2], bound.signal),
    ):
        for k in range(2):
            z = max(abs(error[:, k].mean()) / least[k] - 0.06, 0.0) * np.sqrt(count)
            outcomes[f"{what} {k}, bias"] = 2 * stats.norm.sf(z)
            square = (error[:, k].std() / (1.12 * least[k])) ** 2 * count
            outcomes[f"{what} {k}, above 1.12 bounds"] = float(stats.chi2.sf(square, count - 1))
            square = (error[:, k].std() / (0.94 * least[k])) ** 2 * count
            outcomes[f"{what} {k}, below the bound"] = float(stats.chi2.cdf(square, count - 1))
            inside = int((np.abs(error[:, k]) <= 1.96 * stated[:, k]).sum())
            outcomes[f"{what} {k}, intervals of 95 %"] = float(stats.binom.cdf(inside, count, 0.92))
            assert np.median(stated[:, k]) == pytest.approx(least[k], rel=0.1)
    require(outcomes, f"two returns, {name}")


def test_three_returns_and_more_than_were_asked_for() -> None:
    delays = np.array([20.0, 23.0, 60.0])
    cube = drawn(SYSTEM, (0.2, 0.4, 0.3), 0.5, delays, 300)
    estimate = ml.reconstruct(cube, SYSTEM, returns=4)
    three = estimate.returns.count == 3
    assert three.mean() > 0.95
    assert np.abs(estimate.returns.delay_ns[three, :3] - delays).max() < 0.3
    # the maps are those of the strongest
    assert np.array_equal(estimate.delay_ns[three], estimate.returns.delay_ns[three, 1])
    assert estimate.depth_error_m[three] == pytest.approx(estimate.returns.depth_error_m[three, 1], rel=1e-12)
    assert estimate.background[three].mean() == pytest.approx(0.5, rel=0.02)
    fewer = ml.reconstruct(cube, SYSTEM, returns=2)
    assert (fewer.flags & Flags.MORE_RETURNS > 0).mean() > 0.95
    assert not (estimate.flags[three] & Flags.MORE_RETURNS).any()


def test_the_likelihood_is_that_of_scipy() -> None:
    """Two returns by a general optimiser on a likelihood of Poisson bins: what the dead time of nothing leaves."""
    system = with_dead(0.0)
    delay = DELAY + np.array([0.0, 0.9])
    h = drawn(system, (0.5, 0.3), 0.5, delay, 1)[0].astype(float)
    edges = np.linspace(0.0, 100.0, 501)

    def loss(x: np.ndarray) -> float:
        pulses = (x[k] * np.diff(stats.norm.cdf(edges, x[k + 1], SIGMA)) for k in (1, 3))
        mean = system.cycles * (x[0] / 500 + sum(pulses))
        return float((mean - h * np.log(mean)).sum())

    start = np.array([0.5, 0.5, delay[0], 0.3, delay[1]])
    best = optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9, "maxiter": 9000})
    estimate = ml.reconstruct(h, system, returns=2)
    assert estimate.returns.count == 2
    mine = np.array([estimate.background, *np.stack([estimate.returns.signal, estimate.returns.delay_ns], -1).ravel()])
    # the maximum is flat: a step that gains less than 5e-7 of the logarithm is a thousandth of a standard error
    error = np.stack([estimate.returns.signal_error, estimate.returns.delay_error_ns], -1).ravel()
    assert np.abs((mine - best.x)[1:] / error).max() < 5e-3
    assert loss(mine) - best.fun < 5e-6


def test_nothing_is_found_in_nothing() -> None:
    cube = np.zeros((3, 500), np.uint16)
    cube[1] = drawn(SYSTEM, (0.0,), 1.0, (0.0,), 1)[0]
    estimate = ml.reconstruct(cube, SYSTEM, MaximumLikelihood(false_alarm=1e-6), returns=2).returns
    assert estimate.count.tolist() == [0, 0, 0]
    assert np.isnan(estimate.depth_m).all()
    assert estimate.depth_m.shape == (3, 2)


def test_threads_do_not_matter() -> None:
    cube = drawn(SYSTEM, (0.5, 0.5), 0.5, (DELAY, DELAY + 1.0), 200)
    first, two = (ml.reconstruct(cube, SYSTEM, returns=3, threads=n).returns for n in (1, 2))
    for name in ("delay_ns", "signal", "delay_error_ns", "false_alarm"):
        assert np.array_equal(getattr(first, name), getattr(two, name), equal_nan=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"returns": 0}, "returns must"),
        ({"returns": 9}, "returns must"),
        ({"returns": 2, "method": "peak"}, "returns=2 needs method 'maximum_likelihood' or 'image' or .*, got 'peak'"),
    ],
)
def test_bad_input(change: dict, message: str) -> None:
    refused(message, ml.reconstruct, np.ones((2, 500), np.uint16), SYSTEM, **change, error=(ValueError, TypeError))


def test_the_bound_of_one_is_that_of_one() -> None:
    bound = ml.cramer_rao(ml.Flux(1.0, 0.5, DELAY), SYSTEM)
    same = returns_bound(ml.Flux(1.0, 0.5, DELAY), SYSTEM)
    assert same.depth_m[0] == pytest.approx(float(bound.depth_m), rel=1e-3)
    assert same.signal[0] == pytest.approx(float(bound.signal), rel=1e-3)
    far = returns_bound(pixel([0.5, 0.5], 0.5, [10.0, 60.0]), SYSTEM)
    near = returns_bound(pixel([0.5, 0.5], 0.5, [10.0, 10.5]), SYSTEM)
    assert (near.depth_m > 1.5 * far.depth_m).all()
    with pytest.raises(ValueError, match=r"one return of .* in each pixel; several .* `returns_bound`"):
        ml.cramer_rao(pixel([0.5, 0.5], 0.5, [10.0, 60.0]), SYSTEM)
    with pytest.raises(ValueError, match="flux must have returns with delays, and background > 0"):
        returns_bound(pixel([1.0, 2.0], 0.0, [10.0, 20.0]), SYSTEM)


@pytest.mark.parametrize(
    ("signals", "background", "dead"), [((5.0, 3.0), 0.3, 230.0), ((1.0, 1.0), 0.03, 50.0), ((1.0, 1.0), 1.0, 50.0)]
)
def test_all_returns_reported_are_no_more_returns(signals: tuple[float, float], background: float, dead: float) -> None:
    """The flag is the outcome of the test of one return more: 1 % of 300 pixels, exceeded at 1e-4."""
    delay = np.random.default_rng(8).uniform(5.0, 55.0, 300)
    counts = drawn(with_dead(dead, 3000), signals, background, (delay, delay + 15.0), 300, seed=8)
    estimate = ml.reconstruct(counts, with_dead(dead, 3000), returns=2)
    assert (estimate.returns.count == 2).all()
    flagged = int((estimate.flags & Flags.MORE_RETURNS > 0).sum())
    assert stats.binom.sf(flagged - 1, 300, 0.01) > 1e-4
