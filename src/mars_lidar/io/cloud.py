"""Point clouds: depth along the ray of each pixel of a pinhole camera, as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import beside, check_target
from mars_lidar._base.types import ArrayLike, FloatArray


@checked
def points(depth_m: ArrayLike, focal_px: float) -> FloatArray:
    """Points (H, W, 3), m, of ranges (H, W), m: x to the right, y down, z forward; NaN where the range is.

    Of several ranges a pixel, (H, W, K): (H, W, K, 3).

    Parameters
    ----------
    depth_m
        Range along the ray, as in `mars_lidar.Scene` and `mars_lidar.Reconstruction`.
    focal_px
        Focal length in pixels of this image; its centre is the principal point.

    Raises
    ------
    ValueError, TypeError
        Ranges that are not real numbers (H, W) or (H, W, K), or a focal length that is not positive.

    See Also
    --------
    save_cloud

    Examples
    --------
    >>> from mars_lidar import io
    >>> io.points([[2.0, 2.0], [2.0, 2.0]], focal_px=100.0).shape
    (2, 2, 3)
    """
    depth = np.asarray(depth_m, np.float64)
    if depth.ndim not in (2, 3):
        raise ValueError(f"depth_m must be a map (H, W), or (H, W, K) of several returns, got shape {depth.shape}")
    focal = checks.real("focal_px", focal_px, low=0.0, strict_low=True)
    height, width = depth.shape[:2]
    ray = np.empty((height, width, 3))
    ray[..., 0] = np.arange(width) - 0.5 * (width - 1)
    ray[..., 1] = (np.arange(height) - 0.5 * (height - 1))[:, None]
    ray[..., 2] = focal
    ray /= np.linalg.norm(ray, axis=-1)[..., None]
    if depth.ndim == 3:
        ray = ray[:, :, None]
    return np.asarray(ray * depth[..., None])


@checked
def save_cloud(
    path: str | Path,
    depth_m: ArrayLike,
    focal_px: float,
    *,
    intensity: ArrayLike | None = None,
    error_m: ArrayLike | None = None,
    overwrite: bool = False,
) -> int:
    """Write the pixels with a depth as a ``.ply`` (binary, little endian); returns the number of points.

    Parameters
    ----------
    path
        The file.
    depth_m, focal_px
        As for `points`, also (H, W, K) for several returns a pixel; points with depth NaN or inf are omitted.
    intensity
        (H, W), or as the depth, property of the points, such as reflectivity or signal.
    error_m
        (H, W), or as the depth, standard error of the depth, m; the property ``depth_error``.
    overwrite
        Replace an existing file.

    Raises
    ------
    ValueError
        Another suffix, or maps of different shapes.
    TypeError
        Maps that are not numbers.
    OSError
        `path` exists and `overwrite` is false, or cannot be written.

    See Also
    --------
    points

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> from mars_lidar import io
    >>> io.save_cloud(folder / "wall.ply", [[2.0, 2.0], [2.0, float("nan")]], focal_px=100.0)
    3
    """
    target = Path(path)
    checks.suffix("path of a point cloud", target, [".ply"])
    place = points(depth_m, focal_px)
    columns = {"x": place[..., 0], "y": place[..., 1], "z": place[..., 2]}
    for name, argument, values in (("intensity", "intensity", intensity), ("depth_error", "error_m", error_m)):
        if values is not None:
            columns[name] = np.asarray(values, np.float64)
            if columns[name].shape != place.shape[:-1]:
                raise ValueError(
                    f"{argument} must have the shape of depth_m, {place.shape[:-1]}, got {columns[name].shape}"
                )
    check_target(target, folder=False, overwrite=overwrite)
    known = np.isfinite(place).all(-1)
    rows = np.stack([values[known] for values in columns.values()], axis=-1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in columns), "end_header", ""]
    with beside(target) as unfinished, open(unfinished, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(rows.tobytes())
    return len(rows)
