"""Configuration of the study "reconstruction": instruments, levels of light, and what its picture shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar import Detector, Reconstruction
from studies.common.sample import system_of

SEED = 9
SBR = 1.0
OUTLIER_SIGMAS = 4.0  # of the pulse: further off the pulse itself was missed
_DEAD_NS = 75.0
KNOWN = 10.0  # %, of S: a bound above it is not reached by any estimate (section "Near the bound")
BRIGHT = 3.0  # mean signal photons per period of the picture
PLAIN = system_of(_DEAD_NS, 1000)
SYNCHRONOUS = PLAIN.replace(detector=Detector(dead_time_ns=0.0, mode="synchronous"))


@dataclass(frozen=True)
class Settings:
    """Levels of signal photons per period, pixels at each, side of the picture's image."""

    signals: tuple[float, ...]
    pixels: int
    size: int


FULL = Settings(tuple(float(s) for s in np.geomspace(0.003, 10.0, 15)), 1000, 48)
QUICK = Settings((0.03, 0.3, 3.0), 100, 24)


@dataclass(frozen=True, eq=False)
class Picture:
    """A bright room: true depth (H, W), m, and what two methods make of it."""

    depth_m: Any
    signal: Any
    estimates: dict[str, Reconstruction]
