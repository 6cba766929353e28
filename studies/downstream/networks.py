"""Networks that give a mean and a variance of reflectivity and delay, and their training by the Gaussian likelihood."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from mars_lidar._base.types import FloatArray
from studies.downstream.data import Pixels

OUTPUTS = 2  # reflectivity, and the delay from the middle of the window, in bins
_LIMITS = (-14.0, 6.0)  # of log-variances, in units of the training data's


_RATES = {"pixel": 6e-3, "spatial": 4e-3}  # largest of AdamW: at 2e-3 1,200 steps end 0.3 dB further from the bound


def likelihood(mean: Tensor, log_variance: Tensor, wanted: Tensor) -> Tensor:
    """Negative log-likelihood of a Gaussian, without log(2 pi) / 2."""
    return 0.5 * (log_variance + (wanted - mean) ** 2 * torch.exp(-log_variance))


def _rate(steps: int, largest: float, made: int) -> float:
    warm = max(1, steps // 20)
    if made < warm:
        return largest * (made + 1) / warm
    share = (made - warm) / max(1, steps - warm)
    return largest * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * share)))


class Steps:
    """AdamW with a rate that rises over a twentieth of the steps, then falls as a cosine to a hundredth."""

    def __init__(self, network: nn.Module, steps: int, largest: float) -> None:
        self._network = network
        self._optimizer = torch.optim.AdamW(network.parameters(), lr=1.0, weight_decay=1e-4)  # times `_rate`
        self._schedule = torch.optim.lr_scheduler.LambdaLR(self._optimizer, partial(_rate, steps, largest))

    def step(self, loss: Tensor) -> None:
        """One step down the gradient of `loss`, no longer than 10."""
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._network.parameters(), 10.0)
        self._optimizer.step()
        self._schedule.step()


class Network(nn.Module):
    """Means and log-variances (N, H, W, OUTPUTS) of `features` (N, H, W, features) that `standardise` has scaled.

    ``pixel``: each pixel by itself, three hidden layers; ``spatial``: two residual blocks of 3 x 3 convolutions.
    """

    def __init__(self, kind: str, features: int) -> None:
        super().__init__()
        width = 96 if kind == "pixel" else 64
        self.stem = nn.Linear(features, width)
        inner = [nn.SiLU(), nn.Linear(width, width)]
        self.inner = nn.Sequential(*inner, nn.SiLU(), nn.Linear(width, width)) if kind == "pixel" else nn.Identity()

        def block() -> nn.Module:
            turns = [(nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)) for _ in range(2)]
            return nn.Sequential(*turns[0], *turns[1])

        self.blocks = nn.ModuleList(block() for _ in range(0 if kind == "pixel" else 2))
        self.head = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * OUTPUTS))
        self.inputs_mean, self.inputs_scale = nn.Buffer(torch.zeros(features)), nn.Buffer(torch.ones(features))
        self.wanted_mean, self.wanted_scale = nn.Buffer(torch.zeros(OUTPUTS)), nn.Buffer(torch.ones(OUTPUTS))

    def standardise(self, pixels: Pixels) -> None:
        """Take the scales of features and outputs from training data."""
        for name, values in (("inputs", pixels.inputs), ("wanted", pixels.wanted)):
            flat = values.reshape(-1, values.shape[-1])
            getattr(self, f"{name}_mean").copy_(torch.from_numpy(np.nanmean(flat, 0, dtype=np.float64)))
            scale = torch.from_numpy(np.nanstd(flat, 0, dtype=np.float64))
            getattr(self, f"{name}_scale").copy_(scale.clamp_min(1e-3))

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log-variances in the units of what is wanted."""
        x = self.inner(self.stem((inputs - self.inputs_mean) / self.inputs_scale))
        for block in self.blocks:
            x = x + block(x.movedim(-1, 1)).movedim(1, -1)
        mean, log_variance = self.head(x).chunk(2, -1)
        scale = self.wanted_scale
        return self.wanted_mean + scale * mean, log_variance.clamp(*_LIMITS) + 2.0 * scale.log()


def trained(kind: str, pixels: Pixels, *, steps: int, batch: int, seed: int) -> Network:
    """A network; `batch` images a step, or as many pixels of any images for the pixel network."""
    torch.manual_seed(seed)
    network = Network(kind, pixels.inputs.shape[-1])
    network.standardise(pixels)
    optimizer = Steps(network, steps, _RATES[kind])
    inputs, wanted = torch.from_numpy(pixels.inputs), torch.from_numpy(pixels.wanted)
    if kind == "pixel":
        batch *= inputs.shape[1] * inputs.shape[2]
        inputs, wanted = (values.reshape(-1, values.shape[-1]) for values in (inputs, wanted))
    for index in _turns(len(inputs), batch, steps, seed):
        mean, log_variance = network(inputs[index])
        aim = wanted[index]
        known = torch.isfinite(aim)
        loss = torch.where(known, likelihood(mean, log_variance, torch.where(known, aim, mean.detach())), 0.0)
        optimizer.step(loss.sum() / (loss.numel() / OUTPUTS))
    return network


def _turns(number: int, batch: int, steps: int, seed: int) -> Iterator[Tensor]:
    """Indices of each step: all once in random order before any comes again."""
    random, order = np.random.default_rng([seed, number]), np.empty(0, np.int64)
    for _ in range(steps):
        while len(order) < batch:
            order = np.concatenate([order, random.permutation(number)])
        yield torch.from_numpy(order[:batch])
        order = order[batch:]


def predicted(network: Network, pixels: Pixels) -> tuple[FloatArray, FloatArray]:
    """Means and standard deviations (N, H, W, OUTPUTS); the delay is from bin 0."""
    with torch.inference_mode():
        parts = [network(torch.from_numpy(image[None])) for image in pixels.inputs]
    mean = torch.cat([value for value, _ in parts]).double().numpy()
    deviation = torch.exp(0.5 * torch.cat([value for _, value in parts])).double().numpy()
    mean[..., 1] += pixels.middle
    return mean, deviation
