"""Axes of a table (photons per period, ascending): their specification and thinning."""

import math

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.light.tolerances import TOL as LIGHT
from mars_lidar.table.tolerances import TOL

Grid = tuple[float, float, int] | ArrayLike

PAPER_GRID: dict[str, tuple[float, float, int]] = {"signal": (0.01, 10.0, 256), "background": (0.01, 10.0, 100)}


def axis_values(name: str, grid: Grid) -> FloatArray:
    """Values of an axis.

    Parameters
    ----------
    name
        Name of the argument, for errors.
    grid
        A tuple ``(low, high, points)``: 0, and `points` values from low to high, equally spaced in the logarithm.
        Or an array of ascending values, used unchanged.

    Returns
    -------
    NDArray
        (n,) photons per period.
    """
    if isinstance(grid, tuple):
        if len(grid) != 3:
            raise ValueError(f"{name} must be (low, high, points) or an array of values, got {grid!r}")
        low = checks.real(f"{name}[0]", grid[0], low=0.0, high=LIGHT.photons, strict_low=True)
        high = checks.real(f"{name}[1]", grid[1], low=0.0, high=LIGHT.photons, strict_low=True)
        points = checks.integer(f"{name}[2]", grid[2], low=2, high=TOL.points)
        if not high > low:
            raise ValueError(f"{name} must be (low, high, points) with high > low, got {grid!r}")
        return np.concatenate([[0.0], np.geomspace(low, high, points)])
    values = np.array(checks.numbers(name, checks.unmasked(name, grid)))
    if values.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be (low, high, points) or real numbers, got dtype {values.dtype}")
    if values.ndim != 1 or not 1 <= values.size <= TOL.points:
        raise ValueError(f"{name} must have shape (n,) with n from 1 to {TOL.points}, got {values.shape}")
    values = values.astype(np.float64)
    if not ((values >= 0) & (values <= LIGHT.photons)).all() or not (np.diff(values) > 0).all():
        raise ValueError(
            f"{name} must be strictly ascending photons per period in [0, {LIGHT.photons:g}], got {values}"
        )
    return values


def thinned(values: FloatArray, step: float) -> NDArray[np.int64]:
    """Indices of some values of an axis, its ends included, at most `step` apart in the logarithm where they can."""
    start = 1 if values[0] == 0.0 and values.size > 1 else 0
    logs = np.log(np.maximum(values[start:], np.finfo(float).tiny))
    intervals = max(1, math.ceil((logs[-1] - logs[0]) / step))
    wanted = np.linspace(logs[0], logs[-1], intervals + 1)
    nearest = start + np.abs(wanted[:, None] - logs[None, :]).argmin(1)
    return np.unique(np.concatenate([[0], nearest])).astype(np.int64)


def describe(values: FloatArray) -> str:
    """An axis in words."""
    positive = values[values > 0]
    zero = "0 and " if values[0] == 0.0 and positive.size else ""
    if positive.size < 2:
        return f"{zero}{positive[0]:g}" if positive.size else "0"
    even = np.ptp(np.diff(np.log(positive))) < 1e-9
    return f"{zero}{positive.size} {'log-spaced ' if even else ''}values in [{positive[0]:g}, {positive[-1]:g}]"
