"""Reconstruction: depth, signal and background of every pixel of a cube, with errors and bounds."""

from mars_lidar.reconstruct.coates import Coates, GeneralisedCoates, coates_rates, generalised_coates_rates
from mars_lidar.reconstruct.histogram_bound import (
    HistogramBound,
    cramer_rao,
    returns_bound,
    window_error,
    window_weights,
)
from mars_lidar.reconstruct.image import Image, UntrainedImage
from mars_lidar.reconstruct.matched_filter import MatchedFilter, Peak
from mars_lidar.reconstruct.maximum_likelihood import MaximumLikelihood, log_likelihood
from mars_lidar.reconstruct.mchc import ChainCorrection, mchc_rates
from mars_lidar.reconstruct.method import Flags, Method
from mars_lidar.reconstruct.reconstruction import METHODS, Reconstruction, reconstruct
from mars_lidar.reconstruct.returns import Returns

__all__ = [
    "METHODS",
    "ChainCorrection",
    "Coates",
    "Flags",
    "GeneralisedCoates",
    "HistogramBound",
    "Image",
    "MatchedFilter",
    "MaximumLikelihood",
    "Method",
    "Peak",
    "Reconstruction",
    "Returns",
    "UntrainedImage",
    "coates_rates",
    "cramer_rao",
    "generalised_coates_rates",
    "log_likelihood",
    "mchc_rates",
    "reconstruct",
    "returns_bound",
    "window_error",
    "window_weights",
]
