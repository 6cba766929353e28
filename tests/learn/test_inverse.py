"""The operator for deepinv: its mean, its draws, its gradients."""

import sys

import numpy as np
import pytest
import torch
from harness import make_system, refused

import mars_lidar as ml

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # torch's own forward mode calls it
SYSTEM = make_system(40.0, 300, 16, sigma_ns=4.0, start="stationary")


@pytest.fixture
def physics(deepinv):
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


def test_vjp_and_jvp_are_what_deepinv_asks_for(physics):
    """A, A_vjp and A_jvp against differences along directions, each other's transposes, and the same from a table."""
    from mars_lidar.learn import LidarPhysics

    pixel, way = (
        torch.tensor(v, dtype=torch.float64).reshape(1, 3, 1, 1) for v in ([0.8, 0.4, 37.0], [0.3, -0.2, 0.7])
    )
    assert torch.autograd.gradcheck(physics.A, (pixel.clone().requires_grad_(),))
    refused(r"\(B, 3, H, W\)", physics, pixel[0])
    x = pixel.expand(1, 3, 2, 2)
    torch.manual_seed(1)
    step, back = way * torch.randn_like(x), torch.randn(1, 16, 2, 2, dtype=torch.float64)
    moved = (physics.A(x + 1e-5 * step) - physics.A(x - 1e-5 * step)) / 2e-5
    torch.testing.assert_close(physics.A_jvp(x, step), moved, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close((physics.A_vjp(x, back) * step).sum(), (moved * back).sum(), rtol=1e-5, atol=1e-5)
    entries = ml.Table.build(SYSTEM, (0.5, 1.5, 30), (0.2, 0.8, 30), threads=1)
    table = LidarPhysics(SYSTEM, table=entries)
    torch.testing.assert_close(table.A(x), physics.A(x), rtol=2e-3, atol=1e-2)
    torch.testing.assert_close(table.A_vjp(x, back), physics.A_vjp(x, back), rtol=2e-2, atol=1e-2)
    there, here = (table.A_jvp(x, step) * back).sum(), (table.A_vjp(x, back) * step).sum()
    torch.testing.assert_close(there, here, rtol=1e-4, atol=1e-4)  # a table's is of single precision
    refused("table must be of this system", LidarPhysics, SYSTEM.replace(bins=32), table=entries)


@pytest.mark.full
def test_reconstruction_with_deepinv(physics):
    """Projected gradient steps on deepinv's own data fidelity and prior, from A_dagger: nearer to a smooth truth."""
    from deepinv.optim import L2, Tikhonov

    true = torch.tensor([0.8, 0.4, 37.0], dtype=torch.float64).reshape(1, 3, 1, 1).expand(1, 3, 6, 6).contiguous()
    y = physics(true)
    start = physics.A_dagger(y)
    assert start.shape == true.shape
    units = torch.tensor([0.1, 0.05, 0.5], dtype=torch.float64).reshape(1, 3, 1, 1)  # of about equal standard errors
    fidelity, prior = L2(sigma=3.0), Tikhonov()
    x, first = start.clone(), None
    for _ in range(25):
        rough = (x - x.mean((2, 3), keepdim=True)) / units
        gradient = units * fidelity.grad(x, y, physics) + 4.0 * prior.grad(rough)
        first = gradient.norm() if first is None else first
        x = (x - 0.05 * units * gradient).clamp_min(0.0)
    assert gradient.norm() < 0.2 * first
    before, after = ((example - true).square().mean((0, 2, 3)) for example in (start, x))
    assert (after < before).all()


def test_without_deepinv_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "deepinv", None)
    monkeypatch.delitem(sys.modules, "deepinv.physics", raising=False)
    monkeypatch.delitem(sys.modules, "mars_lidar.learn.inverse", raising=False)
    monkeypatch.delitem(vars(ml.learn), "LidarPhysics", raising=False)
    with pytest.raises(ImportError, match="deepinv: pip install"):
        from mars_lidar.learn import LidarPhysics  # noqa: F401


def test_a_seed_that_is_given_is_honoured(physics):
    x = torch.tensor([0.8, 0.4, 37.0], dtype=torch.float64).reshape(1, 3, 1, 1).expand(2, 3, 4, 5)
    first, second = physics(x), physics(x)
    assert torch.equal(physics(x, seed=5), first)
    assert torch.equal(physics(x, seed=6), second)
    assert not torch.equal(first, second)
    refused("seed", physics, x, seed=-1)


def test_depth_images_are_those_of_deepinv(physics):
    """Without dead time its own operator, whose pulse is sampled in the middle of bins; and back by A_dagger."""
    from deepinv.physics import SinglePhotonLidar

    from mars_lidar.learn import LidarPhysics

    system = SYSTEM.replace(bins=64, detector=ml.Detector(dead_time_ns=0.0), cycles=5000)
    ours, theirs = (LidarPhysics(system, images="depth", seed=2), SinglePhotonLidar(sigma=4.0 / system.bin_ns, bins=64))
    x = torch.tensor([20.3, 900.0, 7.0]).reshape(1, 3, 1, 1).expand(1, 3, 3, 3)
    torch.testing.assert_close(ours.A(x), theirs.A(x), rtol=0.01, atol=0.5)
    result = ours.A_dagger(ours(x).double())
    errors = torch.tensor([0.1, 30.0, 0.4]).reshape(1, 3, 1, 1)  # standard errors, about
    assert ((result - x).abs() < 5.0 * errors).all()
    refused("depth, intensity and background", ours.A, x[0])


def likelihood_descent(physics, y, prior, **options):
    """Images by deepinv's proximal gradient descent with the likelihood of dead time, started at maximum likelihood."""
    from deepinv.optim import PGD

    from mars_lidar.learn import LidarLikelihood

    descent = PGD(data_fidelity=LidarLikelihood(), prior=prior, custom_init=physics.custom_init, **options)
    return descent(y, physics).detach()


@pytest.mark.full
@pytest.mark.parametrize("name", ["TVPrior", "MedianFilter"])
def test_stock_solvers_on_a_step(deepinv, name):
    """Half a bin of depth in constant light: mean squared errors below 0.4 of those of maximum likelihood."""
    from deepinv.models import MedianFilter
    from deepinv.optim.prior import PnP, TVPrior

    from mars_lidar.learn import LidarPhysics

    physics = LidarPhysics(SYSTEM.replace(cycles=100), images="log", seed=3)
    light = torch.tensor([0.6, 0.32, 40.625], dtype=torch.float64).reshape(3, 1, 1, 1).repeat(1, 1, 8, 8)
    light[2, :, :, 4:] += 0.5 * SYSTEM.bin_ns
    true = physics.images(*light)
    y = physics(true)
    prior, options = {
        "TVPrior": (lambda: TVPrior(n_it_max=20), {"stepsize": 0.02, "lambda_reg": 2.0}),
        "MedianFilter": (lambda: PnP(MedianFilter(kernel_size=3)), {"stepsize": 0.005}),
    }[name]
    result = likelihood_descent(physics, y, prior(), max_iter=60, **options)
    error = [(each - true).square().mean((0, 2, 3)) for each in (physics.A_dagger(y), result)]
    assert (error[1] < 0.4 * error[0]).all(), error[1] / error[0]


@pytest.mark.full
def test_drunet_runs_as_it_comes(deepinv, tmp_path):
    """Weights of one's own from a file, for deepinv's own are a download: two steps, beside the same by hand."""
    from deepinv.models import DRUNet
    from deepinv.optim.prior import PnP

    from mars_lidar.learn import LidarLikelihood, LidarPhysics

    physics, weights = LidarPhysics(SYSTEM.replace(cycles=100), images="log", seed=3), tmp_path / "weights.pt"
    torch.manual_seed(0)
    torch.save(DRUNet(3, 3, nc=(8, 8, 8, 8), nb=1, pretrained=None).state_dict(), weights)
    denoiser = DRUNet(3, 3, nc=(8, 8, 8, 8), nb=1, pretrained=str(weights)).eval()
    y = physics(physics.images(*torch.tensor([0.6, 0.32, 40.0]).reshape(3, 1, 1, 1).expand(3, 1, 16, 16)))
    images = likelihood_descent(physics, y, PnP(denoiser), stepsize=0.005, sigma_denoiser=0.1, max_iter=2)
    by_hand = physics.A_dagger(y)
    for _ in range(2):
        by_hand = denoiser(by_hand - 0.005 * LidarLikelihood().grad(by_hand, y, physics), 0.1).detach()
    torch.testing.assert_close(images, by_hand, rtol=1e-4, atol=1e-5)
    assert (images - physics.A_dagger(y)).abs().max() > 0.1
