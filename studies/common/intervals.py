"""Training of networks that tell a mean and a log-variance of each quantity; needs PyTorch, the extra ``learn``."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn

RATE = 2e-3  # largest learning rate of AdamW


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

    def __init__(self, network: nn.Module, steps: int, largest: float = RATE) -> None:
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
