"""mars-lidar: exact, fast simulation of single-photon LiDAR under SPAD dead time."""

from mars_lidar._version import __version__
from mars_lidar.estimate import Reconstruction, cramer_rao, reconstruct
from mars_lidar.flux import Flux
from mars_lidar.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.scene import Scene
from mars_lidar.simulate import simulate, simulate_timestamps
from mars_lidar.statistics import (
    CountLaw,
    JointLaw,
    count_law,
    holding_time_covariance,
    joint_law,
    registration_pdf,
)
from mars_lidar.system import Detector, System
from mars_lidar.table import Lookup, QuantisationError, Table
from mars_lidar.timestamps import Timestamps

__all__ = [
    "CountLaw",
    "Detector",
    "Flux",
    "GaussianPulse",
    "JointLaw",
    "Lookup",
    "Pulse",
    "QuantisationError",
    "Reconstruction",
    "SampledPulse",
    "Scene",
    "System",
    "Table",
    "Timestamps",
    "__version__",
    "count_law",
    "cramer_rao",
    "holding_time_covariance",
    "joint_law",
    "reconstruct",
    "registration_pdf",
    "simulate",
    "simulate_timestamps",
]
