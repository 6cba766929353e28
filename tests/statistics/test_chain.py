"""The phase chain: dense matrices, O(n) products, stationary distribution (docs/theory.md, section 2)."""

import warnings

import numpy as np
import pytest
from harness import refused, system_of

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError, PhaseChain, photons_per_bin

# photons per period, dead time in periods, re-arming
CASES = [
    (2.0, 0.6375, "centre"),
    (2.0, 0.6375, "edge"),
    (1e-6, 0.633, "centre"),
    (1e-6, 0.5, "edge"),
    (30.0, 0.999, "centre"),
    (30.0, 2.75, "edge"),
    (1e3, 0.3331, "centre"),
    (1e3, 0.3331, "edge"),
    (5.0, 0.0, "centre"),
    (5.0, 3.0, "centre"),
    (5.0, 1e-9, "edge"),
    (5.0, 200.4999, "centre"),
]


def bumpy(total, n=96, seed=3):
    """Photons (n,) over many decades, with bins of no flux at all."""
    photons = np.random.default_rng(seed).random(n) ** 8
    photons[5:11] = 0.0
    return photons * (total / photons.sum())


def pulse_chain(signal, background, dead_periods, bins=1024, rearm="centre"):
    return PhaseChain.from_flux(
        ml.Flux(signal, background, 50.0), system_of(dead_periods, bins=1024), bins=bins, rearm=rearm
    )


def dense_by_rapp(chain):
    """Transition matrix element by element, from the flux between re-arming and arrival (2.1), as Rapp has it."""
    n, j = chain.bins, np.arange(chain.bins)
    flux = np.concatenate([[0.0], np.cumsum(chain.photons)])
    arm = (j + chain.shift) % n
    start = flux[arm] + chain.fraction * chain.photons[arm]
    exposure = flux[:-1][None, :] - start[:, None] + flux[-1] * (j[None, :] < arm[:, None])
    exposure[j, arm] = 0.0
    matrix = np.exp(-exposure) * -np.expm1(-chain.photons) / chain.loss
    matrix[j, arm] = (chain.refire + chain.again())[arm]
    return matrix


def test_grid_of_the_statistics():
    """A multiple of the histogram's bins, at least 512, that resolves the pulse or the samples of a waveform."""
    system = system_of(0.6, bins=100)
    size = photons_per_bin(ml.Flux(2.0, 0.5, 50.0), system).size
    assert size % 100 == 0
    assert size >= max(512, 2.9 / 0.00375)
    assert photons_per_bin(ml.Flux(2.0, 0.5, 50.0), system, bins=77).size == 77
    for samples, bins in ((7, 700), (1021, 1100)):
        assert photons_per_bin(ml.Flux(waveform=np.ones(samples), background=0.5), system).size == bins


@pytest.mark.parametrize(("total", "dead", "rearm"), CASES)
def test_rows_sum_to_one_and_forms_agree(total, dead, rearm):
    chain = PhaseChain(bumpy(total), dead, rearm)
    shift, rapp = chain.dense(), dense_by_rapp(chain)
    assert np.all(shift >= 0)
    np.testing.assert_allclose(shift.sum(1), 1.0, rtol=0, atol=1e-14)
    # the exponents themselves are rounded at 1e-16 x photons in Rapp's form
    np.testing.assert_allclose(shift, rapp, rtol=1e-14 * (10 + total), atol=1e-300)


@pytest.mark.parametrize(("total", "dead", "rearm"), CASES)
def test_products_match_the_dense_matrix(total, dead, rearm):
    chain = PhaseChain(bumpy(total), dead, rearm)
    matrix, rng = chain.dense(), np.random.default_rng(0)
    x, y = rng.random(chain.bins), rng.random(chain.bins)
    np.testing.assert_allclose(chain.forward(x), x @ matrix, rtol=1e-13, atol=1e-300)
    np.testing.assert_allclose(chain.backward(y), matrix @ y, rtol=1e-13)
    assert x @ chain.backward(y) == pytest.approx(chain.forward(x) @ y, rel=1e-13)


def test_dense_matrix_is_the_law_of_the_first_arrival():
    """By simulation: re-arm at x_i + t_d, draw the next arrival of the Poisson process, look at its bin."""
    chain = PhaseChain(bumpy(3.0, n=12), 0.29)
    rng, draws, start = np.random.default_rng(11), 400_000, 4
    edges = np.arange(13) / 12
    flux = np.concatenate([[0.0], np.cumsum(chain.photons)])
    armed = np.interp((start + 0.5) / 12 + 0.29, edges, flux)
    target = (armed + rng.exponential(size=draws)) % chain.total
    counts = np.histogram(target, bins=np.unique(flux))[0]
    expected = chain.dense()[start][chain.photons > 0]
    # 4.5 standard errors in each of at most 12 bins: false alarm below 1e-4
    assert np.all(np.abs(counts / draws - expected) < 4.5 * np.sqrt(expected / draws))


@pytest.mark.parametrize(("total", "dead", "rearm"), CASES)
def test_stationary_is_the_dense_eigenvector(total, dead, rearm):
    chain = PhaseChain(bumpy(total), dead, rearm)
    solution = chain.stationary()
    n = chain.bins
    system = np.vstack([np.eye(n) - chain.dense().T, np.ones(n)])
    dense = np.linalg.lstsq(system, np.append(np.zeros(n), 1.0), rcond=None)[0]
    np.testing.assert_allclose(solution.pdf, dense, rtol=0, atol=1e-12)
    assert solution.pdf.sum() == pytest.approx(1.0, abs=1e-14)
    assert solution.residual < 1e-11
    assert solution.error < 1e-11


@pytest.mark.parametrize("dead", [0.0, 0.25, 0.6371, 0.999, 3.3])
@pytest.mark.parametrize("total", [1e-6, 1.0, 40.0])
def test_constant_rate_is_uniform(total, dead):
    n = 64
    solution = PhaseChain(np.full(n, total / n), dead).stationary()
    np.testing.assert_allclose(solution.pdf, 1.0 / n, rtol=1e-12)


@pytest.mark.parametrize("dead", [0.1, 0.6375, 0.997])
@pytest.mark.parametrize("rearm", ["centre", "edge"])
def test_whole_periods_leave_the_stationary_distribution(dead, rearm):
    single = pulse_chain(3.0, 0.5, dead, bins=256, rearm=rearm).stationary()
    for whole in (1, 7, 200):
        more = pulse_chain(3.0, 0.5, dead + whole, bins=256, rearm=rearm).stationary()
        np.testing.assert_allclose(more.pdf, single.pdf, rtol=0, atol=1e-11)
        assert 1.0 / more.rate == pytest.approx(1.0 / single.rate + whole, rel=1e-12)


@pytest.mark.parametrize("whole", [0, 1, 3])
def test_dead_time_of_whole_periods_does_not_distort(whole):
    """Continuous time: r = lambda / (1 + k Lambda). The chain gives 2 sinh(l/2) for l: second order in l."""
    errors = []
    for n in (512, 1024, 2048):
        chain = pulse_chain(2.0, 0.3, float(whole), bins=n)
        solution = chain.stationary()
        law = np.sinh(0.5 * chain.photons)
        np.testing.assert_allclose(solution.pdf, law / law.sum())
        errors.append(np.abs(solution.pdf - chain.photons / chain.total).sum())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize(("rearm", "order"), [("centre", 2), ("edge", 1)])
def test_order_of_convergence_at_a_fractional_dead_time(rearm, order):
    system = system_of(0.6371, bins=1024, sigma=0.02)

    def shape(n):
        chain = PhaseChain.from_flux(ml.Flux(4.0, 0.5, 50.0), system, bins=n, rearm=rearm)
        return chain.stationary().pdf.reshape(64, -1).sum(1)

    fine = shape(64 * 512)
    coarse, better = (np.abs(shape(n) - fine).sum() for n in (64 * 4, 64 * 32))
    # the position within a bin at which the detector re-arms differs between grids: half an order of slack
    assert np.log(coarse / better) / np.log(8.0) > order - 0.5


@pytest.mark.parametrize("dead", [0.49, 0.97, 0.995, 0.9985, 0.9999, 1.995, 200.9985])
def test_slow_mixing_cells_converge(dead):
    solution = pulse_chain(10.0, 0.01, dead).stationary()
    assert solution.error < 1e-11
    assert solution.residual < 1e-11
    assert np.all(solution.pdf >= 0)


def test_sweeps_and_the_factorisation_agree():
    """One cell in which sweeps suffice, solved by each method."""
    feedback = pulse_chain(2.0, 1.0, 0.6375, bins=512).feedback()
    for adjoint in (False, True):
        solution = feedback.solve(adjoint=adjoint)
        assert solution.method == "sweeps"
        rhs = np.ones(512) if adjoint else feedback.fire
        direct = feedback._direct(rhs, adjoint)[0]
        np.testing.assert_allclose(direct, solution.x, rtol=1e-10, atol=1e-12 * np.abs(solution.x).max())


@pytest.mark.parametrize("background", [30.0, 1e3, 1e5])
def test_bright_background_is_factorised(background):
    solution = pulse_chain(1.0, background, 0.6375).stationary()
    assert solution.method == "lu"
    assert solution.error < 1e-11


def test_a_bright_pulse_in_fine_cells():
    assert pulse_chain(10.0, 0.01, 0.9985, bins=16384).stationary().error < 1e-11


@pytest.mark.parametrize(("signal", "background"), [(0.0, 2.0), (2.0, 0.0), (1e-6, 1e-6), (1e3, 1e-6)])
def test_dark_and_empty_fluxes(signal, background):
    for dead in (0.0, 0.5, 0.6375, 1.0, 7.3):
        solution = pulse_chain(signal, background, dead).stationary()
        assert solution.pdf.sum() == pytest.approx(1.0)
        assert np.isfinite(solution.rate)
        assert solution.rate > 0


def test_bad_input_is_named():
    system = system_of(0.6, bins=1024)
    refused("photons must not all be 0", PhaseChain.from_flux, ml.Flux(0.0, 0.0), system)
    refused(r"photons\[1\] = -1", PhaseChain, np.array([1.0, -1.0]), 0.5)
    refused("photons must be", PhaseChain, np.ones((2, 2)), 0.5)
    refused(r"x must be \(4,\), got shape \(3,\)", PhaseChain(np.ones(4), 0.5).forward, np.ones(3))


def test_a_grid_that_cannot_hold_the_flux_is_refused_by_name():
    with pytest.raises(ConvergenceError, match=r"S = 1000, B = 0.5 .* t_d = 0 periods.*more bins"):
        PhaseChain.from_flux(
            ml.Flux(1e3, 0.5, 50.0), system_of(0.0, bins=1024, sigma=1e-4), bins=33, rearm="edge"
        ).stationary()


def test_random_cells_converge_or_say_so():
    rng = np.random.default_rng(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(150):
            signal, background = 10.0 ** rng.uniform(-6, 2.5, 2)
            dead = rng.choice([rng.random(), 10 * rng.random(), rng.integers(1, 5) - 0.003 * rng.random()])
            solution = pulse_chain(signal, background, dead, bins=256).stationary()
            assert solution.residual < 1e-9
