"""Estimation: from measured or simulated histograms back to depth, signal and background."""

from mars_lidar.estimate.coates import Coates, coates_rates
from mars_lidar.estimate.generalised_coates import GeneralisedCoates, generalised_coates_rates
from mars_lidar.estimate.histogram_bound import HistogramBound, cramer_rao, window_error, window_weights
from mars_lidar.estimate.matched_filter import MatchedFilter
from mars_lidar.estimate.maximum_likelihood import MaximumLikelihood, log_likelihood
from mars_lidar.estimate.mchc import ChainCorrection, mchc_rates
from mars_lidar.estimate.method import Flags, Method
from mars_lidar.estimate.peak import Peak
from mars_lidar.estimate.reconstruct import Reconstruction, reconstruct

METHODS: dict[str, Method] = {
    method.name: method
    for method in (MaximumLikelihood(), GeneralisedCoates(), ChainCorrection(), Coates(), MatchedFilter(), Peak())
}

__all__ = [
    "METHODS",
    "ChainCorrection",
    "Coates",
    "Flags",
    "GeneralisedCoates",
    "HistogramBound",
    "MatchedFilter",
    "MaximumLikelihood",
    "Method",
    "Peak",
    "Reconstruction",
    "coates_rates",
    "cramer_rao",
    "generalised_coates_rates",
    "log_likelihood",
    "mchc_rates",
    "reconstruct",
    "window_error",
    "window_weights",
]
