"""Pixels on the grids on which the exact statistics are computed.

Arguments (photons and delays) are checked and broadcast; the period is cut into cells, which are not the bins of the
histogram; each cell gets its photons per period (`Cells`).

Narrow pulses. A grid that does not resolve a pulse is right as long as no pixel re-arms within the pulse. Where the
dead time is a whole number of periods, up to the length of the pulse, what the pulse registered re-arms within the
next pulse, and the grid must resolve it. A comparison of two grids does not notice this: to both the narrowest pulse
on the edge of a cell is the same.

Many bins. A pixel registers the light times the probability that it is armed, which is smooth where the light is:
cells that resolve the light give the registrations as a function of the photons so far, and each bin then has its own
photons exactly. Two checks go with this: the photons that a smooth curve through the cells would misplace within a cell
bound what the cells cannot resolve, and cells twice as wide must give the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.pulse import SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.statistics.gate import PLAIN, CellLight, photons_before, require_mode

# --- Arguments -----------------------------------------------------------------------------------------------------

MAX_PHOTONS = 1e6


def reals(name: str, value: ArrayLike) -> FloatArray:
    """Real numbers as doubles, not none of them."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
    if array.size == 0:
        raise ValueError(f"{name} must not be empty, got shape {array.shape}")
    return array.astype(np.float64)


def photons(name: str, value: ArrayLike) -> FloatArray:
    """Photons per period, in range."""
    array = reals(name, value)
    bad = ~((array >= 0) & (array <= MAX_PHOTONS))
    if bad.any():
        raise ValueError(f"{name} must lie in [0, {MAX_PHOTONS:g}] photons per period, got {array[bad].flat[0]}")
    return array


def broadcast(names: tuple[str, ...], *arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Arrays of one shape; `names` are for the error."""
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError:
        told = ", ".join(f"{n} {a.shape}" for n, a in zip(names, arrays, strict=False))
        raise ValueError(f"shapes must broadcast, got {told}") from None


def with_delays(
    signal: FloatArray, background: FloatArray, delay_ns: ArrayLike | None, period_ns: float
) -> list[NDArray[Any]]:
    """Signal, background and delays, ns, of one shape; delays of None are half the period, NaN is for no return."""
    given = reals("delay_ns", 0.5 * period_ns if delay_ns is None else delay_ns)
    signal, background, delay = broadcast(("signal", "background", "delay_ns"), signal, background, given)
    bad = ~np.isfinite(delay) & ~(np.isnan(delay) & (signal == 0))
    if bad.any():
        raise ValueError(f"delay_ns must be finite (NaN for no return where signal is 0), got {delay[bad].flat[0]}")
    return [signal, background, delay]


def flat(array: NDArray[Any]) -> FloatArray:
    """(cells,) doubles, contiguous."""
    return np.ascontiguousarray(array.reshape(-1), dtype=np.float64)


# --- Grid of the phase chain ---------------------------------------------------------------------------------------

_MAX_BINS = 2**20
_MAX_COMMON = 2**14
_CHAIN_MIN_BINS = 512  # below it the chain's own discretisation shows in the count variance
_CHAIN_BINS_PER_WIDTH = 7.5  # of the equivalent width 1 / max s, 2.507 sigma for a Gaussian: a third of sigma


@checked
def photons_per_bin(
    signal: float | None,
    background: float,
    system: System,
    *,
    bins: int | None = None,
    delay_ns: float | None = None,
    waveform: ArrayLike | None = None,
) -> FloatArray:
    """Photons per bin and period of one pixel, exact integrals over each bin (1.2).

    Parameters
    ----------
    signal, background
        S and B, photons per period, >= 0. With a waveform `signal` is None.
    bins
        Bins of the statistics grid; None: the smallest multiple of the histogram's bins that is at least 512
        and resolves the pulse (bin at most sigma / 3 of a Gaussian), or the waveform's samples.
    delay_ns
        Delay of the return, ns; None: half the period.
    waveform
        (T,) photons per period in T equal parts of the period, constant within each; replaces the signal.

    Returns
    -------
    NDArray
        (bins,).
    """
    back = checks.real("background", background, low=0.0, high=MAX_PHOTONS)
    if bins is not None:
        bins = checks.integer("bins", bins, low=1, high=_MAX_BINS)
    if waveform is not None:
        if signal is not None or delay_ns is not None:
            raise ValueError("waveform replaces signal and delay_ns: give it alone, or with background")
        wave = _waveform(waveform)
        n = bins or _bins_for_waveform(wave.size, system.bins)
        cumulative = np.concatenate([[0.0], np.cumsum(wave)])
        edges = np.arange(n + 1) * (wave.size / n)
        energy = np.diff(np.interp(edges, np.arange(wave.size + 1), cumulative))
        return _detected(np.maximum(energy, 0.0) + back / n, system)
    if signal is None:
        raise ValueError("signal must be given (photons per period), or a waveform instead of it")
    total = checks.real("signal", signal, low=0.0, high=MAX_PHOTONS)
    delay = 0.5 * system.period_ns if delay_ns is None else checks.real("delay_ns", delay_ns)
    n = bins or default_bins(system)
    energy = system.pulse.bin_energy(delay, system.period_ns, n)
    return _detected(total * np.maximum(energy, 0.0) + back / n, system)


def _detected(light: FloatArray, system: System) -> FloatArray:
    """`Flux.detected` on a grid (bins,)."""
    dark = system.detector.dark_count_hz * system.period_ns * 1e-9
    return np.asarray(light * system.detector.detection_efficiency + dark / light.size, dtype=np.float64)


def default_bins(system: System) -> int:
    """Bins of the statistics grid when none are asked for: a multiple of `System.bins`, pulse resolved."""
    probe = 2**15
    peak = float(system.pulse.bin_energy(0.5 * system.period_ns, system.period_ns, probe).max())
    wanted = max(_CHAIN_MIN_BINS, _CHAIN_BINS_PER_WIDTH * peak * probe)
    return min(system.bins * math.ceil(wanted / system.bins), max(system.bins, _MAX_BINS))


def _bins_for_waveform(samples: int, bins: int) -> int:
    """A multiple of the histogram's bins, and of the samples where that is not too many."""
    common = math.lcm(samples, bins)
    step = common if common <= _MAX_COMMON else bins
    return step * math.ceil(max(_CHAIN_MIN_BINS, samples) / step)


def whole_bins(dead: float, bins: int) -> tuple[int, int, float]:
    """A dead time in periods as whole periods, whole bins of the rest, and the fraction of a bin that is left."""
    whole = math.floor(dead)
    position = (dead - whole) * bins  # whole periods apart first: else they cost digits of the fraction
    shift = math.floor(position)
    fraction = position - shift
    if fraction < 1e-9:
        fraction = 0.0
    elif fraction > 1.0 - 1e-9:
        shift, fraction = shift + 1, 0.0
    return (whole + 1, 0, fraction) if shift == bins else (whole, shift, fraction)


def cell_name(signal: float | None, background: float, system: System) -> str:
    """(S, B, t_d) in words, for warnings and errors; a signal of None is a waveform."""
    what = "waveform" if signal is None else f"S = {signal:g}"
    return f"{what}, B = {background:g} photons per period, t_d = {system.dead_time_periods:g} periods"


def _waveform(waveform: ArrayLike) -> FloatArray:
    wave = np.asarray(waveform)
    if wave.dtype.kind not in "fiu":
        raise TypeError(f"waveform must be real numbers, got dtype {wave.dtype}")
    if wave.ndim != 1 or wave.size == 0:
        raise ValueError(f"waveform must be (T,) with T >= 1, got shape {wave.shape}")
    bad = ~((wave >= 0) & (wave <= MAX_PHOTONS))
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"waveform must lie in [0, {MAX_PHOTONS:g}] photons per period, got waveform[{k}] = {wave[k]}")
    return wave.astype(np.float64)


# --- Pulses narrower than a cell -----------------------------------------------------------------------------------

_PROBE = 2**12  # parts of a pulse's record
_SEEN = 8.0  # standard deviations of bins that see a pulse: the refinement of the grid finds the rest
_RESOLVED = 0.5  # and of bins that resolve it: there is nothing to gain from others
_MOST_BINS = 2**15  # of a period: more take seconds
_ROUNDING = 1e-12  # of a whole number of periods, relative
_BLOCKS = 4  # of the period at least, so that none has both ends of a pulse's record at its own two
_LEAST_CELLS = 8  # of a block, on a grid that follows the pulse: its pieces begin with cells of half as many
_PULSE_CELLS = 512  # of the period
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
    bins = blocks * max(_LEAST_CELLS, 4 * math.ceil(_PULSE_CELLS / (4 * blocks)))
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


# --- Pixels on the grid --------------------------------------------------------------------------------------------

_MIN_BINS = 128
_MAX_FIRST_BINS = 2**14  # finer first grids only where the tolerance asks for them
_BINS_PER_WIDTH = 4.0 * math.sqrt(math.pi)  # of 1 / integral of s^2, 2 sqrt(pi) sigma: a bin is sigma / 2
_MAX_STEPS = 4_000_000_000  # bins x periods of one cell before it counts as not settling: minutes
LAW_STEPS = 26_000_000  # of the laws, which are to take 2 s at most
# Sweeps for a warm state, and bins x sweeps, if more than the least; beyond, an equation is solved (warm.py)
_WARM_PERIODS, _WARM_STEPS, _LEAST_WARM = 400, 10_000_000, 4
_CHUNK_BYTES = 64 << 20
_MAX_HISTORY_BYTES = 1 << 30  # for each thread
_NEAR_BYTES, _MIDDLE_BYTES = 1 << 19, 1 << 25  # 15 to 60 ns a step; up to 100 ns; beyond, 100 to 350 ns were measured
_SIMULATE = "simulate it with engine 'exact'"
_SETTLED = 1e-12  # relative change of the state per period (20)


@dataclass(frozen=True, eq=False)
class Cells(CellLight):
    """Pixels with their grids: what the statistics of all modes are computed from."""

    @classmethod
    def of(
        cls,
        signal: ArrayLike | None,
        background: ArrayLike,
        system: System,
        *,
        delay_ns: ArrayLike | None = None,
        waveform: ArrayLike | None = None,
        what: str = "this statistic",
        modes: tuple[Mode, ...] = PLAIN,
        effects: tuple[str, ...] = LIGHT_EFFECTS,
    ) -> Cells:
        """Check the arguments and broadcast them; `waveform` (..., T) broadcasts over its leading axes.

        `what` is computed from the cells, and treats `modes` and `effects` of the detector. The cells have the flux
        of detected photons, and the system for that.
        """
        if not isinstance(system, System):
            raise TypeError(f"system must be a System, got {type(system).__name__}")
        require_mode(what, system, modes, effects)
        share, dark = system.detector.detection_efficiency, system.detector.dark_count_hz * system.period_ns * 1e-9
        back = photons("background", background)
        if share != 1.0 or dark > 0.0:
            system, back = system.detected(), photons("background with dark counts", back * share + dark)
        if waveform is not None:
            if signal is not None or delay_ns is not None:
                raise ValueError("waveform replaces signal and delay_ns: give it alone, or with background")
            wave = photons("waveform", waveform) * share
            if wave.ndim == 0 or wave.shape[-1] == 0:
                raise ValueError(f"waveform must be (..., T) with T >= 1, got shape {wave.shape}")
            total = photons("waveform summed over a period", wave.sum(-1))
            rows = np.arange(total.size).reshape(total.shape)
            total, back, rows = broadcast(("waveform", "background", "waveform"), total, back, rows)
            unit = wave.reshape(-1, wave.shape[-1])
            unit = unit / np.maximum(unit.sum(-1, keepdims=True), np.finfo(float).tiny)
            return cls(
                system,
                total.shape,
                flat(total),
                flat(back),
                np.zeros(total.size),
                unit,
                np.ascontiguousarray(rows.reshape(-1), dtype=np.int64),
            )
        if signal is None:
            raise ValueError("signal must be given (photons per period), or a waveform instead of it")
        total, back, delay = with_delays(photons("signal", signal) * share, back, delay_ns, system.period_ns)
        phase = np.nan_to_num(flat(delay) / system.period_ns)
        phase -= np.floor(phase)
        return cls(system, total.shape, flat(total), flat(back), phase, None, np.zeros(total.size, np.int64))

    @property
    def native_flux(self) -> tuple[FloatArray, FloatArray]:
        """Photons (cells,) of the shapes of `energies`, and of a flat background, as the native core adds them.

        Behind a gate, and in uneven bins, nothing is flat: all is in the shapes.
        """
        if not self._all_in_shapes:
            return self.signal, self.background
        total = photons_before(self, np.ones(1))[:, 0]
        return total, np.zeros_like(total)

    @property
    def _all_in_shapes(self) -> bool:
        return self.system.detector.mode == "gated" or self.follow > 0

    @property
    def total(self) -> FloatArray:
        """Photons per period (cells,), inside of the gate if there is one."""
        return np.asarray(sum(self.native_flux), dtype=np.float64)

    def part(self, index: IndexArray | slice) -> Cells:
        """Some of the cells, flat."""
        signal = self.signal[index]
        return Cells(
            self.system,
            signal.shape,
            signal,
            self.background[index],
            self.delay[index],
            self.waveform,
            self.row[index],
            self.follow,
        )

    def resolved(self, out_bins: int) -> Cells:
        """These cells with bins that follow the pulse where equal ones would have to be too many."""
        even = replace(self, follow=0)
        follow = out_bins if followed_bins(even, max(_MAX_FIRST_BINS, out_bins), out_bins) else 0
        return self if follow == self.follow else replace(self, follow=follow)

    def name(self, index: int) -> str:
        """One cell in words, for errors."""
        where = "waveform" if self.waveform is not None else f"S = {self.signal[index]:g}"
        delay = "" if self.waveform is not None else f", delay = {self.delay[index]:g} periods"
        place = "" if self.size == 1 else f" (cell {index} of {self.size})"
        return (
            f"{where}, B = {self.background[index]:g} photons per period{delay}, "
            f"t_d = {self.system.dead_time_periods:g} periods, {self.system.cycles} cycles{place}"
        )

    @property
    def instead(self) -> str:
        """What to use where an exact law is refused, for errors."""
        return self.alternatives()

    def alternatives(self, *names: str) -> str:
        """`instead`, after what has these `names`."""
        if self.system.detector.mode == "nonparalyzable" and not meets_itself(self):
            names = (*names, "joint_law (mean, variance and mean histogram)", "method 'mars' (a Gaussian)")
        return f"use {', '.join(names)}, or {_SIMULATE}" if names else _SIMULATE

    @property
    def _sharpness(self) -> float:
        """Integral of the squared shape of the signal over the period: 1 / width, the narrowest of all cells."""
        if self.waveform is not None:
            return float(self.waveform.shape[-1] * np.max(np.sum(self.waveform**2, -1)))
        probe = 2**14
        energy = self.system.pulse.bin_energy(0.5 * self.system.period_ns, self.system.period_ns, probe)
        return float(probe * np.sum(energy**2))

    @property
    def finest(self) -> float:
        """Standard deviation, in periods, of a Gaussian as narrow as the signal."""
        return float(1.0 / (2.0 * math.sqrt(math.pi) * max(self._sharpness, 1.0)))

    def first_bins(self, out_bins: int) -> int:
        """Bins of the first grid: as `usual_bins`, but where a pulse narrower than those must be resolved."""
        most = max(_MAX_FIRST_BINS, out_bins)
        if self.follow:
            return followed_bins(self, most, out_bins)
        return _multiple(max(self.usual_bins(out_bins), needed_bins(self, most)), out_bins)

    def usual_bins(self, out_bins: int) -> int:
        """Bins, even, a multiple of `out_bins`, at most half a sigma of the pulse wide, or of 2^-14 of a period."""
        sharpness = self._sharpness
        gate_width = self.system.detector.gate_periods(self.system.period_ns)[2]
        sharpness = max(sharpness, 1.0 / max(gate_width, 1.0 / _MAX_FIRST_BINS))
        wanted = min(max(_MIN_BINS, _BINS_PER_WIDTH * sharpness), _MAX_FIRST_BINS)
        return _multiple(wanted, out_bins)

    def edges(self, bins: int) -> FloatArray:
        """Edges (bins + 1,) of a grid of the period, of cells of one delay."""
        return (
            followed_edges(self.part(slice(0, 1)), bins, self.follow)[0] if self.follow else np.arange(bins + 1) / bins
        )

    def grid(self, bins: int, out_bins: int, steps: int | None = None) -> _core.ExposureGrid:
        """The native grid of `bins` bins per period; a cell is given up after `steps` bins x periods (None: many)."""

        whole, shift, fraction = whole_bins(self.system.dead_time_periods, bins)
        return _core.ExposureGrid(
            cycles=self.system.cycles,
            max_periods=max(10_000, _MAX_STEPS // bins) if steps is None else max(1, steps // bins),
            whole=whole,
            bins=bins,
            out_bins=out_bins,
            shift=shift,
            fraction=fraction,
            stationary=self.system.start == "stationary",
            tolerance=_SETTLED,
            warm_periods=min(_WARM_PERIODS, max(_LEAST_WARM, _WARM_STEPS // bins)),
        )

    def chunks(self, bins: int, out_bins: int) -> Iterator[slice]:
        """Parts whose energies on the grid, and histograms, fit in a moderate amount of memory."""
        per_cell = 8 * (4 * bins + 2 * out_bins)
        least = 64
        if self.system.detector.mode == "paralyzable":  # kinds x moments of the rate, and what they are made of
            per_cell, least = 8 * (40 * bins + 2 * out_bins), 1
        elif self.waveform is None and np.unique(self.delay).size == 1 and not self._all_in_shapes:
            per_cell = 16 * out_bins + 128
        step = max(least, _CHUNK_BYTES // per_cell)
        for start in range(0, self.size, step):
            yield slice(start, min(start + step, self.size))

    def step_cost(self, bins: int) -> float:
        """What a step of a bin costs beside one whose dead time is remembered in the processor's own memory."""
        remembered = self.grid(bins, 1).bytes
        return 1.0 if remembered <= _NEAR_BYTES else 2.0 if remembered <= _MIDDLE_BYTES else 6.0

    def check_history(self, bins: int) -> None:
        """Refuse, before any work, dead times whose history would not fit in memory."""
        needed = int(self.grid(bins, 1).bytes)
        if needed > _MAX_HISTORY_BYTES:
            raise MemoryError(
                f"exposure statistics of {self.name(0)}: {bins} bins per period need "
                f"{needed / 2**30:.3g} GiB to remember one dead time, at most "
                f"{_MAX_HISTORY_BYTES / 2**30:g} GiB are allowed; {self.instead}"
            )

    def energies(self, bins: int) -> tuple[FloatArray, NDArray[np.int32]]:
        """Unit energies (rows, parts of bins) of the distinct signal shapes, and each cell's row (cells,)."""

        parts = bins * int(_core.EXPOSURE_PARTS)
        if self.follow:
            edges = followed_edges(self, parts, self.follow)
            before = np.concatenate([photons_before(self.part(np.array([k])), row) for k, row in enumerate(edges)])
            return _unit_energies(before), np.arange(self.size, dtype=np.int32)
        if self.system.detector.mode == "gated":
            before = photons_before(self, np.arange(parts + 1) / parts)
            return _unit_energies(before), np.arange(self.size, dtype=np.int32)
        if self.waveform is None:
            delays, rows = np.unique(self.delay, return_inverse=True)
            energy = self.system.pulse.bin_energy(delays * self.system.period_ns, self.system.period_ns, parts)
        else:
            used, rows = np.unique(self.row, return_inverse=True)
            samples = self.waveform.shape[-1]
            cumulative = np.zeros((used.size, samples + 1))
            np.cumsum(self.waveform[used], axis=-1, out=cumulative[:, 1:])
            edges = np.arange(parts + 1) * (samples / parts)
            knots = np.arange(samples + 1)
            energy = np.diff(np.stack([np.interp(edges, knots, c) for c in cumulative]), axis=-1)
        return np.ascontiguousarray(np.maximum(energy, 0.0)), rows.reshape(-1).astype(np.int32)


def _multiple(wanted: float, out_bins: int) -> int:
    """The next even multiple of `out_bins`."""
    step = out_bins if out_bins % 2 == 0 else 2 * out_bins
    return step * math.ceil(wanted / step)


def _unit_energies(before: FloatArray) -> FloatArray:
    """Shares (cells, parts) of a period's photons, from those before each edge (cells, parts + 1)."""
    unit = np.diff(before) / np.maximum(before[:, -1:], np.finfo(float).tiny)
    return np.ascontiguousarray(np.maximum(unit, 0.0))


# --- Histograms of very many bins ----------------------------------------------------------------------------------

MANY_BINS = 2**17  # from which it is worth while
_FINE_CELLS = (2**15, 2**17)  # tried in turn
_LEAST_KNOTS = 4  # of a spline
_DARK = 1e-12  # of all photons: such a cell cannot be a step of the curve


def fine_histograms(
    cells: Cells, bins: int, tolerance: float, compute: Callable[[Cells, int], FloatArray]
) -> FloatArray:
    """Histograms (cells, bins) as ``compute(cells, bins)``, by fewer bins where these will do within `tolerance`."""
    if bins <= MANY_BINS:
        return compute(cells, bins)
    return np.concatenate([_fine(cells.part(slice(k, k + 1)), bins, tolerance, compute) for k in range(cells.size)])


def _fine(cell: Cells, bins: int, tolerance: float, compute: Callable[[Cells, int], FloatArray]) -> FloatArray:
    edges = np.arange(bins + 1) / bins
    light = light_before(cell, edges)
    for few in _FINE_CELLS:
        before = light_before(cell, np.arange(few + 1) / few)
        if before[-1] == 0.0 or misplaced(before, edges, light) > 2.0 * tolerance:
            continue
        counts = compute(cell, few)[0]
        found = np.diff(registered_before(before, counts, light))
        coarse = np.diff(registered_before(before[::2], counts.reshape(-1, 2).sum(-1), light))
        if float(np.abs(found - coarse).sum()) <= 2.0 * tolerance * float(counts.sum()):
            return found[None]
    return compute(cell, bins)


def light_before(cell: Cells, edges: FloatArray) -> FloatArray:
    """Photons (n,) that reach the only cell between the start of the period and `edges` (n,), never decreasing."""
    return np.maximum.accumulate(photons_before(cell, edges)[0])


def misplaced(before: FloatArray, edges: FloatArray, light: FloatArray) -> float:
    """Photons that a smooth curve through those before equal cells (m + 1,) misplaces within any of them.

    `light` (n + 1,) are the photons before `edges`. The armed probability changes by no more than the photons of a
    cell within it, so that registrations are displaced by at most a quarter of what is returned, relative to those
    of the cell; of a cell of more than a photon by a share of it.
    """
    from scipy.interpolate import PchipInterpolator

    cells = before.size - 1
    smooth = PchipInterpolator(np.arange(cells + 1) / cells, before)(edges)
    wrong = 0.5 * np.abs(np.diff(smooth) - np.diff(light))
    first = np.searchsorted(edges[:-1], np.arange(cells) / cells)
    return float((np.add.reduceat(wrong, first) / np.maximum(np.diff(before), 1.0)).max())


def registered_before(before: FloatArray, counts: FloatArray, light: FloatArray) -> FloatArray:
    """Registrations up to where there were `light` (n,) photons, from `counts` (m,) of cells and photons before them.

    A cubic spline whose slopes are limited so that it never falls, exact at the edges of cells.
    """
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    lit = np.diff(before) > _DARK * before[-1]
    at = np.concatenate([[True], lit])
    at[-1] |= not lit.any()
    total = np.concatenate([[0.0], np.cumsum(counts)])
    photons, so_far = before[at], total[at]
    photons[-1], so_far[-1] = before[-1], total[-1]
    if photons.size < _LEAST_KNOTS:
        return np.asarray(np.interp(light, photons, so_far))
    armed = np.maximum(np.diff(so_far) / np.diff(photons), 0.0)
    most = 3.0 * np.minimum(np.append(armed[0], armed), np.append(armed, armed[-1]))
    slope = np.clip(CubicSpline(photons, so_far)(photons, 1), 0.0, most)
    return np.asarray(CubicHermiteSpline(photons, so_far, slope)(light), dtype=np.float64)
