"""Stated errors of S and B over Cramér and Rao's bound: ``python -m tests.calibration.light_bound FILE``.

FILE is one of `sweep`. With known dead time and recorded width photons of armed passes are a Poisson process, whose
information on light and delay is the sum of the squared derivatives of its expected counts over these counts.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from mars_lidar.calibration.recording import Clock, free_light
from tests.calibration.photon_by_photon import Truth, photon_by_photon
from tests.calibration.sweep import random_truth

BINS = 4096


def bound(truth: Truth, t: np.ndarray) -> np.ndarray:
    """Least standard errors of B and S by the stream t (n,), delay and width unknown."""
    _, passes = free_light(t, Clock(truth.period), truth.dead, BINS)
    at = np.array([truth.background, truth.signal, truth.delay, np.hypot(truth.width, truth.unit / 12**0.5)])
    edges = np.arange(BINS + 1) / BINS * truth.period

    def light(values: np.ndarray) -> np.ndarray:
        back, signal, delay, width = values
        below = sum(ndtr((edges - delay + turn * truth.period) / width) for turn in (-1, 0, 1))
        return np.asarray(back / BINS + signal * np.diff(below))

    steps = np.diag(1e-4 * np.r_[at[:2], at[3], at[3]])
    slopes = np.array([(light(at + step) - light(at - step)) / (2.0 * step.sum()) for step in steps])
    information = (slopes * passes / np.maximum(light(at), 1e-300)) @ slopes.T
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))[:2]


def main() -> None:
    """The command."""
    ratios = []
    for line in Path(sys.argv[1]).read_text().splitlines():
        row = json.loads(line)
        truth, photons = random_truth(row["number"])
        stated = np.isfinite(np.array(row["errors"], float)).all()
        if row["effect"] or row["asked"] or row.get("range") or not stated or truth.jitter > 0.1 * truth.dead:
            continue
        t, _ = photon_by_photon(truth, photons, row["number"])
        ratios.append(np.array(row["errors"][:2]) / bound(truth, t))
    for name, ratio in zip("BS", np.array(ratios).T, strict=True):
        print(f"{name}: median {np.median(ratio):.2f}, largest {ratio.max():.2f}, {(ratio < 1.3).mean():.0%} below 1.3")
    print(f"{len(ratios)} streams")


if __name__ == "__main__":
    main()
