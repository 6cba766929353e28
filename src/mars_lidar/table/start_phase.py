"""Change of the count's cumulants with the delay of a pixel: the phase at which its exposure begins and ends.

A pixel at delay tau armed at 0 is the canonical pixel (delay t_r / 2) armed at the phase t_r / 2 - tau. One forward
and one backward recursion give the correction at every phase at once; it is kept on a coarse (S, B) grid, where it
is smooth, and on the phases that its interpolation needs. Derivation and equation numbers: docs/table.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure import _run, blank, native_light
from mars_lidar.statistics.phase_chain import ConvergenceError
from mars_lidar.table.axes import thinned

_STEP = 0.2  # of log S and log B; bicubic between: errors below 1e-4 standard deviations (docs/table.md, 4)
_PHASE_ERROR = 1e-3  # of linear interpolation between phases, in standard deviations
_MAX_PHASES = 192
_SAMPLE = 12  # cells of an axis by which the phases are chosen
_MAX_EDGES = 2**14
_BLOCK = 256
_UNSETTLED = -2


@dataclass(frozen=True, eq=False)
class StartPhases:
    """Corrections of the four cumulants over (S, B, phase).

    Attributes
    ----------
    signal, background
        (mS,), (mB,) photons per period: some of the table's axes.
    phase
        (p,) ascending from 0 to 1, in periods: where a canonical exposure begins; t_r / 2 - tau of a pixel.
    correction
        (mS * mB, p * 4) float32, added to the cumulants at the canonical delay; 0 at the phases 0 and 1.
    settled
        (mS * mB,) whether it holds for any long exposure; else for the table's own cycles only.
    """

    signal: FloatArray
    background: FloatArray
    phase: FloatArray
    correction: NDArray[np.float32]
    settled: NDArray[np.bool_]

    @classmethod
    def none(cls) -> StartPhases:
        """No correction: nothing depends on the phase."""
        nothing = np.empty(0)
        return cls(nothing, nothing, nothing, np.empty((0, 0), np.float32), np.empty(0, dtype=bool))

    def correction_at(self, own_cycles: bool) -> NDArray[np.float32]:
        """The corrections for the table's own cycles, or for others: NaN where they do not hold then."""
        if own_cycles or self.settled.all():
            return self.correction
        return np.where(self.settled[:, None], self.correction, np.float32(np.nan))


def start_phases(
    system: System,
    signal: FloatArray,
    background: FloatArray,
    cumulants: FloatArray,
    bins: IndexArray,
    *,
    threads: int,
    progress: Progress | None = None,
) -> StartPhases:
    """Corrections for a table with axes `signal` (nS,), `background` (nB,).

    Parameters
    ----------
    cumulants, bins
        (nS * nB, 4) and (nS * nB,): of the entries, which say how large an error matters and which grid to use.
    progress
        Called as ``progress(done, total)``.
    """
    if system.dead_time_periods == 0.0:
        return StartPhases.none()  # Poisson: no memory
    row, column = thinned(signal, _STEP), thinned(background, _STEP)
    index = (row[:, None] * background.size + column[None, :]).reshape(-1)
    cells = Cells.of(np.repeat(signal[row], column.size), np.tile(background[column], row.size), system).resolved(1)
    own = bins[index]
    grids = np.maximum(own, _phase_grid(cells, int(own.min())))
    spread = np.sqrt(np.maximum(cumulants[index, 1], 0.25))  # of small counts half a count is what matters
    scale = spread[:, None] ** np.arange(1, 5)
    some = np.zeros((row.size, column.size), dtype=bool)
    some[np.ix_(_few(row.size), _few(column.size))] = True
    phase, total = _choose(cells, grids, scale, np.flatnonzero(some), threads), cells.size
    correction, settled = np.empty((cells.size, phase.size, 4)), np.empty(cells.size, np.int64)
    for block, n in _blocks(grids):
        correction[block], settled[block] = _corrections(cells.part(block), n, phase, threads)
        if progress is not None:
            progress(int(block[-1]), total)
    unsettled = np.flatnonzero(settled < 0)
    for place, k in enumerate(unsettled):
        _replace_if_wrong(cells, int(k), int(own[k]), phase, scale[k], correction[k], threads)
        if progress is not None:
            progress(cells.size - unsettled.size + place, total)
    return StartPhases(
        signal[row],
        background[column],
        phase,
        np.ascontiguousarray(correction.reshape(cells.size, -1), dtype=np.float32),
        settled >= 0,
    )


def _few(size: int) -> IndexArray:
    return np.unique(np.linspace(0, size - 1, _SAMPLE).round().astype(np.int64))


def _phase_grid(cells: Cells, coarsest: int) -> int:
    """Bins whose edges lie close enough for phases inside the pulse: an eighth of a sigma; a multiple of all grids."""
    while coarsest < 4 * cells.first_bins(1):
        coarsest *= 2
    return coarsest


def _blocks(grids: IndexArray) -> list[tuple[IndexArray, int]]:
    """Cells in moderate numbers, of one statistics grid each."""
    out = []
    for n in np.unique(grids):
        index = np.flatnonzero(grids == n)
        out += [(index[k : k + _BLOCK], int(n)) for k in range(0, index.size, _BLOCK)]
    return out


def _corrections(cells: Cells, bins: int, phase: FloatArray, threads: int) -> tuple[FloatArray, IndexArray]:
    """Corrections (cells, p, 4) at phases on the grid of `bins`, and when they settled (cells,) (P7)."""
    cells.check_history(bins)
    out = np.zeros((cells.size, phase.size * 4))
    law = blank(cells, 1)
    settled = law.settled
    _core.exposure_moments(
        grid=cells.grid(bins, 1),
        light=native_light(cells, bins),
        cumulants=law.cumulants,
        cumulant_rates=law.cumulant_rates,
        histogram=law.histogram,
        histogram_rate=law.histogram_rate,
        settled=settled,
        threads=threads,
        phase=np.rint(np.interp(phase, cells.edges(bins), np.arange(bins + 1))).astype(np.int32),
        correction=out,
    )
    if (settled == _UNSETTLED).any():
        k = int(np.argmax(settled == _UNSETTLED))
        raise ConvergenceError(
            f"start-phase correction of {cells.name(k)}: the state of the pixel does not repeat from period to "
            "period for so long that the exposure cannot be run to its end"
        )
    values = out.reshape(cells.size, phase.size, 4)
    values[:, phase == 1.0] = 0.0  # the whole period later: the same but for rounding
    return values, settled


def _choose(cells: Cells, grids: IndexArray, scale: FloatArray, sample: IndexArray, threads: int) -> FloatArray:
    """Phases between which linear interpolation is good enough for a sample of cells, the worst one first."""
    coarsest = int(grids.min())
    stride = next(k for k in range(1, coarsest + 1) if coarsest % k == 0 and coarsest // k <= _MAX_EDGES)
    edges = cells.edges(coarsest)[::stride]  # of every finer grid as well: those are multiples of it
    coarsest //= stride
    curves = []
    for block, n in _blocks(grids[sample]):
        index = sample[block]
        values, _ = _corrections(cells.part(index), n, edges, threads)
        curves.append((values / scale[index][:, None, :])[..., :2])  # the higher two follow: same places
    curve = np.concatenate(curves).transpose(1, 0, 2).reshape(edges.size, -1)
    error = np.zeros(edges.size)
    nodes = [0, coarsest]

    def settle(left: int, right: int) -> None:
        inside = np.arange(left, right + 1)
        t = ((inside - left) / (right - left))[:, None]
        line = (1.0 - t) * curve[left] + t * curve[right]
        error[inside] = np.abs(curve[inside] - line).max(1)
        error[[left, right]] = 0.0

    settle(0, coarsest)
    for part in range(1, 32):  # at least every 32nd of the period: cells between those of the sample
        at = part * coarsest // 32
        if at not in nodes:
            nodes.append(at)
    nodes.sort()
    for left, right in pairwise(nodes):
        settle(left, right)
    while error.max() > _PHASE_ERROR and len(nodes) < _MAX_PHASES:
        worst = int(error.argmax())
        place = int(np.searchsorted(nodes, worst))
        left, right = nodes[place - 1], nodes[place]
        nodes.insert(place, worst)
        settle(left, worst)
        settle(worst, right)
    return edges[nodes]


def _replace_if_wrong(
    cells: Cells, cell: int, bins: int, phase: FloatArray, scale: FloatArray, correction: FloatArray, threads: int
) -> None:
    """Exact corrections (p, 4) of a cell whose exposure ended before start and end forgot each other.

    Those of (P7) are checked at a few phases, where they are largest, and replaced where they are not right.
    """
    size = np.abs(correction / scale)
    told = np.unique(np.concatenate([size.argmax(0), size[:, :2].argmin(0), [phase.size // 2]]))
    exact = _directly(cells, cell, bins, phase[told], threads)
    if not (np.abs(exact - correction[told])[:, :2] / scale[:2]).max() > _PHASE_ERROR:
        return
    correction[:] = _directly(cells, cell, bins, phase, threads)


def _directly(cells: Cells, cell: int, bins: int, phase: FloatArray, threads: int) -> FloatArray:
    """Corrections (p, 4) of one cell, an exposure for each phase."""
    period = cells.system.period_ns
    whole = Cells.of(
        cells.signal[cell],
        cells.background[cell],
        cells.system,
        delay_ns=(0.5 - np.concatenate([[0.0], phase])) * period,
    ).resolved(1)
    cumulants = _run(whole, bins, 1, threads, None).cumulants
    return np.asarray(cumulants[1:] - cumulants[0], dtype=np.float64)
