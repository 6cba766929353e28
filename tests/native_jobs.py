"""Jobs for the native core, in laser periods, for the tests that call it without the Python layers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from mars_lidar import _core

PULSE = _core.PulseTable.gaussian(0.00375)


@dataclass(frozen=True)
class Case:
    """A job: flux (returns, pixels) or waveform (pixels, samples), and system."""

    signal: ArrayLike = 1.0
    background: ArrayLike = 1.0
    delay: ArrayLike = 0.5
    waveform: ArrayLike | None = None
    pixel_index: ArrayLike | None = None
    realizations: int = 1
    first_realization: int = 0
    seed: int = 0
    cycles: int = 1000
    bins: int = 64
    dead_time: float = 0.6375
    stationary: bool = False
    pulse: Any = PULSE

    def job(self) -> Any:
        if self.waveform is None:
            signal = np.atleast_2d(np.asarray(self.signal, float))
            wave = None
        else:
            wave = np.ascontiguousarray(np.atleast_2d(np.asarray(self.waveform, float)))
            signal = np.empty((0, len(wave)))
        pixels = signal.shape[1]
        delay = np.asarray(self.delay, float)
        if delay.ndim == 1 and len(signal) > 1:
            delay = delay[:, None]
        delay = np.broadcast_to(delay, signal.shape)
        index = np.arange(pixels) if self.pixel_index is None else self.pixel_index
        return _core.Job(
            signal=np.ascontiguousarray(signal),
            delay=np.ascontiguousarray(delay),
            background=np.ascontiguousarray(np.broadcast_to(np.asarray(self.background, float), pixels)),
            waveform=wave,
            pixel_index=np.asarray(index, np.uint32),
            realizations=self.realizations,
            first_realization=self.first_realization,
            seed=self.seed,
            cycles=self.cycles,
            bins=self.bins,
            dead_time=self.dead_time,
            stationary=self.stationary,
        )

    def change(self, **fields: Any) -> Case:
        return replace(self, **fields)

    def histogram(self, engine: str, *, threads: int = 1, dtype: Any = np.uint32) -> NDArray[Any]:
        """(items, bins); the memory is dirty beforehand, because the engine must fill all of it."""
        job = self.job()
        out = np.full((job.items, self.bins), 7, dtype)
        getattr(_core, f"{engine}_histogram")(job, self.pulse, out, threads, None)
        return out


def gaussian_energy(delay: float, sigma: float, bins: int) -> NDArray[np.float64]:
    """Energy of a wrapped Gaussian pulse per bin (bins,), from SciPy."""
    edges = np.arange(bins + 1) / bins - delay
    return np.diff(sum(stats.norm.cdf((edges + k) / sigma) for k in range(-10, 11)))


def chi_square(observed: ArrayLike, expected: ArrayLike, *, least: float = 20.0) -> float:
    """p-value of independent Poisson counts; neighbours are merged until `least` are expected."""
    obs, exp = np.asarray(observed, float), np.asarray(expected, float)
    group = np.unique(np.floor(np.cumsum(exp) / least), return_inverse=True)[1]
    merged_obs, merged_exp = np.bincount(group, obs), np.bincount(group, exp)
    last = np.flatnonzero(merged_exp > 0)
    keep = last[merged_exp[last] >= 0.5 * least]
    value = np.sum((merged_obs[keep] - merged_exp[keep]) ** 2 / merged_exp[keep])
    return float(stats.chi2.sf(value, keep.size))


def z_to_p(z: ArrayLike) -> NDArray[np.float64]:
    """Two-sided p-values of standard normal scores."""
    return np.asarray(2.0 * stats.norm.sf(np.abs(z)))
