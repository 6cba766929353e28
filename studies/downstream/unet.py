"""A U-Net of the kind that DDPMs use, without its clock: a histogram cube in, one map out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from mars_lidar._base import checks

Target = Literal["depth", "reflectivity"]
TARGETS = ("depth", "reflectivity")


class CubeUNet(nn.Module):
    """Histogram cubes (N, bins, H, W) to maps (N, 1, H, W).

    The architecture of Ho et al. (arXiv 2006.11239) without the embedding of the diffusion step: residual blocks of
    group normalisation, SiLU and 3 x 3 convolutions, attention at the coarsest level, skips between encoder and
    decoder. The time bins are the channels of the input, behind a learned stem: two 1 x 1 convolutions, which see one
    pixel's whole histogram each.

    Parameters
    ----------
    bins
        Time bins.
    target
        ``"depth"`` or ``"reflectivity"``: which map the head gives, by a sigmoid, as a share of a stated range.
    stem
        Channels behind the first layer of the stem.
    widths
        Channels of the levels, each half the size of the one before.
    blocks
        Residual blocks of a level, on either side.
    """

    def __init__(
        self, bins: int, target: Target, *, stem: int = 64, widths: Sequence[int] = (32, 64, 96), blocks: int = 1
    ) -> None:
        super().__init__()
        checks.choice("target", target, TARGETS)
        checks.integer("bins", bins, low=1, high=2**20)
        checks.integer("stem", stem, low=1, high=4096)
        checks.integer("blocks", blocks, low=1, high=16)
        if not widths:
            raise ValueError("widths must have at least one level, got none")
        for width in widths:
            if checks.integer("widths", width, low=8, high=4096) % 8:
                raise ValueError(f"widths must be multiples of 8, got {width}")
        self.target: Target = target
        self.multiple = 2 ** (len(widths) - 1)
        self.stem = nn.Sequential(_Pointwise(bins, stem), nn.SiLU(), _Pointwise(stem, widths[0]))
        self.encoder, self.decoder = nn.ModuleList(), nn.ModuleList()
        before = widths[0]
        for k, width in enumerate(widths):
            level = [_Block(before if b == 0 else width, width) for b in range(blocks)]
            self.encoder.append(nn.Sequential(*level))
            before = width
            if k < len(widths) - 1:
                self.encoder.append(nn.Conv2d(width, width, 3, stride=2, padding=1))
        self.middle = nn.Sequential(_Block(before, before), _Attention(before), _Block(before, before))
        for width in reversed(widths[:-1]):
            self.decoder.append(nn.Sequential(nn.Upsample(scale_factor=2), nn.Conv2d(before, width, 3, padding=1)))
            level = [_Block(2 * width if b == 0 else width, width) for b in range(blocks)]
            self.decoder.append(nn.Sequential(*level))
            before = width
        self.head = nn.Sequential(nn.GroupNorm(8, before), nn.SiLU(), nn.Conv2d(before, 1, 3, padding=1))
        for part in self.modules():
            if isinstance(part, nn.Conv2d):  # as a cube has it: bins innermost
                part.weight.data = part.weight.data.contiguous(memory_format=torch.channels_last)

    def forward(self, cube: Tensor) -> Tensor:
        """Maps (N, 1, H, W) in (0, 1); H and W must be multiples of `multiple`."""
        if cube.ndim != 4 or cube.shape[-1] % self.multiple or cube.shape[-2] % self.multiple:
            raise ValueError(
                f"cube must be (N, bins, H, W) with H and W multiples of {self.multiple}, got {tuple(cube.shape)}"
            )
        x = self.stem(cube)
        skips = []
        for k, layer in enumerate(self.encoder):
            x = layer(x)
            if k % 2 == 0:
                skips.append(x)
        skips.pop()  # of the coarsest level, which goes on through the middle
        x = self.middle(x)
        for k, layer in enumerate(self.decoder):
            x = layer(x) if k % 2 == 0 else layer(torch.cat((x, skips.pop()), dim=1))
        out: Tensor = torch.sigmoid(self.head(x))
        return out


class _Pointwise(nn.Linear):
    """A 1 x 1 convolution as one matrix product: with channels innermost in memory it needs no copy."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class _Block(nn.Module):
    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.GroupNorm(8, inside),
            nn.SiLU(),
            nn.Conv2d(inside, outside, 3, padding=1),
            nn.GroupNorm(8, outside),
            nn.SiLU(),
            nn.Conv2d(outside, outside, 3, padding=1),
        )
        self.past = nn.Identity() if inside == outside else _Pointwise(inside, outside)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.past(x) + self.layers(x)
        return out


class _Attention(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, width)
        self.attention = nn.MultiheadAttention(width, 4, batch_first=True)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.norm(x).flatten(2).transpose(1, 2)
        seen, _ = self.attention(tokens, tokens, tokens, need_weights=False)
        out: Tensor = x + seen.transpose(1, 2).reshape(x.shape)
        return out
