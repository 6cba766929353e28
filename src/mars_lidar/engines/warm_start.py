"""Stationary starts of pixels with twilight pulses: which of them settle before the exposure begins."""

from __future__ import annotations

import math

import numpy as np

from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

MOST_TWILIGHT_PHOTONS = 5.0
"""Photons within `twilight_ns` above which the phase of ticks is remembered for longer than the engines warm up.

A tick, a dead time that ends with a twilight pulse, is followed by another with the probability 1 - e^-photons, so that
phases are remembered for some e^photons ticks: 150 of them at 5, against 256 turns before the exposure (`sequential`).
"""


def check_start(flux: Flux, system: System) -> None:
    """Raise ValueError for a stationary start that twilight pulses keep from settling before the exposure.

    Ticks follow each other on background, or where the same pulses lie in the twilight of the next dead time too: where
    that is a whole number of periods but for less than the twilight.
    """
    period, detector = system.period_ns, system.detector
    if system.start != "stationary" or detector.twilight_ns == 0.0:
        return
    flux = flux.detected(system)
    apart = abs(detector.dead_time_ns / period - round(detector.dead_time_ns / period)) * period
    pulses = math.ceil(detector.twilight_ns / period) if apart < detector.twilight_ns else 0
    photons = flux.background * (detector.twilight_ns / period) + (flux.total - flux.background) * pulses
    worst = float(np.max(photons, initial=0.0))
    if worst > MOST_TWILIGHT_PHOTONS:
        raise ValueError(
            f"start must be 'armed' where more than {MOST_TWILIGHT_PHOTONS:g} photons may arrive within "
            f"detector.twilight_ns of the end of one dead time after another, got 'stationary' with {worst:.3g}: such "
            "a pixel ticks once in every dead time and does not settle; simulate a longer armed exposure and leave out "
            "its beginning"
        )
