"""Holding times, their covariances and the asymptotic count law (docs/theory.md, sections 3, 4 and 6)."""

from functools import partial

import numpy as np
import pytest
from harness import armed_count_pmf, constant_rate_moments, refused, stationary_count_pmf, system_of

import mars_lidar as ml
from mars_lidar.statistics import PhaseChain, holding_time_covariance, holding_times, photons_per_bin
from mars_lidar.statistics.renewal import lag_covariances, row_moments, weighted_waits
from studies.covariance.run import TruncatedSums, moment_matrices

# photons per period, dead time in periods, re-arming
CASES = [
    (2.0, 0.6375, "centre"),
    (2.0, 0.6375, "edge"),
    (20.0, 0.999, "centre"),
    (5.0, 2.75, "edge"),
    (0.01, 0.0, "centre"),
]


def bumpy(total, n=80, seed=3):
    photons = np.random.default_rng(seed).random(n) ** 6
    photons[5:9] = 0.0
    return photons * (total / photons.sum())


make_system = partial(system_of, bins=1024)


def truncated(signal, background, dead, **options):
    return TruncatedSums.of(holding_time_covariance(ml.Flux(signal, background, 50.0), make_system(dead), **options))


@pytest.mark.parametrize(("total", "dead", "rearm"), CASES)
def test_moment_matrices_match_the_definition(total, dead, rearm):
    """mu_ij and sigma_ij^2 against sums over the number of periods waited."""
    chain = PhaseChain(bumpy(total, n=16), dead, rearm)
    (matrix, means, variances), n = moment_matrices(chain), chain.bins
    flux = np.concatenate([[0.0], np.cumsum(np.tile(chain.photons, 2))])
    periods = np.arange(int(60 / total) + 60)
    for i in range(n):
        arm = (i + chain.shift) % n
        start = flux[arm] + chain.fraction * chain.photons[arm]
        for k in range(n):
            j = arm + k
            if chain.photons[j % n] == 0:
                continue
            before = np.maximum(flux[j] - start, 0.0) + periods * chain.total
            if k == 0:  # re-arms inside this bin: a part of it first, whole and later ever after
                before[1:] -= chain.fraction * chain.photons[arm]
            chance = np.exp(-before) * -np.expm1(-chain.photons[j % n])
            if k == 0:
                chance[0] = -np.expm1(-(1 - chain.fraction) * chain.photons[arm])
            wait = (chain.blind_bins + k) / n + periods
            mean = np.average(wait, weights=chance)
            assert means[i, j % n] == pytest.approx(mean, rel=1e-9)
            variance = np.average((wait - mean) ** 2, weights=chance)
            assert variances[i, j % n] == pytest.approx(variance, rel=1e-8)
            assert matrix[i, j % n] == pytest.approx(chance.sum(), rel=1e-9)


@pytest.mark.parametrize(("total", "dead", "rearm"), CASES)
def test_row_sums_match_the_matrices(total, dead, rearm):
    chain = PhaseChain(bumpy(total), dead, rearm)
    matrix, means, variances = moment_matrices(chain)
    mean, variance = row_moments(chain)
    np.testing.assert_allclose(mean, (matrix * means).sum(1), rtol=1e-13)
    np.testing.assert_allclose(variance, (matrix * (means**2 + variances)).sum(1) - mean**2, rtol=1e-10)
    x = np.random.default_rng(1).random(chain.bins)
    np.testing.assert_allclose(weighted_waits(chain, x), x @ (matrix * means), rtol=1e-12)


@pytest.mark.parametrize(("total", "dead", "rearm"), CASES)
def test_covariances_match_dense_powers(total, dead, rearm):
    chain = PhaseChain(bumpy(total), dead, rearm)
    times, (matrix, means, variances) = holding_times(chain), moment_matrices(chain)
    pdf, q_mu = times.stationary.pdf, matrix * means
    mean = q_mu.sum(1)
    mu = pdf @ mean
    single = pdf @ (matrix * (means**2 + variances)).sum(1) - mu**2
    gamma = [pdf @ q_mu @ np.linalg.matrix_power(matrix, k) @ mean - mu**2 for k in range(6)]
    tolerance = 1e-12 * (single + mu**2)
    assert times.mu == pytest.approx(mu, rel=1e-13)
    assert times.sigma_ss2 == pytest.approx(single, abs=tolerance)
    np.testing.assert_allclose(lag_covariances(chain, times, 6), gamma, rtol=0, atol=tolerance)
    # the definition of the exact sum, by a dense solution
    z = np.linalg.solve(np.eye(chain.bins) - matrix + np.outer(np.ones(chain.bins), pdf), mean - mu)
    np.testing.assert_allclose(times.relative_value, z, rtol=0, atol=1e-12 * (mu + np.abs(z).max()))
    assert times.covariance_sum == pytest.approx(pdf @ q_mu @ z, abs=10 * tolerance)
    assert times.sigma2 == pytest.approx(single + 2 * times.covariance_sum, abs=10 * tolerance)


@pytest.mark.parametrize(
    ("signal", "background", "dead"),
    [(1.0, 1.0, 0.6375), (10.0, 1.0, 1.0), (10.0, 10.0, 0.6375), (10.0, 0.01, 0.9985), (3.0, 0.05, 1.0)],
)
def test_exact_sum_is_the_limit_of_partial_sums(signal, background, dead):
    terms = truncated(signal, background, dead, lags=2000)
    assert terms.cutoff_sum(2000) == pytest.approx(terms.exact_sum, abs=1e-10 * terms.sigma_ss2)
    assert terms.sigma2 == pytest.approx(terms.sigma_ss2 + 2 * terms.exact_sum, rel=1e-9)
    assert terms.defect < 1e-9
    np.testing.assert_allclose(terms.cutoff_sum(2003), terms.exact_sum, rtol=1e-9)
    assert terms.cutoff_sum(0) == 0.0


def test_spectral_rules_against_the_exact_sum():
    """t_d = t_r, S = 10, B = 1: the hardest ordinary cell."""
    terms = truncated(10.0, 1.0, 1.0, bins=512)
    assert abs(terms.eigenvalues[0] - 1.0) < 1e-9
    assert np.all(np.diff(np.abs(terms.eigenvalues)) < 1e-9)
    exact = terms.exact_sum
    assert abs(terms.spectral_sum() - exact) < 0.015 * abs(exact)
    assert abs(terms.spectral_sum() - exact) < 0.1 * abs(terms.cutoff_sum(6) - exact)
    assert terms.spectral_sum(lags=6, modes=1) == pytest.approx(terms.cutoff_sum(6))
    for tolerance in (1e-2, 1e-4, 1e-6):
        lags, modes = terms.automatic_rule(tolerance)
        assert lags >= 6
        assert modes >= 1
        assert abs(terms.spectral_sum(lags, modes) - exact) < tolerance * terms.sigma_ss2


def gaussian(times, cycles):
    """Mean and variance of the count of `cycles` periods (3.11)."""
    return cycles / times.mu, cycles * times.sigma2 / times.mu**3


@pytest.mark.parametrize("x", [0.05, 0.6, 3.0])
@pytest.mark.parametrize("dead", [0.3, 0.6371, 2.4])
def test_constant_rate_closed_form(x, dead):
    """Mean slope lambda / (1 + x), variance slope lambda / (1 + x)^3, second order in the bin (6.2)."""
    rate = x / dead
    want = holding_times(PhaseChain(np.full(2048, rate / 2048), dead))
    assert want.mu == pytest.approx(dead + 1 / rate, rel=1e-6)
    assert want.sigma2 == pytest.approx(1 / rate**2, rel=5e-6)
    assert want.covariance_sum == pytest.approx(0.0, abs=1e-12 * want.mu**2)
    renewal = ml.count_law(ml.Flux(0.0, rate), make_system(dead), "renewal")
    mean, variance = gaussian(want, 1000)
    assert mean == pytest.approx(renewal.mean, rel=1e-5)
    assert variance == pytest.approx(renewal.variance, rel=1e-5)


def test_no_dead_time_is_poisson():
    chain = PhaseChain.from_flux(ml.Flux(0.5, 0.3, 50.0), make_system(0.0), bins=4096)
    mean, variance = gaussian(holding_times(chain), 1000)
    assert mean == pytest.approx(800.0, rel=3e-4)
    assert variance == pytest.approx(mean, rel=3e-4)


def test_whole_periods_only_wait():
    short = holding_times(PhaseChain.from_flux(ml.Flux(3.0, 0.5, 50.0), make_system(0.6375), bins=512))
    long = holding_times(PhaseChain.from_flux(ml.Flux(3.0, 0.5, 50.0), make_system(200.6375), bins=512))
    assert long.mu == pytest.approx(short.mu + 200.0, rel=1e-12)
    assert long.sigma2 == pytest.approx(short.sigma2, rel=1e-9)
    assert long.covariance_sum == pytest.approx(short.covariance_sum, rel=1e-7)


def test_edge_rearming_shortens_the_wait_by_half_a_bin():
    n = 512
    flat = [holding_times(PhaseChain(np.full(n, 2.0 / n), 0.6371, rearm)) for rearm in ("centre", "edge")]
    assert flat[0].mu - flat[1].mu == pytest.approx(0.5 / n, rel=0.01)


def simulate_waits(photons, dead, steps, pixels, seed):
    """Times (steps, pixels) of registrations in continuous time, by inversion of the integrated flux."""
    rng, n = np.random.default_rng(seed), photons.size
    edges, flux = np.arange(n + 1) / n, np.concatenate([[0.0], np.cumsum(photons)])
    now, out = np.zeros(pixels), np.empty((steps, pixels))
    for k in range(steps):
        cycle = np.floor(now)
        target = np.interp(now - cycle, edges, flux) + rng.exponential(size=pixels)
        more = np.floor(target / flux[-1])
        now = cycle + more + np.interp(target - more * flux[-1], flux, edges)
        out[k] = now
        now = now + dead
    return out


@pytest.mark.parametrize(
    ("signal", "background", "dead"), [(1.0, 1.0, 0.6375), (5.0, 1.0, 0.983), (2.0, 5.0, 0.1), (1.0, 0.5, 1.53125)]
)
def test_moments_against_simulation(signal, background, dead):
    """Mean and variance of the time of 250 registrations: 4 standard errors, false alarm 1e-4."""
    system, steps, warm, pixels = make_system(dead, sigma=0.01), 290, 40, 6000
    fine = photons_per_bin(ml.Flux(signal, background, 50.0), system, bins=8192)
    times = simulate_waits(fine, dead, steps + 1, pixels, seed=20)
    waited = times[-1] - times[warm]
    count = steps - warm
    chain = PhaseChain.from_flux(ml.Flux(signal, background, 50.0), system, bins=4096)
    law = holding_times(chain)
    gamma = lag_covariances(chain, law, count - 1)
    variance = count * law.sigma_ss2 + 2 * np.sum((count - np.arange(1, count)) * gamma)
    assert abs(waited.mean() - count * law.mu) < 4 * np.sqrt(variance / pixels)
    assert abs(waited.var() / variance - 1) < 4 * np.sqrt(2 / pixels)
    # and the covariances are not decoration: without them, or without the factor 2, the variance is wrong
    assert law.sigma2 == pytest.approx(variance / count, rel=0.05)


def test_random_cells_never_give_a_negative_variance():
    rng = np.random.default_rng(8)
    for _ in range(120):
        signal, background = 10.0 ** rng.uniform(-6, 2.5, 2) * (rng.random(2) > 0.1)
        if signal + background == 0:
            continue
        dead = rng.choice([rng.random(), 10 * rng.random(), rng.integers(0, 5), 1 - 0.003 * rng.random()])
        rearm = "edge" if rng.random() < 0.5 else "centre"
        chain = PhaseChain.from_flux(ml.Flux(signal, background, 50.0), make_system(dead), bins=512, rearm=rearm)
        law = holding_times(chain)  # warnings are errors here
        assert law.sigma2 >= 0
        assert law.sigma_ss2 >= 0
        assert law.mu >= dead - 0.5 / 512


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize(
    ("rate", "dead", "cycles"), [(0.4, 0.6375, 200), (3.0, 1.7, 300), (0.05, 0.3, 40), (2.0, 0.6375, 100)]
)
def test_the_law_of_constant_light_is_a_renewal_process(start, rate, dead, cycles):
    """(6.4), (6.5), and the moments (6.3); the long exposure of (6.2) is off by less than half a count."""
    system, armed = make_system(dead, cycles=cycles, start=start), start == "armed"
    pmf = (armed_count_pmf if armed else stationary_count_pmf)(rate, dead, cycles, 400)
    support = np.arange(pmf.size)
    law = ml.count_law(ml.Flux(0.0, rate), system)
    on = pmf[np.minimum(law.support, pmf.size - 1)]
    np.testing.assert_allclose(law.pmf, on, atol=1e-9)
    np.testing.assert_allclose(law.cdf, np.cumsum(on), atol=1e-9)
    mean, variance = constant_rate_moments(rate, dead, cycles, stationary=not armed)
    assert pmf.sum() == pytest.approx(1.0, abs=1e-11)
    assert pmf @ support == pytest.approx(mean, abs=1e-8)
    assert pmf @ (support - pmf @ support) ** 2 == pytest.approx(variance, abs=1e-5)
    assert abs(ml.count_law(ml.Flux(0.0, rate), system, "renewal").mean - mean) <= 0.5


def test_bad_input_is_named():
    system = make_system(0.6)
    refused("photons must not all be 0", holding_time_covariance, ml.Flux(0.0, 0.0), system)
    refused("lags must be an integer in", holding_time_covariance, ml.Flux(1.0, 0.0, 50.0), system, lags=-1)
    refused("rearm must be one of", ml.count_law, ml.Flux(0.0, 0.0), system, "mars", rearm="middle")
