"""A look over the elements of a MATLAB file of version 5, before a library follows them blindly.

SciPy takes the type of an element as an index into a table and does not look whether it is in it: a damaged one ends
the process. Layout: MathWorks, MAT-File Format, chapter 1.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_VALUES = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}  # numbers and characters
_MATRIX, _COMPRESSED = 14, 15
_HEADER, _STEP = 128, 2**16
_DEEPEST = 100  # matrices within cells within structures
_CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", **dict.fromkeys(range(6, 16), "numbers")}
_MOST_AXES = 32

Read = Callable[[int], bytes]


@dataclass(frozen=True)
class Variable:
    """The head of a variable: its name, class and shape."""

    name: str
    kind: str  # "numbers", "sparse", "cell", "struct", ...
    shape: tuple[int, ...]


def variables(path: Path) -> list[Variable]:
    """Heads of all variables of a file of version 5 or 4, of which only the first bytes are unpacked."""
    with open(path, "rb") as stream:
        if 0 in (start := stream.read(4)) and len(start) == 4:
            from scipy.io import whosmat

            kinds = {"sparse", "char"}
            listed = whosmat(path)
            return [Variable(name, kind if kind in kinds else "numbers", shape) for name, shape, kind in listed]
    return [head for _, _, head in _variables(path)]


def check_elements(path: Path, names: Iterable[str] | None = None) -> int:
    """Raise ValueError for an element of a type that there is not, also within cells and packed variables.

    `names`: look into these variables only. Returns the number of bytes that their elements take unpacked.
    """
    wanted, total = None if names is None else set(names), 0
    for order, read, head in _variables(path):
        if wanted is None or head.name in wanted:
            kind, size = read.tag(order)
            _element(read.read, order, kind, size, 0)
            total += size
    return total


def _variables(path: Path) -> Iterator[tuple[str, _Unpacked | _Plain, Variable]]:
    """Byte order, the element read from its start again, and the head of each variable."""
    with open(path, "rb") as stream:
        header = stream.read(_HEADER)
        if 0 in header[:4]:  # version 4, which has no elements
            return
        order = "<" if header[126:128] == b"IM" else ">"
        end = path.stat().st_size
        if end < _HEADER:
            raise ValueError("cannot be read as a .mat of version 5 (it is cut short)")
        while tag := stream.read(8):
            start = stream.tell()
            kind, size = struct.unpack(order + "II", tag.ljust(8, b"\0"))
            if len(tag) < 8 or start + size > end:
                raise ValueError("cannot be read as a .mat of version 5 (it is cut short)")
            first = _Unpacked(stream, size) if kind == _COMPRESSED else _Plain(stream, size, tag)
            head = _head(first, order)
            stream.seek(start)
            again = _Unpacked(stream, size) if kind == _COMPRESSED else _Plain(stream, size, tag)
            yield order, again, head
            stream.seek(start + size)


def _head(source: _Unpacked | _Plain, order: str) -> Variable:
    """Name, class and shape of a variable; of what is no matrix the name is empty."""
    kind, _ = source.tag(order)
    if kind != _MATRIX:
        return Variable("", "", ())
    flags = _values(source.read, order, 8)
    axes = _values(source.read, order, 4 * _MOST_AXES)
    name = _values(source.read, order, 256)
    shape = struct.unpack(f"{order}{len(axes) // 4}i", axes[: len(axes) // 4 * 4])
    number = struct.unpack(order + "I", flags[:4])[0] & 0xFF if len(flags) >= 4 else 0
    return Variable(name.decode("latin1"), _CLASSES.get(number, f"class {number}"), tuple(shape))


def _values(read: Read, order: str, most: int) -> bytes:
    """The bytes of a sub-element, up to `most` of them."""
    tag = read(8)
    if len(tag) < 8:
        return b""
    kind, size = struct.unpack(order + "II", tag)
    if (kind & 0xFFFF if kind >> 16 else kind) not in _VALUES:
        raise ValueError(f"cannot be read as a .mat of version 5 (no element is of type {kind}: is it damaged?)")
    if kind >> 16:
        return tag[4 : 4 + min(kind >> 16, 4)]
    if size > most:
        raise ValueError(f"cannot be read as a .mat of version 5 (the head of a variable takes {size} bytes)")
    content = read(size)
    _skip(read, -size % 8)
    return content


def _element(read: Read, order: str, kind: int, size: int, depth: int) -> None:
    if kind != _MATRIX:
        if kind not in _VALUES:
            raise ValueError(f"cannot be read as a .mat of version 5 (no element is of type {kind}: is it damaged?)")
        _skip(read, size)
        return
    if depth > _DEEPEST:
        raise ValueError(f"holds cells or structures more than {_DEEPEST} deep")
    left, unpack = size, struct.Struct(order + "II").unpack
    while left >= 8:
        tag = read(8)
        if len(tag) < 8:
            return
        kind, size = unpack(tag)
        left -= 8
        if kind == _MATRIX:
            _element(read, order, kind, size, depth + 1)
            left -= size
            continue
        small = kind >> 16  # a small element: its size, its type and up to four bytes, in the place of a tag
        if (kind & 0xFFFF if small else kind) not in _VALUES:
            _element(read, order, kind & 0xFFFF if small else kind, 0, depth)
        if not small:
            padded = size + -size % 8
            if padded <= _STEP:
                read(padded)
            else:
                _skip(read, padded)
            left -= padded


def _skip(read: Read, size: int) -> None:
    while size > 0 and (got := len(read(min(size, _STEP)))):
        size -= got


class _Plain:
    """A variable that is not packed, with its tag."""

    def __init__(self, stream: BinaryIO, size: int, tag: bytes) -> None:
        self.read, self.size, self._tag = stream.read, size, tag

    def tag(self, order: str) -> tuple[int, int]:
        """Type and size."""
        kind, size = struct.unpack(order + "II", self._tag)
        return kind, size


class _Unpacked:
    """What a packed variable holds, read from its start through a buffer."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._left, self._zlib = stream, size, zlib.decompressobj()
        self._buffer, self._place = b"", 0

    def tag(self, order: str) -> tuple[int, int]:
        """Type and size of the next element; of none where the variable is cut short."""
        tag = self.read(8)
        if len(tag) < 8:
            return 0, 0
        kind, size = struct.unpack(order + "II", tag)
        return kind, size

    def read(self, size: int) -> bytes:
        """Up to `size` bytes; fewer at the end, or where it is cut short."""
        end = self._place + size
        if end <= len(self._buffer):
            out = self._buffer[self._place : end]
            self._place = end
            return out
        parts, have = [self._buffer[self._place :]], len(self._buffer) - self._place
        while have < size and (more := self._next()):
            parts.append(more)
            have += len(more)
        self._buffer = b"".join(parts)
        self._place = min(size, have)
        return self._buffer[: self._place]

    def _next(self) -> bytes:
        """The next block of unpacked bytes, empty at the end."""
        while not self._zlib.eof:
            packed = self._zlib.unconsumed_tail
            if not packed:
                packed = self._stream.read(min(self._left, _STEP))
                self._left -= len(packed)
            if not packed:
                return b""
            if out := self._zlib.decompress(packed, 16 * _STEP):
                return out
        return b""
