"""Histograms of a calibrated recording and of its model, and the distribution of the count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.fit import LIGHTS, Effort, Fitted
from mars_lidar.calibration.recording import Recording
from mars_lidar.statistics.pmf import Pmf, kl_divergence, total_variation

_RATIO = 4.0  # photons of the model's streams over those of the recording


@dataclass(frozen=True, eq=False)
class Curves:
    """Histograms of intervals (200,) and phases (256,), of the recording and of the fitted model.

    `recovery` (60,): residuals of the intervals near the dead time, in standard deviations; NaN below 3 counts.
    """

    interval_edges_ns: FloatArray
    intervals: FloatArray
    fitted_intervals: FloatArray | None
    phase_edges_ns: FloatArray
    phases: FloatArray
    fitted_phases: FloatArray | None
    recovery_edges_ns: FloatArray
    recovery: FloatArray | None


@dataclass(frozen=True, eq=False)
class Realizations:
    """Distribution of the count in pieces of the recording, and that of the model (T6 of the MaRS paper).

    `counts` (realizations,); `measured` and `predicted` frequencies; their distances, and those of samples of this size
    from the predicted law: mean and 99 % quantile of the total variation, mean Kullback-Leibler divergence in nats.
    """

    cycles: int
    counts: FloatArray
    measured: Pmf
    predicted: Pmf
    total_variation: float
    total_variation_floor: tuple[float, float]
    kl: float
    kl_floor: float

    def __str__(self) -> str:
        mean, high = self.total_variation_floor
        return (
            f"{self.counts.size:,} realizations of {self.cycles:,} periods, {self.counts.mean():.6g} counts each: "
            f"total variation {self.total_variation:.4g}, sampling floor {mean:.4g} (99 %: {high:.4g}); "
            f"KL {self.kl:.4g} nats, floor {self.kl_floor:.4g}"
        )


def curves(recording: Recording, fit: Fitted | None, seed: int, sizes: tuple[int, int, int]) -> Curves:
    """Histograms of intervals, phases and ages in `sizes` cells, and those of the model, if it is fitted."""
    period, unit = recording.period_ns, recording.clock.unit_ns

    def counted(times: list[FloatArray], edges: list[FloatArray]) -> list[FloatArray]:
        """Counts of intervals, phases and intervals again, in the cells of each."""
        gaps = np.concatenate([np.diff(t) for t in times])
        phase = np.concatenate([t - np.floor(t / period) * period for t in times])
        return [np.histogram(x, at)[0].astype(float) for x, at in zip((gaps, phase, gaps), edges, strict=True)]

    gaps = np.concatenate([np.diff(piece) for piece in recording.pieces])
    low, high, top = np.quantile(gaps, (0.0005, 0.5, 0.99))
    ages = _edges(max(low - 0.1 * (high - low), 0.0), high + (high - low), sizes[2], unit)
    edges = [_edges(0.0, 1.05 * top, sizes[0], unit), np.linspace(0.0, period, sizes[1] + 1), ages]
    recorded, fitted, residual = counted(list(recording.pieces), edges), None, None
    if fit is not None:
        total = min(_RATIO * recording.photons, Effort.batch)
        cycles = max(2, round(recording.exposure * total / recording.photons / LIGHTS))
        scale = recording.exposure / (cycles * LIGHTS)
        streams = fit.model.streams(np.tile(fit.theta, (LIGHTS, 1)), cycles, seed)
        fitted = [scale * counts for counts in counted(list(streams), edges)]
        residual = (recorded[2] - fitted[2]) / np.sqrt(np.maximum(fitted[2], 1.0) * (1.0 + scale))
        residual[fitted[2] < 3.0] = np.nan
    intervals, phases = (fitted[0], fitted[1]) if fitted else (None, None)
    return Curves(edges[0], recorded[0], intervals, edges[1], recorded[1], phases, ages, residual)


def _edges(low: float, high: float, number: int, unit: float) -> FloatArray:
    """Edges of cells, between the units of a clock."""
    edges = np.linspace(low, high, number + 1)
    if unit == 0.0:
        return edges
    whole = np.unique((np.floor(edges / unit) + 0.5) * unit)
    return np.asarray(whole if whole.size > 2 else np.array([-0.5, 0.5, 1.5]) * unit)


def realizations(
    recording: Recording, fit: Fitted, cycles: int, simulated: int, seed: int, resampled: int = 400
) -> Realizations:
    """Counts in pieces of `cycles` periods, and in `simulated` pieces of the model's streams, by their distances."""
    length = cycles * recording.period_ns

    def cut(t: FloatArray, end: float) -> FloatArray:
        number = int(end // length)
        return np.diff(np.searchsorted(t, np.arange(number + 1) * length))

    counts = np.concatenate(
        [cut(piece, own * recording.period_ns) for piece, own in zip(recording.pieces, recording.cycles, strict=True)]
    )
    if counts.size < 20:
        raise ValueError(
            f"cycles must leave at least 20 realizations of a recording of {recording.exposure:,.0f} periods, got "
            f"{cycles:,}: {counts.size}"
        )
    each = -(-simulated // LIGHTS) + 1
    streams = fit.model.streams(np.tile(fit.theta, (LIGHTS, 1)), each * cycles, seed)
    drawn = np.concatenate([cut(t, each * length)[1:] for t in streams])  # the first begins with an armed pixel
    low, high = int(min(counts.min(), drawn.min())), int(max(counts.max(), drawn.max()))
    measured, predicted = Pmf.of_counts(counts), Pmf.of_counts(drawn)
    law, sample = predicted.on(low, high), measured.on(low, high)
    random = np.random.default_rng(seed)
    floor = []
    for _ in range(resampled):  # two samples of one law: the recording's size and the simulation's
        a = random.multinomial(counts.size, law) / counts.size
        b = random.multinomial(drawn.size, law) / drawn.size
        floor.append((0.5 * np.abs(a - b).sum(), float(kl_divergence(a[None], b)[0])))
    variation, divergence = np.array(floor).T
    finite = divergence[np.isfinite(divergence)]
    return Realizations(
        cycles,
        counts,
        measured,
        predicted,
        total_variation(measured, predicted),
        (float(variation.mean()), float(np.quantile(variation, 0.99))),
        float(kl_divergence(sample[None], law)[0]),
        float(finite.mean()) if finite.size else float("nan"),
    )
