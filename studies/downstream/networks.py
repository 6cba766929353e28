"""Small networks that use the bins: cubes in, means and log-variances of the delay and of reflectivity out.

Both see counts as they are: none is divided by a pixel's own total, which would hide what dead time does to it. Cubes
may lie on the CPU: what is told lies where the network does.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from studies.common.intervals import likelihood
from studies.common.windows import FEATURES, WINDOW, features

_LIMITS = (-14.0, 6.0)  # of log-variances
_BLOCK, _REACH = 16, 24  # bins of a block, and of the filter to either side of a bin
_LOCAL = 12  # bins to either side of the best score that the soft-argmax takes


@dataclass(frozen=True, eq=False)
class Told:
    """Means and log-variances (pixels,) of delay, in bins, and reflectivity; `scores` (pixels, bins) if any."""

    bins: int
    delay: Tensor
    delay_log_variance: Tensor
    reflectivity: Tensor
    reflectivity_log_variance: Tensor
    scores: Tensor | None = None

    def away(self, delay: Tensor) -> Tensor:
        """Bins from the delays told to those given, the shorter way round the period."""
        return torch.remainder(delay - self.delay + 0.5 * self.bins, self.bins) - 0.5 * self.bins

    def loss(self, delay: Tensor, reflectivity: Tensor) -> Tensor:
        """Negative log-likelihood of the truth; of delays that are in reach, and of the bin by its score."""
        away = self.away(delay)
        seen = away.detach().abs() < 0.5 * WINDOW
        depth = likelihood(torch.zeros_like(away), self.delay_log_variance, away)[seen].sum() / len(away)
        light = likelihood(self.reflectivity, self.reflectivity_log_variance, reflectivity).mean()
        if self.scores is None:
            return depth + light
        return depth + light + functional.cross_entropy(self.scores, delay.long() % self.bins)


class _Standard(nn.Module):
    """Features (pixels, size) less their mean over their deviation, both of the first batch."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.zeros(size))

    def forward(self, x: Tensor) -> Tensor:
        if not bool(self.scale.any()):
            self.mean.copy_(x.detach().mean(0))
            self.scale.copy_(x.detach().std(0).clamp_min(1e-3))
        return (x - self.mean) / self.scale


class WindowNetwork(nn.Module):
    """64 bins about a box peak and sums of the rest, then two residual blocks of 3 x 3 convolutions."""

    def __init__(self, bins: int, width: int = 64) -> None:
        super().__init__()
        self.bins = bins
        self.standard = _Standard(FEATURES)
        self.stem = nn.Conv2d(FEATURES, width, 1)

        def turn() -> nn.Module:
            return nn.Sequential(nn.SiLU(), nn.Conv2d(width, width, 3, padding=1))

        self.blocks = nn.ModuleList(nn.Sequential(turn(), turn()) for _ in range(2))
        self.head = nn.Sequential(nn.SiLU(), nn.Conv2d(width, 4, 1))

    def forward(self, cube: Tensor) -> Told:
        """What cubes (N, H, W, bins) of counts tell."""
        found = features(cube.reshape(-1, self.bins).cpu().numpy())
        seen, middle = (torch.from_numpy(one).to(self.stem.weight.device) for one in found)
        image = self.standard(seen).reshape(*cube.shape[:3], FEATURES)
        x = self.stem(image.permute(0, 3, 1, 2))
        for block in self.blocks:
            x = x + block(x)
        return _told(self.bins, middle, self.head(x).permute(1, 0, 2, 3).flatten(1))


class BinNetwork(nn.Module):
    """A score of every bin by a learned filter, mended about the best one, and a soft-argmax there; pixel by pixel."""

    def __init__(self, bins: int, width: int = 96) -> None:
        super().__init__()
        self.bins = bins
        taps = torch.arange(-_REACH, _REACH + 1)
        self.filter = nn.Parameter(torch.where(taps.abs() <= _BLOCK // 2, 1.0 / _BLOCK, 0.0))
        inside = WINDOW + bins // _BLOCK + 2
        self.standard = _Standard(inside)
        self.mend = nn.Sequential(
            nn.Linear(inside, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 2 * _LOCAL + 5)
        )

    def forward(self, cube: Tensor) -> Told:
        """What cubes (N, H, W, bins) of counts tell."""
        at = self.filter.device
        counts = cube.reshape(-1, self.bins).to(at).float()
        x = counts.sqrt()
        scores = self._filtered(x)
        peak = scores.detach().argmax(1, keepdim=True)
        near = x.gather(1, (peak + torch.arange(-WINDOW // 2, WINDOW // 2, device=at)) % self.bins)
        blocks = self.bins // _BLOCK
        sums = counts.reshape(-1, blocks, _BLOCK).sum(-1)
        sums = sums.gather(1, (peak // _BLOCK + torch.arange(blocks, device=at)) % blocks)
        scales = torch.log1p(torch.stack([sums.sum(1), (near * near).sum(1)], 1))
        out = self.mend(self.standard(torch.cat([near, sums.sqrt(), scales], 1)))
        local = torch.arange(-_LOCAL, _LOCAL + 1, device=at)
        places = (peak + local) % self.bins
        scores = scores.scatter_add(1, places, out[:, 4:])
        share = torch.softmax(scores.gather(1, places), 1)
        middle = peak[:, 0] + 0.5 + share @ local.to(share.dtype)
        return _told(self.bins, middle, out[:, :4].T * torch.tensor([[0.0], [1.0], [1.0], [1.0]], device=at), scores)

    def _filtered(self, x: Tensor) -> Tensor:
        """Round the period, `_BLOCK` bins at a time: a matrix product."""
        looks = torch.cat([x[:, -_REACH:], x, x[:, :_REACH]], 1).unfold(1, _BLOCK + 2 * _REACH, _BLOCK)
        rows = [functional.pad(self.filter, (k, _BLOCK - 1 - k)) for k in range(_BLOCK)]
        return (looks @ torch.stack(rows, 1)).flatten(1)


def _told(bins: int, middle: Tensor, out: Tensor, scores: Tensor | None = None) -> Told:
    """From four numbers a pixel (4, pixels): bins from `middle`, reflectivity, and their log-variances."""
    away, spread, light, light_spread = out
    delay = middle.to(out.dtype) + 4.0 * away
    return Told(bins, delay, spread.clamp(*_LIMITS), 0.5 + 0.3 * light, (light_spread - 4.0).clamp(*_LIMITS), scores)
