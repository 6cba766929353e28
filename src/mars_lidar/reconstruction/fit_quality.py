"""Goodness of fit of reconstructed pixels: agreement of each histogram with the law of its estimate.

`native/reconstruct/fit_quality.h` computes the statistics of each pixel: docs/theory_reconstruction.md, section 8.
"""

import math
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histogram_record import recording_of, relative_width

FALSE_ALARM = 1e-3  # of `Flags.MISFIT`, a pixel
COLUMNS = 8  # of the native statistics of a pixel
_DEAD_TIME = 1.2  # factor of the dead times, longer and shorter, ...
_WIDTH = 1.1  # ... and of the pulse whose score is computed, ...
_BIN = 0.5  # ... which has the width of so much of a bin in addition: less cannot be seen


def tested_recordings(system: System) -> list[_core.HistogramRecord]:
    """The changes for which scores are computed (longer, shorter, wider); none if armed passes do not follow.

    They follow for a free-running detector without a gate in an exposure much longer than its dead time.
    """
    if system.detector.mode != "nonparalyzable" or system.cycles <= 4.0 * max(1.0, system.dead_time_periods):
        return []
    return [
        recording_of(system, longer=_DEAD_TIME),
        recording_of(system, longer=1.0 / _DEAD_TIME),
        recording_of(system, wider=math.hypot(_WIDTH, _BIN / (system.bins * relative_width(system)))),
    ]


@dataclass(frozen=True, eq=False)
class Quality:
    """Four tests of each pixel (pixels,) and their combined p-value; NaN for too few photons.

    `chi2` of pooled cells, scaled to the law of `freedom` degrees; `longer`, `shorter` and `wider` in standard
    deviations: positive if a longer dead time, a shorter dead time or a wider pulse fits better.
    """

    chi2: FloatArray
    freedom: FloatArray
    longer: FloatArray
    shorter: FloatArray
    wider: FloatArray
    p_value: FloatArray


def quality_of(statistics: FloatArray) -> Quality:
    """From the native statistics (pixels, 8)."""
    from scipy.special import gammaincc

    chi2, freedom, longer, shorter, wider, *skewness = np.ascontiguousarray(statistics.T)
    sides = [law_above(-wider, -skewness[2]), law_above(wider, skewness[2])]
    scores = [
        np.minimum(2.0 * np.minimum(*sides), 1.0),
        law_above(longer, skewness[0]),
        law_above(shorter, skewness[1]),
    ]
    each = np.stack([gammaincc(0.5 * freedom, 0.5 * chi2), *scores])
    tests = (~np.isnan(each)).sum(0)
    least = np.where(np.isnan(each), np.inf, each).min(0)
    p_value = np.where(np.isnan(chi2), np.nan, -np.expm1(tests * np.log1p(-np.minimum(least, 1.0 - 2.0**-53))))
    return Quality(chi2, freedom, longer, shorter, wider, p_value)


def law_above(score: FloatArray, skewness: FloatArray) -> FloatArray:
    """Probability of more than this score, and half of that of itself, of mean 0, variance 1 and a skewness.

    That of a Poisson number of this skewness, between whole ones too; the normal law, which is above, if negative.
    """
    from scipy.special import gammainc, ndtr

    mean = np.where(skewness > 1e-3, skewness, np.nan) ** -2.0  # beyond a million the same
    number = mean + score * np.sqrt(mean)
    law = 0.5 * (gammainc(np.maximum(number, 0.0), mean) + gammainc(np.maximum(number + 1.0, 0.0), mean))
    return np.where(np.isnan(mean), ndtr(-score), law)
