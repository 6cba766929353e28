"""The pixels of a flux, one return each or evaluated as waveforms, and which of them are alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import Cells, waveform_parts

_BATCH_BYTES = 64 * 2**20  # work area of the statistics of distinct pixels
_MOST_CELLS = 4096
_EFFECTS = LIGHT_EFFECTS + TIMING_EFFECTS


def single_return(flux: Flux) -> tuple[FloatArray, FloatArray] | None:
    """Signal and delay, ns, (pixels,) of a flux with at most one return in each pixel; None for any other flux."""
    if flux.waveform is not None or ((flux.returns_signal > 0).sum(0) > 1).any():
        return None
    signal = np.ascontiguousarray(flux.signal.reshape(-1))
    return signal, np.where(signal > 0, np.nan_to_num(flux.delay_ns.reshape(-1)), 0.0)


@dataclass(frozen=True, eq=False)
class Group:
    """Pixels (P,) of the image, `cell` (P,) the one of `cells` that each is."""

    pixels: IndexArray
    cells: Cells
    cell: IndexArray


def groups(flux: Flux, system: System, pixels: IndexArray, *, delays: bool = True) -> Iterator[Group]:
    """The distinct ones among some pixels, in batches of moderate memory.

    Without `delays` pixels of one return are distinct by (S, B) alone, and the cells have the canonical delay.
    """
    if pixels.size == 0:
        return
    keys = _keys(flux, system, pixels, delays)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.searchsorted(inverse[order], np.arange(first.size + 1))
    step = int(np.clip(_BATCH_BYTES // (8 * _doubles(flux, system)), 1, _MOST_CELLS))
    for low in range(0, first.size, step):
        high = min(low + step, first.size)
        members = order[starts[low] : starts[high]]
        cells = _cells(flux, system, pixels[first[low:high]], delays)
        yield Group(pixels[members], cells, np.ascontiguousarray(inverse[members] - low))


def _doubles(flux: Flux, system: System) -> int:
    """Numbers that the statistics of one pixel hold at a time."""
    parts = 0
    if flux.waveform is not None:
        parts = 4 * flux.waveform.shape[-1]
    elif single_return(flux) is None:
        parts = 4 * waveform_parts(system)
    law = 40.0 * float(np.sqrt(system.cycles * flux.total.max()))  # a count is no wider than without dead time
    return 12 * system.bins + parts + int(law)


def _keys(flux: Flux, system: System, pixels: IndexArray, delays: bool) -> NDArray[np.void]:
    """(P,) bytes that are equal where pixels are."""
    background = flux.background.reshape(-1)[pixels]
    if flux.waveform is not None:
        wave = flux.waveform.reshape(-1, flux.waveform.shape[-1])
        digests = [
            blake2b(np.append(wave[p], b).tobytes(), digest_size=16).digest()
            for p, b in zip(pixels, background, strict=True)
        ]
        return np.frombuffer(b"".join(digests), dtype="V16")
    signal = flux.returns_signal.reshape(len(flux.returns_signal), -1)[:, pixels]
    delay = flux.returns_delay_ns.reshape(len(flux.returns_signal), -1)[:, pixels] / system.period_ns
    delay = np.where((signal > 0) & delays, delay - np.floor(delay), 0.0)
    table = np.ascontiguousarray(np.concatenate([signal, delay, background[None]]).T + 0.0)  # no -0.0
    return table.view(f"V{table.shape[1] * 8}").reshape(-1)


def _cells(flux: Flux, system: System, pixels: IndexArray, delays: bool) -> Cells:
    some = flux.pixels(pixels)
    if delays or single_return(flux) is None:
        return Cells.of_flux(some, system, effects=_EFFECTS)
    return Cells.of(some.signal, some.background, system, effects=_EFFECTS)
