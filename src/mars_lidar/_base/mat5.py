"""A look over the elements of a MATLAB file of version 5, before a library follows them blindly.

SciPy takes the type of an element as an index into a table and does not look whether it is in it: a damaged one ends
the process. Layout: MathWorks, MAT-File Format, chapter 1.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

_VALUES = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}  # numbers and characters
_MATRIX, _COMPRESSED = 14, 15
_HEADER, _STEP = 128, 2**20
_DEEPEST = 100  # matrices within cells within structures


def check_elements(path: Path) -> None:
    """Raise ValueError for an element of a type that there is not, also within cells and packed variables."""
    with open(path, "rb") as stream:
        header = stream.read(_HEADER)
        if 0 in header[:4]:  # version 4, which has no elements
            return
        order = "<" if header[126:128] == b"IM" else ">"
        while len(tag := stream.read(8)) == 8:
            kind, size = struct.unpack(order + "II", tag)
            end = stream.tell() + size
            if kind == _COMPRESSED:
                packed = _Unpacked(stream, size)
                inner = packed.read(8)
                if len(inner) == 8:
                    kind, size = struct.unpack(order + "II", inner)
                    _element(packed.read, order, kind, size, 0)
            else:
                _element(stream.read, order, kind, size, 0)
            stream.seek(end)


def _element(read: Callable[[int], bytes], order: str, kind: int, size: int, depth: int) -> None:
    if kind != _MATRIX:
        if kind not in _VALUES:
            raise ValueError(f"cannot be read as a .mat of version 5 (no element is of type {kind}: is it damaged?)")
        _skip(read, size)
        return
    if depth > _DEEPEST:
        raise ValueError(f"holds cells or structures more than {_DEEPEST} deep")
    left = size
    while left >= 8:
        tag = read(8)
        if len(tag) < 8:
            return
        left -= 8
        kind, size = struct.unpack(order + "II", tag)
        if kind >> 16:  # a small element: its size, its type and up to four bytes, in the place of a tag
            _element(lambda _: b"", order, kind & 0xFFFF, 0, depth)
            continue
        _element(read, order, kind, size, depth + 1)
        padding = 0 if kind == _MATRIX else -size % 8
        _skip(read, padding)
        left -= size + padding


def _skip(read: Callable[[int], bytes], size: int) -> None:
    while size > 0 and (got := len(read(min(size, _STEP)))):
        size -= got


class _Unpacked:
    """What a packed variable holds, read from its start."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._left, self._zlib = stream, size, zlib.decompressobj()

    def read(self, size: int) -> bytes:
        """Up to `size` bytes; fewer at the end, or where it is cut short."""
        out = b""
        while len(out) < size and not self._zlib.eof:
            packed = self._zlib.unconsumed_tail
            if not packed:
                packed = self._stream.read(min(self._left, _STEP))
                self._left -= len(packed)
            if not packed:
                break
            out += self._zlib.decompress(packed, size - len(out))
        return out
