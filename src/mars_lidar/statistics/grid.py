"""Flux of one pixel on the statistics grid, which is not the histogram: photons per bin and period."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cell_input import MAX_PHOTONS

_MAX_BINS = 2**20
_MAX_COMMON = 2**14
_MIN_BINS = 512  # below it the chain's own discretisation shows in the count variance
_BINS_PER_WIDTH = 7.5  # of the equivalent width 1 / max s, 2.507 sigma for a Gaussian: a third of sigma


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
    wanted = max(_MIN_BINS, _BINS_PER_WIDTH * peak * probe)
    return min(system.bins * math.ceil(wanted / system.bins), max(system.bins, _MAX_BINS))


def _bins_for_waveform(samples: int, bins: int) -> int:
    """A multiple of the histogram's bins, and of the samples where that is not too many."""
    common = math.lcm(samples, bins)
    step = common if common <= _MAX_COMMON else bins
    return step * math.ceil(max(_MIN_BINS, samples) / step)


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
