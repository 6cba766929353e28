"""The elements of a MATLAB file of version 5 are checked before SciPy reads them.

SciPy uses the type of an element as an index into a table without a bounds check: a damaged type crashes the process.
Layout: MathWorks, MAT-File Format, chapter 1.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

from mars_lidar._base.tolerances import TOL

_VALUES = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18})  # numbers and characters
_CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", **dict.fromkeys(range(6, 16), "numbers")}


_PARTS = {4: 3, 5: 5, **dict.fromkeys(range(6, 16), 3)}  # elements after the flags, by class: shape, name, values
_HEAD = 40  # bytes of the flags, the shape and the name of an array, at least


class _Kind(IntEnum):
    """Types of elements that contain others."""

    MATRIX = 14
    COMPRESSED = 15


_MATRIX = int(_Kind.MATRIX)  # compared for each element, where an enumeration costs


@dataclass(frozen=True)
class Variable:
    """A variable: its header, and the position of its data."""

    name: str
    kind: str  # "numbers", "sparse", "cell", "struct", ...
    shape: tuple[int, ...]
    size: int = 0  # bytes of its element, unpacked
    _path: Path = field(default=Path(), repr=False)
    _place: tuple[int, int, int] = (0, 0, 0)  # type, first byte and size in the file
    _order: str = "<"

    def element(self) -> bytes:
        """A decompressed file with this variable alone; of version 4 the whole file.

        ValueError for an element of unknown type, also within cells. The returned bytes are those that were checked,
        even if the file changes meanwhile.
        """
        kind, start, size = self._place
        if not start:
            return self._path.read_bytes()
        with open(self._path, "rb") as stream:
            header = stream.read(TOL.mat_header)
            stream.seek(start)
            content = stream.read(size)
            if len(content) < size:
                raise _unreadable("it is cut short")
        if kind != _Kind.COMPRESSED:
            content = struct.pack(self._order + "II", kind, size) + content
        else:
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(content, self.size)
            rest = unpacker.decompress(unpacker.unconsumed_tail, 1)  # compares the checksum at the end
            if len(content) < self.size or rest or not unpacker.eof:
                raise _unreadable(f"{self.name!r} does not unpack to its {self.size} bytes")
        _check(content, self._order, TOL.mat_elements + start + size)
        return header + content


def variables(path: Path) -> list[Variable]:
    """Headers of all variables of a file of version 5 or 4; only their first bytes are decompressed."""
    with open(path, "rb") as stream:
        header = stream.read(TOL.mat_header)
    if len(header) >= 4 and 0 in header[:4]:  # version 4, which has no elements
        from scipy.io import whosmat

        kinds = {"sparse": "sparse", "char": "char"}
        listed = whosmat(path)
        return [Variable(name, kinds.get(kind, "numbers"), shape, _path=path) for name, shape, kind in listed]
    return list(_variables(path, "<" if header[126:128] == b"IM" else ">"))


def _variables(path: Path, order: str) -> Iterator[Variable]:
    end = path.stat().st_size
    if end < TOL.mat_header:
        raise _unreadable("it is cut short")
    with open(path, "rb") as stream:
        stream.seek(TOL.mat_header)
        while tag := stream.read(8):
            start = stream.tell()
            kind, size = struct.unpack(order + "II", tag.ljust(8, b"\0"))
            if len(tag) < 8 or start + size > end:
                raise _unreadable("it is cut short")
            first = stream.read(min(size, 4 * TOL.mat_head))
            content = zlib.decompressobj().decompress(first, TOL.mat_head) if kind == _Kind.COMPRESSED else tag + first
            name, of_class, shape, unpacked = _head(content, order)
            yield Variable(name, of_class, shape, unpacked, path, (kind, start, size), order)
            stream.seek(start + size)


def _head(content: bytes, order: str) -> tuple[str, str, tuple[int, ...], int]:
    """Name, class, shape and size of a variable; of what is no matrix the name is empty."""
    kind, size = struct.unpack(order + "II", content[:8].ljust(8, b"\0"))
    if kind != _Kind.MATRIX:
        return "", "", (), 8 + size
    flags, place = _values(content, 8, order)
    axes, place = _values(content, place, order)
    name, _ = _values(content, place, order)
    shape = struct.unpack(f"{order}{len(axes) // 4}i", axes[: len(axes) // 4 * 4])
    if min(shape, default=0) < 0:
        raise _unreadable(f"{name!r} has the shape {shape}")
    number = struct.unpack(order + "I", flags[:4])[0] & 0xFF if len(flags) >= 4 else 0
    return name.decode("latin1"), _CLASSES.get(number, f"class {number}"), tuple(shape), 8 + size


def _values(content: bytes, place: int, order: str) -> tuple[bytes, int]:
    """The bytes of an element of numbers, and where the next one begins."""
    tag = content[place : place + 8]
    if len(tag) < 8:
        return b"", len(content)
    kind, size = struct.unpack(order + "II", tag)
    if (kind & 0xFFFF if kind >> 16 else kind) not in _VALUES:
        raise _no_type(kind)
    if kind >> 16:
        return tag[4 : 4 + min(kind >> 16, 4)], place + 8
    end = place + 8 + size
    if end > len(content) and size > TOL.mat_head // 2:
        raise _unreadable(f"the head of a variable takes {size} bytes")
    return content[place + 8 : end], end + -size % 8


def _check(content: bytes, order: str, most: int) -> None:
    """Raise ValueError unless SciPy's reader meets, where it expects numbers, an element of numbers; `most` of arrays.

    SciPy goes from element to element and does not look at the size of the matrix around them. So none may end beyond
    the matrix that contains it, and one of numbers must have all its parts, the imaginary one where its flags say so.
    """
    unpack, unpack_head = struct.Struct(order + "II").unpack_from, struct.Struct(order + "10I").unpack_from
    ends: list[int] = []  # of the matrices that contain the element
    place, end = 0, len(content)
    for _ in range(most):
        while end - place < 8:
            if place < end:
                raise _unreadable("its elements do not fill what contains them")
            if not ends:
                return
            end = ends.pop()
        kind, size = unpack(content, place)
        place += 8
        if kind != _MATRIX:
            place = _after(place, kind, size, end)
        elif size:  # of an empty cell it is 0
            inner_end = place + size
            if inner_end > end or size < _HEAD:
                raise _unreadable("its elements do not fill what contains them")
            kind, size, flags, _, of_shape, axes, _, _, of_name, name = unpack_head(content, place)
            if kind != 6 or size != 8:
                raise _unreadable("a variable has no flags")
            place += 16
            parts = _PARTS.get(flags & 0xFF)
            if parts is None:
                if len(ends) > TOL.nested:
                    raise ValueError(f"holds cells or structures more than {TOL.nested} deep")
                ends.append(end)
                end = inner_end
                continue
            parts += flags >> 11 & 1
            if of_shape == 5 and axes == 8 and of_name == 1 and name == 0:  # as in most cells: (H, W), without a name
                place, parts = place + 24, parts - 2
            while parts:
                if inner_end - place < 8:
                    raise _unreadable("a variable lacks a part")
                kind, size = unpack(content, place)
                place = _after(place + 8, kind, size, inner_end)
                parts -= 1
            if place < inner_end:
                raise _unreadable("a variable has a part too many")
    raise _unreadable(f"it has more than {most:,} elements: is it damaged?")


def _after(place: int, kind: int, size: int, end: int) -> int:
    """Where the next element begins after one of numbers, whose content begins at `place`."""
    if kind in _VALUES:
        if place + size > end:
            raise _unreadable("its elements do not fill what contains them")
        return place + (size + 7 & -8)
    if not kind >> 16 or kind & 0xFFFF not in _VALUES:  # a small one has its size there, and values for a size
        raise _no_type(kind)
    return place


def _no_type(kind: int) -> ValueError:
    return _unreadable(f"no element is of type {kind & 0xFFFF if kind >> 16 else kind}: is it damaged?")


def _unreadable(reason: str) -> ValueError:
    return ValueError(f"cannot be read as a .mat of version 5 ({reason})")
