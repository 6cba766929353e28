"""The small system and flux that the tests of files share."""

from __future__ import annotations

import numpy as np
from harness import make_system

import mars_lidar as ml

SUFFIXES = (".zarr", ".h5", ".npz")

SYSTEM = make_system(30.0, 60, 64)


def one_return(height: int = 6, width: int = 5) -> ml.Flux:
    rng = np.random.default_rng(1)
    s = rng.uniform(0.2, 2.0, (height, width))
    tau = rng.uniform(0.0, 100.0, (height, width))
    s[1, 2], tau[1, 2] = 0.0, np.nan  # no return
    info = {"made": "by hand", "sbr": np.float64(2.5)}
    return ml.Flux(s, rng.uniform(0.0, 1.0, (height, width)), tau, info=info)
