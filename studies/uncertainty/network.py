"""A network that tells a mean and a variance of each quantity, and its training by the Gaussian likelihood."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from studies.common.intervals import Steps, likelihood


class IntervalNetwork(nn.Module):
    """Means and log-variances (pixels, outputs) of features (pixels, features), two hidden layers.

    `standardise` first: the scales of both are taken from the training data.
    """

    def __init__(self, features: int, outputs: int, width: int = 128) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(features, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, 2 * outputs),
        )
        self.seen_mean, self.seen_scale = nn.Buffer(torch.zeros(features)), nn.Buffer(torch.ones(features))
        self.wanted_mean, self.wanted_scale = nn.Buffer(torch.zeros(outputs)), nn.Buffer(torch.ones(outputs))

    def standardise(self, seen: NDArray[np.float32], wanted: NDArray[np.float32]) -> None:
        """Take the scales of features and outputs from training data."""
        for name, values in (("seen", seen), ("wanted", wanted)):
            getattr(self, f"{name}_mean").copy_(torch.from_numpy(values.mean(0, dtype=np.float64)))
            getattr(self, f"{name}_scale").copy_(torch.from_numpy(values.std(0, dtype=np.float64)).clamp_min(1e-6))

    def forward(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log-variances in the units of what is wanted."""
        mean, log_variance = self.layers((seen - self.seen_mean) / self.seen_scale).chunk(2, -1)
        scale = self.wanted_scale
        return self.wanted_mean + scale * mean, log_variance.clamp(-14.0, 6.0) + 2.0 * scale.log()


def trained(
    network: IntervalNetwork,
    seen: NDArray[np.float32],
    wanted: NDArray[np.float32],
    *,
    steps: int,
    batch: int,
    seed: int,
) -> Iterator[int]:
    """Train `network`; gives the number of steps after each, for whoever wants to look."""
    network.standardise(seen, wanted)
    optimizer = Steps(network, steps)
    inside, outside = torch.from_numpy(seen), torch.from_numpy(wanted)
    random = np.random.default_rng([seed, len(seen)])
    network.train()
    for step in range(steps):
        index = torch.from_numpy(random.integers(0, len(seen), batch))
        mean, log_variance = network(inside[index])
        optimizer.step(likelihood(mean, log_variance, outside[index]).sum(-1).mean())
        yield step + 1


def told(network: IntervalNetwork, seen: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means and standard deviations (pixels, outputs)."""
    parts = []
    with torch.inference_mode():
        for some in torch.split(torch.from_numpy(seen), 2**14):
            mean, log_variance = network(some)
            parts.append(torch.stack([mean, torch.exp(0.5 * log_variance)]).double())
    mean, deviation = torch.cat(parts, 1).numpy()
    return mean, deviation
