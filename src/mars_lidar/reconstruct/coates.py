"""Coates' correction: exact for detectors that the laser clock arms. Coates, J. Phys. E 1, 878 (1968)."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruct.method import RateMethod


@dataclass(frozen=True)
class Coates(RateMethod):
    """Rates ``l_j = ln[E_j / (E_j - h_j)]``, E_j the armed periods without a registration before bin j (R4, R8).

    `filter` on the rates: as `MatchedFilter`.
    """

    name = "coates"
    modes = ("synchronous",)
    assumes = "nothing: exact for synchronous detectors"


def coates_rates(cube: ArrayLike, system: System, *, threads: int | None = None) -> FloatArray:
    """Photons per period in each bin (..., bins) behind the histograms (..., bins) of a synchronous detector.

    Infinite in bins that registered in every period that was left.
    """
    return Coates().rates(cube, system, threads)
