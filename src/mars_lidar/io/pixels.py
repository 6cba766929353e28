"""Pixels of files: decoding images, arrays, PFM and OpenEXR, luminance of colours, checks that name the file.

A PFM, the portable float map, has three lines of text, then 32-bit floats, the bottom row first. The lines are ``Pf``
(one channel) or ``PF`` (three), the width and height, and a number whose sign gives the byte order: negative for
little-endian. Its magnitude is a scale that no depth data set uses (Middlebury 2014 puts 1/255 there for its viewer),
and it is ignored here as everywhere. OpenEXR needs the library of that name, of the extra ``io``.
"""

from __future__ import annotations

import math
import warnings
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar._base.files import FileError, check_claim, check_source, read_npy, reading
from mars_lidar._base.imports import needed
from mars_lidar._base.types import FloatArray, NDArray

if TYPE_CHECKING:
    from PIL.Image import Image

_PIXEL_BYTES = 4 + 3 * 8  # of a colour image: as it is stored, and as linear light
_DEPTHS = ("Z", "V", "Depth", "depth")  # last part of a channel's name in a layer: ViewLayer.Depth.Z of Blender
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


def read_pfm(path: Path) -> NDArray[np.float32]:
    """Values (H, W), or (H, W, 3), float32, the top row first; a ValueError begins with the file."""
    content = path.read_bytes()
    lines = content.split(b"\n", 3)
    if len(lines) < 4 or lines[0].strip() not in (b"Pf", b"PF"):
        raise ValueError(f"{path}: cannot be read (not a PFM: it must begin with a line Pf or PF)")
    channels = 3 if lines[0].strip() == b"PF" else 1
    try:
        width, height = (int(n) for n in lines[1].split())
        scale = float(lines[2])
    except ValueError:
        width = height = 0
        scale = math.nan
    if width < 1 or height < 1 or not scale or not math.isfinite(scale):
        header = (lines[1][:40] + b" / " + lines[2][:40]).decode("ascii", "replace")
        raise ValueError(f"{path}: cannot be read (not a PFM: width, height and scale are {header!r})")
    expected = 4 * width * height * channels
    if len(lines[3]) < expected:
        raise ValueError(f"{path}: cannot be read (cut short: {len(lines[3])} of {expected} bytes of values)")
    values: NDArray[Any] = np.frombuffer(lines[3], "<f4" if scale < 0 else ">f4", width * height * channels)
    shape = (height, width) if channels == 1 else (height, width, 3)
    return np.ascontiguousarray(values.reshape(shape)[::-1], dtype=np.float32)


def read_exr(path: Path) -> NDArray[Any]:
    """The depth (H, W): channel Z, else that of a layer (``*.Depth.Z``), Y, the only channel, or grey stored as RGB.

    ValueError, starting with the file, for several channels without a depth, for colours, and for unreadable files.
    """
    openexr = needed("OpenEXR", f"{path}: depth in .exr")
    check_source(path)
    with open(path, "rb") as file:
        magic = file.read(4)
    if not magic == b"\x76\x2f\x31\x01":  # the library would write to standard error
        raise ValueError(f"{path}: cannot be read (not an OpenEXR file)")
    with reading(path, "an OpenEXR file"):
        with openexr.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
            claimed = math.prod(int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
            check_claim(path, 8 * claimed * max(1, len(file.channels())), "its pixels")
        with openexr.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    return _depth_channel(path, channels)


def _depth_channel(path: Path, channels: dict[str, NDArray[Any]]) -> NDArray[Any]:
    names = ", ".join(sorted(channels)) or "none"
    for name in ("Z", "Y") if len(channels) > 1 else tuple(channels):
        if name in channels:
            return channels[name]
    layers = [name for name in channels if name.rpartition(".")[2] in _DEPTHS]
    deep = [name for name in layers if "depth" in name.lower()] or [name for name in layers if name.endswith("Z")]
    if len(deep) == 1:
        return channels[deep[0]]
    if deep:
        raise ValueError(f"{path}: has several channels of depth: {', '.join(deep)}; write one of them")
    grey = [channels[name] for name in ("R", "G", "B") if name in channels]
    if grey and all(np.array_equal(channel, grey[0], equal_nan=True) for channel in grey):
        return grey[0]
    if len(grey) > 1:
        raise ValueError(f"{path}: holds colours, not depth: its channels are {names}")
    raise ValueError(f"{path}: must have a channel of depth (Z, *.Depth.Z) or one channel, got {names}")


def reflectivity(path: Path, stored: NDArray[Any]) -> FloatArray:
    """Reflectivity (H, W) from the content of an image file or a .npy: floats in two dimensions are linear."""
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
        raise FileError(f"{path}: image must be grey or RGB, (H, W) or (H, W, 1 to 4), got {describe(stored)}")
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
    """The depth; ValueError if no pixel has one."""
    if np.isnan(depth).all():
        raise FileError(f"{path}: no pixel has a depth")
    return depth


def describe(array: NDArray[Any]) -> str:
    """Shape and type, for messages."""
    return f"shape {array.shape} of {array.dtype}"


def size(array: NDArray[Any]) -> str:
    """Height x width, for messages."""
    return f"{array.shape[0]} x {array.shape[1]}"
