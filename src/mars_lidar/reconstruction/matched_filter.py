"""The matched filter on the histogram as it is, and its largest bin: right where dead time plays no part."""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar._base import checks
from mars_lidar.reconstruction.histograms import Histograms
from mars_lidar.reconstruction.method import FILTERS, Estimates, Filter, Method, window_estimates


@dataclass(frozen=True)
class MatchedFilter(Method):
    """Delay where the histogram, taken as it is, correlates best with the pulse.

    `filter` ``"log"``: with log(1 + S s / b), the maximum-likelihood delay of a Poisson histogram whose signal S and
    background b per bin are those of the linear filter's window; ``"linear"``: with the pulse s itself.
    """

    filter: Filter = "log"

    name = "matched_filter"
    modes = ("nonparalyzable", "paralyzable", "synchronous", "gated")
    assumes = "so little light that dead time loses nothing"

    def __post_init__(self) -> None:
        checks.choice("filter", self.filter, FILTERS)

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay, and signal and background of its window."""
        return window_estimates(histograms, self.filter)


@dataclass(frozen=True)
class Peak(Method):
    """Delay at the centre of the largest bin, the first of several equal ones, less the offset of the pulse's peak."""

    name = "peak"
    modes = ("nonparalyzable", "paralyzable", "synchronous", "gated")
    assumes = "so little light that dead time loses nothing, many signal photons"

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay, and signal and background of its window."""
        return window_estimates(histograms, "peak")
