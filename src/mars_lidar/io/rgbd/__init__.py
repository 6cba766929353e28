"""Depth and reflectivity from RGB-D files: depth images, arrays, NYUv2, Middlebury folders, PFM, EXR."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.files import FileError, open_npz, reading
from mars_lidar._base.types import FloatArray
from mars_lidar.io.named_arrays import mat_arrays
from mars_lidar.io.rgbd import collections, pixels

_DEPTH_IMAGES = (".png", ".tif", ".tiff")
_DEPTH_FLOATS = (".pfm", ".exr")
_NOTHING = (65504.0, 1e10)  # what Blender and others write for no surface: the largest half float, or a depth


def read_rgbd(
    depth_path: str | Path,
    image_path: str | Path | None = None,
    *,
    depth_unit_m: float | None = None,
    focal_px: float | None = None,
    index: int | None = None,
    max_depth_m: float | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Depth in m (NaN = no return), reflectivity in [0, 1], and the background map or None; (H, W) each.

    Depth, by the kind of `depth_path`; 0, NaN and inf in a file mean "no return", and so do 65504 and 1e10 in files of
    floats, which renderers write where a ray meets nothing:

    - 16-bit PNG or TIFF, one channel: integers of `depth_unit_m` each, by default 0.001 (millimetres; other
      data sets use 1/5000 or 1/256).
    - ``.pfm`` (one channel) and ``.exr`` (the channel Z, that of a layer such as ``ViewLayer.Depth.Z``, or the only
      one; needs the extra ``io``): metres, or `depth_unit_m` each.
    - ``.npy``: (H, W), metres, or `depth_unit_m` each. Integers need `depth_unit_m`: they are rarely metres.
    - ``.npz``: ``depth`` as above; optionally ``reflectivity`` (linear, [0, 1]) or ``image`` (as an image
      file), and ``background`` (relative, >= 0).
    - ``.mat``: an array ``depth`` or the only one, (H, W), metres, or `depth_unit_m` each; or the labelled data set
      of NYUv2 (MATLAB v7.3): ``depths`` in metres and ``images`` of frame `index`, from 0. See
      `mars_lidar.io.rgbd.collections`.
    - a folder of Middlebury 2005 or 2006 with ``disp1.png``, ``view1.png`` and ``dmin.txt``, or of 2014 or
      2021 with ``disp0.pfm``, ``im0.png`` and ``calib.txt``. See `mars_lidar.io.rgbd.collections`.

    Reflectivity, from `image_path`, else from what comes with the depth, else 1 everywhere (only relative
    values matter to a flux):

    - an image of 8 or 16 bits: sRGB decoded (IEC 61966-2-1), linear luminance
      Y = 0.2126 R + 0.7152 G + 0.0722 B; alpha is ignored. It stands in for the reflectivity at the laser's
      wavelength, shading included.
    - ``.npy``: (H, W) floats in [0, 1] are the reflectivity itself, linear; integers, and (H, W, 3), are an
      image.

    `focal_px` (pixels of the depth file, principal point at the centre) turns depth perpendicular to the
    image plane into range along the ray, ``r = z sqrt(1 + (x^2 + y^2) / f^2)``; without it depth is taken as
    range. Depths of the file beyond `max_depth_m` are no return.

    Raises
    ------
    ValueError
        A file that is missing, damaged or of the wrong kind, no valid depth, sizes that differ: the message
        starts with the file.
    """
    source = Path(depth_path)
    image = None if image_path is None else Path(image_path)
    unit, focal = _positive("depth_unit_m", depth_unit_m), _positive("focal_px", focal_px)
    most = _positive("max_depth_m", max_depth_m)
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder")
    with reading(source, "a scene"):
        return _read(source, image, unit, focal, index, most)


def _read(
    source: Path, image: Path | None, unit: float | None, focal: float | None, index: int | None, most: float | None
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    suffix = source.suffix.lower()
    frames = suffix == ".mat" and source.is_file() and collections.is_nyu(source)
    if (index is not None) != frames:
        told = "needs index, the frame from 0" if index is None else f"has no frames, got index {index!r}"
        raise ValueError(f"{source}: {told}")
    reflectivity = background = None
    if source.is_dir():
        if unit is not None:
            raise ValueError(f"{source}: depth_unit_m does not apply to a Middlebury folder, got {unit:g}")
        depth, own_image = collections.read_middlebury(source)
        image = own_image if image is None else image
    elif suffix == ".mat" and not frames:
        depth = _depth(source, _matlab(source), unit)
    elif suffix == ".mat":
        if unit is not None:
            raise ValueError(f"{source}: depth_unit_m does not apply to NYUv2, which is in metres, got {unit:g}")
        metres, colours = collections.read_nyu(source, index)
        depth = _depth(source, metres, 1.0)
        reflectivity = pixels.luminance(source, colours)
    elif suffix == ".npz":
        depth, reflectivity, background = _npz(source, unit)
    else:
        read = {".pfm": pixels.read_pfm, ".exr": pixels.read_exr}.get(suffix, pixels.array)
        depth = _depth(source, read(source), unit)
    if image is not None:
        reflectivity = pixels.reflectivity(image, pixels.array(image))
        if reflectivity.shape != depth.shape:
            raise FileError(
                f"{image}: image must have the size of the depth, {pixels.size(depth)} in {source}, "
                f"got {pixels.size(reflectivity)}"
            )
    depth = within(source, depth, most)
    if focal is not None:
        depth = depth * _obliquity(depth.shape, focal)
    return depth, np.ones(depth.shape) if reflectivity is None else reflectivity, background


def _matlab(path: Path) -> NDArray[Any]:
    """The array ``depth`` of a .mat of any version, or the only one that is an image."""
    images = {
        name: array
        for name, array in mat_arrays(path, deep=False).items()
        if isinstance(array, np.ndarray) and array.dtype.kind in "fiu" and min(array.shape, default=0) > 1
    }
    if "depth" not in images and len(images) != 1:
        held = ", ".join(f"{name} {array.shape}" for name, array in images.items()) or "none"
        raise ValueError(f"{path}: must hold an array 'depth' (H, W), or one array alone, got {held}")
    return images["depth"] if "depth" in images else next(iter(images.values()))


def _positive(name: str, value: float | None) -> float | None:
    return None if value is None else checks.real(name, value, low=0.0, strict_low=True)


def _npz(path: Path, unit: float | None) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    arrays = _npz_arrays(path)
    if "reflectivity" in arrays and "image" in arrays:
        raise ValueError(f"{path}: must hold one of 'reflectivity' and 'image', got both")
    depth = _depth(path, arrays["depth"], unit)
    reflectivity = background = None
    if "reflectivity" in arrays:
        reflectivity = pixels.linear(path, arrays["reflectivity"])
    elif "image" in arrays:
        reflectivity = pixels.luminance(path, arrays["image"])
    if "background" in arrays:
        background = pixels.floats(path, "background", arrays["background"])
        if not ((background >= 0.0) & (background < np.inf)).all():
            raise ValueError(f"{path}: background must be finite and >= 0")
    for name, array in (("reflectivity or image", reflectivity), ("background", background)):
        if array is not None and array.shape != depth.shape:
            told = f"{pixels.size(depth)}, got {pixels.size(array)}"
            raise ValueError(f"{path}: {name} must have the size of depth, {told}")
    return depth, reflectivity, background


def _npz_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Everything in the file, a ``depth`` among it."""
    with open_npz(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    if "depth" not in arrays:
        raise ValueError(f"{path}: must hold an array 'depth', got {', '.join(sorted(arrays)) or 'none'}")
    return arrays


def _depth(path: Path, stored: NDArray[Any], unit: float | None) -> FloatArray:
    """Stored depth in metres, NaN where there is none."""
    suffix = path.suffix.lower()
    if suffix in _DEPTH_IMAGES:
        if stored.ndim != 2 or stored.dtype.kind not in "iu" or stored.dtype.itemsize < 2:
            told = pixels.describe(stored)
            raise ValueError(f"{path}: depth must be 16-bit integers in one channel, got {told}")
        unit = 0.001 if unit is None else unit
    elif suffix in (".npy", ".npz", ".mat", *_DEPTH_FLOATS):
        if stored.dtype.kind in "iu" and unit is None:
            raise ValueError(
                f"{path}: depth is {stored.dtype}, whose unit is not known: give depth_unit_m (0.001 for mm)"
            )
        unit = 1.0 if unit is None else unit
    else:
        raise ValueError(f"{path}: depth must be a .png, .tif, .tiff, .pfm, .exr, .npy, .npz or .mat file or a folder")
    depth = unit * pixels.floats(path, "depth", stored)
    if stored.dtype.kind == "f":
        depth[np.isin(stored, _NOTHING)] = np.nan
    if (depth < 0.0).any():
        raise ValueError(f"{path}: depth must not be negative, got {depth[depth < 0.0][0]:g} m")
    return pixels.known(path, np.where((depth > 0.0) & (depth < np.inf), depth, np.nan))


def within(path: Path, depth: FloatArray, most_m: float | None) -> FloatArray:
    """Depths up to `most_m`, m; those beyond are no return."""
    return depth if most_m is None else pixels.known(path, np.where(depth <= most_m, depth, np.nan))


def _obliquity(shape: tuple[int, ...], focal: float) -> FloatArray:
    """Range over perpendicular depth at each pixel of a pinhole camera."""
    height, width = shape
    y, x = np.arange(height) - 0.5 * (height - 1), np.arange(width) - 0.5 * (width - 1)
    return np.sqrt(1.0 + (x**2 + y[:, None] ** 2) / focal**2)
