"""TimeHarp 200 (.t3r of format 5.0): a clock of 100 ns that runs free of the laser, and the time since the laser pulse.

phconvert reads the header. The records are taken apart here, since phconvert 0.10 takes the routing channel from the
wrong bits and markers for overflows: time tag 16 bits, data 12, route 2, valid 1 (PicoQuant, TimeHarp 200 manual).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mars_lidar._base.optional import needed
from mars_lidar.io.streams.photons import Photons

_OVERFLOW = 0x800  # of the data of a record that is not valid


def photons(path: Path) -> Photons:
    """The photons of a file."""
    records, clock_s, fine_s, _ = needed("phconvert.pqreader", "a .t3r").t3r_reader(str(path))
    records = np.asarray(records, np.uint32)
    data, valid = (records >> 16) & 0xFFF, (records >> 30) & 1 == 1
    wraps = np.cumsum(~valid & (data & _OVERFLOW > 0), dtype=np.int64)
    clock = (records & 0xFFFF).astype(np.int64) + (wraps << 16)
    route = ((records >> 28) & 3).astype(np.int64)
    return Photons(
        clock[valid],
        1e9 * clock_s,
        route[valid],
        str(path),
        data[valid].astype(np.int64),
        1e9 * float(np.ravel(fine_s)[0]),
    )
