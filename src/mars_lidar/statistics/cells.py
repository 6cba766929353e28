"""Pixels and the grids of the period on which their exact statistics are computed.

`Cells.of` checks and broadcasts photons and delays. A grid divides the period into bins, which need not be those of the
histogram; `Cells.energies` integrates the light over them.

Narrow pulses. A grid that does not resolve a pulse is accurate as long as no pixel re-arms within the pulse. Where the
dead time is a whole number of periods, within the length of the pulse, pixels blinded by one pulse re-arm within the
next, and the grid must resolve it. Refinement from one grid to the next does not detect this: a pulse much narrower
than a bin looks the same on both.

Many bins. The rate of registrations is the product of the light and the armed probability, which is as smooth as the
light. On a grid that resolves the light, the registrations up to a time are interpolated as a function of the photons
up to that time, which are exact for any bin. Two checks bound the error: the photons that a smooth curve through the
grid would misplace within a bin of the grid, and the agreement with a grid of twice the bin width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.native import _core
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import ArrayLike, FloatArray, IndexArray, NDArray
from mars_lidar.instrument.detector import Mode, require_effects
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.pulse import SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux, StoredFlux, check_photons
from mars_lidar.statistics.tolerances import MOMENTS, TOL, advice

# --- Detectors that a statistic treats -----------------------------------------------------------------------------
# With a gate that repeats every period, a gated pixel is a free-running one that receives only the flux inside of the
# gate; the exposure recursion holds for it with that flux: docs/theory_detectors.md.

PLAIN: tuple[Mode, ...] = ("nonparalyzable",)
_INSTEAD = {
    "nonparalyzable": "",
    "paralyzable": "; count_law, exposure_moments, mean_histogram and registration_pdf have its exact statistics",
    "synchronous": "; count_law, mean_histogram and registration_pdf have its exact statistics",
    "gated": "; count_law, exposure_moments, mean_histogram and registration_pdf have its exact statistics",
}


def require_mode(
    what: str, system: System, modes: tuple[Mode, ...] = PLAIN, effects: tuple[str, ...] = LIGHT_EFFECTS
) -> None:
    """Raise ValueError, with an alternative, where `what` does not treat the mode or an effect of the detector."""
    require_effects(what, system.detector, effects, _engine_advice)
    mode = system.detector.mode
    if mode not in modes:
        allowed = " and ".join(map(repr, modes))
        raise ValueError(
            f"{what} is for detectors of mode {allowed}, got {mode!r}{_INSTEAD[mode]}; any mode can be simulated"
        )
    if system.detector.gate_moves:
        raise ValueError(
            f"{what} needs a gate that repeats every period, got gate_step_ns={system.detector.gate_step_ns:g}; "
            "a moving gate can be simulated"
        )


def _engine_advice(effect: str) -> str:
    engines = "'sequential'" if effect == "crosstalk" else "'exact' or 'sequential'"
    return f"; simulate it with engine {engines}"


def open_parts(system: System) -> tuple[tuple[float, float], ...]:
    """Parts [low, high) of the period [0, 1), in order, in which a fixed gate is open."""
    start, _, width = system.detector.gate_periods(system.period_ns)
    end = start + width
    return ((start, end),) if end <= 1.0 else ((0.0, end - 1.0), (start, 1.0))


# --- Light on a grid ----------------------------------------------------------------------------------------------


def flat(array: NDArray[Any]) -> FloatArray:
    """(cells,) doubles, contiguous."""
    return np.ascontiguousarray(array.reshape(-1), dtype=np.float64)


@checked
def photons_per_bin(flux: Flux, system: System, *, bins: int | None = None) -> FloatArray:
    """Detected photons per bin and period, exact integrals over each bin (1.2).

    Parameters
    ----------
    flux
        The light, of any number of returns, or a waveform.
    system
        Laser, detector and histogram.
    bins
        Bins of the statistics grid; None: the smallest multiple of the histogram's bins that is at least 512
        and resolves the pulse (bin at most sigma / 3 of a Gaussian); for a waveform, at least its number of samples.

    Returns
    -------
    NDArray
        (..., bins), the leading axes those of the flux.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        `bins` that are not a whole number >= 1; light that does not fit the system.

    See Also
    --------
    mean_histogram, PhaseChain

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> photons = ml.statistics.photons_per_bin(ml.Flux(1.0, 1.0, 40.0), system, bins=128)
    >>> photons.shape, round(float(photons.sum()), 6)  # S + B
    ((128,), 2.0)
    """
    flux = flux.detected(system)
    if bins is not None:
        bins = checks.integer("bins", bins, low=1, high=TOL.most_bins)
    if flux.waveform is not None:
        size = flux.waveform.shape[-1]
        n = bins or _bins_for_waveform(size, system.bins)
        before = np.concatenate([np.zeros((*flux.shape, 1)), np.cumsum(flux.waveform, -1)], -1)
        at = np.minimum(np.arange(n + 1) * (size / n), size)
        part = np.minimum(at.astype(np.int64), size - 1)
        until = before[..., part] + (at - part) * flux.waveform[..., part]
        return np.asarray(np.maximum(np.diff(until), 0.0) + flux.background[..., None] / n)
    n = bins or default_bins(system)
    light = np.broadcast_to(flux.background[..., None] / n, (*flux.shape, n)).copy()
    for signal, delay_ns in zip(flux.returns_signal, np.nan_to_num(flux.returns_delay_ns), strict=True):
        light += signal[..., None] * np.maximum(system.pulse.bin_energy(delay_ns, system.period_ns, n), 0.0)
    return light


def one_pixel(flux: Flux) -> Flux:
    """The flux, which must be that of a single pixel."""
    if flux.background.size != 1:
        raise ValueError(f"flux must be one pixel, such as flux[0, 0], got pixels of shape {flux.shape}")
    return flux if flux.shape == () else flux[(0,) * len(flux.shape)]


def default_bins(system: System) -> int:
    """Default number of bins of the statistics grid: a multiple of `System.bins` that resolves the pulse."""
    wanted = max(TOL.unrefined_bins, TOL.chain_bins_per_width * _peak(system))
    return min(system.bins * math.ceil(wanted / system.bins), max(system.bins, TOL.most_bins))


def _peak(system: System) -> float:
    """Largest density of the pulse, per period."""
    probe = 2**15
    return float(system.pulse.bin_energy(0.5 * system.period_ns, system.period_ns, probe).max()) * probe


def _bins_for_waveform(samples: int, bins: int) -> int:
    """Multiple of the histogram's bins, at least 512 and `samples`; also of `samples` if both fit into 2^14 bins."""
    common = math.lcm(samples, bins)
    step = common if common <= TOL.most_first_bins else bins
    return step * math.ceil(max(TOL.unrefined_bins, samples) / step)


def whole_bins(dead: float, bins: int) -> tuple[int, int, float]:
    """A dead time in periods as whole periods, whole bins of the rest, and the remaining fraction of a bin."""
    whole = math.floor(dead)
    position = (dead - whole) * bins  # without the whole periods, which would cost digits of the fraction
    shift = math.floor(position)
    fraction = position - shift
    if fraction < 1e-9:
        fraction = 0.0
    elif fraction > 1.0 - 1e-9:
        shift, fraction = shift + 1, 0.0
    return (whole + 1, 0, fraction) if shift == bins else (whole, shift, fraction)


def cell_name(flux: Flux, system: System) -> str:
    """(S, B, t_d) of one pixel in words, for warnings and errors."""
    what = "waveform" if flux.waveform is not None else f"S = {flux.signal:g}"
    return f"{what}, B = {flux.background:g} photons per period, t_d = {system.dead_time_periods:g} periods"


def waveform_parts(system: System) -> int:
    """Samples of a waveform of several returns: at least 8192, and 8 per sigma of a Gaussian up to 2^18."""
    wanted = max(2**13, min(2**18, 20.0 * _peak(system)))
    return system.bins * max(1, math.ceil(wanted / system.bins))


# --- Pulses narrower than a bin ------------------------------------------------------------------------------------


def needed_bins(cells: Cells, coarsest: int) -> int:
    """Number of equal bins that resolves the pulse; 0 where `coarsest` equal bins suffice.

    A bin is then one standard deviation of the pulse wide, or a third of the time between the end of a pulse and the
    re-arming of the pixels that it blinded.
    """
    return _bins_of_pulse(cells) if _rearms_within_pulse(cells, coarsest, TOL.detected_bins) else 0


def followed_bins(cells: Cells, coarsest: int, out_bins: int) -> int:
    """Number of bins of the first grid that follows the pulse; 0 where equal bins are used.

    Bins may be uneven only where the dead time is a whole number of periods: a pixel then re-arms in the bin of its
    registration. They are used where `coarsest` equal bins do not resolve the pulse.
    """
    if not _is_whole(cells) or not _rearms_within_pulse(cells, coarsest, TOL.resolved_bins):
        return 0
    sigma, length = _extent(cells)
    blocks = _blocks(out_bins)
    bins = blocks * max(TOL.block_bins, 4 * math.ceil(TOL.unrefined_bins / (4 * blocks)))
    return bins if length <= TOL.longest_pulse * sigma and bins < _bins_of_pulse(cells) else 0


def rearms_within_pulse(cells: Cells) -> bool:
    """Whether pixels re-arm within the next pulse and resolving it takes more than 2^15 equal bins."""
    return not _is_whole(cells) and _rearms_within_pulse(cells, TOL.most_even_bins, TOL.resolved_bins)


def _rearms_within_pulse(cells: Cells, coarsest: int, resolved: float) -> bool:
    """Whether sigma is below `resolved` of `coarsest` equal bins and pixels re-arm within the pulse."""
    dead = cells.system.dead_time_periods
    if cells.waveform is not None or dead == 0.0 or not (cells.signal > 0.0).any():
        return False
    sigma, length = _extent(cells)
    return sigma * coarsest < resolved and _off_whole_periods(cells) < length + 3.0 / coarsest


def _bins_of_pulse(cells: Cells) -> int:
    """Number of equal bins that resolves the pulse (`needed_bins`)."""
    sigma, length = _extent(cells)
    return math.ceil(1.0 / max(sigma, (_off_whole_periods(cells) - length) / 3.0))


def _off_whole_periods(cells: Cells) -> float:
    """Distance of the dead time from the nearest whole number of periods, in periods."""
    dead = cells.system.dead_time_periods
    return abs(dead - round(dead))


def followed_edges(cells: Cells, parts: int, out_bins: int) -> FloatArray:
    """Edges (cells, parts + 1) in [0, 1] of a grid that divides the period into blocks of equally many parts.

    A block is a bin of the histogram, or an equal part of it. Where the pulse overlaps a block, half of the parts of
    the block lie on the pulse.
    """
    blocks = _blocks(out_bins)
    each = parts // blocks
    out = np.tile(np.arange(parts + 1) / parts, (cells.size, 1))
    low, high = (x / cells.system.period_ns for x in cells.system.pulse.support_ns())
    for row, delay in zip(out, cells.delay, strict=True):
        for block in range(math.floor((delay + low) * blocks), math.ceil((delay + high) * blocks)):
            low_edge, high_edge = block / blocks, (block + 1) / blocks
            begin, end = max(delay + low, low_edge), min(delay + high, high_edge)
            if begin > low_edge and end < high_edge:
                knots = [0.0, 0.25, 0.75, 1.0], [low_edge, begin, end, high_edge]
            elif begin > low_edge:
                knots = [0.0, 0.5, 1.0], [low_edge, begin, high_edge]
            elif end < high_edge:
                knots = [0.0, 0.5, 1.0], [low_edge, end, high_edge]
            else:
                continue
            at = np.interp(np.arange(1, each) / each, *knots)
            first = block % blocks * each
            row[first + 1 : first + each] = at - math.floor(block / blocks)
    return out


def knots(cells: Cells, bins: int, halved: float) -> FloatArray:
    """Phases (n,) in [0, 1) at which a grid for the only cell must have edges.

    The edges of the samples of a sampled pulse or waveform; on a Gaussian pulse that `bins` bins do not resolve, 8
    times `halved` points per sigma; otherwise none.
    """
    if cells.waveform is not None:
        return np.linspace(0.0, 1.0, cells.waveform.shape[-1], endpoint=False)
    pulse, period = cells.system.pulse, cells.system.period_ns
    low, high = (x / period for x in pulse.support_ns())
    if isinstance(pulse, SampledPulse):
        at = np.linspace(low, high, round((high - low) * period / pulse.bin_ns) + 1)
    elif _extent(cells)[0] * bins < 1.0:
        at = np.linspace(low, high, math.ceil(TOL.knots_per_sigma * halved * (high - low) / _extent(cells)[0]))
    else:
        at = np.empty(0)
    at = cells.delay[0] + at
    return np.asarray(at - np.floor(at), dtype=np.float64)


def _blocks(out_bins: int) -> int:
    return out_bins * math.ceil(TOL.pulse_blocks / out_bins)


def _is_whole(cells: Cells) -> bool:
    """Whether the dead time is a whole number of periods."""
    return _off_whole_periods(cells) <= TOL.rounding * max(1.0, cells.system.dead_time_periods)


def _extent(cells: Cells) -> tuple[float, float]:
    """Standard deviation of a Gaussian as narrow as the pulse, and the pulse's length, in periods."""
    low, high = cells.system.pulse.support_ns()
    energy = np.diff(cells.system.pulse.cumulative(np.linspace(low, high, TOL.pulse_samples + 1)))
    length = (high - low) / cells.system.period_ns
    return length / (TOL.pulse_samples * float(np.sum(energy**2)) * 2.0 * math.sqrt(math.pi)), length


# --- Pixels on the grid --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Cells:
    """Pixels (S, B, delay or waveform) of one system, as flat arrays, and the grids of their statistics.

    Attributes
    ----------
    system
        Laser, detector and histogram that all cells share.
    shape
        Shape (...) of the arguments; the arrays below are flat, (cells,).
    signal, background
        Photons per period.
    delay
        Phase of the return in [0, 1), periods.
    waveform, row
        Waveforms (rows, T) of unit sum, and the row of each cell; `waveform` is None for a pulse.
    returns
        (2, returns, rows) fraction of the light and phase of each of several returns, from which the photons before an
        edge are computed; the waveforms are then samples of their sum. None otherwise.
    follow
        0 for equal bins; otherwise the number of histogram bins, each a whole number of grid bins, on a grid that is
        finer on the pulse.
    """

    system: System
    shape: tuple[int, ...]
    signal: FloatArray
    background: FloatArray
    delay: FloatArray
    waveform: FloatArray | None
    row: IndexArray
    returns: FloatArray | None = None
    follow: int = 0

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.signal.size

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
        """Cells of light that `Flux` has checked. Arguments broadcast, a `waveform` (..., T) by its leading axes.

        The cells hold the flux of detected photons and the system that detects all of it (`System.detected`). `what`
        names the statistic in errors; ValueError where it does not treat the detector's mode or effects.
        """
        require_mode(what, system, modes, effects)
        share, dark = system.detector.detection_efficiency, system.detector.dark_count_hz * system.period_ns * 1e-9
        back = np.asarray(background, dtype=np.float64)
        if share != 1.0 or dark > 0.0:
            system, back = system.detected(), back * share + dark
            check_photons("background with dark counts", back)
        if waveform is not None:
            wave = np.asarray(waveform, dtype=np.float64) * share
            total = wave.sum(-1)
            total, back, rows = np.broadcast_arrays(total, back, np.arange(total.size).reshape(total.shape))
            unit = wave.reshape(-1, wave.shape[-1])
            unit = unit / np.maximum(unit.sum(-1, keepdims=True), np.finfo(float).tiny)
            row = np.ascontiguousarray(rows.reshape(-1), dtype=np.int64)
            return cls(system, total.shape, flat(total), flat(back), np.zeros(total.size), unit, row)
        delay = 0.5 * system.period_ns if delay_ns is None else np.asarray(delay_ns, dtype=np.float64)
        total, back, delay = np.broadcast_arrays(np.asarray(signal, dtype=np.float64) * share, back, delay)
        phase = np.nan_to_num(flat(delay) / system.period_ns)
        phase -= np.floor(phase)
        return cls(system, total.shape, flat(total), flat(back), phase, None, np.zeros(total.size, np.int64))

    @classmethod
    def of_flux(
        cls,
        flux: Flux,
        system: System,
        *,
        what: str = "this statistic",
        modes: tuple[Mode, ...] = PLAIN,
        effects: tuple[str, ...] = LIGHT_EFFECTS,
    ) -> Cells:
        """The pixels of a flux; several returns of a pixel are written as a waveform that resolves the pulse."""
        if isinstance(flux, StoredFlux):
            flux = flux[:]
        named: dict[str, Any] = {"what": what, "modes": modes, "effects": effects}
        if flux.waveform is not None:
            return cls.of(None, flux.background, system, waveform=flux.waveform, **named)
        if ((flux.returns_signal > 0).sum(0) <= 1).all():
            return cls.of(flux.signal, flux.background, system, delay_ns=flux.delay_ns, **named)
        pixels, parts = flux.background.size, waveform_parts(system)
        check_memory(16 * pixels * parts, "the waveforms of several returns", "take rows: flux[rows]")
        waveform = np.zeros((pixels, parts))
        signals, delays = (a.reshape(-1, pixels) for a in (flux.returns_signal, flux.returns_delay_ns))
        for signal, delay_ns in zip(signals, delays, strict=True):
            lit = np.flatnonzero(signal > 0)
            waveform[lit] += signal[lit, None] * system.pulse.bin_energy(delay_ns[lit], system.period_ns, parts)
        waveform = np.maximum(waveform, 0.0).reshape(*flux.shape, parts)
        phases = np.nan_to_num(delays / system.period_ns)
        returns = np.stack([signals / np.maximum(signals.sum(0), np.finfo(float).tiny), phases - np.floor(phases)])
        return replace(cls.of(None, flux.background, system, waveform=waveform, **named), returns=returns)

    @property
    def native_flux(self) -> tuple[FloatArray, FloatArray]:
        """Photons per period (cells,) that have the shapes of `energies`, and those of a flat background.

        Input of the native core. With a gate or uneven bins the shapes include the background, and the flat one is 0.
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
        """Photons per period (cells,), inside the gate if there is one."""
        return np.asarray(sum(self.native_flux), dtype=np.float64)

    @property
    def jumps(self) -> bool:
        """Whether the light has steps, which need not lie on the edges of a grid.

        The error is then of second order in the bin width and irregular, so that two grids may agree by chance.
        """
        return self.waveform is not None or isinstance(self.system.pulse, SampledPulse)

    def flux(self, index: int) -> Flux:
        """The light of one cell."""
        if self.waveform is not None:
            wave = self.signal[index] * self.waveform[self.row[index]]
            return Flux(waveform=wave, background=self.background[index])
        return Flux(self.signal[index], self.background[index], self.delay[index] * self.system.period_ns)

    def part(self, index: IndexArray | slice) -> Cells:
        """The selected cells, flat."""
        signal, row = self.signal[index], self.row[index]
        light = signal, self.background[index], self.delay[index]
        return Cells(self.system, signal.shape, *light, self.waveform, row, self.returns, self.follow)

    def resolved(self, out_bins: int) -> Cells:
        """These cells, with bins that follow the pulse where resolving it takes too many equal bins."""
        even = replace(self, follow=0)
        follow = out_bins if followed_bins(even, max(TOL.most_first_bins, out_bins), out_bins) else 0
        return self if follow == self.follow else replace(self, follow=follow)

    def name(self, index: int) -> str:
        """Description of one cell, for errors."""
        where = "waveform" if self.waveform is not None else f"S = {self.signal[index]:g}"
        delay = "" if self.waveform is not None else f", delay = {self.delay[index]:g} periods"
        place = "" if self.size == 1 else f" (cell {index} of {self.size})"
        return (
            f"{where}, B = {self.background[index]:g} photons per period{delay}, "
            f"t_d = {self.system.dead_time_periods:g} periods, {self.system.cycles} cycles{place}"
        )

    @property
    def instead(self) -> str:
        """Advice for the error message of a refused exact law: the alternatives to it."""
        return self.alternatives()

    def alternatives(self, *names: str) -> str:
        """As `instead`, with further alternatives `names`."""
        if self.system.detector.mode == "nonparalyzable" and not rearms_within_pulse(self):
            names = (*names, "joint_law (mean, variance and mean histogram)", "method 'mars' (a Gaussian)")
        return advice(*names)

    @property
    def _sharpness(self) -> float:
        """Integral of the squared shape of the signal over the period, 1 / width, the largest of all cells."""
        if self.waveform is not None:
            return float(self.waveform.shape[-1] * np.max(np.sum(self.waveform**2, -1)))
        probe = 2**14
        energy = self.system.pulse.bin_energy(0.5 * self.system.period_ns, self.system.period_ns, probe)
        return float(probe * np.sum(energy**2))

    @property
    def finest(self) -> float:
        """Standard deviation, in periods, of a Gaussian as narrow as the registrations of the signal.

        In dim light they are as wide as the signal; the first of n photons arrives within about an n-th of this width.
        0 where they begin or end abruptly: with a gate, a synchronous period, or light in samples.
        """
        smooth = self.returns is not None and not isinstance(self.system.pulse, SampledPulse)
        if (self.jumps and not smooth) or self.system.detector.mode in ("gated", "synchronous"):
            return 0.0
        photons = max(float(np.max(self.total, initial=0.0)), 1.0)
        return 1.0 / (2.0 * math.sqrt(math.pi) * max(self._sharpness, 1.0) * photons)

    def first_bins(self, out_bins: int) -> int:
        """Bins of the first grid: `usual_bins`, or more where a narrower pulse must be resolved.

        Where pixels re-arm in the bin of their registration, the samples of a waveform must be resolved: coarser grids
        agree with each other on a mean with a relative error of 1e-4.
        """
        most = max(TOL.most_first_bins, out_bins)
        if self.follow:
            return followed_bins(self, most, out_bins)
        usual, needed = self.usual_bins(out_bins), needed_bins(self, most)
        if self.waveform is not None and self.system.dead_time_periods > 0.0 and _off_whole_periods(self) * usual < 1.0:
            needed = min(self.waveform.shape[-1], most)
        return _multiple(max(usual, needed), out_bins)

    def usual_bins(self, out_bins: int) -> int:
        """Even multiple of `out_bins` whose bins are at most sigma / 2 of pulse or gate wide, at most some 2^14."""
        sharpness = self._sharpness
        gate_width = self.system.detector.gate_periods(self.system.period_ns)[2]
        sharpness = max(sharpness, 1.0 / max(gate_width, 1.0 / TOL.most_first_bins))
        # 1 / sharpness is 2 sqrt(pi) sigma of a Gaussian: a bin is sigma / 2
        wanted = min(max(TOL.first_bins, 4.0 * math.sqrt(math.pi) * sharpness), TOL.most_first_bins)
        return _multiple(wanted, out_bins)

    def edges(self, bins: int) -> FloatArray:
        """Edges (bins + 1,) of the grid of the first cell, periods."""
        return (
            followed_edges(self.part(slice(0, 1)), bins, self.follow)[0] if self.follow else np.arange(bins + 1) / bins
        )

    def grid(self, bins: int, out_bins: int, steps: float | None = None) -> _core.ExposureGrid:
        """The native grid of `bins` bins per period; it gives up after `steps` bins x periods (None: minutes)."""
        whole, shift, fraction = whole_bins(self.system.dead_time_periods, bins)
        return _core.ExposureGrid(
            cycles=self.system.cycles,
            max_periods=max(10_000, int(MOMENTS.one_pass / bins)) if steps is None else max(1, int(steps / bins)),
            whole=whole,
            bins=bins,
            out_bins=out_bins,
            shift=shift,
            fraction=fraction,
            stationary=self.system.start == "stationary",
            tolerance=TOL.repeats,
            warm_periods=min(TOL.warm_periods, max(TOL.least_warm_periods, TOL.warm_steps // bins)),
        )

    def chunks(self, bins: int, out_bins: int) -> Iterator[slice]:
        """Slices of the cells; the energies and histograms of a slice take about 64 MiB."""
        per_cell = 8 * (4 * bins + 2 * out_bins)
        least = 64
        if self.system.detector.mode == "paralyzable":  # kinds x moments of the rate, and arrays to compute them
            per_cell, least = 8 * (40 * bins + 2 * out_bins), 1
        elif self.waveform is None and np.unique(self.delay).size == 1 and not self._all_in_shapes:
            per_cell = 16 * out_bins + 128
        step = max(least, TOL.chunk_bytes // per_cell)
        for start in range(0, self.size, step):
            yield slice(start, min(start + step, self.size))

    def step_cost(self, bins: int) -> float:
        """Cost of one bin and period (1, 2 or 6), relative to that of a pixel whose history fits in the cache."""
        history_bytes = self.grid(bins, 1).bytes
        return 1.0 if history_bytes <= TOL.near_bytes else 2.0 if history_bytes <= TOL.middle_bytes else 6.0

    def check_history(self, bins: int) -> None:
        """Raise MemoryError where the registrations of one dead time do not fit in memory."""
        needed = int(self.grid(bins, 1).bytes)
        if needed > MOMENTS.history:
            raise MemoryError(
                f"exposure statistics of {self.name(0)}: {bins} bins per period need "
                f"{needed / 2**30:.3g} GiB for the registrations of one dead time, at most "
                f"{MOMENTS.history / 2**30:g} GiB are allowed; {self.instead}"
            )

    def energies(self, bins: int) -> tuple[FloatArray, NDArray[np.int32]]:
        """Unit energies (rows, parts of bins) of the distinct signal shapes, and the row of each cell (cells,)."""
        parts = bins * int(_core.EXPOSURE_PARTS)
        if self.follow:
            edges = followed_edges(self, parts, self.follow)
            before = np.concatenate([photons_before(self.part(np.array([k])), row) for k, row in enumerate(edges)])
            return _unit_energies(before), np.arange(self.size, dtype=np.int32)
        if self.system.detector.mode == "gated":
            before = photons_before(self, np.arange(parts + 1) / parts)
            return _unit_energies(before), np.arange(self.size, dtype=np.int32)
        pulse, period = self.system.pulse, self.system.period_ns
        if self.waveform is None:
            delays, rows = np.unique(self.delay, return_inverse=True)
            energy = pulse.bin_energy(delays * period, period, parts)
        elif self.returns is not None:
            used, rows = np.unique(self.row, return_inverse=True)
            fractions, delays = self.returns[:, :, used]
            energy = np.einsum("rk,rkn->kn", fractions, pulse.bin_energy(delays * period, period, parts))
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
    """Smallest even multiple of `out_bins` that is at least `wanted`: half as many bins have its edges too.

    Two grids that have only every second edge of the histogram can agree although both count registrations in a
    neighbouring bin (in one system, 74,000 of 3 million).
    """
    return 2 * out_bins * math.ceil(wanted / (2 * out_bins))


def _unit_energies(before: FloatArray) -> FloatArray:
    """Shares (cells, parts) of the photons of a period, from the photons `before` each edge (cells, parts + 1)."""
    unit = np.diff(before) / np.maximum(before[:, -1:], np.finfo(float).tiny)
    return np.ascontiguousarray(np.maximum(unit, 0.0))


# --- Photons within the period --------------------------------------------------------------------------------------


def photons_before(cells: Cells, edges: FloatArray) -> FloatArray:
    """Photons that reach each cell between the start of the period and `edges` (n,) in [0, 1]: (cells, n).

    Photons outside the detector's gate are not counted.
    """
    if cells.system.detector.mode != "gated":
        return _photons_before(cells, edges)
    total = np.zeros((cells.size, edges.size))
    for low, high in open_parts(cells.system):
        bounded = np.concatenate([[low], np.clip(edges, low, high)])
        inside = _photons_before(cells, bounded)
        total += inside[:, 1:] - inside[:, :1]
    return total


def _photons_before(cells: Cells, edges: FloatArray) -> FloatArray:
    pulse, period, at = cells.system.pulse, cells.system.period_ns, np.concatenate([[0.0], edges])
    if cells.waveform is None:
        energy = pulse.wrapped_cumulative((at - cells.delay[:, None]) * period, period)
        energy = energy[:, 1:] - energy[:, :1]
    elif cells.returns is not None:
        energy = np.zeros((cells.size, edges.size))
        for fraction, delay in zip(*cells.returns[:, :, cells.row], strict=True):
            before = pulse.wrapped_cumulative((at - delay[:, None]) * period, period)
            energy += fraction[:, None] * (before[:, 1:] - before[:, :1])
    else:
        knots = np.linspace(0.0, 1.0, cells.waveform.shape[-1] + 1)
        rows, used = np.unique(cells.row, return_inverse=True)
        below = [np.concatenate([[0.0], np.cumsum(cells.waveform[row])]) for row in rows]
        energy = np.stack([np.interp(edges, knots, b) for b in below])[used.reshape(-1)]
    total = energy  # in place: for a million edges, allocating memory takes longer than the arithmetic
    total *= cells.signal[:, None]
    total += cells.background[:, None] * edges
    return np.maximum(total, 0.0, out=total)


# --- Histograms of very many bins ----------------------------------------------------------------------------------


def fine_histograms(
    cells: Cells, bins: int, tolerance: float, compute: Callable[[Cells, int], FloatArray]
) -> FloatArray:
    """Histograms (cells, bins) of ``compute(cells, bins)``, interpolated from fewer bins within `tolerance`."""
    if bins <= TOL.many_bins:
        return compute(cells, bins)
    return np.concatenate([_fine(cells.part(slice(k, k + 1)), bins, tolerance, compute) for k in range(cells.size)])


def _fine(cell: Cells, bins: int, tolerance: float, compute: Callable[[Cells, int], FloatArray]) -> FloatArray:
    edges = np.arange(bins + 1) / bins
    light = light_before(cell, edges)
    for coarse_bins in TOL.cells_of_many:
        before = light_before(cell, np.arange(coarse_bins + 1) / coarse_bins)
        if before[-1] == 0.0 or misplaced(before, edges, light) > 2.0 * tolerance:
            continue
        counts = compute(cell, coarse_bins)[0]
        fine = np.diff(registered_before(before, counts, light))
        coarse = np.diff(registered_before(before[::2], counts.reshape(-1, 2).sum(-1), light))
        if float(np.abs(fine - coarse).sum()) <= 2.0 * tolerance * float(counts.sum()):
            return fine[None]
    return compute(cell, bins)


def light_before(cell: Cells, edges: FloatArray) -> FloatArray:
    """Photons (n,) that reach the only cell between the start of the period and `edges` (n,); non-decreasing."""
    return np.maximum.accumulate(photons_before(cell, edges)[0])


def misplaced(before: FloatArray, edges: FloatArray, light: FloatArray) -> float:
    """Largest number of photons that a smooth curve through the coarse grid misplaces within one of its bins.

    `before` (m + 1,) are the photons before the edges of m equal bins, `light` (n + 1,) those before `edges`. Within a
    bin the armed probability changes by at most the photons of the bin, so that registrations are displaced by at most
    a quarter of the result, relative to those of the bin. For bins of more than one photon the result is relative to
    the photons of the bin.
    """
    from scipy.interpolate import PchipInterpolator

    grid = np.arange(before.size) / (before.size - 1)
    wrong = 0.5 * np.abs(np.diff(PchipInterpolator(grid, before)(edges)) - np.diff(light))
    inside = np.bincount(np.searchsorted(grid, edges[:-1], "right") - 1, wrong, before.size - 1)
    return float((inside / np.maximum(np.diff(before), 1.0)).max())


def registered_before(before: FloatArray, counts: FloatArray, light: FloatArray) -> FloatArray:
    """Registrations (n,) up to the times at which `light` (n,) photons have arrived.

    A monotone cubic spline (limited slopes) of the registrations as a function of the photons, exact at the edges of
    the m bins with `counts` (m,) registrations and `before` (m + 1,) photons.
    """
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    lit = np.diff(before) > TOL.rounding * before[-1]
    at = np.concatenate([[True], lit])
    at[-1] |= not lit.any()
    total = np.concatenate([[0.0], np.cumsum(counts)])
    photons, so_far = before[at], total[at]
    photons[-1], so_far[-1] = before[-1], total[-1]
    if photons.size < 4:  # too few knots for a cubic
        return np.asarray(np.interp(light, photons, so_far))
    armed = np.maximum(np.diff(so_far) / np.diff(photons), 0.0)
    most = 3.0 * np.minimum(np.append(armed[0], armed), np.append(armed, armed[-1]))
    slope = np.clip(CubicSpline(photons, so_far)(photons, 1), 0.0, most)
    return np.asarray(CubicHermiteSpline(photons, so_far, slope)(light), dtype=np.float64)
