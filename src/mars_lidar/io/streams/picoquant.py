"""PicoQuant's formats before PTU, .pt2 and .pt3 (PicoHarp 300), .ht2 and .ht3 (HydraHarp 400), as a PTU in memory.

Their records are those of a PTU; only the header is another one, of fixed places (PicoQuant, "Time Tagged File Format
Demos", github.com/PicoQuant; tsbischof/libpicoquant). ptufile then reads them as it reads a PTU.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

from mars_lidar._base.imports import needed

SUFFIXES = (".pt2", ".pt3", ".ht2", ".ht3")
_HYDRA_INPUTS, _HYDRA_INPUT_BYTES = 664, 20
_LSM = 3  # image header of a laser scanning microscope
_IMAGE = ("ImgHdr_Frame", "ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_BiDirect", "ImgHdr_PixX", "ImgHdr_PixY")


def as_ptu(path: Path) -> io.BytesIO:
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
        raise ValueError(f"{path} is cut short: its header tells of {number} records")
    if number == 0 and len(raw) > begin:
        raise ValueError(
            f"{path} was not finished: its header tells of no records, and {(len(raw) - begin) // 4} follow"
        )
    if len(words) >= 8 and words[:2] == (3, _LSM):
        tags |= {"Measurement_SubMode": 3, "ImgHdr_Dimensions": 3, "ImgHdr_Ident": _LSM}
        tags |= dict(zip(_IMAGE, words[2:8], strict=True))
    header = b"".join(encode(name, value) for name, value in {**tags, "Header_End": None}.items())
    return io.BytesIO(b"PQTTTR\0\x001.0.00\0\0" + header + raw[begin : begin + 4 * number])


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
