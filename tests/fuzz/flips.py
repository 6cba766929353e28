"""Single bits flipped in files that we write, data and metadata alike: ``python -m tests.fuzz.flips``."""

import argparse
import collections
import hashlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mars_lidar._base import manifest
from mars_lidar._base.files import FileError
from mars_lidar.dataset import verify
from tests.fuzz.formats import READERS, make

KINDS = ("refused", "same", "wrong", "unnamed")  # read without an error, as it was or otherwise
NAMES = [
    "set.zarr",
    "cube.zarr",
    "cube.h5",
    "cube.npz",
    "maps.zarr",
    "maps.h5",
    "maps.npz",
    "photons.h5",
    "photons.npz",
    "table.h5",
]


def content(name: str, path: Path) -> str:
    """A sum over everything that a reader hands out."""
    total = hashlib.sha256()
    for part in READERS[name](path):
        total.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return total.hexdigest()


def _found_by_verify(name: str, path: Path) -> bool:
    try:
        return any(manifest.damage(path)) or (name == "set.zarr" and not verify(path, chunks=1).good)
    except ValueError:  # it cannot be opened
        return True


def flips(name: str, path: Path, number: int, seed: int) -> Iterator[tuple[str, bool, str]]:
    """(kind, whether verification of a store finds it, where), bit by bit; every file of a store has its turn first."""
    was = content(name, path)
    random = np.random.default_rng(seed)
    every = [inside for inside in sorted(path.rglob("*")) if inside.is_file()] if path.is_dir() else [path]
    for k in range(number):
        file = every[k] if k < len(every) else every[random.integers(len(every))]
        good = file.read_bytes()
        changed = bytearray(good)
        at, bit = int(random.integers(len(good))), int(random.integers(8))
        changed[at] ^= 1 << bit
        file.write_bytes(changed)
        try:
            try:
                kind = "same" if content(name, path) == was else "wrong"
            except (FileError, FileNotFoundError) as error:
                kind = "refused" if str(path) in str(error) else "unnamed"
            yield kind, path.is_dir() and _found_by_verify(name, path), f"{file}, byte {at}, bit {bit}"
        finally:
            file.write_bytes(good)
    assert content(name, path) == was


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flips", type=int, default=200, help="of each format")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    bad = 0
    print("| file | bits flipped | refused by name | read as it was | read otherwise | refused, no name | `verify` |")
    print("|---|" + "--:|" * 6)
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        for name in NAMES:
            rows = list(flips(name, Path(folder) / name, given.flips, given.seed))
            counts = collections.Counter(kind for kind, _, _ in rows)
            detected = sum(verified for _, verified, _ in rows)
            store = (Path(folder) / name).is_dir()
            cells = [len(rows), *(counts[kind] for kind in KINDS), detected if store else ""]
            print(f"| {name} | " + " | ".join(map(str, cells)) + " |", flush=True)
            bad += counts["wrong"] + counts["unnamed"] + (len(rows) - detected if store else 0)
    raise SystemExit(1 if bad else 0)
