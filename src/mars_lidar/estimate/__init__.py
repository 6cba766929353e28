"""From measured photons back to the light: calibration of streams, and whether the model fits them."""

from mars_lidar.estimate.calibration import Calibration, calibrate
from mars_lidar.estimate.calibration_bound import Bound, calibration_bound
from mars_lidar.estimate.calibration_rapp import RappEstimate, rapp_total
from mars_lidar.estimate.inspection import Inspection, inspect
from mars_lidar.estimate.intervals import Summary, summary
from mars_lidar.estimate.recovery import Recovery, recovery
from mars_lidar.estimate.validation import Check, Validation, validate

__all__ = [
    "Bound",
    "Calibration",
    "Check",
    "Inspection",
    "RappEstimate",
    "Recovery",
    "Summary",
    "Validation",
    "calibrate",
    "calibration_bound",
    "inspect",
    "rapp_total",
    "recovery",
    "summary",
    "validate",
]
