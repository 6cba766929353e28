"""The pixels of a flux (one return each, or waveforms), equal pixels, and the shift of shapes to their delays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b

import numpy as np

from mars_lidar._base.types import FloatArray, IndexArray, NDArray
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.pulse import Pulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import Cells, waveform_parts
from mars_lidar.statistics.timing import is_timed
from mars_lidar.statistics.tolerances import TOL as STATISTICS

_EFFECTS = LIGHT_EFFECTS + TIMING_EFFECTS


def single_return(flux: Flux) -> tuple[FloatArray, FloatArray] | None:
    """Signal and delay, ns, (pixels,) of a flux with at most one return in each pixel; None for any other flux."""
    if flux.waveform is not None or ((flux.returns_signal > 0).sum(0) > 1).any():
        return None
    signal = np.ascontiguousarray(flux.signal.reshape(-1))
    return signal, np.where(signal > 0, np.nan_to_num(flux.delay_ns.reshape(-1)), 0.0)


@dataclass(frozen=True, eq=False)
class Group:
    """Pixels (P,) of the image, and for each the index `cell` (P,) of the equal one in `cells`."""

    pixels: IndexArray
    cells: Cells
    cell: IndexArray


def groups(flux: Flux, system: System, pixels: IndexArray, *, delays: bool = True) -> Iterator[Group]:
    """The distinct pixels among some pixels, in batches of moderate memory.

    Without `delays` pixels of one return are distinct by (S, B) alone, and the cells have the canonical delay.
    """
    if pixels.size == 0:
        return
    keys = _keys(flux, system, pixels, delays)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.searchsorted(inverse[order], np.arange(first.size + 1))
    step = int(np.clip(TOL.statistics_bytes // (8 * _doubles(flux, system)), 1, TOL.statistics_pixels))
    for low in range(0, first.size, step):
        high = min(low + step, first.size)
        members = order[starts[low] : starts[high]]
        cells = _cells(flux, system, pixels[first[low:high]], delays)
        yield Group(pixels[members], cells, np.ascontiguousarray(inverse[members] - low))


def _doubles(flux: Flux, system: System) -> int:
    """Number of doubles in memory while the statistics of one pixel are computed."""
    parts = 0
    if flux.waveform is not None:
        parts = 4 * flux.waveform.shape[-1]
    elif single_return(flux) is None:
        parts = 4 * waveform_parts(system)
    law = 40.0 * float(np.sqrt(system.cycles * flux.total.max()))  # a count is no wider than without dead time
    bins = STATISTICS.most_parts if is_timed(system) else system.bins
    return 12 * bins + parts + int(law)


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


@dataclass(frozen=True, eq=False)
class Frame:
    """Energy of the pulse at the canonical delay t_r / 2 in the bins that it reaches.

    Attributes
    ----------
    first
        First of them.
    cells
        Cells of a bin that the sampler needs for this dead time.
    energy
        (parts + 1, bins of the frame) float32: energy from a bin's start to part p of it.
    """

    first: int
    cells: int
    energy: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Alignment:
    """How shapes of the canonical delay become those of the pixels.

    `shift` (pixels,) periods in [0, 1); `signal`, `background` (pixels,) photons per period; `rate` (pixels,) mean
    registrations per period.
    """

    shift: FloatArray
    signal: FloatArray
    background: FloatArray
    rate: FloatArray
    frame: Frame

    @classmethod
    def of(
        cls, system: System, signal: FloatArray, background: FloatArray, delay_ns: FloatArray, rate: FloatArray
    ) -> Alignment:
        """From the pixels' own S, B, delays and registrations per period."""
        return cls(shift_of(delay_ns, system.period_ns), signal, background, rate, pulse_frame(system))

    def part(self, pixels: slice) -> Alignment:
        """That of some of the pixels."""
        return Alignment(
            self.shift[pixels], self.signal[pixels], self.background[pixels], self.rate[pixels], self.frame
        )


def shift_of(delay_ns: FloatArray, period_ns: float) -> FloatArray:
    """Difference of delays (pixels,) from the canonical delay, in periods in [0, 1)."""
    shift = np.nan_to_num(delay_ns / period_ns) - 0.5
    shift -= np.floor(shift)
    shift[shift >= 1.0] = 0.0
    return shift


def pulse_frame(system: System) -> Frame:
    """The frame of a system's pulse."""
    dead = system.dead_time_periods
    return _frame(system.pulse, system.period_ns, system.bins, dead - math.floor(dead))


@lru_cache(maxsize=16)
def _frame(pulse: Pulse, period_ns: float, bins: int, dead_fraction: float) -> Frame:
    low, high = pulse.support_ns()
    t = np.linspace(low, high, 4097)
    energy = pulse.cumulative(t)
    early = t[max(0, int(np.searchsorted(energy, TOL.pulse_outside)) - 1)]
    late = t[min(t.size - 1, int(np.searchsorted(energy, 1.0 - TOL.pulse_outside)))]
    width = period_ns / bins
    first = math.floor((0.5 * period_ns + early) / width)
    size = min(bins, math.floor((0.5 * period_ns + late) / width) - first + 1)
    if size == bins:
        first = 0
    deviation = _deviation(pulse, period_ns) / width  # in bins
    parts = _power_of_two(TOL.energies_of_width / deviation, 8, max(8, min(4096, TOL.energies // size)))
    cells = 1
    near = min(dead_fraction, 1.0 - dead_fraction) * bins  # of the dead time to whole periods, bins
    if deviation < TOL.narrow_bins and near < size + 1:
        cells = _power_of_two(TOL.cells_of_width / deviation, 1, min(64, parts))
        while cells > 1 and size * cells > 8192:  # a record full of narrow features
            cells //= 2
    place = (first + np.arange(size))[None, :] + np.arange(parts + 1)[:, None] / parts
    below = pulse.wrapped_cumulative(place * width - 0.5 * period_ns, period_ns)
    return Frame(first % bins, cells, np.ascontiguousarray((below - below[0]).astype(np.float32)))


def _deviation(pulse: Pulse, period_ns: float) -> float:
    """Standard deviation, ns, of the Gaussian with the pulse's equivalent width 1 / integral of s^2."""
    low, high = pulse.support_ns()
    squares = float(np.sum(np.diff(pulse.cumulative(np.linspace(low, high, 4097))) ** 2)) * 4096.0 / (high - low)
    return min(1.0 / squares / (2.0 * math.sqrt(math.pi)), period_ns)


def _power_of_two(wanted: float, low: int, high: int) -> int:
    """The smallest power of two that is at least `wanted`, limited to [low, high]."""
    power = 1 << math.ceil(math.log2(max(wanted, 1.0)))
    while power > high:
        power //= 2
    return max(power, low)
