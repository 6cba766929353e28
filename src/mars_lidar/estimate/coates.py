"""Coates' correction: exact for detectors that the laser clock arms. Coates, J. Phys. E 1, 878 (1968)."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from mars_lidar import _validate
from mars_lidar.estimate.histograms import checked
from mars_lidar.estimate.method import (
    _PASSES,
    FILTERS,
    Estimates,
    Filter,
    FloatArray,
    Histograms,
    Method,
    corrected_rates,
    window_estimates,
)
from mars_lidar.system import System


@dataclass(frozen=True)
class Coates(Method):
    """Rates ``l_j = ln[E_j / (E_j - h_j)]``, E_j the armed periods without a registration before bin j (R4, R8).

    `filter` on the rates: as `MatchedFilter`.
    """

    filter: Filter = "log"

    name = "coates"
    modes = ("synchronous",)
    assumes = "nothing: exact for synchronous detectors"

    def __post_init__(self) -> None:
        _validate.choice("filter", self.filter, FILTERS)

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay by the filter, signal and background by its window, and their standard errors."""
        return window_estimates(histograms, self.filter, _PASSES)


def coates_rates(cube: ArrayLike, system: System, *, threads: int | None = None) -> FloatArray:
    """Photons per period in each bin (..., bins) behind the histograms (..., bins) of a synchronous detector.

    Infinite in bins that registered in every period that was left.
    """
    given, shape = checked(cube, system, threads)
    Coates().check(system)
    return corrected_rates(given, _PASSES).reshape(*shape, system.bins)
