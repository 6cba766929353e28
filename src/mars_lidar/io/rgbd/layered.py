"""Scenes of several surfaces behind each other: an .npz whose depth and reflectivity are (layers, H, W)."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from mars_lidar._base.files import npy_header, reading
from mars_lidar.io.rgbd import _depth, _npz_arrays, _obliquity, pixels, within
from mars_lidar.scene.layers import LayeredScene
from mars_lidar.scene.scene import Scene


def is_layered(path: Path) -> bool:
    """Whether it is an ``.npz`` with a ``depth`` of three axes; only its header is read."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        with reading(path), zipfile.ZipFile(path) as archive, archive.open("depth.npy") as member:
            return len(npy_header(member)[0]) == 3
    except (OSError, ValueError, MemoryError):
        return False  # the reader of scenes says what is wrong


def read_layers(
    path: str | Path,
    *,
    depth_unit_m: float | None = None,
    focal_px: float | None = None,
    max_depth_m: float | None = None,
) -> LayeredScene:
    """The scene in an ``.npz`` whose ``depth`` and ``reflectivity`` are (layers, H, W).

    ``background`` is (H, W), where there is one; without ``reflectivity`` it is 1 everywhere. Units and what means "no
    return": `mars_lidar.Scene.from_rgbd`.

    Raises
    ------
    ValueError
        A damaged file, or arrays that do not fit together: the message starts with the file.
    """
    source = Path(path)
    if not is_layered(source):
        raise ValueError(f"{source}: must be an .npz with a depth of (layers, H, W)")
    with reading(source, "a scene"):
        arrays = _npz_arrays(source)
        stored = arrays["depth"]
        layers, height, width = stored.shape
        depth = _depth(source, stored.reshape(layers * height, width), depth_unit_m).reshape(stored.shape)
        depth = within(source, depth, max_depth_m)
        if focal_px is not None:
            depth = depth * _obliquity((height, width), focal_px)
        if "image" in arrays:
            raise ValueError(f"{source}: with (layers, H, W) of depth give reflectivity, not image")
        share = arrays.get("reflectivity", np.ones(depth.shape))
        if share.shape != depth.shape:
            raise ValueError(f"{source}: reflectivity must have the shape of depth, {depth.shape}, got {share.shape}")
        share = pixels.linear(source, share.reshape(layers * height, width)).reshape(depth.shape)
        background = None
        if "background" in arrays:
            background = pixels.floats(source, "background", arrays["background"])
            if background.shape != (height, width):
                raise ValueError(f"{source}: background must be {(height, width)}, got {background.shape}")
        return LayeredScene([Scene(depth[0], share[0], background), *map(Scene, depth[1:], share[1:])])
