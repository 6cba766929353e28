"""deepinv's denoiser DRUNet as a prior of depths (plug and play).

The weights that deepinv downloads are used if a file of them is given; else a small network of the same class is
trained on depths of this package's own scenes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar import Detector, GaussianPulse, System
from mars_lidar._base.imports import MissingLibraryError
from mars_lidar._base.types import FloatArray
from studies.image import scenes

MOST_NOISE = 50.0 / 255.0  # standard deviation that the network was trained up to, of images from 0 to 1
_LEAST_NOISE = 1.0 / 255.0
_CHANNELS = 32, 32, 48, 64  # of the network that is trained here; deepinv's own has 64, 128, 256 and 512
_SIDE, _BATCH = 32, 8  # of the crops that it is trained on, and how many at a time


@dataclass(frozen=True, eq=False)
class Prior:
    """A network that removes noise of known standard deviation from images from 0 to 1, and where it is from."""

    net: Any
    weights: str

    def __call__(self, image: FloatArray, noise: float) -> FloatArray:
        """The image without noise of this standard deviation."""
        import torch

        low, span = float(image.min()), max(float(np.ptp(image)), noise / MOST_NOISE)
        x = torch.from_numpy((image - low) / span).float()[None, None]
        with torch.no_grad():
            return np.asarray(self.net(x, noise / span)[0, 0].double().numpy() * span + low)


def prior(file: Path | None, steps: int, images: int, seed: int) -> Prior:
    """DRUNet with the weights of a file, or trained here in so many steps on so many images.

    Raises
    ------
    MissingLibraryError
        Without PyTorch or deepinv.
    """
    try:
        import torch
        from deepinv.models import DRUNet
    except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision is of another PyTorch
        raise MissingLibraryError(f"DRUNet needs deepinv, PyTorch and its torchvision: {error}") from error
    torch.set_num_threads(1)
    if file is not None:
        values = torch.load(file, map_location="cpu", weights_only=True)
        channels = [values[f"m_up{k}.0.weight"].shape[axis] for k in (1, 3) for axis in (1, 0)]
        blocks = sum(name.startswith("m_down1") and name.endswith("res.0.weight") for name in values)
        net = DRUNet(1, 1, nc=channels, nb=blocks, pretrained=None)
        net.load_state_dict(values)
        return Prior(net.eval(), f"weights of the file {file.name}")
    began = time.process_time()
    torch.manual_seed(seed)
    net = DRUNet(1, 1, nc=_CHANNELS, nb=1, pretrained=None)
    _train(torch, net, steps, images, seed)
    spent = time.process_time() - began
    words = f"a small one (channels {', '.join(map(str, _CHANNELS))}) trained here in {spent:.0f} s of a processor, "
    return Prior(net.eval(), words + f"{steps} steps on the depths of {images} of the images that `image` learned from")


def _train(torch: Any, net: Any, steps: int, images: int, seed: int) -> None:
    """By the absolute error in crops with Gaussian noise, as Zhang et al. trained theirs."""
    clean = torch.from_numpy(np.stack(list(_depths(images, seed)))).float()
    rng = np.random.default_rng([seed, images])
    optimiser = torch.optim.AdamW(net.parameters())
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
    for _ in range(steps):
        row, column = rng.integers(0, scenes.SIDE - _SIDE + 1, 2)
        x = clean[rng.integers(0, images, _BATCH), None, row : row + _SIDE, column : column + _SIDE]
        noise = torch.from_numpy(np.geomspace(_LEAST_NOISE, MOST_NOISE, 1001)[rng.integers(0, 1001, _BATCH)]).float()
        given = x + noise[:, None, None, None] * torch.randn(x.shape)
        loss = ((net(given, noise) - x).abs().mean((1, 2, 3)) / noise).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        rate.step()


def _depths(images: int, seed: int) -> Iterator[FloatArray]:
    """Depths of the scenes of the training, each from 0 to 1."""
    for number in range(images):
        rng = np.random.default_rng([seed, number, 1])
        sigma = float(np.exp(rng.uniform(*np.log(scenes.SIGMA_NS))))
        system = System(
            period_ns=scenes.PERIOD_NS,
            cycles=1000,
            bins=1000,
            pulse=GaussianPulse(sigma_ns=sigma),
            detector=Detector(dead_time_ns=0.0),
        )
        depth = np.asarray(scenes.training_scene(number, rng, system).depth_m)
        depth = np.where(np.isfinite(depth), depth, np.nanmax(depth))
        yield (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
