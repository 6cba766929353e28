"""The network: an autoencoder over the period, cyclic, whose answer multiplies the flux."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from mars_lidar._base.imports import MissingLibraryError

try:
    import torch
    from torch import Tensor, nn
except ImportError as _error:
    raise MissingLibraryError(f"the neural map needs PyTorch: pip install 'mars-lidar[learn]' ({_error})") from _error

STRIDE, LEVELS = 4, 3
MULTIPLE = STRIDE**LEVELS  # of which the number of bins must be one


class PdfAutoencoder(nn.Module):
    """Photons per bin (P, bins) to log registration PDF (P, bins).

    log pi = log(flux) + correction, normalised: no photon, no registration. The correction is the log of the share of
    periods in which the pixel is ready; the encoder sees the flux and its integral over the dead time before each bin,
    and the decoder corrects the first guess 1 / (1 + integral), which is exact for a constant flux. Cyclic
    convolutions; the flux is rolled to have its largest bin in the middle, so that the delay is not learned but exact.
    """

    def __init__(self, bins: int, dead_time: float, width: int = 16, code: int = 64) -> None:
        super().__init__()
        if bins % MULTIPLE or bins < 2 * MULTIPLE:
            raise ValueError(f"bins must be a multiple of {MULTIPLE}, at least {2 * MULTIPLE}, got {bins}")
        self.bins, self.dead_time = bins, dead_time
        self.width, self.code = width, code
        wide = [width * min(k + 1, 3) for k in range(LEVELS + 1)]
        self.stem = _cyclic(4, wide[0])
        self.down = nn.ModuleList(_Down(wide[k], wide[k + 1]) for k in range(LEVELS))
        flat = wide[-1] * (bins // MULTIPLE)
        self.encode, self.decode = nn.Linear(flat, code), nn.Linear(code, flat)
        self.up = nn.ModuleList(_Up(wide[k + 1], wide[k]) for k in reversed(range(LEVELS)))
        self.head = nn.Conv1d(wide[0], 1, 1)
        nn.init.zeros_(self.head.weight)
        assert self.head.bias is not None
        nn.init.zeros_(self.head.bias)

    def forward(self, photons: Tensor) -> Tensor:
        """Log PDF (P, bins) of fluxes (P, bins), in the frame of the network (see `canonical`)."""
        blind = self.blind(photons)
        x = torch.stack(
            (
                torch.log(photons * self.bins + 1e-6),
                torch.log1p(blind),
                blind / (1.0 + blind),
                torch.log(photons.sum(-1, keepdim=True) + 1e-6).expand_as(photons),
            ),
            dim=1,
        )
        x = nn.functional.silu(self.stem(0.25 * x))
        skips = []
        for layer in self.down:
            skips.append(x)
            x = layer(x)
        shape = x.shape
        x = x + self.decode(nn.functional.silu(self.encode(x.flatten(1)))).reshape(shape)
        for layer in self.up:
            x = layer(x, skips.pop())
        correction = self.head(x)[:, 0] - torch.log1p(blind)
        return torch.log_softmax(torch.log(photons + 1e-30) + correction, dim=-1)

    def blind(self, photons: Tensor) -> Tensor:
        """Photons in the dead time before the centre of each bin (P, bins), cyclic."""
        whole = math.floor(self.dead_time)
        back = (self.dead_time - whole) * self.bins  # bins
        shift = math.floor(back)
        below = torch.cumsum(photons, -1) - 0.5 * photons  # to the centre of each bin
        total = photons.sum(-1, keepdim=True)
        ago = torch.arange(self.bins, device=photons.device) - shift

        def at(index: Tensor) -> Tensor:
            turns = torch.div(index, self.bins, rounding_mode="floor")
            return below[:, index - turns * self.bins] + turns * total

        early = torch.lerp(at(ago), at(ago - 1), back - shift)
        return torch.clamp(whole * total + below - early, min=0.0)


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums in the same order whatever the machine; layers as small as these lose by more threads anyway."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def canonical(photons: Tensor) -> tuple[Tensor, Tensor]:
    """Fluxes (P, bins) rolled so that the largest bin is the middle one, and by how many bins (P,)."""
    bins = photons.shape[-1]
    shift = bins // 2 - photons.argmax(-1)
    return rolled(photons, shift), shift


def rolled(rows: Tensor, shift: Tensor) -> Tensor:
    """Rows (P, bins), each moved cyclically by its own number of bins (P,)."""
    bins = rows.shape[-1]
    index = (torch.arange(bins, device=rows.device)[None] - shift[:, None]) % bins
    return torch.gather(rows, -1, index)


class _Down(nn.Module):
    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.first = nn.Conv1d(inside, outside, STRIDE, stride=STRIDE)
        self.second = _cyclic(outside, outside)

    def forward(self, x: Tensor) -> Tensor:
        x = nn.functional.silu(self.first(x))
        return x + nn.functional.silu(self.second(x))


class _Up(nn.Module):
    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.first = nn.ConvTranspose1d(inside, outside, STRIDE, stride=STRIDE)
        self.second = _cyclic(2 * outside, outside)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = nn.functional.silu(self.first(x))
        return x + nn.functional.silu(self.second(torch.cat((x, skip), dim=1)))


def _cyclic(inside: int, outside: int) -> nn.Conv1d:
    return nn.Conv1d(inside, outside, 5, padding=2, padding_mode="circular")
