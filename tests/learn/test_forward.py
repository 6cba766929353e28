"""The differentiable forward model: its gradients, and its values against independent ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import mars_lidar as ml
from mars_lidar.estimate.maximum_likelihood import log_likelihood
from mars_lidar.learn import armed_periods, bin_photons, expected_histogram, histogram_log_likelihood
from mars_lidar.statistics.joint import joint_law

PULSES = (ml.GaussianPulse(sigma_ns=3.0), ml.SampledPulse([1, 4, 9, 7, 3, 1, 0.5], bin_ns=2.7))


def system(dead_ns=42.3, pulse=PULSES[0], bins=20, start="stationary", cycles=500) -> ml.System:
    return ml.System(
        period_ns=100.0, cycles=cycles, bins=bins, pulse=pulse, detector=ml.Detector(dead_time_ns=dead_ns), start=start
    )


def point(*values):
    return [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in values]


AT = ([0.7, 3.0, 0.02], [0.3, 1.0, 0.01], [40.0, 97.0, 3.3])


@pytest.mark.parametrize("dead_ns", [0.0, 42.3, 100.0, 163.1])
@pytest.mark.parametrize("pulse", PULSES, ids=["gaussian", "sampled"])
def test_gradients(dead_ns, pulse):
    one, at = system(dead_ns, pulse), point(*AT)
    assert torch.autograd.gradcheck(lambda *x: bin_photons(*x, one), at)
    assert torch.autograd.gradcheck(lambda *x: expected_histogram(*x, one, refine=2), at)
    counts = torch.tensor(np.random.default_rng(0).poisson(9.0, (3, 20)))
    assert torch.autograd.gradcheck(lambda *x: histogram_log_likelihood(counts, *x, one), at)


@pytest.mark.parametrize("pulse", PULSES, ids=["gaussian", "sampled"])
def test_photons_are_those_of_the_pulse(pulse):
    found = bin_photons(*point(*AT), system(pulse=pulse)).detach().numpy()
    s, b, tau = (np.array(one) for one in AT)
    expected = s[:, None] * pulse.bin_energy(tau, 100.0, 20) + b[:, None] / 20
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("dead_ns", [0.0, 42.3, 100.0, 163.1, 300.0])
@pytest.mark.parametrize(("s", "b", "tau"), [(0.7, 0.3, 40.0), (3.0, 1.0, 97.0)])
def test_expected_histogram_is_the_mean_of_the_joint_law(dead_ns, s, b, tau):
    """Of another grid, of fourth order, bin by bin; and of the closed form where the dead time is whole periods."""
    one = system(dead_ns, bins=50)
    found = expected_histogram(*point(s, b, tau), one, refine=8).detach().numpy()
    np.testing.assert_allclose(found, joint_law(s, b, one, delay_ns=tau, tolerance=1e-5).mean, rtol=2e-3, atol=1e-3)
    if dead_ns % 100.0 == 0.0:
        flux = s * one.pulse.bin_energy(tau, 100.0, 50) + b / 50
        np.testing.assert_allclose(found, 500 * flux / (1 + dead_ns / 100.0 * (s + b)), rtol=2e-3)


def test_log_likelihood_is_the_native_one():
    one = system(bins=2000, cycles=2000)
    flux = ml.Flux(0.7, 0.3, 40.0)
    counts = ml.simulate(flux, one, seed=1)[0, 0, 0]
    at = point([0.7, 0.5], [0.3, 0.35], [40.0, 40.5])
    found = histogram_log_likelihood(torch.from_numpy(counts.astype(float)), *at, one)
    value, gradient, _ = log_likelihood(counts, one, *(x.detach().numpy() for x in at))
    found.sum().backward()
    np.testing.assert_allclose(float((found[0] - found[1]).detach()), value[0] - value[1], rtol=5e-3)
    for k in range(3):
        np.testing.assert_allclose(at[k].grad[1], gradient[1, k], rtol=5e-3)


def test_batches_types_and_bad_arguments():
    one = system()
    maps = [torch.rand(2, 3, 4) + 0.1, torch.rand(4) + 0.1, torch.tensor(30.0)]
    found = expected_histogram(*maps, one)
    assert found.shape == (2, 3, 4, 20)
    assert found.dtype == torch.float32
    alone = expected_histogram(maps[0][1, 2, 3], maps[1][3], maps[2], one)
    torch.testing.assert_close(found[1, 2, 3], alone)
    assert armed_periods(found, one).shape == found.shape
    with pytest.raises(TypeError, match="signal must be a tensor"):
        expected_histogram(1.0, *maps[1:], one)
    with pytest.raises(ValueError, match="must be >= 0"):
        expected_histogram(-maps[0], *maps[1:], one)
    with pytest.raises(ValueError, match="histogram must be a tensor"):
        histogram_log_likelihood(torch.zeros(3), *maps, one)
    with pytest.raises(ValueError, match="mode 'synchronous'"):
        expected_histogram(*maps, one.replace(detector=ml.Detector(dead_time_ns=10.0, mode="synchronous")))
    with pytest.raises(ValueError, match="at least a bin"):
        expected_histogram(*maps, system(dead_ns=1.0), refine=1)
