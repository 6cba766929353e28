"""The closed-form mean and covariance of the histogram (`mars_lidar.joint_law`) as an oracle for every engine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import mars_lidar as ml
from harness.cases import Case
from harness.pvalues import merge


@dataclass(frozen=True, eq=False)
class JointLaw:
    """Mean and covariance of cells (neighbouring bins that are joined until they hold enough) and windows."""

    law: ml.JointLaw

    @classmethod
    def of(cls, case: Case, tolerance: float = 3e-4) -> "JointLaw":
        """The law of the case's pixel; None of its engines is asked."""
        return cls(ml.joint_law(case.flux[0, 0], case.system, tolerance=tolerance))

    def cells(self, items: int, most: int) -> NDArray[np.float64]:
        """(cells, bins) weights of at most `most` cells, each with 500 registrations in `items` exposures."""
        expected = self.law.mean * items
        cell = merge(expected, max(500.0, expected.sum() / most))
        return (cell == np.arange(cell[-1] + 1)[:, None]).astype(float)

    def windows(self, items: int) -> NDArray[np.float64]:
        """(windows, bins) weights: half of the registrations in the fewest bins, and single bins, six or fewer."""
        mean = self.law.mean
        order = np.argsort(-mean, kind="stable")
        brightest = np.zeros(mean.size)
        brightest[order[: int(np.searchsorted(np.cumsum(mean[order]), 0.5 * mean.sum())) + 1]] = 1.0
        often = order[mean[order] * items >= 500][:200]
        single = np.eye(mean.size)[often[:: max(1, often.size // 6)][:6]]
        return np.vstack([brightest, single])
