"""Pulses narrower than the bins of a statistics grid: where one meets what it registered, a dead time later.

A grid that does not resolve a pulse is right as long as no pixel re-arms within one. Where the dead time is a whole
number of periods, but for less than the pulse is long, what the pulse registered re-arms within the next one, and the
grid must resolve it. Comparing two grids does not tell: to both the narrowest pulse on an edge of a bin is the same.
"""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import SampledPulse
from mars_lidar.statistics.gate import CellLight

_PROBE = 2**12  # parts of a pulse's record
_SEEN = 8.0  # standard deviations of bins that see a pulse: the refinement of the grid finds the rest
_RESOLVED = 0.5  # and of bins that resolve it: there is nothing to gain from others
_MOST_BINS = 2**15  # of a period: more take seconds
_ROUNDING = 1e-12  # of a whole number of periods, relative
_BLOCKS = 4  # of the period at least, so that none has both ends of a pulse's record at its own two
_LEAST_CELLS = 8  # of a block, on a grid that follows the pulse: its pieces begin with cells of half as many
_CELLS = 512  # of the period
_KNOTS = 8.0  # in a standard deviation
_LONGEST = 64.0  # standard deviations of a record that such a grid resolves from the first


def needed_bins(cells: CellLight, coarsest: int) -> int:
    """Equal bins that the pulse needs where `coarsest` do not see it; 0 where they do, or need not.

    A bin is then one standard deviation of the pulse, or a third of the time between a pulse and its photons'
    re-arming.
    """
    return _bins_of_pulse(cells) if _meets_itself(cells, coarsest, _SEEN) else 0


def followed_bins(cells: CellLight, coarsest: int, out_bins: int) -> int:
    """Bins of the first grid that follows the pulse; 0 where `coarsest` equal ones will do, or it may not.

    Time may be cut unevenly where the dead time is a whole number of periods: the same bin, periods later.
    """
    if not _is_whole(cells) or not _meets_itself(cells, coarsest, _RESOLVED):
        return 0
    sigma, length = _extent(cells)
    blocks = _blocks(out_bins)
    bins = blocks * max(_LEAST_CELLS, 4 * math.ceil(_CELLS / (4 * blocks)))
    return bins if length <= _LONGEST * sigma and bins < _bins_of_pulse(cells) else 0


def meets_itself(cells: CellLight) -> bool:
    """Whether no law but the slowest resolves the pulse, which re-arms within the next one."""
    return not _is_whole(cells) and _meets_itself(cells, _MOST_BINS, _RESOLVED)


def _meets_itself(cells: CellLight, coarsest: int, resolved: float) -> bool:
    """Whether the pulse is narrower than a share of such bins, and what it registers re-arms where it shines."""
    dead = cells.system.dead_time_periods
    if cells.waveform is not None or dead == 0.0 or not (cells.signal > 0.0).any():
        return False
    sigma, length = _extent(cells)
    return sigma * coarsest * resolved < 1.0 and _apart(cells) < length + 3.0 / coarsest


def _bins_of_pulse(cells: CellLight) -> int:
    sigma, length = _extent(cells)
    return math.ceil(1.0 / max(sigma, (_apart(cells) - length) / 3.0))


def _apart(cells: CellLight) -> float:
    """Periods by which the dead time misses a whole number of them."""
    dead = cells.system.dead_time_periods
    return abs(dead - round(dead))


def followed_edges(cells: CellLight, parts: int, out_bins: int) -> FloatArray:
    """Edges (cells, parts + 1) in [0, 1] of a grid that has half of its parts on the pulse, in each block it meets.

    A block is a bin of the histogram, or an equal part of it, and keeps its edges and its number of parts.
    """
    blocks = _blocks(out_bins)
    each = parts // blocks
    out = np.tile(np.arange(parts + 1) / parts, (cells.size, 1))
    low, high = (x / cells.system.period_ns for x in cells.system.pulse.support_ns())
    for row, delay in zip(out, cells.delay, strict=True):
        for block in range(math.floor((delay + low) * blocks), math.ceil((delay + high) * blocks)):
            left, right = block / blocks, (block + 1) / blocks
            begin, end = max(delay + low, left), min(delay + high, right)
            if begin > left and end < right:
                knots = [0.0, 0.25, 0.75, 1.0], [left, begin, end, right]
            elif begin > left:
                knots = [0.0, 0.5, 1.0], [left, begin, right]
            elif end < right:
                knots = [0.0, 0.5, 1.0], [left, end, right]
            else:
                continue
            at = np.interp(np.arange(1, each) / each, *knots)
            first = block % blocks * each
            row[first + 1 : first + each] = at - math.floor(block / blocks)
    return out


def knots(cells: CellLight, bins: int, halved: float) -> FloatArray:
    """Phases (n,) in [0, 1) where the light of the only cell steps, or between which a narrow pulse is resolved.

    Of samples and of waveforms all edges; on a Gaussian pulse that `bins` do not resolve, 8 `halved` a sigma.
    """
    if cells.waveform is not None:
        return np.linspace(0.0, 1.0, cells.waveform.shape[-1], endpoint=False)
    pulse, period = cells.system.pulse, cells.system.period_ns
    low, high = (x / period for x in pulse.support_ns())
    if isinstance(pulse, SampledPulse):
        at = np.linspace(low, high, round((high - low) * period / pulse.bin_ns) + 1)
    elif _extent(cells)[0] * bins < 1.0:
        at = np.linspace(low, high, math.ceil(_KNOTS * halved * (high - low) / _extent(cells)[0]))
    else:
        at = np.empty(0)
    at = cells.delay[0] + at
    return np.asarray(at - np.floor(at), dtype=np.float64)


def _blocks(out_bins: int) -> int:
    return out_bins * math.ceil(_BLOCKS / out_bins)


def _is_whole(cells: CellLight) -> bool:
    """Whether the dead time is a whole number of periods."""
    return _apart(cells) <= _ROUNDING * max(1.0, cells.system.dead_time_periods)


def _extent(cells: CellLight) -> tuple[float, float]:
    """Standard deviation of a Gaussian as narrow as the pulse, and the pulse's length, in periods."""
    low, high = cells.system.pulse.support_ns()
    energy = np.diff(cells.system.pulse.cumulative(np.linspace(low, high, _PROBE + 1)))
    length = (high - low) / cells.system.period_ns
    return length / (_PROBE * float(np.sum(energy**2)) * 2.0 * math.sqrt(math.pi)), length
