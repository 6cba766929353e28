"""Markov-chain histogram correction: Rapp et al., Dead time compensation for high-flux ranging, IEEE TSP 2019."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.method import _CHAIN, RateMethod


@dataclass(frozen=True)
class ChainCorrection(RateMethod):
    """Rates whose Markov chain of phases has the histogram f as its stationary distribution.

    ``l <- f; repeat s = (f P(l)) / l, l <- f / s``, scaled to the total flux (R14, R15). The paper takes the total from
    the times between registrations, which a histogram does not have; here it is that of `GeneralisedCoates` (the
    number of registrations alone hardly tells it of a bright pixel). Phases are taken as stationary: the start and
    the end of the exposure are neglected.

    Parameters
    ----------
    filter
        On the rates: as `MatchedFilter`.
    iterations, tolerance
        Stops when the rates move by less than `tolerance` of their sum, or after so many iterations.
    """

    iterations: int = 60
    tolerance: float = 1e-5

    correction = _CHAIN
    name = "mchc"
    modes = ("nonparalyzable", "gated")
    assumes = "a long exposure, in which the phases are stationary"

    def __post_init__(self) -> None:
        super().__post_init__()
        count = checks.integer("iterations", self.iterations, low=1, high=100_000)
        object.__setattr__(self, "iterations", count)
        checks.real("tolerance", self.tolerance, low=0.0, high=0.1, strict_low=True)

    def check(self, system: System) -> None:
        """As any method; and the dead time is at least one bin."""
        super().check(system)
        if system.detector.dead_time_ns < system.bin_ns:
            raise ValueError(
                f"method 'mchc' needs a dead time of at least one bin ({system.bin_ns:g} ns), got "
                f"{system.detector.dead_time_ns:g} ns; use 'generalised_coates'"
            )

    @property
    def settings(self) -> dict[str, float]:
        """Steps and the movement at which they end."""
        return {"steps": self.iterations, "tolerance": self.tolerance}


@checked
def mchc_rates(
    cube: ArrayLike,
    system: System,
    *,
    total: ArrayLike | None = None,
    iterations: int = 60,
    tolerance: float = 1e-5,
    threads: int | None = None,
) -> FloatArray:
    """Photons per period in each bin (..., bins) behind the histograms (..., bins), by `ChainCorrection`.

    `total`: photons per period in all, a scalar or (...), where they are known, from the times between registrations
    for instance.
    """
    return ChainCorrection(iterations=iterations, tolerance=tolerance).rates(cube, system, threads, total)
