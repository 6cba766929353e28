"""Analytic count laws and histogram shapes of one pixel: no scene, no sampling."""

from mars_lidar.statistics.cells import photons_per_bin
from mars_lidar.statistics.chain import ConvergenceError, PhaseChain, Stationary
from mars_lidar.statistics.constant_light import constant_light_rate
from mars_lidar.statistics.count_laws import CountLaw, count_law
from mars_lidar.statistics.electronics import electronics_moments
from mars_lidar.statistics.exposure import Exposure, Moments, exposure_moments
from mars_lidar.statistics.histogram import mean_histogram, registration_pdf
from mars_lidar.statistics.joint import JointLaw, joint_law
from mars_lidar.statistics.renewal import HoldingTimeCovariance, HoldingTimes, holding_time_covariance, holding_times

__all__ = [
    "ConvergenceError",
    "CountLaw",
    "Exposure",
    "HoldingTimeCovariance",
    "HoldingTimes",
    "JointLaw",
    "Moments",
    "PhaseChain",
    "Stationary",
    "constant_light_rate",
    "count_law",
    "electronics_moments",
    "exposure_moments",
    "holding_time_covariance",
    "holding_times",
    "joint_law",
    "mean_histogram",
    "photons_per_bin",
    "registration_pdf",
]
