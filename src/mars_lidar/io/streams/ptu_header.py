"""What every PTU file of ours has in its header, and reading it back.

A PTU file is a list of tags (name, type, value) and then 32-bit records. Readers skip tags that they do not
know, so two of our own carry what the format has no place for: ``MarsLidar_Attributes`` (JSON) and
``MarsLidar_Variables`` (an .npz as binary blob).
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import open_npz, reading
from mars_lidar._base.imports import needed
from mars_lidar._version import __version__
from mars_lidar.io.streams import picoquant

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

    `cycles` are the laser periods of a pixel; the time that all records span is asked for by phconvert and PicoQuant's
    own software.
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


def attributes(found: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes in the tags `found`; empty where another program wrote the file."""
    text = found.get(_ATTRIBUTES)
    if not isinstance(text, str):
        return {}
    told = json.loads(text)
    return dict(told) if isinstance(told, dict) else {}


def variables(path: Path, found: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """The arrays in the tags `found` of a file."""
    blob = found.get(_VARIABLES, b"")
    if not blob:
        return {}
    with open_npz(path, BytesIO(blob)) as archive:
        return {name: archive[name] for name in archive.files}


def opened(path: Path, trimdims: str = "") -> Any:
    """A `ptufile.PtuFile`, also of the formats before PTU; ValueError where it is none, damaged, or never finished."""
    ptufile = needed("ptufile", f"a {path.suffix}")
    if path.suffix in picoquant.SUFFIXES:
        with reading(path, f"a {path.suffix}"):
            return ptufile.PtuFile(picoquant.as_ptu(path), trimdims=trimdims)
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
    stored, told = (path.stat().st_size - ptu.record_offset) // 4, ptu.tags.get("TTResult_NumberOfRecords", 0)
    if told > stored:
        ptu.close()
        raise ValueError(f"{path} is cut short: its header tells of {told} records, {stored} are there")
    return ptu


def set_integer(file: Any, end: int, tag: bytes, value: int) -> None:
    """Set the value of an integer tag in the header, which ends at byte `end`; the file's place is kept."""
    here = file.tell()
    file.seek(0)
    place = file.read(end).find(tag.ljust(32, b"\0"))
    if place < 0:
        raise ValueError(f"the header that ptufile wrote has no tag {tag.decode()}")
    file.seek(place + 40)  # after the name (32 bytes), its index and its type (4 bytes each)
    file.write(int(value).to_bytes(8, "little", signed=True))
    file.seek(here)
