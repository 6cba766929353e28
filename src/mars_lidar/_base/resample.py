"""Images at another size: which pixel is nearest, and means over the area of the new pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.tolerances import TOL
from mars_lidar._base.types import FloatArray, NDArray


def image_size(size: Any) -> tuple[int, int]:
    """(height, width), checked."""
    if len(size) != 2:
        raise ValueError(f"size must be one integer or (height, width), got {size!r}")
    height, width = (checks.integer("size", n, low=1, high=TOL.image_side) for n in size)
    return height, width


def new_size(size: Any, old: tuple[int, int]) -> tuple[int, int]:
    """(H, W) that `size` means for an image of size `old`: as given, or the longer side with the aspect ratio kept."""
    if isinstance(size, tuple | list):
        return image_size(size)
    longer = checks.integer("size", size, low=1, high=TOL.image_side)
    height, width = (max(1, round(longer * n / max(old))) for n in old)
    return height, width


def nearest(old: int, new: int) -> NDArray[np.intp]:
    """Old pixel under the centre of each new one; integer arithmetic, so halves never depend on rounding."""
    return (2 * np.arange(new) + 1) * old // (2 * new)


def area_mean(image: FloatArray, new: int, axis: int) -> FloatArray:
    """Mean of a piecewise constant image over each of `new` equal parts of an axis."""
    old = image.shape[axis]
    if new == old:
        return image
    x = np.moveaxis(image, axis, 0)
    before = np.concatenate((np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)))  # integral up to each edge
    whole, part = np.divmod(np.arange(new + 1) * old, new)
    inner = x[np.minimum(whole, old - 1)] * (part / new).reshape(-1, *(1,) * (x.ndim - 1))
    mean = np.diff(before[whole] + inner, axis=0) * (new / old)
    return np.moveaxis(np.clip(mean, image.min(), image.max()), 0, axis)  # the sums' rounding stays inside


def window(name: str, key: Any, shape: tuple[int, int]) -> tuple[slice, slice]:
    """The slices of rows and columns of ``image[key]``, at least one pixel."""
    keys = key if isinstance(key, tuple) else (key,)
    if len(keys) > 2 or not all(isinstance(k, slice) for k in keys):
        raise IndexError(f"{name} takes one or two slices (rows, columns), got {key!r}")
    rows, columns = (*keys, slice(None))[:2]
    if not (range(shape[0])[rows] and range(shape[1])[columns]):
        raise IndexError(f"{name}[{key!r}] selects no pixel of {shape}")
    return rows, columns
