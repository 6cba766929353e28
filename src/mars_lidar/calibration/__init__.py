"""Calibration: what a recorded stream of photons says about its light and its detector, and whether a model fits it."""

from mars_lidar.calibration.calibration import Calibration, Estimate, Limit, Suspect, calibrate
from mars_lidar.calibration.histograms import CubeCalibration, calibrate_cube
from mars_lidar.calibration.look import Look
from mars_lidar.calibration.suspects import Drift

__all__ = [
    "Calibration",
    "CubeCalibration",
    "Drift",
    "Estimate",
    "Limit",
    "Look",
    "Suspect",
    "calibrate",
    "calibrate_cube",
]
