"""Several surfaces in one file: an .npz whose depth and reflectivity are (layers, H, W)."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from mars_lidar._base.files import npy_header, reading
from mars_lidar._base.types import FloatArray
from mars_lidar.io.rgbd import _depth, _npz_arrays, _obliquity, pixels, within


def is_stack(path: Path) -> bool:
    """Whether it is an ``.npz`` with a ``depth`` of three axes; only its header is read."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        with reading(path), zipfile.ZipFile(path) as archive, archive.open("depth.npy") as member:
            return len(npy_header(member)[0]) == 3
    except (OSError, ValueError, MemoryError):
        return False  # the reader of scenes says what is wrong


def read_stack(
    path: Path, *, depth_unit_m: float | None = None, focal_px: float | None = None, max_depth_m: float | None = None
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Depth in m (NaN = no return) and reflectivity in [0, 1], (layers, H, W), and the background (H, W) or None.

    ``depth`` and ``reflectivity`` (1 everywhere where it is missing) are those of `mars_lidar.io.rgbd.read_rgbd`, with
    one axis more; ``background`` is as there.
    """
    arrays = _npz_arrays(path)
    stored = arrays["depth"]
    layers, height, width = stored.shape
    depth = _depth(path, stored.reshape(layers * height, width), depth_unit_m).reshape(stored.shape)
    depth = within(path, depth, max_depth_m)
    if focal_px is not None:
        depth = depth * _obliquity((height, width), focal_px)
    if "image" in arrays:
        raise ValueError(f"{path}: with (layers, H, W) of depth give reflectivity, not image")
    reflectivity = np.ones(depth.shape)
    if "reflectivity" in arrays:
        given = arrays["reflectivity"]
        if given.shape != depth.shape:
            raise ValueError(f"{path}: reflectivity must have the shape of depth, {depth.shape}, got {given.shape}")
        reflectivity = pixels.linear(path, given.reshape(layers * height, width)).reshape(depth.shape)
    background = None
    if "background" in arrays:
        background = pixels.floats(path, "background", arrays["background"])
        if background.shape != (height, width):
            raise ValueError(f"{path}: background must be {(height, width)}, got {background.shape}")
    return depth, reflectivity, background
