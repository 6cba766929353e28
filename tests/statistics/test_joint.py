"""The closed-form covariance of the histogram: against closed forms, other derivations and other numerics.

Oracles: constant rate; t_d = 0 and whole periods; the count law's recursion (`exposure_moments`: another
expansion); a weighted delay recursion and a dense matrix, both on plain bins, written here; ten cases of an
independent simulator. Engines are compared with it in tests/engines/test_engines.py.
"""

from functools import partial

import numpy as np
import pytest
from harness import REFERENCE_NAMES, Reference, constant_rate_moments, refused, require, system_of
from scipy import stats

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError, exposure_moments, joint_law

PERIOD = 100.0
system = partial(system_of, sigma=0.02)


def photons(signal: float, background: float, at: ml.System, bins: int) -> np.ndarray:
    return signal * at.pulse.bin_energy(0.5 * PERIOD, PERIOD, bins) + background / bins


# Closed forms


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("rate", "dead", "cycles"), [(2.0, 0.3, 200), (0.5, 0.013, 50), (5.0, 0.11, 400), (1.0, 2.37, 600), (3.0, 2.0, 900)]
)
def test_constant_rate(rate: float, dead: float, cycles: int, start: str):
    """Terms of the two ends of the exposure included."""
    law = joint_law(ml.Flux(0.0, rate), system(dead, cycles, bins=16, start=start), tolerance=1e-6)
    mean, variance = constant_rate_moments(rate, dead, cycles, stationary=start == "stationary")
    assert law.settled >= 0
    assert law.count_mean == pytest.approx(mean, rel=1e-8)
    assert law.count_variance == pytest.approx(variance, rel=2e-6)


@pytest.mark.full
@pytest.mark.parametrize("dead", [0.97, 0.999])
def test_a_resonance_just_below_the_period_settles_in_any_long_exposure(dead: float):
    """One pulse blinds until just before the next: locked, with a transient of a hundred periods, here of a million."""
    at = system(dead, cycles=1_000_000, sigma=0.00375)
    law = joint_law(ml.Flux(10.0, 0.01, 50.0), at)
    assert 0 <= law.settled < 200
    counts = ml.simulate(ml.Flux(10.0, 0.01, 0.5 * PERIOD), at, realizations=150, seed=4).reshape(150, -1).sum(1)
    square = (counts - law.count_mean) ** 2
    p = {
        "mean": float(2 * stats.norm.sf(abs(counts.mean() - law.count_mean) / np.sqrt(law.count_variance / 150))),
        "variance": float(2 * stats.norm.sf(abs(square.mean() - law.count_variance) / (square.std() / np.sqrt(150)))),
    }
    require(p, f"joint law, S 10, B 0.01, t_d {dead}, 1e6 cycles")


def test_no_dead_time_is_poisson():
    law = joint_law(ml.Flux(1.5, 0.5, 50.0), system(0.0, cycles=70))
    expected = 70 * photons(1.5, 0.5, system(0.0), 64)
    assert law.mean == pytest.approx(expected, rel=1e-12)
    assert law.covariance() == pytest.approx(np.diag(expected), rel=1e-12)
    w, v = np.random.default_rng(0).normal(size=(2, 64))
    assert law.window(w) == pytest.approx((w @ expected, w**2 @ expected), rel=1e-12)
    assert law.covariance_of(w, v) == pytest.approx((w * v) @ expected, rel=1e-12)
    assert not law.lag(3).any()


def test_tends_to_poisson_with_the_dead_time():
    """Dead times down to a thousandth of a bin of the grid, where a bin re-arms into itself."""
    poisson = joint_law(ml.Flux(1.5, 0.5, 50.0), system(0.0))
    change = [
        joint_law(ml.Flux(1.5, 0.5, 50.0), system(dead), tolerance=1e-5).count_variance / poisson.count_variance - 1
        for dead in (1e-4, 1e-5, 1e-6)
    ]
    assert change[0] / 1e-4 == pytest.approx(change[1] / 1e-5, rel=1e-2)
    assert change[1] / 1e-5 == pytest.approx(change[2] / 1e-6, rel=1e-2)


@pytest.mark.parametrize("whole", [1, 3])
def test_whole_periods_of_dead_time(whole: int):
    """t_d = k t_r: T = 1 - k lambda 1' / (1 + k Lambda), r = lambda / (1 + k Lambda), in closed form (3.4)."""
    cycles = 10**6
    law = joint_law(
        ml.Flux(2.0, 0.7, 50.0), system(float(whole), cycles, bins=32, sigma=0.05, start="stationary"), tolerance=1e-5
    )
    flux = photons(2.0, 0.7, law.system, 32)
    scale = 1.0 + whole * 2.7
    feedback = np.eye(32) - whole * np.outer(flux, np.ones(32)) / scale
    expected = cycles * feedback @ np.diag(flux / scale) @ feedback.T
    assert law.mean == pytest.approx(cycles * flux / scale, rel=1e-5)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(law.covariance() - expected).max() < 1e-4 * size.max()
    assert law.variance == pytest.approx(np.diag(expected), rel=3e-4, abs=1e-6 * cycles / 32)


# Other derivations


def systems(number: int, seed: int, **changes: object) -> list[tuple[float, float, ml.System, float]]:
    random = np.random.default_rng(seed)
    results = []
    for k in range(number):
        dead = 10 ** random.uniform(-2, np.log10(4))
        if k % 4 == 0:
            dead = max(1, round(dead)) - 10 ** random.uniform(-3, -1) * random.choice([-1, 0, 1])
        if k % 4 == 1:
            dead = 10 ** random.uniform(-5, -2)
        at = system(
            dead,
            int(10 ** random.uniform(0, 3.5)),
            sigma=10 ** random.uniform(-2.3, -1),
            start="stationary" if k % 2 else "armed",
        ).replace(**changes)
        flux = 10 ** random.uniform(-2, 1), 10 ** random.uniform(-3, 1)
        results.append((*flux, at, random.uniform(0, PERIOD)))
    return results


@pytest.mark.parametrize(("signal", "background", "at", "delay"), systems(40, seed=3))
def test_count_and_mean_agree_with_the_count_law(signal: float, background: float, at: ml.System, delay: float):
    """Exposures of one period and more, start-up and end included, settled or not."""
    law = joint_law(ml.Flux(signal, background, delay), at, tolerance=1e-4)
    exact = exposure_moments(ml.Flux(signal, background, delay), at, tolerance=1e-6)
    assert law.movement <= 1e-4
    assert law.residual < 1e-9
    assert law.count_variance == pytest.approx(float(exact.variance), rel=1e-4, abs=1e-9)
    assert np.abs(law.mean - exact.histogram).sum() < 1e-4 * float(exact.mean)


@pytest.mark.parametrize(("signal", "background", "at", "delay"), systems(16, seed=4, cycles=1500))
def test_closed_form_is_the_limit_of_the_exact_recursion(signal, background, at, delay):
    """The O(n) formula and the recursion through all periods, on one grid: any window with every bin."""
    law = joint_law(ml.Flux(signal, background, delay), at)
    assert law.settled >= 0
    window = (np.arange(64) % 7 < 3).astype(float)
    columns = law._pixel._columns(window[None])[0]
    result = law.covariance_of(window, np.eye(64))
    assert np.abs(result - columns).max() < 1e-7 * np.abs(columns).max()


def weighted_recursion(
    flux: np.ndarray, dead: int, cycles: int, weights: np.ndarray, history: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of windows (m, n) on plain bins, by E[e^{s w.H}] to second order in s.

    Armed at the start, or with `history` (n,) stationary registrations per period.
    """
    n, m = flux.size, len(weights)
    p, q = -np.expm1(-flux), 1.0 + np.expm1(-flux) / flux
    fired = np.zeros((cycles * n + dead, 3, m))  # registrations and their derivatives, history first
    armed = np.zeros((3, m))
    armed[0] = 1.0
    if history is not None:
        fired[:dead, 0] = np.resize(np.roll(history, dead % n), dead)[:, None]
        armed[0] -= fired[:dead, 0].sum(0)

    def after(t: int) -> np.ndarray:
        r = fired[t]
        if t < dead:
            return r
        w = weights[:, (t - dead) % n]
        return np.array([r[0], r[1] + w * r[0], r[2] + 2 * w * r[1] + w**2 * r[0]])

    for t in range(dead, cycles * n + dead):
        again = after(t - dead)
        j = (t - dead) % n
        fired[t] = p[j] * armed + q[j] * again
        armed = armed + again - fired[t]
    total = armed + sum(after(t) for t in range(cycles * n, cycles * n + dead))
    assert total[0] == pytest.approx(np.ones(m), abs=1e-10)
    return total[1], total[2] - total[1] ** 2


def plain_feedback(flux: np.ndarray, dead: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T (n, n), stationary registrations and their noise (n,) on plain bins, dead time in bins: dense matrices."""
    n = flux.size
    p, q = -np.expm1(-flux), 1.0 + np.expm1(-flux) / flux
    back = (np.arange(n)[:, None] - np.arange(n)) % n
    blinds = dead // n + ((back >= 1) & (back <= dead % n))
    again = (back == dead % n).astype(float)
    solution = np.linalg.inv(np.eye(n) + p[:, None] * blinds - q[:, None] * again)
    fired = solution @ p
    return solution, fired, p * (1 - p) * (1 - blinds @ fired) + q * (1 - q) * (again @ fired)


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("signal", "background", "dead", "cycles"), [(2.0, 1.0, 0.625, 3), (6.0, 0.3, 0.25, 2), (1.0, 0.5, 1.375, 4)]
)
def test_short_exposures_by_another_recursion(signal, background, dead, cycles, start):
    """Variances of windows of unsettled exposures: generating function, plain bins, Richardson."""
    law = joint_law(
        ml.Flux(signal, background, 50.0), system(dead, cycles, bins=16, sigma=0.06, start=start), tolerance=1e-6
    )
    assert law.settled == -1
    random = np.random.default_rng(5)
    weights = np.vstack([np.ones(16), np.eye(16)[[7, 8, 15]], random.normal(size=(4, 16))])
    results = []
    for n in (128, 256):
        flux = photons(signal, background, law.system, n)
        history = plain_feedback(flux, int(dead * n))[1] if start == "stationary" else None
        fine = np.repeat(weights, n // 16, axis=1)
        results.append(np.array(weighted_recursion(flux, int(dead * n), cycles, fine, history)))
    mean, variance = results[1] + (results[1] - results[0]) / 3.0
    spread = np.abs(results[1] - results[0]).max(0)
    got = np.array(law.window(weights))
    assert np.all(np.abs(got[0] - mean) < 0.05 * spread + 1e-6)
    assert np.all(np.abs(got[1] - variance) < 0.05 * spread + 1e-6 * variance)


@pytest.mark.parametrize(
    ("signal", "background", "dead"), [(1.0, 1.0, 0.640625), (5.0, 0.5, 0.984375), (2.0, 5.0, 0.125), (2.0, 0.5, 2.25)]
)
def test_matrix_by_dense_algebra(signal: float, background: float, dead: float):
    """The whole matrix, leading term: T diag(v) T' on plain bins, Richardson."""
    cycles = 10**8
    law = joint_law(ml.Flux(signal, background, 50.0), system(dead, cycles, bins=32, sigma=0.05, start="stationary"))
    results = []
    for n in (256, 512):
        solution, _, noise = plain_feedback(photons(signal, background, law.system, n), round(dead * n))
        joined = solution.reshape(32, -1, n).sum(1)
        results.append(cycles * (joined * noise) @ joined.T)
    expected = results[1] + (results[1] - results[0]) / 3.0
    error = np.abs(law.covariance() - expected)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.all(error < 0.1 * np.abs(results[1] - results[0]) + 1e-4 * size)


@pytest.mark.parametrize("name", REFERENCE_NAMES)
def test_reference(name: str):
    """Count and bins of an independent simulator; errors of the variances by the moments of the law itself."""
    reference = Reference.load(name)
    case, size = reference.case(), reference.realizations
    law = joint_law(
        ml.Flux(reference.signal, reference.background, reference.delay * PERIOD), case.system, tolerance=1e-4
    )
    often = law.variance * size >= 500
    pairs = often & np.roll(often, -1)
    v, lag = law.variance, law.lag(1)
    z = {
        "count mean": (reference.count_mean - law.count_mean) / np.sqrt(law.count_variance / size),
        "means": ((reference.mean - law.mean) / np.sqrt(np.maximum(v, 1e-300) / size))[often],
        "variances": (np.log(reference.variance / np.maximum(v, 1e-300)) / np.sqrt((2 + 1 / v) / size))[often],
        "lag 1": ((reference.lag1 - lag) / np.sqrt((v * np.roll(v, -1) + lag**2) / size))[pairs],
    }
    n = np.arange(reference.count.size)
    p = reference.count / size
    kurtosis = p @ (n - p @ n) ** 4 / reference.count_var**2 - 1.0
    z["count variance"] = np.log(reference.count_var / law.count_variance) / np.sqrt(kurtosis / size)
    require(
        {k: min(1.0, 2 * np.size(s) * stats.norm.sf(np.abs(s).max())) for k, s in z.items() if np.size(s)},
        f"joint law, {name}",
    )


# The object: its ways to a covariance agree, its inputs are checked, hard pixels work


@pytest.fixture(scope="module")
def law() -> ml.JointLaw:
    return ml.joint_law(ml.Flux(3.0, 1.0, 31.0), system(0.64, bins=50))


def test_all_ways_to_a_covariance_agree(law: ml.JointLaw):
    other = ml.joint_law(ml.Flux(3.0, 1.0, 31.0), law.system)  # makes its matrix first
    matrix = other.covariance()
    w, v = np.random.default_rng(1).normal(size=(2, 3, 50))
    size = np.diag(matrix).max()
    assert matrix == pytest.approx(matrix.T, abs=1e-12 * size)
    assert np.linalg.eigvalsh(matrix).min() > 0
    assert law.variance == pytest.approx(np.diag(matrix), rel=1e-9)
    assert law.lag(1) == pytest.approx([matrix[j, (j + 1) % 50] for j in range(50)], abs=1e-8 * size)
    assert other.lag(-7) == pytest.approx(law.lag(-7), abs=1e-8 * size)
    assert law.window(w)[1] == pytest.approx(np.einsum("ki,ij,kj->k", w, matrix, w), rel=1e-8)
    assert law.covariance_of(w, v) == pytest.approx(np.einsum("ki,ij,kj->k", w, matrix, v), abs=1e-7 * size)
    assert law.covariance_of(w[0], v) == pytest.approx(w[0] @ matrix @ v.T, abs=1e-7 * size)
    assert law.count_variance == pytest.approx(matrix.sum(), rel=1e-8)
    assert law.count_mean == pytest.approx(law.mean.sum(), rel=1e-12)
    assert np.ndim(law.window(w[0])[1]) == 0
    matrix[0, 0] = -1.0
    assert other.covariance()[0, 0] > 0, "a copy"


def test_short_exposures_have_the_same_interface():
    law = joint_law(ml.Flux(3.0, 1.0, 50.0), system(0.64, cycles=2, bins=20))
    assert law.settled == -1
    matrix = law.covariance()
    w = np.random.default_rng(2).normal(size=20)
    assert law.window(w)[1] == pytest.approx(w @ matrix @ w, rel=1e-9)
    assert law.lag(1)[3] == pytest.approx(matrix[3, 4], rel=1e-9)
    assert law.variance == pytest.approx(np.diag(matrix), rel=1e-9)


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "background", "dead"), [(1.0, 30.0, 0.6375), (0.0, 300.0, 0.9), (2.0, 100.0, 1.45), (1000.0, 0.1, 0.3)]
)
def test_slow_sweeps_are_solved_all_the_same(signal: float, background: float, dead: float):
    """Where sweeps hardly contract (many background photons in a dead time), a factorisation takes over."""
    at = system(dead, cycles=3000, bins=32)
    law = joint_law(ml.Flux(signal, background, 50.0), at)
    exact = exposure_moments(ml.Flux(signal, background, 50.0), at)
    assert law.residual < 1e-9
    assert law.count_mean == pytest.approx(float(exact.mean), rel=1e-6)
    assert law.count_variance == pytest.approx(float(exact.variance), rel=2e-3)


def test_bad_input(law: ml.JointLaw):
    at = law.system
    with pytest.raises(ValueError, match=r"flux must be one pixel, such as flux\[0, 0\], got pixels of shape \(2,\)"):
        joint_law(ml.Flux([1.0, 2.0], 1.0, 50.0), at)
    refused(r"flux must be one pixel.* shape \(2,\)", joint_law, ml.Flux(waveform=np.ones((2, 3)), background=1.0), at)
    refused(r"weights must be \(\.\.\., 50\), one for each bin, got shape \(3,\)", law.window, np.ones(3))
    refused("weights must be finite, got nan", law.window, np.full(50, np.nan))
    refused("weights must be real numbers, got dtype complex128", law.window, np.ones(50, complex), error=TypeError)
    with pytest.raises(ValueError, match=r"first and second must broadcast, got shapes \(2, 50\) and \(3, 50\)"):
        law.covariance_of(np.ones((2, 50)), np.ones((3, 50)))
    refused(r"lag must be an integer in \[-50, 50\], got 51", law.lag, 51)
    with pytest.raises(
        ConvergenceError, match=r"S = 20, B = 0 .* t_d = 1\.5 .* start-up transient does not end .* 300000"
    ):
        joint_law(ml.Flux(20.0, 0.0, 50.0), system(1.5, cycles=300_000))  # locked to every second pulse
