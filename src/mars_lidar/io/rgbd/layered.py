"""Scenes of several surfaces behind each other, from one file."""

from __future__ import annotations

from pathlib import Path

from mars_lidar._base.files import reading
from mars_lidar.io.rgbd.stack import is_stack, read_stack
from mars_lidar.scene.layers import LayeredScene
from mars_lidar.scene.scene import Scene


def read_layers(
    path: str | Path,
    *,
    depth_unit_m: float | None = None,
    focal_px: float | None = None,
    max_depth_m: float | None = None,
) -> LayeredScene:
    """The scene in an ``.npz`` whose ``depth`` and ``reflectivity`` are (layers, H, W).

    ``background`` is (H, W), where there is one. Units and what means "no return": `mars_lidar.Scene.from_rgbd`.

    Raises
    ------
    ValueError
        A damaged file, or arrays that do not fit together: the message starts with the file.
    """
    source = Path(path)
    if not is_stack(source):
        raise ValueError(f"{source}: must be an .npz with a depth of (layers, H, W)")
    with reading(source, "a scene"):
        depth, reflectivity, background = read_stack(
            source, depth_unit_m=depth_unit_m, focal_px=focal_px, max_depth_m=max_depth_m
        )
        first = Scene(depth[0], reflectivity[0], background)
        return LayeredScene([first, *map(Scene, depth[1:], reflectivity[1:])])
