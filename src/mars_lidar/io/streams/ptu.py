"""PTU of PicoQuant and the formats before it: header, cubes and photon streams.

A PTU file is a list of tags (name, type, value) and then 32-bit records. Readers skip unknown tags, so that
two additional tags contain the data without a place in the format: ``MarsLidar_Attributes`` (JSON) and
``MarsLidar_Variables`` (an .npz as binary blob).

Cubes: a T3 image that programs of laboratories open; realizations are its frames. The format contains photons, not
counts: `ptufile.PtuWriter` writes the photons of a pixel in successive laser periods, so that any reader that makes an
image of the file returns the cube. The times of photons within the exposure are not stored.

Photon streams: generic T3 records with the real times of a raster scan. Written: one detector records the pixels one
after the other, each for one exposure, so that pixel k spans laser periods ``k * cycles`` to ``(k + 1) * cycles``, with
line markers at both ends of each image row. A reader of images (`ptufile.imread`) returns the cube, a reader of streams
the photons. The fine time is in units of ``bin width / m``, m as large as the 15 bits of a record
allow: the bin is kept exactly, the time to half a unit. Read: these files, and T3 and T2 streams of others, where a
pixel is a detector.

``.pt2`` and ``.pt3`` (PicoHarp 300), ``.ht2`` and ``.ht3`` (HydraHarp 400) become a PTU in memory: their records are
those of a PTU; only the header differs, with fixed positions (PicoQuant, "Time Tagged File Format Demos",
github.com/PicoQuant; tsbischof/libpicoquant).
"""

import contextlib
import json
import math
import struct
import uuid
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import IncompleteFileError, UnchangedFile, beside, open_npz, reading
from mars_lidar._base.imports import needed
from mars_lidar._base.resources import check_memory
from mars_lidar._version import __version__
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.store import LazyCounts, OnDisk, OpenedStore, Writer
from mars_lidar.io.streams.photons import BEFORE_PTU, Photons, attributes, fine_times, of_fine_times
from mars_lidar.light.timestamps import Timestamps

MAX_BINS = 2**15  # 15 bits of delay in a generic T3 record
_ATTRIBUTES, _VARIABLES = "MarsLidar_Attributes", "MarsLidar_Variables"
PHOTONS = "MarsLidar_Photons"  # number of photons; 0 until the file is finished
_MAGIC = b"PQTTTR\0\0"
_MAX_BLOB = 2**31 - 1


def new_file(
    file: Any,
    shape: tuple[int, int, int],
    period_ns: float,
    cycles: int,
    attrs: Mapping[str, Any],
    variables: Mapping[str, NDArray[Any]],
    frames: int = 1,
) -> Any:
    """A `ptufile.PtuWriter` of generic T3 records, with our tags, for images of shape (H, W, bins).

    `cycles` are the laser periods of a pixel; phconvert and PicoQuant's software need the time that all records span.
    """
    ptufile = needed("ptufile", "a .ptu")
    packed = BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(array) for name, array in variables.items()}
    np.savez_compressed(packed, **arrays)
    if packed.tell() > _MAX_BLOB:
        raise ValueError(f"the maps of a .ptu must take less than 2 GiB, got {packed.tell()} bytes; use .h5")
    text = json.dumps(attrs)
    height, width, bins = shape
    period_s = 1e-9 * period_ns
    tags = {
        "File_GUID": f"{{{uuid.uuid5(uuid.NAMESPACE_OID, text)}}}",
        "File_Comment": f"simulated by mars-lidar {__version__}: {attrs.get('source', '')}"[:200],
        "CreatorSW_Name": "mars-lidar",
        "CreatorSW_Version": __version__,
        "HW_Type": "mars-lidar",
        "MeasDesc_AcquisitionTime": round(1e3 * period_s * cycles * height * width * frames),
        PHOTONS: 0,
        _ATTRIBUTES: text,
        _VARIABLES: packed.getvalue(),
    }
    return ptufile.PtuWriter(
        file,
        (1, height, width, 1, bins),
        period_s,
        period_s / bins,
        period_s * cycles,
        record_type=ptufile.PtuRecordType.GenericT3,
        tags=tags,
    )


def header_attributes(tags: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes in the tags of a file; empty for files of other programs."""
    text = tags.get(_ATTRIBUTES)
    if not isinstance(text, str):
        return {}
    attrs = json.loads(text)
    return dict(attrs) if isinstance(attrs, dict) else {}


def header_variables(path: Path, tags: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """The arrays in the tags of a file."""
    blob = tags.get(_VARIABLES, b"")
    if not blob:
        return {}
    with open_npz(path, BytesIO(blob)) as archive:
        return {name: archive[name] for name in archive.files}


def open_ptu(path: Path, trimdims: str = "") -> Any:
    """A `ptufile.PtuFile`, also of the formats before PTU; ValueError for other, damaged or unfinished files."""
    ptufile = needed("ptufile", f"a {path.suffix}")
    if path.suffix in BEFORE_PTU:
        with reading(path, f"a {path.suffix}"):
            return ptufile.PtuFile(as_ptu(path), trimdims=trimdims)
    with open(path, "rb") as file:
        magic = file.read(8)
    if magic != _MAGIC:
        raise ValueError(f"{path} is not a PTU file: it starts with {magic!r}, not {_MAGIC!r}")
    with reading(path, "a PTU file"):
        ptu = ptufile.PtuFile(path, trimdims=trimdims)
    for name in ("ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_Frame"):
        marker = ptu.tags.get(name)
        if marker is not None and not (isinstance(marker, int) and 0 <= marker <= 32):  # ptufile takes 2 to its power
            ptu.close()
            raise ValueError(f"{path} is damaged: {name} must be a marker of at most 32, got {marker!r}")
    stored, stated = (path.stat().st_size - ptu.record_offset) // 4, ptu.tags.get("TTResult_NumberOfRecords", 0)
    if stated > stored:
        ptu.close()
        raise ValueError(f"{path} is cut short: its header states {stated} records, {stored} are there")
    return ptu


def set_integer(file: Any, end: int, tag: bytes, value: int) -> None:
    """Set the value of an integer tag in the header, which ends at byte `end`; the position in the file is restored."""
    here = file.tell()
    file.seek(0)
    place = file.read(end).find(tag.ljust(32, b"\0"))
    if place < 0:
        raise ValueError(f"the header that ptufile wrote has no tag {tag.decode()}")
    file.seek(place + 40)  # after the name (32 bytes), its index and its type (4 bytes each)
    file.write(int(value).to_bytes(8, "little", signed=True))
    file.seek(here)


_HYDRA_INPUTS, _HYDRA_INPUT_BYTES = 664, 20
_LSM = 3  # image header of a laser scanning microscope
_IMAGE = ("ImgHdr_Frame", "ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_BiDirect", "ImgHdr_PixX", "ImgHdr_PixY")


def as_ptu(path: Path) -> BytesIO:
    """The file as a PTU: tags from its header, then its records."""
    encode = needed("ptufile.ptufile", f"a {path.suffix}").encode_tag
    raw = path.read_bytes()
    kind, version = raw[:16].strip(b"\0 "), raw[16:22].strip(b"\0 ")
    known = {(b"PicoHarp 300", b"2.0"): _pico, (b"HydraHarp 400", b"1.0"): _hydra, (b"HydraHarp 400", b"2.0"): _hydra}
    if (kind, version) not in known:
        raise ValueError(f"{path} is no {path.suffix}: it begins with {kind!r} {version!r}; is it of another version?")
    tags, end, image = known[kind, version](raw)
    begin = end + 4 * image
    words = struct.unpack_from(f"<{image}i", raw, end) if image >= 0 and begin <= len(raw) else ()
    number = tags["TTResult_NumberOfRecords"]
    if len(words) != image or not 0 <= number <= (len(raw) - begin) // 4:
        raise ValueError(f"{path} is cut short: its header states {number} records")
    if number == 0 and len(raw) > begin:
        raise ValueError(f"{path} was not finished: its header states no records, and {(len(raw) - begin) // 4} follow")
    if len(words) >= 8 and words[:2] == (3, _LSM):
        tags |= {"Measurement_SubMode": 3, "ImgHdr_Dimensions": 3, "ImgHdr_Ident": _LSM}
        tags |= dict(zip(_IMAGE, words[2:8], strict=True))
    header = b"".join(encode(name, value) for name, value in {**tags, "Header_End": None}.items())
    return BytesIO(b"PQTTTR\0\x001.0.00\0\0" + header + raw[begin : begin + 4 * number])


def _pico(raw: bytes) -> tuple[dict[str, Any], int, int]:
    """Tags, end of the header, and words of the image header, of format 2.0."""
    bits, mode = _at(raw, "<i", 332), _at(raw, "<i", 348)
    rate, number, image = _at(raw, "<i", 704), _at(raw, "<i", 720), _at(raw, "<i", 724)
    fine_s, base_s = 1e-9 * _at(raw, "<f", 584), 4e-12
    return _tags(bits, mode, {2: 0x00010203, 3: 0x00010303}, rate, base_s, fine_s, number), 728, image


def _hydra(raw: bytes) -> tuple[dict[str, Any], int, int]:
    """As `_pico`, of formats 1.0, whose T2 records count half units, and 2.0."""
    first = raw[16:19] == b"1.0"
    bits, mode = _at(raw, "<i", 332), _at(raw, "<i", 340)
    fine_s, base_s = 1e-12 * _at(raw, "<d", 352), 1e-12 * _at(raw, "<d", 648) * (0.5 if first else 1.0)
    place = _HYDRA_INPUTS + 32 + _HYDRA_INPUT_BYTES * _at(raw, "<i", _HYDRA_INPUTS)
    rate, image, number = _at(raw, "<i", place), _at(raw, "<i", place + 12), _at(raw, "<Q", place + 16)
    types = {2: 0x00010204, 3: 0x00010304} if first else {2: 0x01010204, 3: 0x01010304}
    return _tags(bits, mode, types, rate, base_s, fine_s, number), place + 24, image


def _tags(
    bits: int, mode: int, types: dict[int, int], rate: int, base_s: float, fine_s: float, number: int
) -> dict[str, Any]:
    if bits != 32 or mode not in types:
        raise ValueError(f"records must have 32 bits and be of mode T2 or T3, got {bits} bits and mode {mode}")
    clock_s = base_s if mode == 2 else (1.0 / rate if rate > 0 else 0.0)
    return {
        "Measurement_Mode": mode,
        "Measurement_SubMode": 1,
        "MeasDesc_GlobalResolution": clock_s,
        "MeasDesc_Resolution": fine_s,
        "TTResult_NumberOfRecords": number,
        "TTResult_SyncRate": rate,
        "TTResultFormat_TTTRRecType": types[mode],
        "TTResultFormat_BitsPerRecord": bits,
    }


def _at(raw: bytes, kind: str, place: int) -> Any:
    return struct.unpack_from(kind, raw, place)[0]


CUBE = "cube"
_IMAGE_END = ((1 << 31) | (63 << 25) | 1).to_bytes(4, "little")  # generic T3: 1024 laser periods more
_MAX_PIXEL_PERIODS = 2**31  # ptufile counts the periods of a pixel in 32 bits


def check(recipe: Recipe) -> None:
    """Raise ValueError, before any work, for data that the format cannot contain."""
    needed("ptufile", "a .ptu")
    if recipe.system.bins > MAX_BINS:
        raise ValueError(f"bins must be at most {MAX_BINS} in a .ptu, got {recipe.system.bins}; use .h5")
    if _pixel_periods(recipe) >= _MAX_PIXEL_PERIODS:
        raise ValueError(f"a pixel of a .ptu must span fewer than 2^31 laser periods, got {_pixel_periods(recipe)}")


@contextlib.contextmanager
def open_writer(path: Path, recipe: Recipe) -> Iterator[Writer]:
    """Writes a cube image by image; the number of records is written into the header at the end."""
    check(recipe)
    _, height, width, bins = recipe.shape
    size = height * width * bins * recipe.dtype.itemsize
    check_memory(3 * size, f"the images of {path}, which are written whole,", "a .zarr or .h5 is written in parts")
    image, periods = np.empty((height, width, bins), recipe.dtype), _pixel_periods(recipe)
    attrs = {"kind": CUBE, "complete": True, **layout.attributes(recipe)}
    arrays = {v.name: v.data for v in layout.variables(recipe)}

    def put(realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        for part in block:
            image[rows] = part
            if rows.stop < height:  # an image is written when its last row has come
                continue
            most = int(image.sum(-1, dtype=np.uint64).max())
            if most > periods:  # the writer would leave photons out without a word
                raise ValueError(f"a pixel of {most} counts does not fit the {periods} laser periods of a .ptu")
            ptu.write(image[None, :, :, None])
            file.write(_IMAGE_END)  # the next image begins with its time at 0: time must not run backwards

    with beside(path) as unfinished, open(unfinished, "w+b") as file:
        ptu = new_file(file, (height, width, bins), recipe.system.period_ns, periods, attrs, arrays, recipe.shape[0])
        begin = file.tell()
        writer = Writer(recipe.chunks(size), put)
        yield writer
        records = (file.tell() - begin) // 4
        ptu.close()
        set_integer(file, begin, b"TTResult_NumberOfRecords", records)
        set_integer(file, begin, PHOTONS.encode(), writer.registrations)


def open_store(path: Path) -> OpenedStore:
    """Open a file for reading."""
    opened = UnchangedFile(path)
    with open_ptu(path) as ptu:
        attrs = header_attributes(ptu.tags)
        arrays = header_variables(path, ptu.tags)
        frames = int(ptu.tags.get("ImgHdr_MaxFrames", 0))
        attrs["registrations"] = int(ptu.tags.get(PHOTONS, 0))
    if attrs.get("kind") != CUBE:
        raise ValueError(
            f"{path} is not a cube written by mars-lidar; mars_lidar.Timestamps.load reads photon streams, "
            f"ptufile.imread any image"
        )
    layout.check_format(path, attrs)
    recipe = layout.recipe_from(attrs, arrays, frames)
    shape = recipe.shape

    def counts() -> NDArray[Any]:
        with opened.unchanged(), open_ptu(path) as ptu:
            size = recipe.nbytes + path.stat().st_size
            check_memory(size, f"the counts of {path}", "mars-lidar convert makes a .zarr of it elsewhere")
            image = ptu.decode_image(channel=0, dtime=shape[-1], dtype=recipe.dtype)
        if image.shape != (*shape[:3], 1, shape[3]):
            made = f"{image.shape[:3]} instead of {shape[:3]} (realization, y, x)"
            raise ValueError(f"{path} is damaged: its records make an image of {made}")
        total = int(image.sum(dtype=np.uint64))
        if total != attrs["registrations"]:
            raise ValueError(f"{path} is damaged: its image has {total} of {attrs['registrations']} registrations")
        return np.ascontiguousarray(image[:, :, :, 0])

    return OpenedStore(attrs, arrays | {"histogram": OnDisk(LazyCounts(shape, recipe.dtype, counts), path)})


def _pixel_periods(recipe: Recipe) -> int:
    """Laser periods given to a pixel: the exposure, or more where its photons could be more."""
    system = recipe.system
    mean = float(recipe.flux.total.max()) * system.cycles
    most = mean + 12.0 * math.sqrt(mean) + 60.0  # of a Poisson count; probability of more: 1e-30
    if system.detector.dead_time_ns > 0:
        most = min(most, system.exposure_ns // system.detector.dead_time_ns + 1)
    return max(system.cycles, math.ceil(most))


STREAM = "timestamps"
_WRAP = 1024  # laser periods that the 10 bits of a generic T3 record count
_SPECIAL, _OVERFLOW = np.uint32(1 << 31), np.uint32(63 << 25)
_SYNC = 64  # special bit and channel 0 of a T2 record
_PICOHARP = (0x00010203, 0x00010303)  # whose records have no special bit
_LINE_START, _LINE_STOP, _FRAME = 1, 2, 4  # marker bits, as the header of ptufile's writer declares them


def check_library() -> None:
    """Raise if the library that writes the format is missing."""
    needed("ptufile", "a .ptu")


def write(path: Path, times: Timestamps, clock_ps: float | None = None) -> None:
    """Write a stream; the caller renames the complete file.

    `clock_ps`: smallest unit of the fine time. Programs that make images of the file use one bin per unit: at the
    finest unit, 32768 a period, an image of 128 x 128 pixels takes 1 GB.
    """
    if times.bins > MAX_BINS:
        raise ValueError(f"bins must be at most {MAX_BINS} in a .ptu, got {times.bins}; use .h5 or .npz")
    height, width = times.shape
    if not times.cycles < 2**31:
        raise ValueError(f"cycles must be below 2^31 in a .ptu, got {times.cycles}")
    fine = units_per_bin(times.bins, times.period_ns, clock_ps)
    attrs = {"kind": STREAM, **attributes(times)}
    with open(path, "w+b") as file:
        new_file(file, (height, width, times.bins * fine), times.period_ns, times.cycles, attrs, {})
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
        set_integer(file, begin, b"TTResult_NumberOfRecords", number)
        set_integer(file, begin, b"ImgHdr_MaxFrames", 1)
        set_integer(file, begin, PHOTONS.encode(), len(times))


def read(path: Path, period_ns: float | None, bins: int | None) -> Timestamps:
    """Read a stream; `period_ns` and `bins` are for files of other programs."""
    with open_ptu(path) as ptu:
        attrs = header_attributes(ptu.tags)
        if attrs.get("kind") == CUBE:
            raise ValueError(f"{path} is a cube, not a stream: mars_lidar.io.load reads it")
        if not attrs and ptu.is_image:
            raise ValueError(
                f"{path} is an image of another program: mars_lidar.io.foreign_cube and mars-lidar reconstruct read it"
            )
        if attrs and (period_ns is not None or bins is not None):
            raise ValueError(f"{path} states its period and bins: period_ns and bins are for streams of other programs")
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
    """The photons of a file: T3, or T2, absolute times; markers are skipped."""
    with open_ptu(path) as ptu:
        return _photons(ptu, path)


def _photons(ptu: Any, path: Path) -> Photons:
    clock_ns, fine_ns = 1e9 * ptu.global_resolution, 1e9 * ptu.tcspc_resolution
    records = ptu.decode_records()
    photon = records["channel"] >= 0
    if not ptu.is_t3:
        channel = records["channel"].astype(np.int64)
        if ptu.record_type not in _PICOHARP:  # ptufile has the sync input as channel 0, like the first other one
            channel[ptu.read_records() >> 25 == _SYNC] = -1
        return Photons(records["time"][photon], clock_ns, channel[photon], str(path))
    records = records[photon]
    if not clock_ns > 0.0:
        raise ValueError(f"{path} states no sync rate, so that its laser period is unknown")
    return Photons(records["time"], clock_ns, records["channel"], str(path), records["dtime"], fine_ns, clock_ns)


def units_per_bin(bins: int, period_ns: float = 0.0, clock_ps: float | None = None) -> int:
    """Units of the fine time in a histogram bin: as many as fit in a record, or units of at least `clock_ps`."""
    most = MAX_BINS // bins
    return most if clock_ps is None else min(most, max(1, int(1e3 * period_ns / bins / clock_ps * (1 + 1e-9))))


def is_stream(path: Path) -> bool:
    """Whether the file contains a stream: of mars-lidar, or of another program and not an image."""
    with open_ptu(path) as ptu:
        attrs = header_attributes(ptu.tags)
        return attrs.get("kind") == STREAM if attrs else not ptu.is_image


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
    return (np.concatenate([ends[:1], period, ends[1:]]), np.concatenate([[first], records, [last]]).astype(np.uint32))


def _marker(bits: int) -> np.uint32:
    return np.uint32(_SPECIAL | np.uint32(bits << 25))


def _with_overflows(
    period: NDArray[np.int64], records: NDArray[np.uint32], last: np.int64
) -> tuple[NDArray[np.uint32], np.int64]:
    """Records with overflow records between them: each stands for up to 1023 times 1024 periods."""
    wraps = period // _WRAP
    steps = np.diff(wraps, prepend=last)
    extra = -(-steps // (_WRAP - 1))
    at = np.repeat(np.arange(period.size), extra)
    order = np.arange(at.size) - np.repeat(np.cumsum(extra) - extra, extra)
    size = np.minimum(steps[at] - order * (_WRAP - 1), _WRAP - 1)
    return np.insert(records, at, _SPECIAL | _OVERFLOW | size.astype(np.uint32)), wraps[-1]
