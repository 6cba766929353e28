"""Errors of reconstructed maps against the truth; SSIM by scikit-image (extra ``estimate``)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mars_lidar._base.imports import MissingLibraryError, needed
from mars_lidar._base.types import BoolArray, FloatArray
from mars_lidar.instrument.system import System

if TYPE_CHECKING:
    from mars_lidar.io import Cube
    from mars_lidar.reconstruction.reconstruction import Reconstruction

_LEAST_SIDE = 7  # of scikit-image's SSIM window


@dataclass(frozen=True)
class MapError:
    """Errors of a map over the pixels whose truth is known, pooled over realizations.

    rmse, median
        Root mean square and median absolute error of the pixels with an estimate, in the map's unit.
    psnr
        Peak signal-to-noise ratio, dB: range of the truth over `rmse`.
    ssim
        Structural similarity (Wang et al., 2004), mean over pixels; NaN for images of less than 7 pixels a side, and
        where scikit-image is not installed.
    missing
        Share of pixels without an estimate; for SSIM they are set to the median of the others.
    """

    rmse: float
    median: float
    psnr: float
    ssim: float
    missing: float


def map_error(truth: FloatArray, estimate: FloatArray) -> MapError:
    """Errors of `estimate` (..., H, W) against `truth` (H, W); NaN is unknown in either."""
    truth, estimate = np.asarray(truth, np.float64), np.asarray(estimate, np.float64)
    if truth.ndim != 2 or estimate.shape[-2:] != truth.shape:
        raise ValueError(
            f"truth must be (H, W) and estimate (..., H, W) of the same image, got {truth.shape} and {estimate.shape}"
        )
    known = np.isfinite(truth)
    images = estimate.reshape(-1, *truth.shape)
    both = known & np.isfinite(images)
    if not both.any():
        return MapError(np.nan, np.nan, np.nan, np.nan, missing=1.0)
    error = (images - truth)[both]
    rmse = float(np.sqrt(np.mean(error**2)))
    span = float(np.ptp(truth[known]))
    psnr = ssim = float("nan")
    if span > 0.0:
        psnr = 20.0 * math.log10(span / rmse) if rmse > 0 else math.inf
        if ssim_available() and min(truth.shape) >= _LEAST_SIDE:
            ssim = _mean_ssim(truth, images, known, span)
    missing = 1.0 - float(both.sum()) / (len(images) * int(known.sum()))
    return MapError(rmse, float(np.median(np.abs(error))), psnr, ssim, missing)


def ssim_available() -> bool:
    """Whether scikit-image is installed."""
    try:
        needed("skimage.metrics", "SSIM", "estimate")
    except MissingLibraryError:
        return False
    return True


def _mean_ssim(truth: FloatArray, images: FloatArray, known: BoolArray, span: float) -> float:
    """Mean SSIM of `images` (n, H, W) against `truth`; a missing estimate is the median of its image."""
    metrics = needed("skimage.metrics", "SSIM", "estimate")
    plain = np.where(known, truth, np.median(truth[known]))
    means = []
    for image in images:
        good = known & np.isfinite(image)
        middle = np.median(image[good]) if good.any() else plain.mean()
        filled = np.where(known, np.where(good, image, middle), plain)
        local = metrics.structural_similarity(plain, filled, data_range=span, full=True)[1]
        means.append(float(local[known].mean()))
    return float(np.mean(means))


def errors_against(cube: Cube, result: Reconstruction) -> dict[str, MapError]:
    """Errors of depth, in m modulo the unambiguous range, and of reflectivity or else signal, of a known scene.

    Signal is compared in detectable photons per period: the true signal times the detection efficiency. Depth is
    compared where a return was detected, as in the figure of `mars_lidar.plot.reconstruction`: elsewhere the estimate
    is arbitrary, and counts as missing.
    """
    out: dict[str, MapError] = {}
    if cube.measured:
        return out
    lit = cube.flux.signal > 0
    if (lit & np.isfinite(cube.depth_m)).any():
        truth = np.where(lit, cube.depth_m, np.nan)
        lag = depth_lag_m(cube.system, result.depth_m, truth)
        out["depth"] = map_error(truth, np.where(result.detected, truth + lag, np.nan))
    if lit.any():
        if cube.reflectivity is not None:
            out["reflectivity"] = map_error(np.where(lit, cube.reflectivity, np.nan), result.reflectivity)
        else:
            strongest = result.returns is not None and len(cube.flux.returns_signal) > 0
            signal = cube.flux.returns_signal.max(0) if strongest else cube.flux.signal
            detectable = cube.system.detector.detection_efficiency * signal
            out["signal"] = map_error(np.where(lit, detectable, np.nan), result.signal)
    return out


def depth_lag_m(system: System, estimate_m: FloatArray, truth_m: FloatArray) -> FloatArray:
    """Estimated minus true depth (...), m, modulo the unambiguous range; NaN where either is missing."""
    span = system.unambiguous_range_m
    return np.asarray((estimate_m - truth_m + 0.5 * span) % span - 0.5 * span, dtype=np.float64)
