"""Entries of a table for each (S, B): their evaluation and their interpolation for pixels (docs/table.md).

Each entry has cumulants and shape at the canonical delay t_r / 2 (`Entries`), the exact law of the count if four
cumulants do not determine it (`NodeLaws`), and for an armed start the change of the cumulants with the delay
(`StartPhases`). An `Evaluation` computes entries, by the exact recursion or by the method of the MaRS paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.progress import of_part
from mars_lidar._base.types import ArrayLike, FloatArray, IndexArray, NDArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux, broadcast
from mars_lidar.statistics.cells import Cells, cell_name, default_bins, flat
from mars_lidar.statistics.chain import ConvergenceError, PhaseChain, Rearm
from mars_lidar.statistics.matched import trusted
from mars_lidar.statistics.moments import Settled, _run, blank, native_light, normalised, refined_moments
from mars_lidar.statistics.pmf import Pmf, guessed_pmfs
from mars_lidar.statistics.renewal import holding_times
from mars_lidar.table.axes import thinned
from mars_lidar.table.tolerances import TOL

# --- Entries -------------------------------------------------------------------------------------------------------

Shapes = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Entries:
    """Statistics of (n,) cells at the canonical delay t_r / 2, made for exposures of `cycles` periods.

    Attributes
    ----------
    cycles
        N, the exposure that `cumulants` and `shape` describe.
    cumulants, rates
        (n, 4) of the count, and their increments per further period; NaN if unknown.
    enough
        (n,) periods from which the linear continuation is valid; -1: for N only.
    bins
        (n,) bins per period of the statistics grid.
    shape
        (n, bins) float32 mean histogram of N periods, normalised; uniform where nothing is registered.
    startup
        (n, bins) float32 part of the mean histogram that does not grow with the exposure, in registrations; None
        without such a part.
    """

    cycles: int
    cumulants: FloatArray
    rates: FloatArray
    enough: IndexArray
    bins: IndexArray
    shape: Shapes
    startup: Shapes | None

    def serves(self, cycles: int) -> NDArray[np.bool_]:
        """Which entries (n,) are valid for exposures of `cycles` periods."""
        if cycles == self.cycles:
            return np.ones(self.enough.size, dtype=bool)
        return (self.enough >= 0) & (self.enough <= cycles)

    def cumulants_at(self, cycles: int) -> FloatArray:
        """Cumulants (n, 4) for exposures of `cycles` periods; NaN for entries that do not serve them."""
        if cycles == self.cycles:
            return self.cumulants
        out = self.cumulants + (cycles - self.cycles) * self.rates
        out[~self.serves(cycles)] = np.nan
        return out

    def shapes_at(self, cycles: int) -> Shapes:
        """Normalised mean histograms (n, bins) for `cycles` periods; NaN for entries that do not serve them.

        Returns the stored array if it is for these cycles.
        """
        serves = self.serves(cycles)
        if cycles == self.cycles or (self.startup is None and serves.all()):
            return self.shape
        out = np.empty_like(self.shape)
        part = cycles / self.cycles
        step = max(1, TOL.block_bytes // (8 * self.shape.shape[1]))
        for start in range(0, len(out), step):
            some = slice(start, start + step)
            # H(n) = u + n (H(N) - u) / N
            histogram = self.shape[some] * (part * self.cumulants[some, :1])
            if self.startup is not None:
                histogram += (1.0 - part) * self.startup[some]
            np.maximum(histogram, 0.0, out=histogram)
            total = histogram.sum(-1, keepdims=True)
            out[some] = np.where(total > 0, histogram / np.where(total > 0, total, 1.0), self.shape[some])
        out[~serves] = np.nan
        return out


# --- Exact laws of some entries ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class NodeLaws:
    """Probabilities of the count of some entries, at the canonical delay and for the cycles of the table.

    Attributes
    ----------
    row
        (m,) entries, ascending, as the rows of `Table.shapes`.
    first
        (m,) first count of each.
    offsets
        (m + 1,) where the probabilities of each begin in `pmf`.
    pmf
        (offsets[-1],) probabilities of the counts first, first + 1, ...
    """

    row: IndexArray
    first: IndexArray
    offsets: IndexArray
    pmf: FloatArray

    @classmethod
    def of(cls, row: IndexArray, laws: Sequence[Pmf]) -> NodeLaws:
        """From one law for each row."""
        trimmed = [_trimmed(law) for law in laws]
        return cls(
            np.asarray(row, dtype=np.int64),
            np.array([law.first for law in trimmed], np.int64),
            np.concatenate([[0], np.cumsum([law.p.size for law in trimmed])]).astype(np.int64),
            np.concatenate([np.empty(0), *(law.p for law in trimmed)]),
        )

    @classmethod
    def none(cls) -> NodeLaws:
        """Laws of no entry."""
        return cls.of(np.empty(0, np.int64), [])

    def law(self, row: int) -> Pmf | None:
        """Law of an entry; None if its cumulants suffice."""
        k = int(np.searchsorted(self.row, row))
        if k == self.row.size or self.row[k] != row:
            return None
        return Pmf(int(self.first[k]), self.pmf[self.offsets[k] : self.offsets[k + 1]], TOL.negligible)


def _trimmed(law: Pmf) -> Pmf:
    below = np.cumsum(law.p)
    some = np.flatnonzero((below > TOL.negligible) & (below[-1] - below + law.p > TOL.negligible))
    low, high = (int(some[0]), int(some[-1]) + 1) if some.size else (0, law.p.size)
    return Pmf(law.first + low, law.p[low:high], TOL.negligible)


def node_laws(
    system: System,
    signal: FloatArray,
    background: FloatArray,
    entries: Entries,
    *,
    threads: int,
    progress: Progress | None = None,
) -> NodeLaws:
    """Laws of the entries of a table, axes `signal` and `background`, that `statistics.matched.trusted` rejects."""
    if system.dead_time_periods == 0.0:
        return NodeLaws.none()  # Poisson
    row = np.flatnonzero(~trusted(entries.cumulants, threads=threads))
    if not row.size:
        return NodeLaws.none()
    cells = Cells.of(signal[row // background.size], background[row % background.size], system)
    waiting = None if progress is None else lambda done: progress(done, row.size)
    return NodeLaws.of(row, guessed_pmfs(cells, entries.cumulants[row], entries.bins[row], threads, waiting))


# --- Change with the delay -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StartPhases:
    """Corrections of the four cumulants over (S, B, phase).

    Attributes
    ----------
    signal, background
        (mS,), (mB,) photons per period: some of the table's axes.
    phase
        (p,) ascending from 0 to 1, in periods: start of a canonical exposure; t_r / 2 - tau of a pixel.
    correction
        (mS * mB, p * 4) float32, added to the cumulants at the canonical delay; 0 at the phases 0 and 1.
    settled
        (mS * mB,) whether it is valid for any long exposure, or for the table's cycles only.
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
        """The corrections for `cycles`; NaN where they are not valid."""
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
        (nS * nB, 4) and (nS * nB,) of the entries, which determine the tolerable error and the grid.
    progress
        Called as ``progress(done, total)``.
    """
    if system.dead_time_periods == 0.0:
        return StartPhases.none()  # Poisson: no memory
    row, column = thinned(signal, TOL.log_step), thinned(background, TOL.log_step)
    index = (row[:, None] * background.size + column[None, :]).reshape(-1)
    cells = Cells.of(np.repeat(signal[row], column.size), np.tile(background[column], row.size), system).resolved(1)
    own = bins[index]
    grids = np.maximum(own, _phase_grid(cells, int(own.min())))
    # at least half a count: errors of small counts matter in counts
    spread = np.sqrt(np.maximum(cumulants[index, 1], 0.25))
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
    return np.unique(np.linspace(0, size - 1, TOL.phase_values).round().astype(np.int64))


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
        out += [(index[k : k + TOL.cells], int(n)) for k in range(0, index.size, TOL.cells)]
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
    if (settled == Settled.UNSETTLED).any():
        k = int(np.argmax(settled == Settled.UNSETTLED))
        raise ConvergenceError(
            f"start-phase correction of {cells.name(k)}: the state of the pixel does not repeat from period to "
            "period, and the exposure is too long to be computed to its end"
        )
    values = out.reshape(cells.size, phase.size, 4)
    values[:, phase == 1.0] = 0.0  # the whole period later: the same but for rounding
    constant = cells.signal == 0.0  # nothing comes later; rounding may keep the recursion from repeating itself
    values[constant], settled[constant] = 0.0, 1
    return values, settled


def _choose(cells: Cells, grids: IndexArray, scale: FloatArray, sample: IndexArray, threads: int) -> FloatArray:
    """Phases between which linear interpolation is good enough for a sample of cells, the worst one first."""
    coarsest = int(grids.min())
    stride = next(k for k in range(1, coarsest + 1) if coarsest % k == 0 and coarsest // k <= TOL.phase_candidates)
    edges = cells.edges(coarsest)[::stride]  # edges of every finer grid as well, whose bins divide these
    coarsest //= stride
    curves = []
    for block, n in _blocks(grids[sample]):
        index = sample[block]
        values, _ = _corrections(cells.part(index), n, edges, threads)
        curves.append((values / scale[index][:, None, :])[..., :2])  # the higher two follow: same places
    curve = np.concatenate(curves).transpose(1, 0, 2).reshape(edges.size, -1)
    error = np.zeros(edges.size)
    nodes = [0, coarsest]

    def settle(begin: int, end: int) -> None:
        inside = np.arange(begin, end + 1)
        t = ((inside - begin) / (end - begin))[:, None]
        line = (1.0 - t) * curve[begin] + t * curve[end]
        error[inside] = np.abs(curve[inside] - line).max(1)
        error[[begin, end]] = 0.0

    settle(0, coarsest)
    for part in range(1, 32):  # at least every 32nd of the period: cells between those of the sample
        at = part * coarsest // 32
        if at not in nodes:
            nodes.append(at)
    nodes.sort()
    for begin, end in pairwise(nodes):
        settle(begin, end)
    while error.max() > TOL.phase_error and len(nodes) < TOL.phases:
        worst = int(error.argmax())
        place = int(np.searchsorted(nodes, worst))
        begin, end = nodes[place - 1], nodes[place]
        nodes.insert(place, worst)
        settle(begin, worst)
        settle(worst, end)
    return edges[nodes]


def _replace_if_wrong(
    cells: Cells, cell: int, bins: int, phase: FloatArray, scale: FloatArray, correction: FloatArray, threads: int
) -> None:
    """Exact corrections (p, 4) of a cell whose exposure ended before its start-up transient had decayed.

    The corrections of (P7) are compared with exact ones at the few phases where they are largest, and replaced where
    they differ by more than the tolerance `phase_error`.
    """
    size = np.abs(correction / scale)
    checked = np.unique(np.concatenate([size.argmax(0), size[:, :2].argmin(0), [phase.size // 2]]))
    exact = _directly(cells, cell, bins, phase[checked], threads)
    if not (np.abs(exact - correction[checked])[:, :2] / scale[:2]).max() > TOL.phase_error:
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


# --- The two methods -----------------------------------------------------------------------------------------------

Method = Literal["exposure", "mars"]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Method and tolerance by which entries are evaluated."""

    method: Method
    rearm: Rearm
    tolerance: float
    threads: int

    def entries(
        self, signal: FloatArray, background: FloatArray, system: System, progress: Progress | None = None
    ) -> Entries:
        """Entries of cells (n,)."""
        compute = self._by_chain if self.method == "mars" else self._by_recursion
        return compute(signal, background, system, progress)

    def _by_recursion(
        self, signal: FloatArray, background: FloatArray, system: System, progress: Progress | None
    ) -> Entries:
        """Entries (n,) by the exact recursion, `statistics.exposure_moments`, in blocks of moderate memory."""
        n, bins = signal.size, system.bins
        growing = system.start == "armed" and system.dead_time_periods > 0.0
        entries = Entries(
            cycles=system.cycles,
            cumulants=np.empty((n, 4)),
            rates=np.empty((n, 4)),
            enough=np.empty(n, np.int64),
            bins=np.empty(n, np.int64),
            shape=np.empty((n, bins), np.float32),
            startup=np.zeros((n, bins), np.float32) if growing else None,
        )
        window = 3 * (int(system.dead_time_periods) + 1)  # periods of the recursion after settling (20)
        step = max(64, TOL.block_bytes // (8 * bins))
        for start in range(0, n, step):
            some = slice(start, min(start + step, n))
            cells = Cells.of(signal[some], background[some], system)
            done = of_part(progress, start, some.stop, n)
            part = refined_moments(cells, bins, tolerance=self.tolerance, threads=self.threads, progress=done)
            entries.cumulants[some], entries.rates[some] = part.cumulants, part.cumulant_rates
            entries.enough[some] = np.where(part.settled < 0, -1, np.maximum(part.settled - window, 1))
            entries.bins[some] = part.bins
            entries.shape[some] = normalised(part.histogram)
            if entries.startup is not None:
                rest = part.histogram - system.cycles * part.histogram_rate
                entries.startup[some] = np.where(np.isnan(rest), 0.0, rest)
        return entries

    def _by_chain(
        self, signal: FloatArray, background: FloatArray, system: System, progress: Progress | None
    ) -> Entries:
        """Entries (n,) with N ~ Normal(t / mu, t sigma^2 / mu^3) and the stationary shape of the chain.

        The sum of the covariances of the holding times, which the MaRS paper (arXiv 2512.04924) approximates by L lags
        and p eigenpairs, is not truncated (docs/theory.md, 3.10). The law is that of long exposures: linear in the
        exposure from 1 period on, and independent of its start and of the delay. The third and fourth cumulant are 0.
        """
        n, bins = signal.size, default_bins(system)
        energy = np.maximum(system.pulse.bin_energy(0.5 * system.period_ns, system.period_ns, bins), 0.0)
        rates = np.zeros((n, 4))
        shape = np.full((n, system.bins), 1.0 / system.bins, dtype=np.float32)

        def block(start: int) -> int:
            stop = min(start + TOL.chain_cells, n)
            for k in range(start, stop):
                photons = signal[k] * energy + background[k] / bins
                if photons.any():
                    name = cell_name(Flux(signal[k], background[k], 0.5 * system.period_ns), system)
                    times = holding_times(PhaseChain(photons, system.dead_time_periods, self.rearm, name))
                    rates[k, :2] = 1.0 / times.mu, times.sigma2 / times.mu**3
                    shape[k] = times.stationary.pdf.reshape(system.bins, -1).sum(-1)
            return stop - start

        with ThreadPoolExecutor(max(1, self.threads)) as pool:
            waiting = {pool.submit(block, start) for start in range(0, n, TOL.chain_cells)}
            try:
                while waiting:
                    done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_EXCEPTION)
                    for future in done:
                        future.result()
                    if progress is not None:
                        progress(n - min(n, TOL.chain_cells * len(waiting)), n)
            except BaseException:  # Ctrl-C as well: what has not begun never does
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return Entries(
            cycles=system.cycles,
            cumulants=system.cycles * rates,
            rates=rates,
            enough=np.ones(n, np.int64),
            bins=np.full(n, bins, np.int64),
            shape=shape,
            startup=None,
        )


# --- Lookup --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Lookup:
    """Entries of a table for P pixels; all arrays C-contiguous.

    Attributes
    ----------
    rows, weights
        (P, 4) rows of `Table.shapes` and their weights, >= 0 with sum 1: the pixel's shape at the canonical delay
        is their mixture. A pixel `outside` has row 0 with weight 1.
    cumulants
        (P, 4) mean, variance, third and fourth cumulant of the pixel's count, at its delay and the requested
        exposure; NaN for a pixel `outside`.
    outside
        (P,) pixels beyond the table, to be evaluated by the caller.

    See Also
    --------
    Table

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=64,
    ...     pulse=ml.GaussianPulse(sigma_ns=2.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> table = ml.Table.build(system, signal=(0.1, 2.0, 6), background=(0.1, 1.0, 4), tolerance=1e-3)
    >>> pixels = table.lookup(ml.Flux([0.5, 9.0], 0.5, 30.0), outside="exact")
    >>> pixels.outside
    array([False,  True])
    >>> pixels.rows.shape
    (2, 4)
    """

    rows: IndexArray
    weights: FloatArray
    cumulants: FloatArray
    outside: NDArray[np.bool_]

    def mixture(self, shapes: Shapes) -> FloatArray:
        """Shapes (P, bins) of the pixels at the canonical delay, from those of the table (`Table.shapes`)."""
        return np.stack([w @ shapes[r] for r, w in zip(self.rows, self.weights, strict=True)])

    def trusted(self) -> NDArray[np.bool_]:
        """Pixels (P,) whose four cumulants determine the law of the count to about 0.002 in total variation.

        See `statistics.matched.trusted`; elsewhere (few photons, saturation, mode locking) use an exact law. False
        for pixels `outside`.
        """
        good = np.zeros(self.outside.size, dtype=bool)
        inside = ~self.outside
        if inside.any():
            good[inside] = trusted(self.cumulants[inside], threads=1)
        return good


def read_pixels(
    period_ns: float,
    axes: tuple[FloatArray, FloatArray],
    signal: ArrayLike,
    background: ArrayLike,
    delay_ns: ArrayLike | None,
    outside: str,
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """The arguments of `Table.lookup`, checked, (P,): signal, background, phase, and what lies beyond the axes.

    The phase, in [0, 1) periods, is the canonical delay, half a period, minus the delay of the return; 0 without a
    return.
    """
    delay_ns = 0.5 * period_ns if delay_ns is None else delay_ns
    given = [np.asarray(values, dtype=np.float64) for values in (signal, background, delay_ns)]
    s, b, delay = (flat(part) for part in broadcast(("signal", "background", "delay_ns"), given))
    if (bad := ~np.isfinite(delay) & ~(np.isnan(delay) & (s == 0))).any():
        raise ValueError(f"delay_ns must be finite (NaN for no return where signal is 0), got {delay[bad][0]}")
    beyond = np.zeros(s.size, dtype=bool)
    for name, values, axis in (("signal", s, axes[0]), ("background", b, axes[1])):
        if not (values >= 0).all():
            raise ValueError(f"{name} must be photons per period >= 0, got {values[~(values >= 0)][0]}")
        out = (values < axis[0]) | (values > axis[-1])
        if out.any() and outside == "error":
            raise ValueError(
                f"{name} must lie in the table's [{axis[0]:g}, {axis[-1]:g}] photons per period, got "
                f"{values.min():g} to {values.max():g} ({int(out.sum())} of {values.size} pixels outside); build "
                "the table over that range, or leave them to the exact engine with outside='exact'"
            )
        beyond |= out
    canonical = 0.5 * period_ns
    phase = (canonical - np.where(np.isnan(delay), canonical, delay)) / period_ns
    phase -= np.floor(phase)
    return s, b, phase, beyond


def evaluate(
    axes: tuple[FloatArray, FloatArray],
    cumulants: FloatArray,
    limit: FloatArray,
    phases: StartPhases,
    own_cycles: bool,
    signal: FloatArray,
    background: FloatArray,
    phase: FloatArray,
    nearest: bool,
    threads: int,
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """Rows, weights and cumulants (P, 4) each of pixels (P,) inside the axes; `phase` in [0, 1) periods."""
    rows = np.empty((signal.size, 4), np.int64)
    weights, out = np.empty((signal.size, 4)), np.empty((signal.size, 4))
    _core.table_lookup(
        signal_axis=axes[0],
        background_axis=axes[1],
        entries=cumulants,
        limit=limit,
        sub_signal=phases.signal,
        sub_background=phases.background,
        phase=phases.phase,
        correction=phases.correction_at(own_cycles),
        signal=signal,
        background=background,
        at=phase,
        nearest=nearest,
        rows=rows,
        weights=weights,
        cumulants=out,
        threads=threads,
    )
    return rows, weights, out
