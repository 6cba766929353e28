"""Training: streams and datasets for PyTorch, histograms and likelihoods that have gradients, inverse problems.

Needs the extra ``learn``: pip install 'mars-lidar[learn]'.
"""

from typing import TYPE_CHECKING

from mars_lidar._base.imports import MissingLibraryError

try:
    import torch.utils.data  # noqa: F401
except ImportError as _error:
    raise MissingLibraryError(f"mars_lidar.learn needs PyTorch: pip install 'mars-lidar[learn]' ({_error})") from _error

from mars_lidar.learn.forward import bin_photons, expected_histogram
from mars_lidar.learn.likelihood import armed_periods, histogram_log_likelihood
from mars_lidar.learn.ranges import Choice, LogUniform, SystemRange, Uniform
from mars_lidar.learn.stored import StoredDataset
from mars_lidar.learn.stream import CubeStream
from mars_lidar.learn.tabulated import HistogramTable

__all__ = [
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

if TYPE_CHECKING:
    from mars_lidar.learn.inverse import LidarLikelihood as LidarLikelihood
    from mars_lidar.learn.inverse import LidarPhysics as LidarPhysics


def __getattr__(name: str) -> object:
    if name not in ("LidarLikelihood", "LidarPhysics"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mars_lidar.learn import inverse  # which needs deepinv

    return getattr(inverse, name)
