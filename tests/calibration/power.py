"""How clearly an effect can show in the counts of 100,000 photons: ``python -m tests.calibration.power recovery``.

The model without the effect is fitted to a long stream of the independent simulator. The square by which its counts are
off that fit, beyond that of streams of the fit, is proportional to the photons: its root is the largest number of
standard deviations that a test of these counts can have, beside the parameters that take up the rest.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from mars_lidar.calibration.calibration import Calibration, _Run
from mars_lidar.calibration.look import look_at
from mars_lidar.calibration.model import Model
from mars_lidar.calibration.recording import recording_of
from tests.calibration.photon_by_photon import as_timestamps, photon_by_photon
from tests.calibration.sweep import EFFECTS, ORDINARY, with_effect


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("effect", choices=EFFECTS)
    parser.add_argument("--jitter", type=float, default=ORDINARY.jitter)
    parser.add_argument("--photons", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    truth = replace(with_effect(ORDINARY, asked.effect), jitter=asked.jitter)
    t, cycles = photon_by_photon(truth, asked.photons, asked.seed)
    recording = recording_of(as_timestamps(t, truth, cycles))
    described, model = Calibration(look_at(recording), recording), Model(recording.clock, 1)
    _, fitted = _Run(described, model, {}, asked.seed).first()
    used = fitted.batch.common
    weight = fitted.batch.weight[np.ix_(used, used)]
    own, drawn = fitted.rest[used], fitted.fresh[:, used]
    excess = own @ weight @ own - np.einsum("ki,ij,kj->k", drawn, weight, drawn).mean()
    print(
        f"{asked.effect}, jitter {asked.jitter} ns: {(max(excess, 0.0) * 1e5 / t.size) ** 0.5:.1f} standard deviations"
    )


if __name__ == "__main__":
    main()
