"""The largest bin: the simplest estimate of depth."""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar.reconstruct.histograms import Histograms
from mars_lidar.reconstruct.method import Estimates, Method, window_estimates


@dataclass(frozen=True)
class Peak(Method):
    """Delay at the centre of the largest bin, the first of several equal ones, less the offset of the pulse's peak."""

    name = "peak"
    modes = ("nonparalyzable", "paralyzable", "synchronous", "gated")
    assumes = "so little light that dead time loses nothing, many signal photons"

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay, and signal and background of its window."""
        return window_estimates(histograms, "peak")
