"""From measured photons back to depth and light: reconstruction of cubes, calibration and validation of streams."""

from mars_lidar.estimate.calibration import Calibration, calibrate
from mars_lidar.estimate.calibration_bound import Bound, calibration_bound
from mars_lidar.estimate.calibration_rapp import RappEstimate, rapp_total
from mars_lidar.estimate.checks import Check
from mars_lidar.estimate.coates import Coates, coates_rates
from mars_lidar.estimate.generalised_coates import GeneralisedCoates, generalised_coates_rates
from mars_lidar.estimate.histogram_bound import HistogramBound, cramer_rao, window_error, window_weights
from mars_lidar.estimate.inspection import Inspection, inspect
from mars_lidar.estimate.matched_filter import MatchedFilter
from mars_lidar.estimate.maximum_likelihood import MaximumLikelihood, log_likelihood
from mars_lidar.estimate.mchc import ChainCorrection, mchc_rates
from mars_lidar.estimate.method import Flags, Method
from mars_lidar.estimate.peak import Peak
from mars_lidar.estimate.reconstruct import Reconstruction, reconstruct
from mars_lidar.estimate.recovery import Recovery, recovery
from mars_lidar.estimate.stream_summary import Summary, summary
from mars_lidar.estimate.validation import Validation, validate

METHODS: dict[str, Method] = {
    method.name: method
    for method in (MaximumLikelihood(), GeneralisedCoates(), ChainCorrection(), Coates(), MatchedFilter(), Peak())
}

__all__ = [
    "METHODS",
    "Bound",
    "Calibration",
    "ChainCorrection",
    "Check",
    "Coates",
    "Flags",
    "GeneralisedCoates",
    "HistogramBound",
    "Inspection",
    "MatchedFilter",
    "MaximumLikelihood",
    "Method",
    "Peak",
    "RappEstimate",
    "Reconstruction",
    "Recovery",
    "Summary",
    "Validation",
    "calibrate",
    "calibration_bound",
    "coates_rates",
    "cramer_rao",
    "generalised_coates_rates",
    "inspect",
    "log_likelihood",
    "mchc_rates",
    "rapp_total",
    "reconstruct",
    "recovery",
    "summary",
    "validate",
    "window_error",
    "window_weights",
]
