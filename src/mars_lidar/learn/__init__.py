"""Training: streams and datasets for PyTorch, histograms and likelihoods that have gradients, inverse problems.

Needs the extra ``learn``: pip install 'mars-lidar[learn]'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mars_lidar.learn.forward import expected_histogram
    from mars_lidar.learn.inverse import LidarPhysics as LidarPhysics
    from mars_lidar.learn.light import bin_photons
    from mars_lidar.learn.likelihood import armed_periods, histogram_log_likelihood
    from mars_lidar.learn.ranges import Choice, LogUniform, SystemRange, Uniform
    from mars_lidar.learn.stored import StoredDataset
    from mars_lidar.learn.stream import CubeStream
    from mars_lidar.learn.tabulated import HistogramTable

_MODULES = {
    "Choice": "ranges",
    "CubeStream": "stream",
    "HistogramTable": "tabulated",
    "LidarPhysics": "inverse",
    "LogUniform": "ranges",
    "StoredDataset": "stored",
    "SystemRange": "ranges",
    "Uniform": "ranges",
    "armed_periods": "likelihood",
    "bin_photons": "light",
    "expected_histogram": "forward",
    "histogram_log_likelihood": "likelihood",
}


def __getattr__(name: str) -> Any:  # PyTorch is loaded by whoever uses it
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"mars_lidar.learn.{_MODULES[name]}"), name)


__all__ = [  # but LidarPhysics: `import *` would ask for deepinv
    "Choice",
    "CubeStream",
    "HistogramTable",
    "LogUniform",
    "StoredDataset",
    "SystemRange",
    "Uniform",
    "armed_periods",
    "bin_photons",
    "expected_histogram",
    "histogram_log_likelihood",
]
