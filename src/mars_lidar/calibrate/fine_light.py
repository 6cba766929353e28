"""The light of a stream without a model of it, as finely as its photons allow."""

from __future__ import annotations

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import Sensitivity, armed_time
from mars_lidar.calibrate.intervals import Stream

_COARSE = 1024
_ENOUGH = 32  # registrations of a bin that is halved


def fine_light(
    stream: Stream, hold_off_ns: float, bins: int, coarse: int | None = None, sensitivity: Sensitivity | None = None
) -> FloatArray:
    """Photons per period (bins,): h / D of `coarse` (1024) bins that are halved where photons abound.

    `bins` are a power of two times `coarse`.

    A pulse much narrower than a bin of the coarsest grid is seen as it is, and faint light does not fall apart into
    single photons.
    """
    seen = armed_time(stream, hold_off_ns, bins, sensitivity)
    number = min(_COARSE if coarse is None else coarse, bins)
    rate, photons = np.zeros(bins), np.full(number, np.inf)
    while True:
        each = bins // number
        h, passes = seen.registrations.reshape(number, each).sum(1), seen.passes.reshape(number, each).mean(1)
        finer = np.where(passes > 0.0, h / np.where(passes > 0.0, passes, 1.0), 0.0) / each
        kept = np.repeat(photons >= _ENOUGH, number // photons.size)
        rate = np.where(np.repeat(kept, each), np.repeat(finer, each), rate)
        if number == bins:
            return rate
        # what was not halved stays as it is
        photons = np.where(kept, h, 0.0)
        number *= 2
