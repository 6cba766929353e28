"""The internal grid of the feedback engine: how narrow its cells must be, and where."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

MOST_CELLS = 2**16  # of a period; beyond, the memory of a batch leaves every cache
_ERROR, _ERROR_AFTER, _ERROR_ECHO, _ERROR_DARK = 1.1e-3, 0.03, 0.022, 0.03  # see cell_cuts
_GOAL, _GOAL_ECHO = 0.05, 0.02
_SIGMAS = 5.0  # of a pulse that counts as one that is met
_TAIL = 1e-6  # energy of a pulse outside of what is cut finely


Cuts = tuple[NDArray[np.int64], NDArray[np.int64]]


class Echo(NamedTuple):
    """Pixels (H, W) that are armed again near a return, one dead time after the same or another one."""

    within: NDArray[np.bool_]  # within 5 sigma of it
    remembered: NDArray[np.bool_]  # these, but for dead times that end within the pulse that they began in
    near: NDArray[np.bool_]  # within the whole extent of the pulse
    late: NDArray[np.bool_]  # the same, after the middle of the return


def meets_echo(flux: Flux, system: System) -> Echo:
    """Which pixels are armed again within a return after another one, or the same one, has blinded them.

    Where the dead time ends within the pulse that it began in, nothing is remembered from period to period.
    """
    within, remembered, near, late = np.zeros((4, *flux.shape), dtype=np.bool_)
    reach = _SIGMAS * pulse_sigma(system) / system.period_ns
    low, high = _extent(system)
    lit = flux.returns_signal > 0
    delay = np.where(lit, flux.returns_delay_ns, 0.0) / system.period_ns
    for i, j in np.ndindex(len(lit), len(lit)):
        apart = delay[i] - delay[j] + system.dead_time_periods
        after = np.where(lit[i] & lit[j], apart - np.rint(apart), np.inf)
        distance = np.abs(after)
        within |= distance < reach
        near |= distance < max(high - low, reach)
        late |= (after >= 0.0) & (after < high - low)
        if i != j or round(system.dead_time_periods) > 0:
            remembered |= distance < reach
    return Echo(within, remembered, near, late)


def cell_cuts(flux: Flux, system: System) -> Cuts:
    """Parts (H, W) that a bin of the histogram is cut into, and that these are cut into again near the pulse.

    The grid's error of a bin's mean is about c (width / sigma)^2 of its standard deviation for one period, and
    grows as the root of the number of periods. c = 1.1e-3 S up to S = 4 (measured against 16 times finer grids); one
    dead time after the pulse 0.03 S sqrt(B / bins), where re-arming is interpolated within cells: an eighth of the
    slope of the pulse, seen by a bin's background; 0.022 S, of any S, where a pulse meets its own echo: a pixel that is
    armed again within the pulse registers and re-arms within 1 / S of its width. Cells are narrow enough
    for 1/20 of a standard deviation (1/50 with an echo, which shifts many bins alike), at most 0.3 sigma wide, 0.15
    above 5 signal photons, and at most a quarter of the dead time.

    A single return apart from its echo needs them only within its extent and one dead time after it (`near_pulse`).
    Elsewhere the armed bend only by those whom the modulated background of the echo has blinded, c = 0.03 B width
    sqrt(B / bins), more where a bright pulse leaves few armed: e^(S / 2), S up to 4. Such cells are at most one
    sigma wide.
    """
    ones = np.ones(flux.shape, dtype=np.int64)
    if system.dead_time_periods == 0.0:  # independent bins
        return ones, ones
    widest = np.full(flux.shape, min(1.0, 0.25 * system.dead_time_periods))
    if flux.waveform is not None:
        return _waveform_cuts(flux, system, widest), ones
    sigma = pulse_sigma(system) / system.period_ns
    echo = meets_echo(flux, system)
    periods = math.sqrt(system.cycles)
    after = np.maximum(_ERROR, _ERROR_AFTER * np.sqrt(flux.background / system.bins))
    signal = np.maximum(flux.signal, 1e-3)
    within = echo.within | (echo.late & (signal > 4.0))  # bright pulses register in their early tail
    error = np.where(within, _ERROR_ECHO * signal, after * np.minimum(signal, 4.0)) * periods
    goal = np.where(within, _GOAL_ECHO, _GOAL)
    finest = np.minimum(widest, sigma * np.minimum(np.where(flux.signal > 5, 0.15, 0.3), np.sqrt(goal / error)))
    # goal = _ERROR_DARK B width sqrt(B / bins) (width / sigma)^2 sqrt(N_r) e^(S / 2)
    few_armed = np.exp(0.5 * np.minimum(flux.signal, 4.0))
    dim = np.maximum(flux.background, 1e-9) ** 1.5 * few_armed
    dark = np.cbrt(_GOAL * sigma**2 * math.sqrt(system.bins) / (_ERROR_DARK * periods * dim))
    single = ((flux.returns_signal > 0).sum(0) == 1) & ~echo.near
    base = np.where(single, np.minimum(widest, np.minimum(sigma, dark)), finest)
    base = np.where(flux.signal > 0, base, widest)
    merge = _cuts(base, 1.0 / system.bins)
    return merge, np.where(single, _cuts(finest, 1.0 / (system.bins * merge)), 1)


def _waveform_cuts(flux: Flux, system: System, widest: NDArray[np.float64]) -> NDArray[np.int64]:
    """Parts (H, W) that a bin is cut into, for a rate that is constant on parts of the period.

    Cells of width w are crossed by the edges of parts, and re-arm those of the part one dead time before, whose rate
    falls within it as its photons are used up. Where the photons of parts differ by J, and one has l, this puts
    J (1 + l) N_r / 8 (w / part)^2 exposures wrong at the edges of a cell one dead time on, where m photons a part see
    them: an error of J (1 + l) sqrt(N_r m) / 8 standard deviations, for w as wide as a part, second order in w.
    Smooth light needs no cuts. Edges of cells are those of parts where bins and parts allow it within twice as many
    cells.
    """
    assert flux.waveform is not None
    parts = flux.waveform.shape[-1]
    later = system.dead_time_periods % 1.0 * parts
    worst = np.empty(flux.shape)
    for row, photons in enumerate(flux.waveform):  # a row of the image at a time: waveforms may be large
        rate = photons + flux.background[row, :, None] / parts
        step = np.abs(rate - np.roll(rate, 1, -1))
        uneven = np.maximum(step, np.roll(step, -1, -1)) * (1.0 + rate)
        seen = rate
        for shift in range(math.floor(later) - 1, math.ceil(later) + 2):
            seen = np.maximum(seen, np.roll(rate, -shift, -1))
        worst[row] = (uneven * np.sqrt(seen)).max(-1)
    worst *= math.sqrt(system.cycles) / 8.0
    width = np.minimum(1.0, np.sqrt(_GOAL_ECHO / np.maximum(worst, 1e-30))) / parts
    merge = _cuts(np.minimum(widest, width), 1.0 / system.bins)
    aligned = parts // math.gcd(parts, system.bins)
    rounded = -(-merge // aligned) * aligned
    return np.where(rounded <= 2 * merge, rounded, merge)


def _cuts(finest: NDArray[np.float64], width: float | NDArray[np.float64]) -> NDArray[np.int64]:
    return np.asarray(np.maximum(np.ceil(width / finest - 1e-9), 1.0), dtype=np.int64)


def near_pulse(system: System, merge: int) -> NDArray[np.uint8]:
    """Base cells (bins * merge) that are cut again: within the pulse, and one dead time after it.

    The period begins half a period before the bin of the return.
    """
    cells = system.bins * merge
    low, high = _extent(system)
    first, last = system.bins // 2 * merge + low * cells, (system.bins // 2 + 1) * merge + high * cells
    found = np.zeros(cells, dtype=np.uint8)
    for after in (0.0, system.dead_time_periods % 1.0 * cells):
        begin, end = math.floor(first + after), math.ceil(last + after)
        found[np.arange(begin, min(end, begin + cells)) % cells] = 1
    return found


def internal_cells(flux: Flux, system: System, cuts: Cuts | None = None) -> NDArray[np.int64]:
    """Cells (H, W) of the period on which the sweeps run; `cuts` are those of `cell_cuts`."""
    merge, parts = cell_cuts(flux, system) if cuts is None else cuts
    cells = merge * system.bins
    for factor in np.unique(merge[parts > 1]):
        if factor * system.bins <= MOST_CELLS:  # else refused whatever the pulse needs
            more = int(near_pulse(system, int(factor)).sum())
            cells = np.where(merge == factor, cells + (parts - 1) * more, cells)
    return cells


def pulse_sigma(system: System) -> float:
    """Width of the pulse, as the standard deviation of the Gaussian of the same energy concentration, ns."""
    if isinstance(system.pulse, GaussianPulse):
        return system.pulse.sigma_ns
    edges, energy = _energies(system)
    return float((edges[1] - edges[0]) / np.sum(energy**2) / (2.0 * math.sqrt(math.pi)))


def _extent(system: System) -> tuple[float, float]:
    """Beginning and end of the pulse about its delay, in periods, but for a millionth of its energy at either end."""
    edges, energy = _energies(system)
    below = np.concatenate([[0.0], np.cumsum(energy)])
    first = np.searchsorted(below, _TAIL, side="right") - 1
    last = np.searchsorted(below, below[-1] - _TAIL)
    return float(edges[first]) / system.period_ns, float(edges[last]) / system.period_ns


def _energies(system: System) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = system.pulse.support_ns()
    edges = np.linspace(low, high, 4097)
    return edges, np.diff(system.pulse.cumulative(edges))
