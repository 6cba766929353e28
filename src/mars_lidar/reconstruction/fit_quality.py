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
_DEAD_TIME = 1.2  # factor by which the dead time of an alternative is longer or shorter
_WIDTH = 1.1  # factor by which the pulse of an alternative is wider, ...
_BIN = 0.5  # ... and bins added to its width in quadrature: a smaller change does not alter the histogram


def tested_recordings(system: System) -> list[_core.HistogramRecord]:
    """Systems with a longer dead time, a shorter one and a wider pulse, for which scores are computed.

    Empty unless the detector is free-running without a gate and the exposure is longer than four dead times and four
    periods: otherwise the histogram does not determine the armed periods of its bins.
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
    """The tests from the native statistics (pixels, `COLUMNS`)."""
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
    """Mid-p upper tail, P(X > score) + P(X = score) / 2, of a score X of mean 0, variance 1 and given skewness.

    X is a standardised Poisson number of mean 1 / skewness^2, continued between integers by the incomplete gamma
    function. For a skewness below 1e-3, or negative, it is normal; for negative skewness this tail is too large.
    """
    from scipy.special import gammainc, ndtr

    mean = np.where(skewness > 1e-3, skewness, np.nan) ** -2.0  # for larger means the normal law
    number = mean + score * np.sqrt(mean)
    law = 0.5 * (gammainc(np.maximum(number, 0.0), mean) + gammainc(np.maximum(number + 1.0, 0.0), mean))
    return np.where(np.isnan(mean), ndtr(-score), law)
