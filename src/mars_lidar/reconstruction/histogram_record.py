"""Inputs of the native estimators from a system: dead time on the histogram's bins, pulse, gate."""

import math
from functools import lru_cache

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.instrument.system import System

_CELLS_PER_SIGMA = 32  # Hermite interpolation: energies to 3e-9
_CELLS_PER_PERIOD = 4096  # of a pulse that is wider than the period; most of a sampled pulse
_CELLS_PER_SAMPLE = 16  # at most: the interpolation rounds the edge of a sample over one cell
_OUTSIDE_CORE = 0.0015  # of the energy on either side of the window in which the signal is counted: 3 sigma


@lru_cache(maxsize=16)
def recording_of(system: System, *, longer: float = 1.0, wider: float = 1.0) -> _core.HistogramRecord:
    """The native form of a system without a moving gate; times in laser periods.

    Its dead time is multiplied by `longer`, the width of its pulse by `wider`.
    """
    from mars_lidar.statistics.cells import whole_bins

    # a pulse that is wider by a factor looks, in units of the period, like this one in a period shorter by it
    low, cell, energy, slope = _curve(system.pulse, system.period_ns / wider)
    peak = low + cell * (int(np.argmax(np.diff(energy))) + 0.5)
    core = core_ns(system)
    sharpness = float(np.sum(np.diff(energy) ** 2)) / cell  # integral of s^2
    whole, shift, fraction = whole_bins(longer * system.dead_time_periods, system.bins)
    open_low, open_high = open_bins(system)
    return _core.HistogramRecord(
        bins=system.bins,
        cycles=system.cycles,
        whole=whole,
        shift=shift,
        fraction=fraction,
        stationary=system.start == "stationary",
        synchronous=system.detector.mode == "synchronous",
        pulse_low=low,
        pulse_cell=cell,
        energy=energy,
        slope=slope,
        peak=0.0 if isinstance(system.pulse, GaussianPulse) else peak,
        width=pulse_width(sharpness),
        core_low=core[0] / system.period_ns,
        core_high=core[1] / system.period_ns,
        sample=system.pulse.bin_ns / system.period_ns * wider if isinstance(system.pulse, SampledPulse) else 0.0,
        open_low=open_low,
        open_high=open_high,
    )


def pulse_width(sharpness: float) -> float:
    """Sigma of the Gaussian whose density s has the integral `sharpness` of s^2, in the reciprocal unit."""
    return 1.0 / (2.0 * math.sqrt(math.pi) * sharpness)


def check_window(what: str, system: System) -> None:
    """Raise ValueError if the window of the signal leaves no bins for the background."""
    low, high = core_ns(system)
    most = 0.75 * system.detector.gate_periods(system.period_ns)[2] * system.period_ns
    if high - low > most:
        raise ValueError(
            f"method {what!r} takes the background from outside of the pulse, which lasts {high - low:.4g} ns, more "
            f"than {most:.4g} ns (three quarters of the period or the gate); use 'maximum_likelihood'"
        )


def relative_width(system: System) -> float:
    """Width of the pulse, `pulse_width`, in laser periods."""
    _, cell, energy, _ = _curve(system.pulse, system.period_ns)
    return pulse_width(float(np.sum(np.diff(energy) ** 2)) / cell)


def core_ns(system: System) -> tuple[float, float]:
    """The interval around the delay in which signal is counted: all but 0.15 % of the pulse on either side."""
    low, high = system.pulse.support_ns()
    x = np.linspace(low, high, _CELLS_PER_PERIOD + 1)
    ends = np.interp([_OUTSIDE_CORE, 1.0 - _OUTSIDE_CORE], system.pulse.cumulative(x), x)
    return float(ends[0]), float(ends[1])


def _curve(pulse: Pulse, period: float) -> tuple[float, float, FloatArray, FloatArray]:
    """First knot relative to the delay, distance of knots, energy below each and density there; in periods."""
    low, high = pulse.support_ns()
    if isinstance(pulse, GaussianPulse) and high - low < period:
        cells = math.ceil((high - low) / pulse.sigma_ns * _CELLS_PER_SIGMA)
        x = np.linspace(low, high, cells + 1)
        density = np.exp(-0.5 * (x / pulse.sigma_ns) ** 2) / (math.sqrt(2.0 * math.pi) * pulse.sigma_ns)
        return low / period, (high - low) / cells / period, _unit(pulse.cumulative(x)), density * period
    if isinstance(pulse, SampledPulse):  # linear between the edges of samples; smooth and monotone through them here
        samples = round((high - low) / pulse.bin_ns)
        each = max(1, min(_CELLS_PER_SAMPLE, _CELLS_PER_PERIOD // samples))
        cells, width = samples * each, pulse.bin_ns / each
        energy = _unit(pulse.cumulative(low + width * np.arange(cells + 1)))
        cell = width / period
        return low / period, cell, energy, _monotone_slopes(energy, cell)
    x = low + period * np.arange(_CELLS_PER_PERIOD + 1) / _CELLS_PER_PERIOD
    before = pulse.wrapped_cumulative(x, period)
    energy = _unit(before - before[0])
    return low / period, 1.0 / _CELLS_PER_PERIOD, energy, _monotone_slopes(energy, 1.0 / _CELLS_PER_PERIOD)


def _unit(energy: FloatArray) -> FloatArray:
    """Cumulative energies that are exactly 0 at the first knot and 1 at the last: no energy lies outside of them."""
    energy = np.clip(energy, 0.0, 1.0)
    energy[0], energy[-1] = 0.0, 1.0
    return energy


def _monotone_slopes(energy: FloatArray, cell: float) -> FloatArray:
    """Derivatives for which the cubic interpolation stays monotone (Fritsch and Butland, 1984)."""
    from scipy.interpolate import PchipInterpolator

    if energy.size < 3:
        return np.diff(energy).repeat(2) / cell
    knots = cell * np.arange(energy.size)
    return np.ascontiguousarray(PchipInterpolator(knots, energy).derivative()(knots), dtype=np.float64)


def open_bins(system: System) -> tuple[FloatArray, FloatArray]:
    """The open part [low, high) of each bin, in periods; empty arrays without a gate."""
    if system.detector.mode != "gated":
        return np.empty(0), np.empty(0)
    from mars_lidar.statistics.cells import open_parts

    bins = system.bins
    edges = np.arange(bins + 1) / bins
    low, high = edges[:-1].copy(), edges[:-1].copy()
    for start, end in open_parts(system):
        a, b = np.clip(start, edges[:-1], edges[1:]), np.clip(end, edges[:-1], edges[1:])
        here = b > a
        if (here & (high > low)).any():
            raise ValueError(
                "gate_width_ns must leave at least one bin edge outside of the gate for reconstruction: the closed "
                f"part of the period lies inside one bin of {system.bin_ns:g} ns"
            )
        low[here], high[here] = a[here], b[here]
    return low, high
