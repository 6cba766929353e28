"""Errors of a table on random pixels between its nodes, and their units."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.table.tolerances import TOL

# total variation between normal laws that differ a little: 0.399 per standard deviation of the mean, 0.242 per
# relative change of the variance
_TV_MEAN, _TV_VARIANCE = 1.0 / math.sqrt(2.0 * math.pi), 1.0 / math.sqrt(2.0 * math.pi * math.e)


@dataclass(frozen=True)
class QuantisationError:
    """Errors of a table on random pixels between its nodes, and on dim ones between its lowest nodes and 0.

    Errors of the cumulants are in units of powers of the standard deviation, at least 1/2 count. Errors
    `delayed` are at random delays, where an armed start has another law; the others at the canonical delay t_r / 2.
    All hold for exposures of `cycles` periods: an error of the mean count per period grows with the exposure, the
    standard deviation with its root, so that errors of the mean in standard deviations grow as the root of the
    exposure. Those of the variance and of the shape do not grow.

    Attributes
    ----------
    interpolation, samples, cycles
        Interpolation, number of pixels, and periods of the exposures.
    mean_rms, mean_max, variance_rms, variance_max, third_max, fourth_max
        Of the cumulants.
    shape_mean, shape_max
        Total variation between the mixture of shapes and the pixel's own.
    delayed_mean_max, delayed_variance_max, delayed_shape_max
        The same at random delays. Shapes are shifted by whole bins, so that only errors of the table count.
    law_max
        Largest of 0.399 ``|error of the mean|`` + 0.242 ``|error of the variance|``: the total variation between two
        normal laws, to first order; delays included.
    worst_signal, worst_background
        The pixel of `law_max` or `shape_max`, whichever is larger.

    See Also
    --------
    Table

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=64,
    ...     pulse=ml.GaussianPulse(sigma_ns=2.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> table = ml.Table.build(system, signal=(0.1, 2.0, 6), background=(0.1, 1.0, 4), tolerance=1e-3)
    >>> error = table.quantisation_error(samples=32)
    >>> error.largest == max(error.law_max, error.shape_max)
    True
    >>> error.largest < 0.1  # in total variation
    True
    """

    interpolation: str
    samples: int
    cycles: int
    mean_rms: float
    mean_max: float
    variance_rms: float
    variance_max: float
    third_max: float
    fourth_max: float
    shape_mean: float
    shape_max: float
    delayed_mean_max: float
    delayed_variance_max: float
    delayed_shape_max: float
    law_max: float
    worst_signal: float
    worst_background: float

    @property
    def largest(self) -> float:
        """Largest error of the table in total variation: the larger of `law_max` and `shape_max`."""
        return max(self.law_max, self.shape_max)

    def cycles_within(self, allowed: float = 0.05) -> int:
        """Periods up to which the mean is within `allowed` standard deviations, from 1 to 1e8.

        Extrapolated from the error at `cycles` with the square root of the exposure. It is most accurate for errors
        measured at 1e8 cycles, where the lower limit of half a count on the standard deviation no longer matters.
        """
        allowed = checks.real("allowed", allowed, low=0.0, strict_low=True)
        worst = max(self.mean_max, self.delayed_mean_max, 1e-300)
        return max(1, int(min(self.cycles * (allowed / worst) ** 2, TOL.cycles)))

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self)


def deviations(cumulants: FloatArray, exact: FloatArray) -> FloatArray:
    """Errors (P, 4) of cumulants in powers of the standard deviation, of at least half a count."""
    return np.abs(cumulants - exact) / np.maximum(np.sqrt(exact[:, 1:2]), TOL.least_spread) ** np.arange(1, 5)


def law_variation(error: FloatArray) -> FloatArray:
    """Total variation (P,) between two normal laws with such `deviations`, to first order."""
    return error[:, 0] * _TV_MEAN + error[:, 1] * _TV_VARIANCE


def random_pixels(rng: np.random.Generator, axis: FloatArray, samples: int, below: bool) -> FloatArray:
    """Random values of an axis: log-uniform, and if `below` one in eight in the cell that begins at 0."""
    positive = axis[axis > 0]
    if positive.size == 0:
        return np.zeros(samples)
    values = np.exp(rng.uniform(np.log(positive[0]), np.log(positive[-1]), samples))
    values = np.clip(values, positive[0], positive[-1])
    if below and axis[0] == 0.0:
        low = rng.random(samples) < 0.125
        values[low] = positive[0] * rng.random(int(low.sum()))
    return values


def dim_pixels(signal: FloatArray, background: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (P,) at quarters of the cells that begin at 0, with their edges: relative errors are largest there."""
    below = [
        axis[1] * np.arange(5) / 4 if axis.size > 1 and axis[0] == 0.0 else axis[:1] for axis in (signal, background)
    ]
    s, b = (values.ravel() for values in np.meshgrid(*below, indexing="ij"))
    between = (~np.isin(s, signal)) | (~np.isin(b, background))
    return s[between], b[between]
