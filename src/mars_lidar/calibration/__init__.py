"""Calibration: light and detector estimated from a recorded photon stream, with a test of the model."""

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
