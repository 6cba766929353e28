"""Files of photon counters: histograms (.ptu and related formats, .t3r, .spc, .sdt), and photons of .t3r and .spc."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import check_claim, reading
from mars_lidar._base.imports import needed
from mars_lidar.io.streams import files, ptu
from mars_lidar.io.streams.photons import BEFORE_PTU, Photons

_PICOQUANT = (".ptu", *BEFORE_PTU)
RECORDER_SUFFIXES = (*_PICOQUANT, ".t3r", ".spc", ".sdt")


@dataclass(frozen=True, eq=False)
class Recorded:
    """Histograms of a recorder, and its description of them."""

    arrays: dict[str, NDArray[Any]]  # by name: (frames, y, x, t), (y, x, t) or (t,) counts
    bin_ns: float | None = None  # width of a bin
    period_ns: float | None = None  # of the laser, as the file has it: a whole number of bins need not fill it
    cycles: int | None = None  # laser periods of a pixel and frame
    notes: tuple[str, ...] = ()  # what else is worth a line


def photons(path: Path) -> Photons:
    """The photons of a .t3r or .spc."""
    return _time_harp(path) if path.suffix == ".t3r" else _becker_hickl(path)


def recorded(path: Path) -> Recorded:
    """Read the histograms of a file."""
    with reading(path, f"a {path.suffix}"):
        if path.suffix == ".sdt":
            return _sdt(path)
        if path.suffix in _PICOQUANT:
            with ptu.open_ptu(path, trimdims="T") as file:
                if file.is_image:
                    return _image(path, file)
        recording = files.recorded(path)
        period = recording.period_ns
        cycles = int(recording.clock.max()) + 1 if recording.clock.size and period is not None else None
        return Recorded(recording.histograms(), recording.fine_ns, period, cycles)


def _image(path: Path, ptu: Any) -> Recorded:
    """A scanned image: ptufile puts the photons between the markers of lines and frames into pixels."""
    if not ptu.is_t3:
        raise ValueError(f"{path} is a scan of absolute times (T2): without laser pulses it has no histograms")
    period, width = 1e9 * ptu.global_resolution, 1e9 * ptu.tcspc_resolution
    bins = max(1, round(period / width))
    frames, height, columns, channels, _ = ptu.shape
    check_claim(path, 4.0 * frames * height * columns * bins * channels, "its image")
    image = ptu.decode_image(dtime=bins, dtype=np.uint32, keepdims=True)
    used, total = int(image.sum(dtype=np.uint64)), int(ptu.number_photons)
    notes = (f"{total - used:,} of {total:,} photons lie between lines and frames or beyond the last whole bin",)
    first = next(iter(ptu.active_channels), 0)
    arrays = {}
    for k in range(image.shape[3]):
        counts = image[:, :, :, k]
        if counts.any() or image.shape[3] == 1:
            name = f"channel {k if image.shape[3] > 1 else first}"
            arrays[name] = counts[0] if frames == 1 else counts
    cycles = round(ptu.global_pixel_time)
    return Recorded(arrays, width, period, cycles if cycles > 0 else None, notes if total > used else ())


def _sdt(path: Path) -> Recorded:
    """Becker & Hickl's histograms and images; sdtfile reads them."""
    library = needed("sdtfile", "a .sdt")
    with open(path, "rb") as file, library.SdtFile(file) as sdt:
        blocks = {f"block {k}": np.asarray(data) for k, data in enumerate(sdt.data)}
        times = [np.asarray(axis, np.float64) for axis in sdt.times]
    blocks = {name: data for name, data in blocks.items() if data.dtype.kind in "iu" and data.ndim and data.size > 1}
    widths = {float(axis[1] - axis[0]) * 1e9 for axis in times if axis.size > 1}
    if not blocks:
        raise ValueError(f"{path} holds no histograms: photon by photon is in .spc")
    width = widths.pop() if len(widths) == 1 else math.nan
    return Recorded(blocks, width if width > 0.0 else None)


# of the header: bytes of its text, and of the names of the hardware that come before the board's numbers
_FORMATS = {b"5.0": (304, 0), b"6.0": (328, 24)}
_MEASUREMENT = 212  # bytes of settings between the two
_OVERFLOW = 0x800  # of the data of a record that is not valid


def _time_harp(path: Path) -> Photons:
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


_SYNC = 1  # SP_MST_CLK: the macro clock is the laser's sync; 0: one of its own, others: the sync divided
_MARKER_WRAP = 0xD  # a marker with an overflow: phconvert 0.10 reads its bits as the number of overflows


def _becker_hickl(path: Path) -> Photons:
    """Becker & Hickl's FIFO records; phconvert reads them with the .set that SPCM writes beside them."""
    reader = needed("phconvert.bhreader", "a .spc")
    settings = next((each for each in map(path.with_suffix, (".set", ".SET")) if each.is_file()), None)
    if settings is None:
        raise ValueError(
            f"{path} needs {path.with_suffix('.set').name} beside it: it tells the card and its time range"
        )
    code = int(reader.load_set(settings)["header"][0]["revision"] & 0xFF0) >> 4
    card = reader._spc_codes.get(code, f"of code {code:#x}")
    kind = "SPC-1XX" if card == "SPC-140" else "auto"  # phconvert knows the card, but not that it is of this kind
    if reader._spc_types.get(card) in (None, "NotSup", "DPC-230"):
        raise ValueError(f"{path} is of a card {card}, whose records phconvert does not read")
    if kind == "SPC-1XX" or reader._spc_types[card] == "SPC-1XX":
        words = np.fromfile(path, "<u4")[1:]
        if (words >> 28 == _MARKER_WRAP).any():
            raise ValueError(f"{path} has markers of a scan, which phconvert misreads: save it as .sdt or export times")
    recording = reader.load_spc(path, settings, kind)
    data, setup = recording["photon_data"], recording["meta"]["setup"]
    photon = ~np.isin(data["detectors"], data["marker_ids"])
    clock_ns = 1e9 * float(data["timestamps_unit"])
    bins = int(data.get("tcspc_num_bins", 4096))
    fine_ns = 1e9 * float(setup.get("SP_TAC_R", 0.0)) / float(setup.get("SP_TAC_G", 1) or 1) / bins
    if not fine_ns > 0.0:
        raise ValueError(f"{settings} does not state the time range, SP_TAC_R")
    return Photons(
        np.asarray(data["timestamps"][photon], np.int64),
        clock_ns,
        np.asarray(data["detectors"][photon], np.int64),
        str(path),
        np.asarray(data["nanotimes"][photon], np.int64),
        fine_ns,
        clock_ns if setup.get("SP_MST_CLK") == _SYNC else None,
    )
