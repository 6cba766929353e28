"""OpenEXR depth, as renderers write it; needs the library OpenEXR of the extra ``io``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import check_claim, check_source, reading
from mars_lidar._base.optional import needed

_DEPTHS = ("Z", "V", "Depth", "depth")  # last part of a channel's name in a layer: ViewLayer.Depth.Z of Blender


def read_exr(path: Path) -> NDArray[Any]:
    """The depth (H, W): the channel Z, else that of a layer (``*.Depth.Z``), Y, the only one, or grey written as RGB.

    A ValueError begins with the file: several channels of which none is depth, colours, or no EXR that can be read.
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
            found = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    return _depth(path, found)


def _depth(path: Path, found: dict[str, NDArray[Any]]) -> NDArray[Any]:
    told = ", ".join(sorted(found)) or "none"
    for name in ("Z", "Y") if len(found) > 1 else tuple(found):
        if name in found:
            return found[name]
    layers = [name for name in found if name.rpartition(".")[2] in _DEPTHS]
    deep = [name for name in layers if "depth" in name.lower()] or [name for name in layers if name.endswith("Z")]
    if len(deep) == 1:
        return found[deep[0]]
    if deep:
        raise ValueError(f"{path}: has several channels of depth: {', '.join(deep)}; write one of them")
    grey = [found[name] for name in ("R", "G", "B") if name in found]
    if grey and all(np.array_equal(one, grey[0], equal_nan=True) for one in grey):
        return grey[0]
    if len(grey) > 1:
        raise ValueError(f"{path}: holds colours, not depth: its channels are {told}")
    raise ValueError(f"{path}: must have a channel of depth (Z, *.Depth.Z) or one channel, got {told}")
