"""Training: streams and datasets for PyTorch, histograms and likelihoods that have gradients, inverse problems.

Needs the extra ``learn``: pip install 'mars-lidar[learn]'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mars_lidar._base.imports import names_of

if TYPE_CHECKING:
    from mars_lidar.learn.forward import bin_photons as bin_photons
    from mars_lidar.learn.forward import expected_histogram as expected_histogram
    from mars_lidar.learn.inverse import LidarLikelihood as LidarLikelihood
    from mars_lidar.learn.inverse import LidarPhysics as LidarPhysics
    from mars_lidar.learn.likelihood import histogram_log_likelihood as histogram_log_likelihood
    from mars_lidar.learn.ranges import Choice as Choice
    from mars_lidar.learn.ranges import LogUniform as LogUniform
    from mars_lidar.learn.ranges import SystemRange as SystemRange
    from mars_lidar.learn.ranges import Uniform as Uniform
    from mars_lidar.learn.stored import StoredDataset as StoredDataset
    from mars_lidar.learn.stream import CubeStream as CubeStream
    from mars_lidar.learn.tabulated import HistogramTable as HistogramTable

_HOMES = {
    "Choice": "ranges",
    "CubeStream": "stream",
    "HistogramTable": "tabulated",
    "LidarLikelihood": "inverse",
    "LidarPhysics": "inverse",
    "LogUniform": "ranges",
    "StoredDataset": "stored",
    "SystemRange": "ranges",
    "Uniform": "ranges",
    "bin_photons": "forward",
    "expected_histogram": "forward",
    "histogram_log_likelihood": "likelihood",
}
__getattr__ = names_of(__name__, _HOMES)  # PyTorch is loaded by whoever uses it
__all__ = [name for name in _HOMES if _HOMES[name] != "inverse"]  # `import *` would ask for deepinv
