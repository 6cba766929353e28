"""mars-lidar: exact, fast simulation of single-photon LiDAR under SPAD dead time."""

from typing import TYPE_CHECKING

from mars_lidar._version import __version__
from mars_lidar.engines.simulation import simulate, simulate_timestamps
from mars_lidar.instrument.avalanches import Afterpulsing, Crosstalk
from mars_lidar.instrument.detector import dark_count_map
from mars_lidar.instrument.effects import Jitter, SampledJitter
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.instrument.units import UnitWarning
from mars_lidar.light.flux import Flux
from mars_lidar.light.timestamps import Timestamps
from mars_lidar.reconstruction import Reconstruction, cramer_rao, reconstruct
from mars_lidar.scene.scene import Scene
from mars_lidar.statistics import (
    CountLaw,
    JointLaw,
    count_law,
    holding_time_covariance,
    joint_law,
    mean_histogram,
    registration_pdf,
)
from mars_lidar.table import Lookup, QuantisationError, Table

__all__ = [
    "Afterpulsing",
    "Calibration",
    "CountLaw",
    "Crosstalk",
    "Cube",
    "Detector",
    "Flux",
    "GaussianPulse",
    "Generated",
    "Jitter",
    "JointLaw",
    "Lookup",
    "Pulse",
    "QuantisationError",
    "Reconstruction",
    "SampledJitter",
    "SampledPulse",
    "Scene",
    "System",
    "Table",
    "Timestamps",
    "UnitWarning",
    "__version__",
    "calibrate",
    "count_law",
    "cramer_rao",
    "dark_count_map",
    "generate",
    "holding_time_covariance",
    "joint_law",
    "mean_histogram",
    "reconstruct",
    "registration_pdf",
    "simulate",
    "simulate_timestamps",
    "to_xarray",
]

if TYPE_CHECKING:
    from mars_lidar import dataset as dataset
    from mars_lidar import io as io
    from mars_lidar import learn as learn
    from mars_lidar import plot as plot
    from mars_lidar.calibration import Calibration as Calibration
    from mars_lidar.calibration import calibrate as calibrate
    from mars_lidar.dataset import Generated as Generated
    from mars_lidar.dataset import generate as generate
    from mars_lidar.io import Cube as Cube
    from mars_lidar.io import to_xarray as to_xarray
else:
    from importlib import import_module

    _LATER = ("dataset", "io", "learn", "plot")  # with what they import, only where they are used: `ml.io.load`
    _HOMES = {
        "Calibration": "calibration",
        "Cube": "io",
        "Generated": "dataset",
        "calibrate": "calibration",
        "generate": "dataset",
        "to_xarray": "io",
    }

    def __getattr__(name: str) -> object:
        if name in _LATER:
            return import_module(f"mars_lidar.{name}")
        if name in _HOMES:
            return getattr(import_module(f"mars_lidar.{_HOMES[name]}"), name)
        packages = [import_module(f"mars_lidar.{package}") for package in ("engines", "reconstruction", "statistics")]
        place = next((f"; it is {package.__name__}.{name}" for package in packages if name in package.__all__), "")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{place}")

    def __dir__() -> list[str]:
        return sorted({*__all__, *_LATER, "engines", "reconstruction", "statistics"})
