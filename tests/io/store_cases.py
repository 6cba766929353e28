"""The small system and flux that the tests of files share."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import make_system
from PIL import Image

import mars_lidar as ml

SUFFIXES = (".zarr", ".h5", ".npz")
PTU = pytest.param(
    ".ptu",
    marks=pytest.mark.skipif(importlib.util.find_spec("ptufile") is None, reason="ptufile (extra io) is not installed"),
)

SYSTEM = make_system(30.0, 60, 64)


def one_return(height: int = 6, width: int = 5) -> ml.Flux:
    rng = np.random.default_rng(1)
    s = rng.uniform(0.2, 2.0, (height, width))
    tau = rng.uniform(0.0, 100.0, (height, width))
    s[1, 2], tau[1, 2] = 0.0, np.nan  # no return
    info = {"made": "by hand", "sbr": np.float64(2.5)}
    return ml.Flux(s, rng.uniform(0.0, 1.0, (height, width)), tau, info=info)


def several_returns() -> ml.Flux:
    return ml.Flux.multi(one_return(), ml.Flux(0.3, 0.1, 70.0), ml.Flux(0.1, 0.0, 99.9))


def waveform() -> ml.Flux:
    return ml.Flux(waveform=np.random.default_rng(2).uniform(0.0, 0.05, (6, 5, 40)), background=0.2)


def png(path: Path, array: Any) -> Path:
    """A picture of any format."""
    Image.fromarray(np.asarray(array)).save(path)
    return path
