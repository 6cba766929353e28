"""Probabilities of the count of an exposure: closed forms, and the inversion of the generating function E z^N.

Rigorous tail bounds give the support; the generating function is evaluated at as many points of the unit circle as the
support has counts, and an FFT gives the probabilities. Equation numbers: docs/theory_exposure.md, section 8.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray, NDArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.moments import Settled, native_light, refined_moments, warm_history
from mars_lidar.statistics.tolerances import LAW, TOL

# --- Support of the count, and closed forms ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Pmf:
    """Probabilities `p` (w,) of the counts `first`, `first` + 1, ...; that of all others is at most `outside`.

    For simulated counts `p` holds their frequencies.
    """

    first: int
    p: FloatArray
    outside: float = 0.0

    @classmethod
    def of_counts(cls, counts: NDArray[np.integer[Any]]) -> Pmf:
        """Frequencies of simulated counts (n,)."""
        first = int(counts.min())
        return cls(first, np.bincount((counts - first).astype(np.int64)) / counts.size)

    def on(self, low: int, high: int) -> FloatArray:
        """Probabilities of the counts low .. high (inclusive)."""
        out = np.zeros(high - low + 1)
        begin, end = max(low, self.first), min(high, self.last)
        if begin <= end:
            out[begin - low : end - low + 1] = self.p[begin - self.first : end - self.first + 1]
        return out

    @property
    def last(self) -> int:
        """The last count of `p`."""
        return self.first + self.p.size - 1


def total_variation(a: Pmf, b: Pmf) -> float:
    """Total variation distance of two laws: half the sum of |a - b| over all counts."""
    if a.last < b.first or b.last < a.first:
        return 0.5 * float(a.p.sum() + b.p.sum())
    low, high = min(a.first, b.first), max(a.last, b.last)
    return 0.5 * float(np.abs(a.on(low, high) - b.on(low, high)).sum())


def kl_divergence(sample: FloatArray, law: FloatArray) -> FloatArray:
    """KL(sample || law) (...) in nats, pmfs (..., w) and (w,) on the same counts; `law` at least `Tolerances.tail`."""
    log_law = np.log(np.maximum(law, TOL.tail))
    log_sample = np.log(np.where(sample > 0, sample, 1.0))
    return np.asarray((sample * (log_sample - log_law)).sum(-1), dtype=np.float64)


def poisson_pmf(mean: float) -> Pmf:
    """Poisson law, exact without dead time; the support follows from Bernstein's bounds of the two tails."""
    from scipy.special import gammaln, xlogy

    reach = -math.log(TOL.tail)
    low = max(0, math.ceil(mean - math.sqrt(2.0 * reach * mean)))
    high = math.floor(mean + reach / 3.0 + math.sqrt(reach**2 / 9.0 + 2.0 * reach * mean))
    counts = np.arange(low, high + 1)
    return Pmf(low, np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1.0)), TOL.tail * (1 + (low > 0)))


def gaussian_pmf(mean: float, variance: float) -> Pmf:
    """Normal law on the integers: P(n) = Phi((n + 1/2 - mean) / sd) - Phi((n - 1/2 - mean) / sd).

    P(0) includes the probability below 0.
    """
    from scipy.special import ndtr

    spread = math.sqrt(variance)
    low = max(0, math.floor(mean - 8.5 * spread))
    high = max(low, math.ceil(mean + 8.5 * spread))
    counts = np.arange(low, high + 1)
    if spread == 0.0:
        return Pmf(low, (counts == round(mean)).astype(np.float64), 0.0)
    edges = np.arange(low, high + 2) - 0.5 - mean
    if low == 0:
        edges[0] = -np.inf
    # the difference of the smaller of the two tails avoids cancellation at both ends
    below, above = ndtr(edges / spread), ndtr(-edges / spread)
    pmf = np.where(edges[:-1] > 0, above[:-1] - above[1:], below[1:] - below[:-1])
    return Pmf(low, np.maximum(pmf, 0.0), float(below[0] + above[-1]))


# --- The generating function and its cost --------------------------------------------------------------------------


class TooLongError(ConvergenceError):
    """The state of the pixel did not repeat within the budget of a law."""


class Remaining:
    """Steps of `Budget.transform` that remain for the law of one cell; initially the `share` of all."""

    def __init__(self, share: float = 1.0) -> None:
        self.steps = share * LAW.transform


def characteristic(
    cells: Cells, z_re: FloatArray, z_im: FloatArray | None, bins: int, threads: int, remaining: Remaining | None = None
) -> tuple[FloatArray, FloatArray]:
    """E z^N (re, im) of each cell at its points z (cells, points); without `z_im` log E z^N at real z."""
    remaining, batches = remaining or Remaining(), math.ceil(z_re.shape[1] / TOL.lanes)
    dead = cells.system.dead_time_periods
    reach = 256.0 * bins * (min(dead, float(cells.system.cycles)) + 1.0)
    slow = reach > TOL.near_transform_bytes or dead * bins < 1.0
    cost = TOL.far_transform * (6.0 if reach > TOL.far_transform_bytes else 1.0) if slow else 1.0
    cost *= 1.0 + TOL.period_bins / bins
    # at real points the registrations of every period of a dead time are summed
    cost *= 1.0 + (min(dead, float(cells.system.cycles)) / bins if z_im is None else 0.0)
    steps = max(int(remaining.steps / cost) // batches, bins)
    grid = cells.grid(bins, 1, steps)
    re, im = np.empty(z_re.shape), np.empty(z_re.shape)
    settled = np.empty(z_re.shape, np.int64)
    points: dict[str, Any] = {
        "tilted": z_im is None,
        "z_re": np.ascontiguousarray(z_re),
        "z_im": np.zeros(z_re.shape) if z_im is None else np.ascontiguousarray(z_im),
        "re": re,
        "im": im,
        "settled": settled,
    }
    for part in cells.chunks(bins, 1):
        arguments: dict[str, Any] = points | {name: x[part] for name, x in points.items() if np.ndim(x)}
        light = native_light(cells.part(part), bins)
        _core.exposure_characteristic(grid=grid, light=light, **arguments, threads=threads)
    not_warm = np.flatnonzero((settled == Settled.NOT_WARM).any(-1))
    if not_warm.size:
        again: dict[str, Any] = points | {
            name: np.ascontiguousarray(x[not_warm]) for name, x in points.items() if np.ndim(x)
        }
        light = native_light(cells.part(not_warm), bins, warm_history(cells, not_warm, bins))
        _core.exposure_characteristic(grid=grid, light=light, **again, threads=threads)
        for name, array in (("re", re), ("im", im), ("settled", settled)):
            array[not_warm] = again[name]
    unsettled = (settled == Settled.UNSETTLED).any(-1)
    if unsettled.any():
        raise TooLongError(
            f"count law of {cells.name(int(np.argmax(unsettled)))}: the state of the pixel does not repeat within "
            f"{steps:.1g} bins x periods, too many to compute the exposure to its end at {z_re.shape[1]} points; mean, "
            f"variance and two more cumulants are known; for the law {cells.instead}"
        )
    taken = np.where(settled >= 0, settled, cells.system.cycles).mean(-1).max()
    remaining.steps = max(remaining.steps - float(taken) * bins * batches * cost, 1.0)
    return re, im


# --- Probabilities -------------------------------------------------------------------------------------------------

_TILTS = np.array([1.0, 2.0, 3.5, 5.0, 6.5, 8.0, 11.0, 15.0])  # exponential tilts in units of 1 / standard deviation


def exact_pmfs(cells: Cells, cumulants: FloatArray, bins: IndexArray, threads: int) -> list[Pmf]:
    """Exact pmf of each cell, on the grid of `bins` (cells,) on which its `cumulants` (cells, 4) converged."""
    if cells.system.dead_time_periods == 0.0:
        return [poisson_pmf(float(mean)) for mean in cumulants[:, 0]]
    cells = cells.resolved(1)
    dark = cells.total == 0.0
    laws: list[Pmf | None] = [Pmf(0, np.ones(1), 0.0) if nothing else None for nothing in dark]
    for n in np.unique(bins[~dark]):
        index = np.flatnonzero((bins == n) & ~dark)
        cells.check_history(int(n))
        for block in np.array_split(index, math.ceil(index.size / TOL.block)):
            try:
                lows, highs, outside = _supports(cells.part(block), cumulants[block], int(n), threads)
            except TooLongError:
                lows, highs, outside = _guessed_supports(cells, cumulants[block])
            for k, cell in enumerate(block):
                single = cells.part(block[k : k + 1])
                spread = float(cumulants[cell, 1])
                law = _on_support(single, int(lows[k]), int(highs[k]), float(outside[k]), int(n), threads, spread)
                _check(cells, int(cell), law, cumulants[cell])
                laws[cell] = law
    return [law for law in laws if law is not None]


def guessed_pmfs(
    cells: Cells, cumulants: FloatArray, bins: IndexArray, threads: int, waiting: Callable[[int], object] | None = None
) -> list[Pmf]:
    """Exact pmf of each cell, given approximate cumulants (cells, 4), for example from a table.

    The support is that of the approximate cumulants. Where the result shows that it is too small, the law is computed
    by `exact_pmfs` with exact cumulants. For narrow laws this is several times faster than `exact_pmfs`.
    `waiting` is called with the number of cells computed so far.
    """
    cells = cells.resolved(1)
    spread = np.sqrt(np.maximum(cumulants[:, 1], 0.0))
    half = np.ceil(TOL.guess_spreads * spread + TOL.guess_counts)
    size = (8.0 * np.ceil((2.0 * half + 1.0) / 8.0)).astype(np.int64)
    first = np.maximum(np.floor(cumulants[:, 0]) - half, 0.0).astype(np.int64)
    laws: list[Pmf | None] = [None] * cells.size
    done = 0
    for n, width in np.unique(np.stack([bins, size], -1), axis=0):
        index = np.flatnonzero((bins == n) & (size == width))
        cells.check_history(int(n))
        for block in np.array_split(index, math.ceil(index.size / TOL.block)):
            guessed = width <= TOL.widest_guess
            pmf = _folded(cells.part(block), first[block], int(width), int(n), threads) if guessed else None
            for k, cell in enumerate(block):
                candidate = (
                    None if pmf is None else _if_complete(pmf[k], int(first[cell]), cumulants[cell, 0], spread[cell])
                )
                laws[cell] = candidate or _by_own_cumulants(cells.part(block[k : k + 1]), threads)
            done += block.size
            if waiting is not None:
                waiting(done)
    return [law for law in laws if law is not None]


def _folded(cells: Cells, first: IndexArray, size: int, bins: int, threads: int) -> FloatArray:
    """Probabilities (cells, size) of the counts `first` (cells,), `first` + 1, ..., aliased modulo `size` (23)."""
    angle = 2.0 * np.pi * np.arange(size // 2 + 1) / size
    shape = (cells.size, 1)
    re, im = characteristic(cells, np.tile(np.cos(angle), shape), np.tile(np.sin(angle), shape), bins, threads)
    folded = np.fft.irfft(re - 1j * im, size, axis=-1)
    return np.take_along_axis(folded, (first[:, None] + np.arange(size)) % size, axis=-1)


def _if_complete(pmf: FloatArray, first: int, mean: float, spread: float) -> Pmf | None:
    """The pmf if its counts include the law: small at both ends, not negative, with sum 1 and the assumed mean."""
    moved = float(pmf @ (first + np.arange(pmf.size))) - mean
    inside = _ends(pmf, first) <= TOL.edge and abs(moved) <= TOL.guess_mean * max(spread, 0.5)
    if not (inside and float(pmf.min()) >= -TOL.consistent and abs(float(pmf.sum()) - 1.0) <= TOL.consistent):
        return None
    return Pmf(first, np.maximum(pmf, 0.0), pmf.size * TOL.edge)


def _ends(pmf: FloatArray, first: int, most: float = math.inf) -> float:
    """Larger probability of the first and the last count, neither being 0 nor `most`, the largest possible count."""
    low = abs(float(pmf[0])) if first > 0 else 0.0
    return max(low, abs(float(pmf[-1])) if first + pmf.size - 1 < most else 0.0)


def _by_own_cumulants(cell: Cells, threads: int) -> Pmf:
    """Exact pmf of one cell, computed with its exact cumulants."""
    own = refined_moments(cell, 1, tolerance=TOL.law_tolerance, threads=threads)
    return exact_pmfs(cell, own.cumulants.reshape(-1, 4), own.bins.reshape(-1), threads)[0]


def _supports(
    cells: Cells, cumulants: FloatArray, bins: int, threads: int
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """First and last count of the support of each cell, and a bound on the probability outside it (24)."""
    mean, spread = cumulants[:, 0], np.sqrt(cumulants[:, 1])
    # a period multiplies E e^(theta N) at most by e^(theta (1 + t_r/t_d)) and by exp(Lambda (e^theta - 1))
    dead = cells.system.dead_time_periods
    growth = np.maximum(
        TOL.most_log_growth / (1.0 + 1.0 / dead), np.log1p(TOL.most_log_growth / np.maximum(cells.total, 1e-300))
    )
    # if necessary the tilts are reduced to this limit; where large counts are rare, small tilts give the best bounds
    unit = np.minimum(1.0 / np.maximum(spread, 1e-300), np.minimum(growth, TOL.most_tilt) / _TILTS[-1])
    tilt = _TILTS * unit[:, None]
    tilt = np.concatenate([tilt, -tilt], axis=1)
    log_value = characteristic(cells, np.exp(tilt), None, bins, threads, Remaining(TOL.support_share))[0]
    with np.errstate(invalid="ignore"):
        # P(N >= edge) <= tail for a positive tilt, P(N <= edge) <= tail for a negative one
        edge = (log_value - math.log(TOL.tail)) / tilt
    up, down = np.split(np.where(np.isfinite(edge), edge, np.nan), 2, axis=1)
    most = _most(cells)
    high = np.fmin.reduce(up, axis=1, initial=most + 1.0)
    low = np.fmax.reduce(down, axis=1, initial=-1.0)
    last = np.minimum(np.ceil(high) - 1.0, most)
    first = np.clip(np.floor(low) + 1.0, 0.0, np.floor(mean))
    last = np.maximum(last, np.ceil(mean))
    if (last - first >= TOL.most_counts).any():
        k = int(np.argmax(last - first))
        raise ConvergenceError(
            f"count law of {cells.name(k)}: its support of {last[k] - first[k]:.3g} counts exceeds "
            f"{TOL.most_counts}; mean, variance and cumulants are known; use method 'mars' or 'renewal' for a Gaussian"
        )
    # no probability lies beyond the smallest and the largest possible count
    outside = TOL.tail * ((first > 0).astype(np.float64) + (last < most))
    return first.astype(np.int64), last.astype(np.int64), outside


def _most(cells: Cells) -> float:
    """Largest possible count."""
    return min(math.floor(cells.system.cycles / cells.system.dead_time_periods) + 1.0, 9e15)


def _guessed_supports(cells: Cells, cumulants: FloatArray) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Supports from mean and variance alone; `_check` verifies that they contain the law."""
    spread, mean = np.sqrt(cumulants[:, 1]), cumulants[:, 0]
    half = np.ceil(TOL.support_spreads * (spread + 1.0))
    most = _most(cells)
    first, last = np.maximum(np.floor(mean) - half, 0.0), np.minimum(np.ceil(mean) + half, most)
    return first.astype(np.int64), last.astype(np.int64), (last - first) * TOL.edge


def _on_support(cell: Cells, first: int, last: int, outside: float, bins: int, threads: int, variance: float) -> Pmf:
    """Exact pmf of one cell on the counts `first` to `last`."""
    from scipy.fft import irfft  # of lengths with a large prime factor twice as fast as NumPy's

    counts, remaining = last - first + 1, Remaining()
    size = counts + counts % 2
    value = _narrow(cell, size, bins, threads, variance, remaining) if size > TOL.all_points else None
    if value is None:
        angle = 2.0 * np.pi * np.arange(size // 2 + 1) / size
        re, im = characteristic(cell, np.cos(angle)[None], np.sin(angle)[None], bins, threads, remaining)
        value = re[0] - 1j * im[0]
    # the transform has e^(-i angle n): the conjugate; index n mod size holds count n (23)
    folded = np.asarray(irfft(value, size))
    return Pmf(first, np.roll(folded, -(first % size))[:counts], outside)


def _narrow(
    cell: Cells, size: int, bins: int, threads: int, variance: float, remaining: Remaining
) -> NDArray[np.complex128] | None:
    """Conjugate of E z^N at (size // 2 + 1,) points of the circle, evaluated only near z = 1; None if not justified.

    The transform of a wide law is a narrow peak at z = 1; beyond about 9 of its standard deviations it is below
    rounding. If the counts lie on a lattice (all even, say), there are further peaks of the same width. They also occur
    in the transform of a much shorter exposure, where they are so wide that few points detect them (27).
    """
    cycles = cell.system.cycles
    shorter = max(1, math.ceil(TOL.short_variance * cycles / max(variance, 1e-300)))
    if shorter * TOL.least_shorter > cycles:
        return None
    angle = 2.0 * np.pi * np.arange(size // 2 + 1) / size
    value = np.zeros(angle.size, np.complex128)
    # about two standard deviations of the peak
    step = max(8, math.ceil(2.0 * size / (2.0 * np.pi * math.sqrt(variance))))
    end = 0
    while end < angle.size:
        some = slice(end, min(end + step, angle.size))
        re, im = characteristic(cell, np.cos(angle[some])[None], np.sin(angle[some])[None], bins, threads, remaining)
        value[some] = re[0] - 1j * im[0]
        end = some.stop
        if np.abs(value[some]).max() <= TOL.faint:
            break
    spread = math.sqrt(variance * shorter / cycles)
    begin = min(4.0 / spread, np.pi)
    between = np.geomspace(angle[min(end, angle.size - 1)], max(begin, angle[min(end, angle.size - 1)]), 16)
    re, im = characteristic(cell, np.cos(between)[None], np.sin(between)[None], bins, threads, remaining)
    beyond = np.linspace(begin, np.pi, 2 + math.ceil((np.pi - begin) * spread / 0.3))
    short = replace(cell, system=cell.system.replace(cycles=shorter))
    short_re, short_im = characteristic(short, np.cos(beyond)[None], np.sin(beyond)[None], bins, threads, remaining)
    highest = float(np.hypot(short_re, short_im).max())
    faint = float(np.hypot(re, im).max()) <= 10.0 * TOL.faint
    return value if faint and highest ** (cycles / shorter) <= 1e-3 * TOL.faint else None


def _check(cells: Cells, cell: int, law: Pmf, cumulants: FloatArray) -> None:
    """Compare sum, sign, mean and variance of the pmf with the cumulants; remove rounding and normalise it in place."""
    pmf: NDArray[np.float64] = law.p
    offset = law.first + np.arange(pmf.size) - cumulants[0]
    spread = max(math.sqrt(cumulants[1]), 1e-3)
    edge = TOL.edge + TOL.consistent_per_cycle * cells.system.cycles
    if law.outside > TOL.tail * 4.0 and _ends(pmf, law.first, _most(cells)) > edge:  # a guessed support
        raise ConvergenceError(
            f"count law of {cells.name(cell)}: it extends beyond {law.first} .. {law.first + pmf.size - 1}, "
            f"the support expected from mean and variance; mean, variance and cumulants are known; for the law "
            f"{cells.instead}"
        )
    total, mean = float(pmf.sum()), float((pmf * offset).sum())
    variance, least = float((pmf * offset**2).sum()), float(pmf.min())
    # rounding and extrapolation cause absolute errors of probability, which may exceed the variance of a locked count
    rounding, unit = TOL.consistent_per_cycle * cells.system.cycles, max(spread, 1.0)
    error = max(
        abs(total - 1.0) / (TOL.consistent + rounding),
        abs(mean) / (TOL.consistent * spread + rounding * unit),
        abs(variance - cumulants[1]) / (TOL.consistent * spread**2 + rounding * unit**2),
        -least / (TOL.consistent + rounding),
    )
    if not error <= 1.0:
        raise ConvergenceError(
            f"count law of {cells.name(cell)}: its pmf on {law.first} .. {law.first + pmf.size - 1} "
            f"disagrees with the cumulants {error:.2g} times as much as is allowed: sum - 1 = "
            f"{total - 1.0:.2g}, mean off by {mean:.2g}, variance {variance:.6g} for {cumulants[1]:.6g}, "
            f"least {least:.2g}; mean, variance and cumulants are known; for the law {cells.instead}"
        )
    # 1e-9 in each of 30 counts is a few percent of the variance of a locked count
    pmf[pmf <= max(min(-least, rounding), 0.0)] = 0.0
    pmf /= pmf.sum()
