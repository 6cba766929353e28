"""Depth and reflectivity from RGB-D files: 16-bit depth images, arrays, Middlebury stereo folders."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _validate

FloatArray = NDArray[np.float64]

_DEPTH_IMAGES = (".png", ".tif", ".tiff")
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709, the primaries of sRGB
# Middlebury 2005 and 2006, https://vision.middlebury.edu/stereo/data/scenes2006: focal length and baseline.
_MIDDLEBURY_FOCAL_PX = 3740.0
_MIDDLEBURY_BASELINE_M = 0.160


def read_rgbd(
    depth_path: str | Path,
    image_path: str | Path | None = None,
    *,
    depth_unit_m: float | None = None,
    focal_px: float | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Depth in m (NaN = no return), reflectivity in [0, 1], and the background map or None; (H, W) each.

    Depth, by the kind of `depth_path`; 0, NaN and inf in a file mean "no return":

    - 16-bit PNG or TIFF, one channel: integers of `depth_unit_m` each, by default 0.001 (millimetres; other
      data sets use 1/5000 or 1/256).
    - ``.npy``: (H, W), metres, or `depth_unit_m` each. Integers need `depth_unit_m`: they are rarely metres.
    - ``.npz``: ``depth`` as above; optionally ``reflectivity`` (linear, [0, 1]) or ``image`` (as an image
      file), and ``background`` (relative, >= 0).
    - a folder of Middlebury 2005 or 2006 with ``disp1.png``, ``view1.png`` and ``dmin.txt``. Depth is
      ``f b / (d + d_min)``, f = 3740 px and b = 160 mm at full size. The stored d is in pixels of the *full*
      size at full, half and third size alike (the data set's page has it divided by 2 or 3 to get pixels of
      the image at hand), and so is d_min: no scale enters. (On half-size "Art" this makes the paper cup
      72 mm wide and the depth 1.4 to 2.2 m; d_min in half-size pixels would make it 48 mm.)
      d = 0 is unknown.

    Reflectivity, from `image_path`, else from what comes with the depth, else 1 everywhere (only relative
    values matter to a flux):

    - an image of 8 or 16 bits: sRGB decoded (IEC 61966-2-1), linear luminance
      Y = 0.2126 R + 0.7152 G + 0.0722 B; alpha is ignored. It stands in for the reflectivity at the laser's
      wavelength, shading included.
    - ``.npy``: (H, W) floats in [0, 1] are the reflectivity itself, linear; integers, and (H, W, 3), are an
      image.

    `focal_px` (pixels of the depth file, principal point at the centre) turns depth perpendicular to the
    image plane into range along the ray, ``r = z sqrt(1 + (x^2 + y^2) / f^2)``; without it depth is taken as
    range.

    Raises
    ------
    ValueError
        A file that is missing, damaged or of the wrong kind, no valid depth, sizes that differ: the message
        starts with the file.
    """
    source = Path(depth_path)
    image = None if image_path is None else Path(image_path)
    unit, focal = _positive("depth_unit_m", depth_unit_m), _positive("focal_px", focal_px)
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder")
    reflectivity = background = None
    if source.is_dir():
        if unit is not None:
            raise ValueError(f"{source}: depth_unit_m does not apply to a Middlebury folder, got {unit:g}")
        depth = _middlebury_depth(source)
        image = source / "view1.png" if image is None else image
    elif source.suffix.lower() == ".npz":
        depth, reflectivity, background = _npz(source, unit)
    else:
        depth = _depth(source, _array(source), unit)
    if image is not None:
        reflectivity = _reflectivity(image, _array(image))
        if reflectivity.shape != depth.shape:
            raise ValueError(
                f"{image}: image must have the size of the depth, {_size(depth)} in {source}, "
                f"got {_size(reflectivity)}"
            )
    if focal is not None:
        depth = depth * _obliquity(depth.shape, focal)
    return depth, np.ones(depth.shape) if reflectivity is None else reflectivity, background


def _positive(name: str, value: float | None) -> float | None:
    return None if value is None else _validate.real(name, value, low=0.0, strict_low=True)


def _array(path: Path) -> NDArray[Any]:
    """The pixels of an image file or the array of a .npy file."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        content = path.read_bytes()  # decoders that fail leave the files they opened open
        if path.suffix.lower() == ".npy":
            return np.asarray(np.load(BytesIO(content), allow_pickle=False))
        import imageio.v3 as iio

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the decoder, about metadata
            return np.asarray(iio.imread(content, extension=path.suffix, plugin="pillow"))
    except Exception as error:
        raise ValueError(f"{path}: cannot be read ({_reason(error)})") from error


def _npz(path: Path, unit: float | None) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    try:
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path}: cannot be read ({_reason(error)})") from error
    if "depth" not in arrays:
        raise ValueError(f"{path}: must hold an array 'depth', got {', '.join(sorted(arrays)) or 'none'}")
    if "reflectivity" in arrays and "image" in arrays:
        raise ValueError(f"{path}: must hold one of 'reflectivity' and 'image', got both")
    depth = _depth(path, arrays["depth"], unit)
    reflectivity = background = None
    if "reflectivity" in arrays:
        reflectivity = _linear(path, arrays["reflectivity"])
    elif "image" in arrays:
        reflectivity = _luminance(path, arrays["image"])
    if "background" in arrays:
        background = _floats(path, "background", arrays["background"])
        if not ((background >= 0.0) & (background < np.inf)).all():
            raise ValueError(f"{path}: background must be finite and >= 0")
    for name, array in (("reflectivity or image", reflectivity), ("background", background)):
        if array is not None and array.shape != depth.shape:
            told = f"{_size(depth)}, got {_size(array)}"
            raise ValueError(f"{path}: {name} must have the size of depth, {told}")
    return depth, reflectivity, background


def _depth(path: Path, stored: NDArray[Any], unit: float | None) -> FloatArray:
    """Stored depth in metres, NaN where there is none."""
    if path.suffix.lower() in _DEPTH_IMAGES:
        if stored.ndim != 2 or stored.dtype.kind not in "iu" or stored.dtype.itemsize < 2:
            raise ValueError(f"{path}: depth must be 16-bit integers in one channel, got {_describe(stored)}")
        unit = 0.001 if unit is None else unit
    elif path.suffix.lower() in (".npy", ".npz"):
        if stored.dtype.kind in "iu" and unit is None:
            raise ValueError(
                f"{path}: depth is {stored.dtype}, whose unit is not known: give depth_unit_m (0.001 for mm)"
            )
        unit = 1.0 if unit is None else unit
    else:
        raise ValueError(f"{path}: depth must be a .png, .tif, .tiff, .npy or .npz file or a folder")
    depth = unit * _floats(path, "depth", stored)
    if (depth < 0.0).any():
        raise ValueError(f"{path}: depth must not be negative, got {depth[depth < 0.0][0]:g} m")
    return _known(path, np.where((depth > 0.0) & (depth < np.inf), depth, np.nan))


def _middlebury_depth(folder: Path) -> FloatArray:
    missing = [name for name in ("disp1.png", "view1.png", "dmin.txt") if not (folder / name).is_file()]
    if missing:
        raise ValueError(
            f"{folder}: {', '.join(missing)} not found; "
            f"a folder must be a Middlebury 2005/2006 scene with disp1.png, view1.png and dmin.txt"
        )
    text = (folder / "dmin.txt").read_text(errors="replace").strip()
    try:
        offset = _validate.real("dmin", float(text), low=0.0)
    except ValueError as error:
        raise ValueError(f"{folder / 'dmin.txt'}: must hold one number >= 0, got {text[:40]!r}") from error
    stored = _array(folder / "disp1.png")
    if stored.ndim != 2 or stored.dtype.kind not in "iu":
        told = _describe(stored)
        raise ValueError(f"{folder / 'disp1.png'}: must have one channel of integers, got {told}")
    disparity = stored.astype(np.float64)
    known = np.where(disparity > 0.0, disparity + offset, np.nan)
    return _known(folder / "disp1.png", _MIDDLEBURY_FOCAL_PX * _MIDDLEBURY_BASELINE_M / known)


def _reflectivity(path: Path, stored: NDArray[Any]) -> FloatArray:
    if path.suffix.lower() == ".npy" and stored.ndim == 2 and stored.dtype.kind == "f":
        return _linear(path, stored)
    return _luminance(path, stored)


def _linear(path: Path, stored: NDArray[Any]) -> FloatArray:
    values = _floats(path, "reflectivity", stored)
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise ValueError(f"{path}: reflectivity must lie in [0, 1], got {values.min():g} to {values.max():g}")
    return values


def _luminance(path: Path, stored: NDArray[Any]) -> FloatArray:
    """Linear luminance of an sRGB image: (H, W), (H, W, 1 to 4) with alpha as channel 2 or 4."""
    if stored.dtype in (np.uint8, np.uint16):
        encoded = stored / float(np.iinfo(stored.dtype).max)
    elif stored.dtype.kind == "f":
        encoded = stored.astype(np.float64)
        if not ((encoded >= 0.0) & (encoded <= 1.0)).all():
            raise ValueError(f"{path}: an image of floats must lie in [0, 1]")
    else:
        raise ValueError(f"{path}: image must have 8 or 16 bits per channel, got {_describe(stored)}")
    if encoded.ndim == 2:
        encoded = encoded[:, :, None]
    if encoded.ndim != 3 or encoded.size == 0 or encoded.shape[2] not in (1, 2, 3, 4):
        told = _describe(stored)
        raise ValueError(f"{path}: image must be grey or RGB, (H, W) or (H, W, 1 to 4), got {told}")
    colours = encoded[:, :, : 3 if encoded.shape[2] >= 3 else 1]
    light = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    luminance: FloatArray = light[:, :, 0] if light.shape[2] == 1 else np.minimum(light @ _LUMINANCE, 1.0)
    return luminance


def _floats(path: Path, name: str, stored: NDArray[Any]) -> FloatArray:
    if stored.ndim != 2 or stored.size == 0 or stored.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {name} must be real numbers (H, W), got {_describe(stored)}")
    return stored.astype(np.float64)


def _known(path: Path, depth: FloatArray) -> FloatArray:
    if np.isnan(depth).all():
        raise ValueError(f"{path}: no pixel has a depth")
    return depth


def _obliquity(shape: tuple[int, ...], focal: float) -> FloatArray:
    """Range over perpendicular depth at each pixel of a pinhole camera."""
    height, width = shape
    y, x = np.arange(height) - 0.5 * (height - 1), np.arange(width) - 0.5 * (width - 1)
    return np.sqrt(1.0 + (x**2 + y[:, None] ** 2) / focal**2)


def _describe(array: NDArray[Any]) -> str:
    return f"shape {array.shape} of {array.dtype}"


def _size(array: NDArray[Any]) -> str:
    return f"{array.shape[0]} x {array.shape[1]}"


def _reason(error: Exception) -> str:
    """The first line of what a decoder said."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
