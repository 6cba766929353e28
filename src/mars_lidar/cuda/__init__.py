"""Engines on a GPU: the native headers compiled for CUDA at run time."""

from mars_lidar.cuda.dispatch import check, histogram, records

__all__ = ["check", "histogram", "records"]
