"""Training of networks that tell a mean and a log-variance of each quantity; needs PyTorch, the extra ``learn``."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

RATE = 2e-3  # largest learning rate of AdamW


def likelihood(mean: Tensor, log_variance: Tensor, wanted: Tensor) -> Tensor:
    """Negative log-likelihood of a Gaussian, without log(2 pi) / 2."""
    return 0.5 * (log_variance + (wanted - mean) ** 2 * torch.exp(-log_variance))


class Steps:
    """AdamW with a rate that rises over a twentieth of the steps, then falls as a cosine to a hundredth."""

    def __init__(self, network: nn.Module, steps: int, largest: float = RATE) -> None:
        self._network, self._steps, self._largest, self._made = network, steps, largest, 0
        self._optimizer = torch.optim.AdamW(network.parameters(), lr=largest, weight_decay=1e-4)

    def step(self, loss: Tensor) -> None:
        """One step down the gradient of `loss`, no longer than 10."""
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._network.parameters(), 10.0)
        self._optimizer.step()
        self._made += 1

    def _rate(self) -> float:
        warm = max(1, self._steps // 20)
        if self._made < warm:
            return self._largest * (self._made + 1) / warm
        share = (self._made - warm) / max(1, self._steps - warm)
        return self._largest * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * share)))
