"""Depths by a prior that smooths, a baseline: likelihood of method "image" in turn with a denoiser of images.

The likelihood of a pixel is searched over all cells of delay. Total variation: alternating directions (Boyd et al.,
Found. Trends Mach. Learn. 3, 1, 2011). A network: half-quadratic splitting with noise that decreases in each round
(Zhang et al., IEEE Trans. Pattern Anal. Mach. Intell. 44, 6360, 2022).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import uniform_filter

from mars_lidar import System
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.image import solver_of
from mars_lidar.reconstruction.image_pulse import settings_of
from mars_lidar.reconstruction.photons import Photons

TV_WEIGHT = 1.0  # of the variation, per sigma: of 0.3, 1, 2 and 4 the best in five images of the training's kind
_ROUNDS, _STIFFNESS, _PROJECTIONS = 60, 0.5, 25
# of the network: rounds, and standard deviations of the noise at first (of the range of depths) and at last (sigma of
# the pulse; of 1 and 0.3 the better in nine images of the training's kind, in which alternating directions were worse)
_NETWORK_ROUNDS, _FIRST_NOISE, _LAST_NOISE = 30, 0.2, 1.0
Denoise = Callable[[FloatArray, float], FloatArray]  # an image and the standard deviation of its noise, both in sigma


class _Pixels:
    """Likelihood of each pixel alone; delays in sigma. It does not wrap: scenes of it end within the period."""

    def __init__(self, cube: np.ndarray, system: System) -> None:
        height, width, bins = cube.shape
        solver = solver_of(Photons.of(cube.reshape(-1, bins), height, width), 1)
        setting = settings_of(system)[-1]
        solver.begin(setting)
        likelihood = np.asarray(solver.volumes().likelihood)
        self.cost = -np.log(likelihood.reshape(height, width, -1).astype(np.float64) + 1e-12)
        self.place = (np.arange(setting.cells) + 0.5) / setting.sigma
        self.ns = setting.sigma / setting.cells * system.period_ns

    def start(self) -> FloatArray:
        """The most likely delays of 5 x 5 pixels together."""
        return np.asarray(self.place[uniform_filter(self.cost, (5, 5, 0), mode="nearest").argmin(-1)], np.float64)

    def near(self, target: FloatArray, stiffness: float) -> FloatArray:
        """Delays of least cost plus stiffness / 2 times their squared distance from the target."""
        return np.asarray(self.place[(self.cost + 0.5 * stiffness * (self.place - target[..., None]) ** 2).argmin(-1)])


def by_variation(cube: np.ndarray, system: System, weight: float = TV_WEIGHT) -> FloatArray:
    """Most likely delays (H, W), ns, whose differences from pixel to pixel are penalised."""
    pixels = _Pixels(cube, system)
    smooth = pixels.start()
    dual = np.zeros_like(smooth)
    for _ in range(_ROUNDS):
        own = pixels.near(smooth - dual, _STIFFNESS)
        smooth = total_variation(own + dual, weight / _STIFFNESS)
        dual += own - smooth
    return smooth * pixels.ns


def by_denoiser(cube: np.ndarray, system: System, denoise: Denoise) -> FloatArray:
    """Delays (H, W), ns, with a denoiser of images for the prior."""
    pixels = _Pixels(cube, system)
    smooth = pixels.start()
    first = max(_FIRST_NOISE * float(np.ptp(smooth)), _LAST_NOISE)
    for noise in np.geomspace(first, _LAST_NOISE, _NETWORK_ROUNDS):
        smooth = denoise(pixels.near(smooth, 1.0 / noise**2), float(noise))
    return smooth * pixels.ns


def total_variation(image: FloatArray, weight: float, projections: int = _PROJECTIONS) -> FloatArray:
    """The image u of least |u - image|^2 / 2 + weight times the sum of |gradient of u|.

    By Chambolle's projection (J. Math. Imaging Vis. 20, 89, 2004).
    """
    down, right = np.zeros_like(image), np.zeros_like(image)
    for _ in range(projections):
        value = _divergence(down, right) - image / weight
        slope = np.diff(value, axis=0, append=value[-1:]), np.diff(value, axis=1, append=value[:, -1:])
        size = 1.0 + 0.25 * np.hypot(*slope)
        down, right = (down + 0.25 * slope[0]) / size, (right + 0.25 * slope[1]) / size
    return np.asarray(image - weight * _divergence(down, right))


def _divergence(down: FloatArray, right: FloatArray) -> FloatArray:
    out = np.diff(down, axis=0, prepend=0.0) + np.diff(right, axis=1, prepend=0.0)
    return np.asarray(out)
