"""Coates' correction: each bin's registrations over the periods in which the pixel was armed there.

Coates, J. Phys. E 1, 878 (1968), exact for detectors that the laser clock arms. Generalised to free-running ones by
Gupta, Ingle, Gupta, Asynchronous single-photon 3D imaging, ICCV 2019; here for bins of any brightness, dead times of
any length, and both ends of the exposure (docs/reconstruction.md).
"""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.method import RateMethod


@dataclass(frozen=True)
class Coates(RateMethod):
    """Rates ``l_j = ln[E_j / (E_j - h_j)]``, E_j the armed periods without a registration before bin j (R4, R8).

    `filter` on the rates: as `MatchedFilter`.
    """

    name = "coates"
    modes = ("synchronous",)
    assumes = "nothing: exact for synchronous detectors"


@checked
def coates_rates(cube: ArrayLike, system: System, *, threads: int | None = None) -> FloatArray:
    """Photons per period in each bin (..., bins) from histograms (..., bins) of a synchronous detector.

    Infinite in bins that registered in every remaining armed period.
    """
    return Coates().rates(cube, system, threads)


@dataclass(frozen=True)
class GeneralisedCoates(RateMethod):
    """Rates with which every bin registers as often as it did, given when the histogram says the pixel was armed (R8).

    `filter` on the rates: as `MatchedFilter`.
    """

    name = "generalised_coates"
    modes = ("nonparalyzable", "gated")
    assumes = "nothing of the flux but its period"


@checked
def generalised_coates_rates(cube: ArrayLike, system: System, *, threads: int | None = None) -> FloatArray:
    """Photons per period in each bin (..., bins) from histograms (..., bins) of a free-running detector.

    Whatever the waveform: no pulse is assumed. Bins that registered whenever they could are infinite. The variance of
    a bin's rate l is about l^2 / h, h its registrations, and bins are independent of each other.
    """
    return GeneralisedCoates().rates(cube, system, threads)
