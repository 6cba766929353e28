"""Depth and reflectivity from RGB-D files: depth images, arrays, PFM, EXR, layers, and the layouts of two collections.

The labelled data set of NYUv2 is ``nyu_depth_v2_labeled.mat``: 1449 frames of depth and colour.

It is a MATLAB v7.3 file, that is HDF5 with MATLAB's axes reversed: ``depths`` (N, W, H) in metres, holes filled
by its authors, and ``images`` (N, 3, W, H), 8 bits. Depth is perpendicular to the image plane (focal length
about 519 px; N. Silberman et al., ECCV 2012).

Middlebury has a folder for each stereo scene (vision.middlebury.edu/stereo/data): depth from disparity.

2005 and 2006, ``disp1.png``, ``view1.png``, ``dmin.txt``: depth is ``f b / (d + d_min)``, f = 3740 px and b =
160 mm at full size. The stored d is in pixels of the *full* size at full, half and third size alike (the data
set's page divides it by 2 or 3 for pixels of the reduced image), and so is d_min, so that no scale is needed. (On
half-size "Art" the paper cup is then 72 mm wide and the depth 1.4 to 2.2 m; with d_min in half-size pixels it would
be 48 mm wide.) d = 0 is unknown.

2014 and 2021, ``disp0.pfm``, ``im0.png``, ``calib.txt``: depth is ``f b / (d + doffs)`` with f from the matrix
``cam0`` in pixels, ``baseline`` b in mm, and ``doffs`` the distance in x of the two principal points; d = inf is
unknown (D. Scharstein et al., GCPR 2014).

Depth is perpendicular to the image plane in all of them.
"""

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.files import FileError, check_claim, npy_header, open_npz, reading
from mars_lidar._base.hdf5 import open_hdf5
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.io import pixels
from mars_lidar.io.named_arrays import mat_arrays
from mars_lidar.scene.scene import LayeredScene, Scene

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

    Depth, by the kind of `depth_path`; 0, NaN and inf in a file mean "no return", as do 65504 and 1e10 in files of
    floats, which renderers write for rays without a surface:

    - 16-bit PNG or TIFF, one channel: integers of `depth_unit_m` each, by default 0.001 (millimetres; other
      data sets use 1/5000 or 1/256).
    - ``.pfm`` (one channel) and ``.exr`` (the channel Z, that of a layer such as ``ViewLayer.Depth.Z``, or the only
      one; needs the extra ``io``): metres, or `depth_unit_m` each.
    - ``.npy``: (H, W), metres, or `depth_unit_m` each. Integers need `depth_unit_m`: they are rarely metres.
    - ``.npz``: ``depth`` as above; optionally ``reflectivity`` (linear, [0, 1]) or ``image`` (as an image
      file), and ``background`` (relative, >= 0).
    - ``.mat``: an array ``depth`` or the only one, (H, W), metres, or `depth_unit_m` each; or the labelled data set
      of NYUv2 (MATLAB v7.3): ``depths`` in metres and ``images`` of frame `index`, from 0.
    - a folder of Middlebury 2005 or 2006 with ``disp1.png``, ``view1.png`` and ``dmin.txt``, or of 2014 or
      2021 with ``disp0.pfm``, ``im0.png`` and ``calib.txt``.

    Reflectivity, from `image_path`, else from the file of the depth, else 1 everywhere (only relative
    values affect a flux):

    - an image of 8 or 16 bits: sRGB decoded (IEC 61966-2-1), linear luminance
      Y = 0.2126 R + 0.7152 G + 0.0722 B; alpha is ignored. It approximates the reflectivity at the laser's
      wavelength, shading included.
    - ``.npy``: (H, W) floats in [0, 1] are the reflectivity itself, linear; integers, and (H, W, 3), are an
      image.

    `focal_px` (pixels of the depth file, principal point at the centre) turns depth perpendicular to the
    image plane into range along the ray, ``r = z sqrt(1 + (x^2 + y^2) / f^2)``; without it depth is taken as
    range. Depths beyond `max_depth_m` are treated as no return.

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
    frames = suffix == ".mat" and source.is_file() and is_nyu(source)
    if (index is not None) != frames:
        problem = "needs index, the frame from 0" if index is None else f"has no frames, got index {index!r}"
        raise ValueError(f"{source}: {problem}")
    reflectivity = background = None
    if source.is_dir():
        if unit is not None:
            raise ValueError(f"{source}: depth_unit_m does not apply to a Middlebury folder, got {unit:g}")
        depth, own_image = read_middlebury(source)
        image = own_image if image is None else image
    elif suffix == ".mat" and not frames:
        depth = _depth(source, _matlab(source), unit)
    elif suffix == ".mat":
        if unit is not None:
            raise ValueError(f"{source}: depth_unit_m does not apply to NYUv2, which is in metres, got {unit:g}")
        metres, colours = read_nyu(source, index)
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
            raise ValueError(
                f"{path}: {name} must have the size of depth, {pixels.size(depth)}, got {pixels.size(array)}"
            )
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
            raise ValueError(f"{path}: depth must be 16-bit integers in one channel, got {pixels.describe(stored)}")
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
    """Depths up to `most_m`, m; greater depths become NaN, no return."""
    return depth if most_m is None else pixels.known(path, np.where(depth <= most_m, depth, np.nan))


def _obliquity(shape: tuple[int, ...], focal: float) -> FloatArray:
    """Range over perpendicular depth at each pixel of a pinhole camera."""
    height, width = shape
    y, x = np.arange(height) - 0.5 * (height - 1), np.arange(width) - 0.5 * (width - 1)
    return np.sqrt(1.0 + (x**2 + y[:, None] ** 2) / focal**2)


_FILES_2005 = ("disp1.png", "view1.png", "dmin.txt")
_FILES_2014 = ("disp0.pfm", "im0.png", "calib.txt")
_FOCAL_2005_PX = 3740.0
_BASELINE_2005_M = 0.160


def is_nyu(path: Path) -> bool:
    """Whether a .mat is of version 7.3 and has NYUv2's ``depths`` or ``images``."""
    import h5py

    if not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as file:
        return "depths" in file or "images" in file


def nyu_frames(path: Path) -> int:
    """Number of frames in the file."""
    with _nyu(path) as file:
        return int(file["depths"].shape[0])


def read_nyu(path: Path, index: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Depth (H, W), m, and colours (H, W, 3), uint8, of a frame; only this frame is read."""
    with _nyu(path) as file:
        depths, images = file["depths"], file["images"]
        k = checks.integer("index", index, low=0, high=int(depths.shape[0]) - 1)
        check_claim(path, 4 * 8 * depths[:1].size, f"frame {k}")
        depth, image = np.asarray(depths[k]), np.asarray(images[k])
    return depth.T, image.transpose(2, 1, 0)


@contextmanager
def _nyu(path: Path) -> Iterator[Any]:
    import h5py

    with open_hdf5(path, "NYUv2's labelled .mat, of MATLAB v7.3") as file:
        for name in ("depths", "images"):
            if not isinstance(file.get(name), h5py.Dataset):
                raise ValueError(f"{path}: must hold 'depths' and 'images' as NYUv2 does, got {', '.join(file)}")
        depths, images = file["depths"], file["images"]
        if depths.ndim != 3 or images.shape != (depths.shape[0], 3, *depths.shape[1:]) or depths.size == 0:
            shapes = f"{pixels.describe(depths)} and {pixels.describe(images)}"
            raise ValueError(f"{path}: depths must be (N, W, H) and images (N, 3, W, H), got {shapes}")
        yield file


def is_middlebury(folder: Path) -> bool:
    """Whether the folder has the disparities of a scene, of either layout."""
    return any((folder / files[0]).is_file() for files in (_FILES_2005, _FILES_2014))


def read_middlebury(folder: Path) -> tuple[FloatArray, Path]:
    """Depth (H, W) in m, NaN where it is unknown, and the path of the left image."""
    newer = any((folder / name).is_file() for name in (_FILES_2014[0], _FILES_2014[2]))
    files, years = (_FILES_2014, "2014/2021") if newer else (_FILES_2005, "2005/2006")
    missing = [name for name in files if not (folder / name).is_file()]
    if missing:
        either = "" if newer else f", or one of 2014/2021 with {', '.join(_FILES_2014)}"
        raise ValueError(
            f"{folder}: {', '.join(missing)} not found; "
            f"a folder must be a Middlebury {years} scene with {', '.join(files)}{either}"
        )
    return (_depth_2014(folder) if newer else _depth_2005(folder)), folder / files[1]


def _depth_2005(folder: Path) -> FloatArray:
    text = (folder / "dmin.txt").read_text(errors="replace").strip()
    try:
        offset = checks.real("dmin", float(text), low=0.0)
    except ValueError as error:
        raise ValueError(f"{folder / 'dmin.txt'}: must hold one number >= 0, got {text[:40]!r}") from error
    stored = pixels.array(folder / "disp1.png")
    if stored.ndim != 2 or stored.dtype.kind not in "iu":
        raise ValueError(f"{folder / 'disp1.png'}: must be integers in one channel, got {pixels.describe(stored)}")
    disparity = stored.astype(np.float64)
    known = np.where(disparity > 0.0, disparity + offset, np.nan)
    return pixels.known(folder / "disp1.png", _FOCAL_2005_PX * _BASELINE_2005_M / known)


def _depth_2014(folder: Path) -> FloatArray:
    focal_px, baseline_mm, offset_px = _calibration(folder / "calib.txt")
    disparity = pixels.floats(folder / "disp0.pfm", "disparity", pixels.read_pfm(folder / "disp0.pfm"))
    shifted = disparity + offset_px
    usable = np.isfinite(disparity) & (disparity > 0.0) & (shifted > 0.0)
    depth = 1e-3 * baseline_mm * focal_px / np.where(usable, shifted, np.nan)
    return pixels.known(folder / "disp0.pfm", depth)


def _calibration(path: Path) -> tuple[float, float, float]:
    """Focal length in px, baseline in mm, and offset of the principal points in px, of a ``calib.txt``."""
    lines = (line.partition("=") for line in path.read_text(errors="replace").splitlines())
    entries = {name.strip(): value.strip() for name, _, value in lines}
    numbers = []
    for name in ("cam0", "baseline", "doffs"):
        text = entries.get(name)
        if text is None:
            raise ValueError(f"{path}: must give {name}")
        try:  # of the matrix [f 0 cx; 0 f cy; 0 0 1] the first element
            number = float(text.lstrip("[").replace(";", " ").split()[0])
        except (ValueError, IndexError):
            number = math.nan
        if not math.isfinite(number) or (name != "doffs" and number <= 0.0):
            raise ValueError(f"{path}: {name} must begin with a number{' > 0' * (name != 'doffs')}, got {text[:60]!r}")
        numbers.append(number)
    return numbers[0], numbers[1], numbers[2]


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

    ``background``, if present, is (H, W); without ``reflectivity`` it is 1 everywhere. Units and values for "no
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
