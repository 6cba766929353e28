"""mars-lidar: exact, fast simulation of single-photon LiDAR under SPAD dead time."""

from mars_lidar._version import __version__
from mars_lidar.avalanches import Afterpulsing, Crosstalk
from mars_lidar.dark_counts import dark_count_map
from mars_lidar.effects import Jitter, SampledJitter
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
    "Afterpulsing",
    "CountLaw",
    "Crosstalk",
    "Detector",
    "Flux",
    "GaussianPulse",
    "Jitter",
    "JointLaw",
    "Lookup",
    "Pulse",
    "QuantisationError",
    "SampledJitter",
    "SampledPulse",
    "Scene",
    "System",
    "Table",
    "Timestamps",
    "__version__",
    "count_law",
    "dark_count_map",
    "holding_time_covariance",
    "joint_law",
    "registration_pdf",
    "simulate",
    "simulate_timestamps",
]
