"""Pixels of the exposure statistics: checked, flattened, and put on the grid of the native recursion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cell_input import broadcast, flat, photons, with_delays
from mars_lidar.statistics.gate import PLAIN, CellLight, photons_before, require_mode
from mars_lidar.statistics.grid import whole_bins
from mars_lidar.statistics.narrow_pulse import followed_bins, followed_edges, meets_itself, needed_bins

if TYPE_CHECKING:
    from mars_lidar._base.native import _core


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
        from mars_lidar._base.native import _core

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
        from mars_lidar._base.native import _core

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
