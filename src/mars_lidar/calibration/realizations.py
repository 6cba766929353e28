"""Distribution of the count in pieces of a recording, beside that of its fitted model (T6 of the MaRS paper)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import NDArray
from mars_lidar.calibration.fit import LIGHTS, Fitted
from mars_lidar.calibration.recording import Recording
from mars_lidar.statistics.pmf import Pmf, kl_divergence, total_variation


@dataclass(frozen=True, eq=False)
class Realizations:
    """Distribution of the count in pieces of the recording, and that of the model (T6 of the MaRS paper).

    `counts` (realizations,); `measured` and `predicted` frequencies; their distances, and those of samples of this size
    from the predicted law: mean and 99 % quantile of the total variation, mean Kullback-Leibler divergence in nats.
    """

    cycles: int
    counts: NDArray[np.int64]
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


def realizations(
    recording: Recording, fit: Fitted, cycles: int, simulated: int, seed: int, resampled: int = 400
) -> Realizations:
    """Counts in pieces of `cycles` periods, and in `simulated` pieces of the model's streams, by their distances."""
    counts = np.concatenate(recording.counts(cycles))
    if counts.size < 20:
        raise ValueError(
            f"cycles must leave at least 20 realizations of a recording of {recording.exposure:,.0f} periods, got "
            f"{cycles:,}: {counts.size}"
        )
    each = -(-simulated // LIGHTS) + 1
    streams = fit.model.streams(np.tile(fit.theta, (LIGHTS, 1)), each * cycles, seed)
    drawn = np.concatenate([row[1:] for row in streams.counts(cycles)])  # the first begins with an armed pixel
    measured, predicted = Pmf.of_counts(counts), Pmf.of_counts(drawn)
    low, high = min(measured.first, predicted.first), max(measured.last, predicted.last)
    law, sample = predicted.on(low, high), measured.on(low, high)
    random = np.random.default_rng(seed)
    floor = []
    for _ in range(resampled):  # two samples of one law: the recording's size and the simulation's
        a = random.multinomial(counts.size, law) / counts.size
        b = random.multinomial(drawn.size, law) / drawn.size
        floor.append((0.5 * np.abs(a - b).sum(), kl_divergence(a, b)))
    variation, divergence = np.array(floor, float).T
    return Realizations(
        cycles,
        counts,
        measured,
        predicted,
        total_variation(measured, predicted),
        (float(variation.mean()), float(np.quantile(variation, 0.99))),
        float(kl_divergence(sample, law)),
        float(divergence.mean()),
    )
