"""Photons of PicoQuant's TimeHarp 200: .t3r."""

import math
from pathlib import Path

import numpy as np

from mars_lidar.io.streams.photons import Photons

# of the header: bytes of its text, and of the names of the hardware that come before the board's numbers
_FORMATS = {b"5.0": (304, 0), b"6.0": (328, 24)}
_MEASUREMENT = 212  # bytes of settings between the two
_OVERFLOW = 0x800  # of the data of a record that is not valid


def photons(path: Path) -> Photons:
    """A clock that runs free of the laser, and the time since the laser pulse.

    Headers and records as PicoQuant's demonstration programs have them (TimeHarp 200, T3R file access, software 5.0 of
    2003 and 6.x of 2009). A record: time tag 16 bits, data 12, route 2, valid 1; a record that is not valid is an
    overflow of the time tag, or a marker.
    """
    content = path.read_bytes()
    kind, version = content[:16].strip(b"\0 "), content[16:22].strip(b"\0 ")
    if kind != b"TimeHarp 200" or version not in _FORMATS:
        known = " or ".join(name.decode() for name in _FORMATS)
        raise ValueError(f"{path} is no .t3r of format {known}: it begins with {kind!r} {version!r}")
    text, names = _FORMATS[version]
    board = text + _MEASUREMENT + names
    tags = board + 24
    if len(content) < tags + 52:
        raise ValueError(f"{path} is cut short: its header takes {tags + 52} bytes")
    fine_ns = float(np.frombuffer(content, "<f4", 1, board + 20)[0])
    header = np.frombuffer(content, "<i4", 13, tags)
    clock_ns, number, more = int(header[0]), int(header[11]), int(header[12])
    begin = tags + 52 + 4 * more
    if not (math.isfinite(fine_ns) and fine_ns > 0.0 and clock_ns > 0 and more >= 0):
        raise ValueError(f"{path} is damaged: its clocks are {clock_ns} ns and {fine_ns:g} ns, image header {more}")
    if not 0 <= number <= (len(content) - begin) // 4:
        raise ValueError(f"{path} is cut short: its header states {number} records")
    records = np.frombuffer(content, "<u4", number, begin)
    data, valid = (records >> 16) & 0xFFF, (records >> 30) & 1 == 1
    wraps = np.cumsum(~valid & (data & _OVERFLOW > 0), dtype=np.int64)
    clock = (records & 0xFFFF).astype(np.int64) + (wraps << 16)
    route = ((records >> 28) & 3).astype(np.int64)
    return Photons(clock[valid], clock_ns, route[valid], str(path), data[valid].astype(np.int64), fine_ns)
