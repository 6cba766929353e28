"""Pixels of files: decoding images and arrays, luminance of colours, checks that name the file."""

from __future__ import annotations

import math
import warnings
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import FileError, check_claim, read_npy, reading
from mars_lidar._base.types import FloatArray

if TYPE_CHECKING:
    from PIL.Image import Image

_PIXEL_BYTES = 4 + 3 * 8  # of a colour image: as it is stored, and as linear light
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709, the primaries of sRGB


def array(path: Path) -> NDArray[Any]:
    """The pixels of an image file or the array of a .npy file."""
    if not path.exists():
        raise FileError(f"{path}: no such file")
    if path.suffix.lower() == ".npy":
        return read_npy(path)
    with reading(path, "an image"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the decoder, about metadata and large images
        from PIL import Image

        content = path.read_bytes()  # decoders that fail leave the files they opened open
        with Image.open(BytesIO(content)) as image:  # which reads no pixels
            check_claim(path, _PIXEL_BYTES * math.prod(image.size), "its pixels")
            return decoded(image)


def decoded(image: Image) -> NDArray[Any]:
    """Pixels (H, W) or (H, W, channels) of an image of Pillow: colours for a palette, 16 bits of a grey PNG as such."""
    if image.mode == "P":
        return np.array(image.convert(image.palette.mode if image.palette else "RGB"))
    values = np.array(image)
    return values.astype(np.uint16) if image.format == "PNG" and values.dtype == np.int32 else values


def reflectivity(path: Path, stored: NDArray[Any]) -> FloatArray:
    """Reflectivity (H, W) of what an image file or a .npy holds: floats in two dimensions are linear."""
    if path.suffix.lower() == ".npy" and stored.ndim == 2 and stored.dtype.kind == "f":
        return linear(path, stored)
    return luminance(path, stored)


def linear(path: Path, stored: NDArray[Any]) -> FloatArray:
    """Reflectivity (H, W), float64, checked to lie in [0, 1]."""
    values = floats(path, "reflectivity", stored)
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise FileError(f"{path}: reflectivity must lie in [0, 1], got {values.min():g} to {values.max():g}")
    return values


def luminance(path: Path, stored: NDArray[Any]) -> FloatArray:
    """Linear luminance of an sRGB image: (H, W), (H, W, 1 to 4) with alpha as channel 2 or 4."""
    if stored.dtype in (np.uint8, np.uint16):
        encoded = stored / float(np.iinfo(stored.dtype).max)
    elif stored.dtype.kind == "f":
        encoded = stored.astype(np.float64)
        if not ((encoded >= 0.0) & (encoded <= 1.0)).all():
            raise FileError(f"{path}: an image of floats must lie in [0, 1]")
    else:
        raise FileError(f"{path}: image must have 8 or 16 bits per channel, got {describe(stored)}")
    if encoded.ndim == 2:
        encoded = encoded[:, :, None]
    if encoded.ndim != 3 or encoded.size == 0 or encoded.shape[2] not in (1, 2, 3, 4):
        told = describe(stored)
        raise FileError(f"{path}: image must be grey or RGB, (H, W) or (H, W, 1 to 4), got {told}")
    colours = encoded[:, :, : 3 if encoded.shape[2] >= 3 else 1]
    light = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    luminance: FloatArray = light[:, :, 0] if light.shape[2] == 1 else np.minimum(light @ _LUMINANCE, 1.0)
    return luminance


def floats(path: Path, name: str, stored: NDArray[Any]) -> FloatArray:
    """Real numbers (H, W), float64."""
    if stored.ndim != 2 or stored.size == 0 or stored.dtype.kind not in "fiu":
        raise FileError(f"{path}: {name} must be real numbers (H, W), got {describe(stored)}")
    return stored.astype(np.float64)


def known(path: Path, depth: FloatArray) -> FloatArray:
    """The depth, unless no pixel has one."""
    if np.isnan(depth).all():
        raise FileError(f"{path}: no pixel has a depth")
    return depth


def describe(array: NDArray[Any]) -> str:
    """Shape and type, for messages."""
    return f"shape {array.shape} of {array.dtype}"


def size(array: NDArray[Any]) -> str:
    """Height x width, for messages."""
    return f"{array.shape[0]} x {array.shape[1]}"
