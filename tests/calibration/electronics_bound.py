"""What any test of intervals and phases can say of electronics of 1.2 dead times.

``python -m tests.calibration.electronics_bound``

Streams of a detector of 50 ns behind electronics of 60 ns, and of a detector of 60 ns, are counted in fine cells of
(interval, phase at its begin); the chi-square between both, less what light, pulse, jitter and dead time can take up
and less the noise of the simulation, grows with the photons and is the square of the largest score.
"""

from __future__ import annotations

import numpy as np

from mars_lidar.calibration.model import Effect, Model, effects
from mars_lidar.calibration.recording import Clock

AT = np.array([0.15, 0.4, 30.0, 0.316, 0.322, 60.0])  # B, S, delay, recorded width, angle of the jitter, dead time
STEPS = np.array([0.01, 0.02, 0.05, 0.03, 0.1, 0.1])
GAPS = np.r_[59.5, 60.2, 61, 63, 66, 70:121:5, 130:161:10, 180, 200, 230, 260, 300, 400, 600, 1e9]
PHASES = np.r_[0:26:5, 28, 29.3, 29.7, 30.0, 30.3, 30.7, 32, 35:101:5]


def counts(at: np.ndarray, seed: int, *more: Effect) -> tuple[np.ndarray, int]:
    """Fine cells of 3.2 million periods, and their photons."""
    model = Model(Clock(100.0, 0.064, 0.5, locked=True), 1, effects=more)
    streams = list(model.streams(np.tile(at, (16, 1)), 200_000, seed))
    tables = [np.histogram2d(np.diff(t), t[:-1] % 100.0, [GAPS, PHASES])[0] for t in streams]
    return np.sum(tables, axis=0).ravel(), sum(t.size for t in streams)


def main() -> None:
    """The command."""
    electronics = next(effect for effect in effects(60.0) if effect.names[0] == "electronics_excess")
    with_them, photons = counts(np.r_[AT, 0.2], 1, electronics)
    without, _ = counts(AT, 2)
    slopes = []
    for k, step in enumerate(STEPS):
        more = np.eye(AT.size)[k] * step
        slopes.append((counts(AT + more, 10 + k)[0] - counts(AT - more, 20 + k)[0]) / 2.0)
    used = without > 50
    change, root = (with_them - without)[used], np.sqrt(without[used])
    jacobian = np.array(slopes).T[used] / root[:, None]
    taken_up, *_ = np.linalg.lstsq(jacobian, change / root, rcond=None)
    square = float(((change / root - jacobian @ taken_up) ** 2).sum()) - 2.0 * used.sum()
    score = np.sqrt(max(square, 0.0) * 1e5 / photons)
    print(f"{photons:,} photons, {used.sum()} cells: {score:.2f} standard deviations at 100,000 photons")


if __name__ == "__main__":
    main()
