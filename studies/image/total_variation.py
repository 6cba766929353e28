"""Total variation, a baseline: the most likely depths whose differences from pixel to pixel are penalised.

Alternating directions (Boyd et al., Found. Trends Mach. Learn. 3, 1, 2011) on the likelihood of method "image" itself:
each pixel's part is searched over all cells of delay, the penalty's by Chambolle's projection (J. Math. Imaging Vis.
20, 89, 2004).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from mars_lidar import System
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.image import solver_of
from mars_lidar.reconstruction.image_pulse import settings_of
from mars_lidar.reconstruction.photons import Photons

WEIGHT = 1.0  # of the variation, per sigma: of 0.3, 1, 2 and 4 the best in five images of the training's kind
_ROUNDS, _STIFFNESS, _PROJECTIONS = 60, 0.5, 25


def total_variation(cube: np.ndarray, system: System, weight: float = WEIGHT) -> FloatArray:
    """Delays (H, W), ns; the penalty does not wrap: scenes of it end within the period."""
    height, width, bins = cube.shape
    solver = solver_of(Photons.of(cube.reshape(-1, bins), height, width), 1)
    setting = settings_of(system)[-1]
    solver.begin(setting)
    likelihood = np.asarray(solver.volumes().likelihood)
    cells = setting.cells
    cost = -np.log(likelihood.reshape(-1, cells).astype(np.float64) + 1e-12)
    place = (np.arange(cells) + 0.5) / setting.sigma
    around = uniform_filter(cost.reshape(height, width, -1), (5, 5, 0), mode="nearest")
    smooth = place[around.argmin(-1)].astype(np.float64)
    dual = np.zeros_like(smooth)
    for _ in range(_ROUNDS):
        target = (smooth - dual).reshape(-1, 1)
        own = place[(cost + 0.5 * _STIFFNESS * (place - target) ** 2).argmin(1)].reshape(height, width)
        smooth = denoised(own + dual, weight / _STIFFNESS)
        dual += own - smooth
    return np.asarray(smooth * setting.sigma / cells * system.period_ns)


def denoised(image: FloatArray, weight: float, projections: int = _PROJECTIONS) -> FloatArray:
    """The image u of least |u - image|^2 / 2 + weight times the sum of |gradient of u|."""
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
