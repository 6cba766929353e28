"""Packed counts against the format as docs/generate.md states it, bit by bit in Python."""

import contextlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
from harness import refused

from mars_lidar import _core
from mars_lidar.dataset.codec import SparseCodec


def plain_decoder(packed: bytes) -> np.ndarray:
    """The words of docs/generate.md, one bit after the other."""
    size, number = (int.from_bytes(packed[k : k + 8], "little") for k in (0, 8))
    bits = iter(np.unpackbits(np.frombuffer(packed, np.uint8, offset=16), bitorder="little"))

    def plain(width: int) -> int:
        return sum(int(next(bits)) << k for k in range(width))

    def rice(mean_times: int, shift: int) -> int:
        k = ((mean_times >> shift) | 1).bit_length() - 1
        zeros = 0
        while zeros < 24 and not next(bits):
            zeros += 1
        return plain(32) if zeros == 24 else (zeros << k) + plain(k)

    out, position, gaps, above = np.zeros(size, np.uint64), 0, 0, 0
    for _ in range(number):
        gap = rice(gaps, 4)
        gaps += gap - (gaps >> 4)
        more = rice(above, 1)
        above += more - (above >> 1)
        position += gap
        out[position] = more + 1
        position += 1
    return out


def cases() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    pulse = random.poisson(np.where(np.arange(3000) % 300 < 5, 400.0, 0.2))
    rare = np.zeros(20_000, np.int64)
    rare[[0, 7, 19_999]] = 1, 65_535, 2
    wide = random.integers(0, 2**32, 500) * (random.random(500) < 0.3)
    return {
        "nothing": np.zeros(100, np.uint16),
        "empty": np.zeros(0, np.uint16),
        "one": np.ones(1, np.uint16),
        "full": np.full(9000, 65_535, np.uint16),
        "poisson": random.poisson(0.5, 9001).astype(np.uint16),
        "pulses": pulse.astype(np.uint16),
        "rare": rare.astype(np.uint16),
        "rare 32": rare.astype(np.uint32),
        "wide": wide.astype(np.uint32),
    }


@pytest.mark.parametrize("name", cases())
def test_packed_counts_come_back(name):
    counts = cases()[name]
    packed = np.frombuffer(_core.pack_counts(counts), np.uint8)
    out = np.full_like(counts, 7)
    _core.unpack_counts(packed, out)
    np.testing.assert_array_equal(out, counts)
    np.testing.assert_array_equal(plain_decoder(packed.tobytes()), counts)


def test_what_is_damaged_is_refused_or_at_least_stays_inside():
    counts = cases()["pulses"]
    packed = np.frombuffer(_core.pack_counts(counts), np.uint8)
    out = np.empty_like(counts)
    refused("shorter than their header", _core.unpack_counts, packed[:10], out)
    refused("packed counts", _core.unpack_counts, packed[: len(packed) // 2].copy(), out)
    refused("another size", _core.unpack_counts, packed, out[:-1])
    random = np.random.default_rng(1)
    for _ in range(300):  # any bytes: an error or other counts, never a crash
        bad = packed.copy()
        bad[random.integers(0, len(bad), 3)] ^= random.integers(1, 256, 3).astype(np.uint8)
        with contextlib.suppress(ValueError):
            _core.unpack_counts(bad, out)


def test_counts_beyond_their_type_are_refused():
    packed = np.frombuffer(_core.pack_counts(np.array([70_000], np.uint32)), np.uint8)
    refused("exceed their type", _core.unpack_counts, packed, np.empty(1, np.uint16))


def test_zarr_finds_the_codec_of_the_installed_package():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    ((name, target),) = project["entry-points"]["zarr.codecs"].items()
    assert (name, target) == ("mars_lidar.sparse", f"{SparseCodec.__module__}:{SparseCodec.__name__}")
