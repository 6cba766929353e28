"""Calibration: what a stream of photons says about its instrument, and whether the model describes the stream."""

from mars_lidar.calibrate.arrivals import ArrivalInspection, inspect_arrivals
from mars_lidar.calibrate.calibration import Calibration, calibrate
from mars_lidar.calibrate.calibration_bound import Bound, calibration_bound
from mars_lidar.calibrate.calibration_rapp import RappEstimate, rapp_total
from mars_lidar.calibrate.fit_tests import Check
from mars_lidar.calibrate.inspection import Inspection, inspect
from mars_lidar.calibrate.intervals import Summary, summary
from mars_lidar.calibrate.recovery import Recovery, recovery
from mars_lidar.calibrate.validation import Validation, validate

__all__ = [
    "ArrivalInspection",
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
    "inspect_arrivals",
    "rapp_total",
    "recovery",
    "summary",
    "validate",
]
