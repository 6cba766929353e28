"""Errors of reconstructed maps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.optional import needed


def psnr(found: ArrayLike, true: ArrayLike, data_range: float) -> float:
    """Peak signal-to-noise ratio, dB: 20 log10(`data_range` / RMSE); `data_range` is stated, not the data's."""
    peak = checks.real("data_range", data_range, low=0.0, strict_low=True)
    error = rmse(found, true)
    return math.inf if error == 0.0 else 20.0 * math.log10(peak / error)


def rmse(found: ArrayLike, true: ArrayLike) -> float:
    """Root of the mean squared error over the entries where `true` is finite."""
    a, b = _pair(found, true)
    known = np.isfinite(b)
    if not known.any():
        raise ValueError("true must have a finite entry, got none")
    return float(np.sqrt(np.mean((a[known] - b[known]) ** 2)))


def ssim(found: ArrayLike, true: ArrayLike, data_range: float) -> float:
    """Structural similarity (Wang et al. 2004) of two images (H, W), Gaussian window of 1.5 pixels; scikit-image's."""
    peak = checks.real("data_range", data_range, low=0.0, strict_low=True)
    metrics = needed("skimage.metrics", "ssim", "estimate")
    a, b = _pair(found, true)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(metrics.structural_similarity(a, b, data_range=peak, **options))


def _pair(found: ArrayLike, true: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
    a, b = np.asarray(found, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if a.shape != b.shape:
        raise ValueError(f"found must have the shape {b.shape} of true, got {a.shape}")
    return a, b
