"""Depths by priors that smooth, the baselines: likelihood of method "image" in turn with a denoiser of images.

The likelihood of a pixel is searched over all cells of delay. Total variation: alternating directions (Boyd et al.,
Found. Trends Mach. Learn. 3, 1, 2011). A network: half-quadratic splitting with noise that decreases in each round
(Zhang et al., IEEE Trans. Pattern Anal. Mach. Intell. 44, 6360, 2022), deepinv's DRUNet: the weights that deepinv
downloads are used if a file of them is given; else a small network of the same class is trained on depths of this
package's own scenes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from mars_lidar import Detector, GaussianPulse, System
from mars_lidar._base.imports import MissingLibraryError
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.image import solver_of
from mars_lidar.reconstruction.image_pulse import settings_of
from mars_lidar.reconstruction.photons import Photons
from studies.image import scenes

TV_WEIGHT = 1.0  # of the variation, per sigma: of 0.3, 1, 2 and 4 the best in five images of the training's kind
_ROUNDS, _STIFFNESS, _PROJECTIONS = 60, 0.5, 25
# of the network: rounds, and standard deviations of the noise at first (of the range of depths) and at last (sigma of
# the pulse; of 1 and 0.3 the better in nine images of the training's kind, in which alternating directions were worse)
_NETWORK_ROUNDS, _FIRST_NOISE, _LAST_NOISE = 30, 0.2, 1.0
Denoise = Callable[[FloatArray, float], FloatArray]  # an image and the standard deviation of its noise, both in sigma


class _Pixels:
    """Likelihood of each pixel alone; delays in sigma. It does not wrap: scenes of it end within the period."""

    def __init__(self, cube: np.ndarray, system: System) -> None:
        height, width, bins = cube.shape
        solver = solver_of(Photons.of(cube.reshape(-1, bins), height, width), 1)
        setting = settings_of(system)[-1]
        solver.begin(setting)
        likelihood = np.asarray(solver.volumes().likelihood)
        self.cost = -np.log(likelihood.reshape(height, width, -1).astype(np.float64) + 1e-12)
        self.place = (np.arange(setting.cells) + 0.5) / setting.sigma
        self.ns = setting.sigma / setting.cells * system.period_ns

    def start(self) -> FloatArray:
        """The most likely delays of 5 x 5 pixels together."""
        return np.asarray(self.place[uniform_filter(self.cost, (5, 5, 0), mode="nearest").argmin(-1)], np.float64)

    def near(self, target: FloatArray, stiffness: float) -> FloatArray:
        """Delays of least cost plus stiffness / 2 times their squared distance from the target."""
        return np.asarray(self.place[(self.cost + 0.5 * stiffness * (self.place - target[..., None]) ** 2).argmin(-1)])


def by_variation(cube: np.ndarray, system: System, weight: float = TV_WEIGHT) -> FloatArray:
    """Most likely delays (H, W), ns, whose differences from pixel to pixel are penalised."""
    pixels = _Pixels(cube, system)
    smooth = pixels.start()
    dual = np.zeros_like(smooth)
    for _ in range(_ROUNDS):
        own = pixels.near(smooth - dual, _STIFFNESS)
        smooth = total_variation(own + dual, weight / _STIFFNESS)
        dual += own - smooth
    return smooth * pixels.ns


def by_denoiser(cube: np.ndarray, system: System, denoise: Denoise) -> FloatArray:
    """Delays (H, W), ns, with a denoiser of images for the prior."""
    pixels = _Pixels(cube, system)
    smooth = pixels.start()
    first = max(_FIRST_NOISE * float(np.ptp(smooth)), _LAST_NOISE)
    for noise in np.geomspace(first, _LAST_NOISE, _NETWORK_ROUNDS):
        smooth = denoise(pixels.near(smooth, 1.0 / noise**2), float(noise))
    return smooth * pixels.ns


def total_variation(image: FloatArray, weight: float, projections: int = _PROJECTIONS) -> FloatArray:
    """The image u of least |u - image|^2 / 2 + weight times the sum of |gradient of u|.

    By Chambolle's projection (J. Math. Imaging Vis. 20, 89, 2004).
    """
    down, right = np.zeros_like(image), np.zeros_like(image)
    for _ in range(projections):
        value = _divergence(down, right) - image / weight
        slope = np.diff(value, axis=0, append=value[-1:]), np.diff(value, axis=1, append=value[:, -1:])
        size = 1.0 + 0.25 * np.hypot(*slope)
        down, right = (down + 0.25 * slope[0]) / size, (right + 0.25 * slope[1]) / size
    return np.asarray(image - weight * _divergence(down, right))


def _divergence(down: FloatArray, right: FloatArray) -> FloatArray:
    out = np.diff(down, axis=0, prepend=0.0) + np.diff(right, axis=1, prepend=0.0)
    return np.asarray(out)


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


def drunet(file: Path | None, steps: int, images: int, seed: int) -> Prior:
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
