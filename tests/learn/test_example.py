"""The example, shortened: it runs, learns, and measures itself."""

import runpy
from pathlib import Path

import pytest
import torch

from mars_lidar import Flux

PATH = Path(__file__).parents[2] / "examples" / "train_depth.py"


@pytest.mark.full
def test_train_depth():
    example = runpy.run_path(str(PATH))
    net, losses = example["train"](30, 12)
    assert len(losses) == 30
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    shares = example["within_a_bin"](net, 12)
    assert set(shares) == {"network", "matched filter"}
    assert 0.3 < shares["matched filter"] <= 1.0  # chance is 0.03
    assert 0.1 < shares["network"] <= 1.0


def test_it_is_short():
    """The stream, the network and its training: code, without imports, blank lines and what measures and plots."""
    text = PATH.read_text()
    core = text[text.index("PULSE") : text.index("def within_a_bin")]
    assert len([line for line in core.splitlines() if line.strip()]) <= 24


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::UserWarning")  # sbi's: four epochs and a prior by its draws alone, on purpose
def test_own_prior():
    """90 % intervals hold 88 to 92 % over the prior: beyond that 3 standard errors (false alarm 4e-3 over six ends)."""
    pytest.importorskip("sbi")
    example = runpy.run_path(str(PATH.with_name("own_prior.py")))
    shares, errors = example["coverage"](example["train"]())
    for name, (half, most) in shares.items():
        assert abs(most - 0.9) < 0.02 + 3.0 * errors[1], (name, most)
        assert abs(half - 0.5) < 0.04 + 3.0 * errors[0], (name, half)


@pytest.mark.full
def test_learned_prior(deepinv):
    """Shortened: the denoiser learns; its gradient is that of the likelihood; it mends depths that noise displaced."""
    example = runpy.run_path(str(PATH.with_name("learned_prior.py")))
    denoiser, losses = example["train"](100, 24)
    assert losses[-1] < 0.8 * sum(losses[:10]) / 10
    rows, pictures = example["compared"](denoiser, "random", 2, 24, 12)
    assert [len(row) for row in rows] == 7 * [6]
    assert set(example["PICTURED"]) <= set(pictures)
    depth, reflectivity = ({row[0]: float(row[k]) for row in rows} for k in (1, 5))
    assert depth["learned prior"] < 0.5 * depth[example["ALONE"]]
    assert reflectivity["learned prior"] < reflectivity[example["ALONE"]]
    true = pictures["truth"]
    noisy = true + 0.5 * torch.randn(true.shape, generator=torch.Generator().manual_seed(3))
    denoised = denoiser(noisy, 0.5).detach()
    assert (denoised - true).square().mean() < 0.6 * (noisy - true).square().mean()


@pytest.mark.full(seconds=20)
def test_stock_solvers_improve_on_each_pixel_alone(deepinv, tmp_path):
    """Three solvers of deepinv on a dim cube, DRUNet with weights trained here: all three images are nearer."""
    example = runpy.run_path(str(PATH.with_name("stock_solvers.py")))
    torch.save(example["weights"](), tmp_path / "drunet.pt")
    alone, *solved = example["errors"](tmp_path / "drunet.pt").values()
    assert len(solved) == 3
    assert all(after < before for row in solved for before, after in zip(alone, row, strict=True)), (alone, solved)


def test_the_data_term_of_the_learned_prior_is_the_likelihood(deepinv):
    """The gradient that deepinv follows beside that of the native likelihood, to 2 % of its standard deviation."""
    from mars_lidar.learn import LidarLikelihood, LidarPhysics
    from mars_lidar.reconstruction import log_likelihood

    example = runpy.run_path(str(PATH.with_name("learned_prior.py")))
    system, physics = example["SYSTEM"], LidarPhysics(example["SYSTEM"], images="log")
    light = example["scenes"]("room", 8, [0]).double()
    x = example["images"](light)
    y = physics(x, seed=1)
    gradient = LidarLikelihood().grad(x, y, physics)[0].detach()
    units = (light[0, 0], light[0, 1], torch.tensor(example["PULSE_NS"]).expand(8, 8))
    for row, column in ((0, 0), (3, 4), (7, 2), (5, 5)):
        _, slope, information = log_likelihood(
            y[0, :, row, column].numpy(), Flux(*light[0, :, row, column].numpy()), system
        )
        for channel, unit in enumerate(units):
            predicted = -slope[channel] * unit[row, column].item()
            deviation = information[channel, channel] ** 0.5 * unit[row, column].item()
            assert abs(gradient[channel, row, column].item() - predicted) < 0.02 * deviation
