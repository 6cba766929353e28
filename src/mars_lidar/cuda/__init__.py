"""Engines on a GPU: the native headers compiled for CUDA at run time."""

from mars_lidar.cuda.exact import exact_histogram, exact_records

__all__ = ["exact_histogram", "exact_records"]
