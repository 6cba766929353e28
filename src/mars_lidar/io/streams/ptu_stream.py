"""PTU of PicoQuant, photon streams: generic T3 records with the real times of a raster scan.

Written: one detector looks at the pixels one after the other, each for one exposure, so pixel k spans laser
periods ``k * cycles`` to ``(k + 1) * cycles`` and line markers stand at both ends of each image row. Any
reader that makes images (`ptufile.imread`) gets the cube; one that makes streams gets the photons. The fine
time is in units of ``bin width / m``, m as large as the 15 bits of a record allow: the bin is kept exactly,
the time to half a unit.

Read: these files, and T3 and T2 streams of others, also of the formats before PTU, where a pixel is a detector.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import IncompleteFileError
from mars_lidar._base.imports import needed
from mars_lidar.io.streams import ptu_header
from mars_lidar.io.streams.photons import Photons, attributes, fine_times, of_fine_times
from mars_lidar.light.timestamps import Timestamps

KIND = "timestamps"
_WRAP = 1024  # laser periods that the 10 bits of a generic T3 record count
_SPECIAL, _OVERFLOW = np.uint32(1 << 31), np.uint32(63 << 25)
_SYNC = 64  # special bit and channel 0 of a T2 record
_PICOHARP = (0x00010203, 0x00010303)  # whose records have no special bit
_LINE_START, _LINE_STOP, _FRAME = 1, 2, 4  # marker bits, as the header of ptufile's writer declares them


def check() -> None:
    """Raise where the library that writes the format is missing."""
    needed("ptufile", "a .ptu")


def write(path: Path, times: Timestamps, clock_ps: float | None = None) -> None:
    """Write a stream; the caller renames the file when it is whole.

    `clock_ps`: least unit of the fine time. Programs that make images of the file have a bin for each of its codes:
    at the finest one, 32768 a period, an image of 128 x 128 pixels takes 1 GB there.
    """
    if times.bins > ptu_header.MAX_BINS:
        raise ValueError(f"bins must be at most {ptu_header.MAX_BINS} in a .ptu, got {times.bins}; use .h5 or .npz")
    height, width = times.shape
    if not times.cycles < 2**31:
        raise ValueError(f"cycles must be below 2^31 in a .ptu, got {times.cycles}")
    fine = units_per_bin(times.bins, times.period_ns, clock_ps)
    attrs = {"kind": KIND, **attributes(times)}
    with open(path, "w+b") as file:
        ptu_header.new_file(file, (height, width, times.bins * fine), times.period_ns, times.cycles, attrs, {})
        begin = file.tell()
        number = 0
        last = np.int64(0)  # overflows written so far
        for row in range(height):
            records, last = _with_overflows(*_row(times, row, fine), last)
            file.write(records.tobytes())
            number += records.size
        end = height * width * times.cycles
        records, last = _with_overflows(
            np.array([end]), np.array([_marker(_FRAME) | np.uint32(end % _WRAP)], np.uint32), last
        )
        file.write(records.tobytes())
        number += records.size
        ptu_header.set_integer(file, begin, b"TTResult_NumberOfRecords", number)
        ptu_header.set_integer(file, begin, b"ImgHdr_MaxFrames", 1)
        ptu_header.set_integer(file, begin, ptu_header.PHOTONS.encode(), len(times))


def read(path: Path, period_ns: float | None, bins: int | None) -> Timestamps:
    """Read a stream; `period_ns` and `bins` are for files of others."""
    with ptu_header.opened(path) as ptu:
        attrs = ptu_header.attributes(ptu.tags)
        if attrs.get("kind") == "cube":
            raise ValueError(f"{path} is a cube, not a stream: mars_lidar.io.load reads it")
        if not attrs and ptu.is_image:
            raise ValueError(
                f"{path} is an image of another program: mars_lidar.io.foreign_cube and mars-lidar reconstruct read it"
            )
        if attrs and (period_ns is not None or bins is not None):
            raise ValueError(f"{path} tells its period and bins: period_ns and bins are for the streams of others")
        if not attrs:
            return _photons(ptu, path).timestamps(period_ns, bins)
        decoded = ptu.decode_records()
        unit_ns = 1e9 * ptu.tcspc_resolution
    photons = decoded[decoded["channel"] >= 0]
    height, width = (int(n) for n in attrs["shape"])
    cycles, number = int(attrs["cycles"]), int(attrs["bins"])
    if not ((decoded["marker"] == _FRAME) & (decoded["channel"] < 0)).any():
        raise IncompleteFileError(f"{path} is incomplete: the marker at the end of its image is missing")
    pixel, cycle = np.divmod(photons["time"].astype(np.int64), cycles)
    if pixel.size and pixel.max() >= height * width:
        raise ValueError(f"{path} is damaged: it has photons after the last of {height} x {width} pixels")
    fine = max(1, round(float(attrs["period_ns"]) / (number * unit_ns)))
    dtime = photons["dtime"].astype(np.int64)
    return of_fine_times(attrs, cycle, dtime, fine, pixel)


def photons(path: Path) -> Photons:
    """The photons of a file: T3, or T2, absolute times; markers are passed over."""
    with ptu_header.opened(path) as ptu:
        return _photons(ptu, path)


def _photons(ptu: Any, path: Path) -> Photons:
    clock_ns, fine_ns = 1e9 * ptu.global_resolution, 1e9 * ptu.tcspc_resolution
    found = ptu.decode_records()
    kept = found["channel"] >= 0
    if not ptu.is_t3:
        channel = found["channel"].astype(np.int64)
        if ptu.record_type not in _PICOHARP:  # ptufile has the sync input as channel 0, like the first other one
            channel[ptu.read_records() >> 25 == _SYNC] = -1
        return Photons(found["time"][kept], clock_ns, channel[kept], str(path))
    found = found[kept]
    if not clock_ns > 0.0:
        raise ValueError(f"{path} tells no sync rate, so that its laser period is not known")
    return Photons(found["time"], clock_ns, found["channel"], str(path), found["dtime"], fine_ns, clock_ns)


def units_per_bin(bins: int, period_ns: float = 0.0, clock_ps: float | None = None) -> int:
    """Units of the fine time in a histogram bin: as many as a record has room for, or of at least `clock_ps` each."""
    most = ptu_header.MAX_BINS // bins
    return most if clock_ps is None else min(most, max(1, int(1e3 * period_ns / bins / clock_ps * (1 + 1e-9))))


def is_stream(path: Path) -> bool:
    """Whether the file holds a stream: ours, or of others but no image."""
    with ptu_header.opened(path) as ptu:
        attrs = ptu_header.attributes(ptu.tags)
        return attrs.get("kind") == KIND if attrs else not ptu.is_image


def _row(times: Timestamps, row: int, fine: int) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """Laser periods and records of an image row, its markers first and last."""
    width = times.shape[1]
    pixels = np.arange(row * width, (row + 1) * width)
    part = slice(int(times.offsets[pixels[0]]), int(times.offsets[pixels[-1] + 1]))
    counts = np.diff(times.offsets[pixels[0] : pixels[-1] + 2])
    cycle = times.cycle[part].astype(np.int64)
    dtime = fine_times(times, fine, part)
    period = np.repeat(pixels, counts) * times.cycles + cycle
    records = (dtime.astype(np.uint32) << np.uint32(10)) | (period % _WRAP).astype(np.uint32)
    ends = np.array([pixels[0], pixels[-1] + 1]) * times.cycles
    marks = [_marker(_LINE_START), _marker(_LINE_STOP)]
    first, last = (np.uint32(mark | np.uint32(end % _WRAP)) for mark, end in zip(marks, ends, strict=True))
    return (
        np.concatenate([ends[:1], period, ends[1:]]),
        np.concatenate([[first], records, [last]]).astype(np.uint32),
    )


def _marker(bits: int) -> np.uint32:
    return np.uint32(_SPECIAL | np.uint32(bits << 25))


def _with_overflows(
    period: NDArray[np.int64], records: NDArray[np.uint32], last: np.int64
) -> tuple[NDArray[np.uint32], np.int64]:
    """Records with overflow records between them: each tells of up to 1023 times 1024 periods."""
    wraps = period // _WRAP
    steps = np.diff(wraps, prepend=last)
    extra = -(-steps // (_WRAP - 1))
    at = np.repeat(np.arange(period.size), extra)
    order = np.arange(at.size) - np.repeat(np.cumsum(extra) - extra, extra)
    size = np.minimum(steps[at] - order * (_WRAP - 1), _WRAP - 1)
    return np.insert(records, at, _SPECIAL | _OVERFLOW | size.astype(np.uint32)), wraps[-1]
