"""PFM, the portable float map: three lines of text, then 32-bit floats, the bottom row first.

The lines are ``Pf`` (one channel) or ``PF`` (three), the width and height, and a number whose sign gives the
byte order: negative for little-endian. Its magnitude is a scale that no depth data set uses (Middlebury 2014
puts 1/255 there for its viewer), and it is ignored here as everywhere.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
        told = (lines[1][:40] + b" / " + lines[2][:40]).decode("ascii", "replace")
        raise ValueError(f"{path}: cannot be read (not a PFM: width, height and scale are {told!r})")
    expected = 4 * width * height * channels
    if len(lines[3]) < expected:
        raise ValueError(f"{path}: cannot be read (cut short: {len(lines[3])} of {expected} bytes of values)")
    values: NDArray[Any] = np.frombuffer(lines[3], "<f4" if scale < 0 else ">f4", width * height * channels)
    shape = (height, width) if channels == 1 else (height, width, 3)
    return np.ascontiguousarray(values.reshape(shape)[::-1], dtype=np.float32)
