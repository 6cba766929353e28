"""Reconstruction: depth, signal and background of every pixel of a cube, with errors and bounds."""

from mars_lidar.reconstruction.histogram_bound import (
    HistogramBound,
    cramer_rao,
    returns_bound,
    window_error,
    window_weights,
)
from mars_lidar.reconstruction.image import Image, UntrainedImage
from mars_lidar.reconstruction.matched_filter import MatchedFilter, Peak
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood, log_likelihood, systematic_error
from mars_lidar.reconstruction.method import Flags, Method
from mars_lidar.reconstruction.rates import ChainCorrection, Coates, GeneralisedCoates
from mars_lidar.reconstruction.reconstruction import METHODS, Reconstruction, reconstruct
from mars_lidar.reconstruction.returns import Returns

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
    "cramer_rao",
    "log_likelihood",
    "reconstruct",
    "returns_bound",
    "systematic_error",
    "window_error",
    "window_weights",
]
