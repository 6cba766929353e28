"""The operator for deepinv: its mean, its draws, its gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import mars_lidar as ml

SYSTEM = ml.System(
    period_ns=100.0, cycles=300, bins=16, pulse=ml.GaussianPulse(sigma_ns=4.0), detector=ml.Detector(dead_time_ns=40.0),
    start="stationary",
)  # fmt: skip


@pytest.fixture
def physics():
    pytest.importorskip("deepinv", reason="deepinv needs torchvision", exc_type=ImportError)
    from mars_lidar.learn import LidarPhysics

    return LidarPhysics(SYSTEM, seed=5)


def test_draws_have_the_mean(physics):
    """4000 pixels alike: every bin within 4.5 standard errors (false alarm 1e-4 over 16 bins)."""
    x = torch.tensor([0.8, 0.4, 37.0], dtype=torch.float64).reshape(1, 3, 1, 1).expand(2, 3, 40, 50)
    drawn, mean = physics(x), physics.A(x)
    assert drawn.shape == mean.shape == (2, 16, 40, 50)
    error = drawn.var(dim=(0, 2, 3)).sqrt() / 4000**0.5
    assert ((drawn.mean(dim=(0, 2, 3)) - mean[0, :, 0, 0]).abs() < 4.5 * error).all()
    assert not torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn, physics(x))
    cube = ml.simulate(ml.Flux(np.full((40, 50), 0.8), 0.4, 37.0), SYSTEM, seed=5)[0]
    np.testing.assert_array_equal(drawn[0].permute(1, 2, 0), cube)


def test_gradient_and_bad_input(physics):
    x = torch.tensor([0.8, 0.4, 37.0], dtype=torch.float64).reshape(1, 3, 1, 1).requires_grad_()
    assert torch.autograd.gradcheck(physics.A, (x,))
    with pytest.raises(ValueError, match=r"\(B, 3, H, W\)"):
        physics(x[0])


def test_without_deepinv_the_error_says_what_to_install():
    try:
        import deepinv  # noqa: F401
    except ImportError:
        with pytest.raises(ImportError, match="deepinv: pip install"):
            from mars_lidar.learn import LidarPhysics  # noqa: F401
