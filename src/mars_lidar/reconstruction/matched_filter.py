"""The matched filter and the largest bin of the uncorrected histogram, valid if dead time is negligible."""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar._base import checks
from mars_lidar.reconstruction.histograms import Histograms
from mars_lidar.reconstruction.method import FILTERS, Estimates, Filter, Method, window_estimates


@dataclass(frozen=True)
class MatchedFilter(Method):
    """Delay at which the uncorrected histogram correlates best with the pulse.

    Parameters
    ----------
    filter
        ``"log"``: with log(1 + S s / b), the maximum-likelihood delay of a Poisson histogram whose signal S and
        background b per bin are those of the linear filter's window; ``"linear"``: with the pulse s itself.

    Raises
    ------
    ValueError
        An unknown filter.

    See Also
    --------
    Peak, MaximumLikelihood, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(0.05, 0.05, 40.0), system, seed=0)
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.MatchedFilter(filter="linear"))
    >>> abs(float(maps.delay_ns[0, 0, 0]) - 40.0) < 1.0
    True
    """

    filter: Filter = "log"

    name = "matched_filter"
    modes = ("nonparalyzable", "paralyzable", "synchronous", "gated")

    def __post_init__(self) -> None:
        checks.choice("filter", self.filter, FILTERS)

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay, and signal and background of its window, of each of the `histograms`."""
        return window_estimates(histograms, self.filter)


@dataclass(frozen=True)
class Peak(Method):
    """Delay at the centre of the largest bin (the first of equal ones), minus the offset of the pulse's peak.

    See Also
    --------
    MatchedFilter, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(0.5, 0.05, 40.0), system, seed=0)
    >>> abs(float(ml.reconstruct(counts, system, ml.reconstruction.Peak()).delay_ns[0, 0, 0]) - 40.0) < 1.0
    True
    """

    name = "peak"
    modes = ("nonparalyzable", "paralyzable", "synchronous", "gated")

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay, and signal and background of its window, of each of the `histograms`."""
        return window_estimates(histograms, "peak")
