"""OpenEXR depth, as renderers write it; needs the library OpenEXR of the extra ``io``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import check_claim, check_source, reading
from mars_lidar._base.optional import needed

_CHANNELS = ("Z", "Y", "R")  # depth, luminance; red where a grey image was written in colour


def read_exr(path: Path) -> NDArray[Any]:
    """The channel Z (H, W), else Y, R or the only one.

    Raises
    ------
    ValueError
        Not an EXR that can be read, or several channels of which none is depth; the message starts with the
        file. `mars_lidar.io.MissingLibraryError` where OpenEXR is not installed.
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
    for name in _CHANNELS if len(found) > 1 else tuple(found):
        if name in found:
            return found[name]
    raise ValueError(f"{path}: must have a channel Z, Y or R, got {', '.join(sorted(found)) or 'none'}")
