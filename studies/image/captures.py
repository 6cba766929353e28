"""Real captures, thinned to a few photons a pixel, and judged by what all of their photons say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, GaussianPulse, System, reconstruct
from mars_lidar._base.types import FloatArray
from mars_lidar.io import SUFFIXES, Cube, foreign_cube, load

# data/tower.mat of https://github.com/yeruilin/Long-range-single-photon-imaging-over-200-km: photon times, ps, of a
# building at 9.8 km in a window of 200 ns, in 1,500 laser periods; pulse and jitter as its brightest pixels have them
TOWER = System(
    period_ns=200.0, cycles=1500, bins=400, pulse=GaussianPulse(sigma_ns=0.45), detector=Detector(dead_time_ns=0.0)
)
FEWEST = 20.0  # signal photons of a pixel of the whole capture, from which on its depth is taken for true


@dataclass(frozen=True, eq=False)
class Capture:
    """Counts (H, W, bins) of a measured cube, its system; delay, ns, and signal photons of it, and where they are."""

    name: str
    counts: NDArray[np.generic]
    system: System
    delay_ns: FloatArray
    signal: FloatArray
    valid: NDArray[np.bool_]

    def thinned(self, photons: float, seed: int) -> tuple[NDArray[np.int64], float]:
        """Counts of which each photon was kept by chance, so that `photons` of signal remain a pixel; and the share.

        A capture of little light is then as one of less; a pixel that was often dead is not.
        """
        share = min(1.0, photons / float(self.signal[self.valid].mean()))
        return np.random.default_rng(seed).binomial(self.counts.astype(np.int64), share), share


def captures(folder: Path) -> Iterator[Capture]:
    """The first image of each cube in a folder, and of the public file "tower.mat"."""
    for path in sorted(folder.iterdir()):
        if path.name == "tower.mat":
            window = (5180.0, 5380.0)
            cube = foreign_cube(path, TOWER, variable="data_processed", unit_ns=0.001, window_ns=window)
            yield capture(path.stem, cube)
        elif path.suffix in SUFFIXES:
            yield capture(path.stem, load(path))


def capture(name: str, cube: Cube) -> Capture:
    """A cube, with maximum likelihood of all its photons for the truth where these are enough."""
    counts = np.asarray(cube.histogram[0])
    alone = reconstruct(counts, cube.system, threads=1)
    signal = alone.signal * cube.system.cycles * cube.system.detector.detection_efficiency
    return Capture(name, counts, cube.system, alone.delay_ns, signal, alone.detected & (signal > FEWEST))
