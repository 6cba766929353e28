"""Jobs for the native core, in laser periods, for the tests that call it without the Python layers."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from mars_lidar import _core
from mars_lidar.engines.pixels import Alignment

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

    def change(self, **fields: Any) -> "Case":
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


def shape_job(
    shapes: NDArray[np.float32],
    pixels: int,
    realizations: int = 1,
    seed: int = 1,
    rows: Any = None,
    weights: Any = None,
) -> Any:
    """A job for the sampler of shapes (rows, bins); every pixel has the first one unless `rows` and `weights` say."""
    return _core.ShapeJob(
        shapes=shapes,
        rows=np.zeros((pixels, 4), np.int64) if rows is None else rows,
        weights=np.tile([1.0, 0.0, 0.0, 0.0], (pixels, 1)) if weights is None else weights,
        pixel_index=np.arange(pixels, dtype=np.uint32),
        place=np.arange(pixels),
        image=pixels,
        realizations=realizations,
        first_realization=0,
        seed=seed,
    )


def align(job: Any, move: Alignment, dead_time: float) -> None:
    """Move the job's shapes to their pixels' delays."""
    job.align(
        shift=move.shift,
        signal=move.signal,
        background=move.background,
        rate=move.rate,
        dead_time=dead_time,
        first=move.frame.first,
        cells=move.frame.cells,
        energy=move.frame.energy,
    )
