"""Single bits flipped in files that we write, data and metadata alike: ``python -m tests.fuzz.flips``."""

import argparse
import collections
import hashlib
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base import manifest
from mars_lidar._base.files import FileError
from mars_lidar._base.hdf5 import SEAL
from mars_lidar.dataset import open_dataset, verify
from mars_lidar.io.maps import load_maps
from mars_lidar.io.store import OnDisk

KINDS = ("refused", "same", "wrong", "unnamed")  # read without an error, as it was or otherwise


def _cube(path: Path) -> Iterator[Any]:
    with io.load(path) as cube:
        yield np.asarray(cube.histogram)
        yield from (cube.depth_m, cube.flux.signal, cube.flux.background, cube.flux.delay_ns, cube.reflectivity)
        yield from (cube.system.to_json(), cube.engine, cube.seed, cube.registrations, cube.settings)


def _dataset(path: Path) -> Iterator[Any]:
    stored = open_dataset(path)
    yield stored.recipe
    group = zarr.open_group(path, mode="r")
    for folder in (group, group["scenes"]):
        for name, array in sorted(folder.arrays()):
            yield from (name, np.asarray(OnDisk(array, path)))


def _maps(path: Path) -> Iterator[Any]:
    maps, attrs = load_maps(path)
    for entries in (maps, attrs):
        yield from (
            part for name in sorted(entries) if name not in (SEAL, "manifest") for part in (name, entries[name])
        )


def _photons(path: Path) -> Iterator[Any]:
    times = ml.Timestamps.load(path)
    yield from (times.times_ns, times.cycle, times.bin, times.counts, times.period_ns, times.cycles, times.bins)


def _table(path: Path) -> Iterator[Any]:
    table = ml.Table.load(path)
    yield from (table.system.to_json(), table.signal, table.background, table.method, table.tolerance)
    for part in (table.entries, table.start_phases, table.laws):
        yield from (value for _, value in sorted(vars(part).items()) if isinstance(value, np.ndarray))


READERS: dict[str, Callable[[Path], Iterator[Any]]] = {
    "set.zarr": _dataset,
    **dict.fromkeys(["cube.zarr", "cube.h5", "cube.npz"], _cube),
    **dict.fromkeys(["maps.zarr", "maps.h5", "maps.npz"], _maps),
    **dict.fromkeys(["photons.h5", "photons.npz"], _photons),
    "table.h5": _table,
}


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
    from tests.fuzz.formats import make

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flips", type=int, default=200, help="of each format")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    bad = 0
    print("| file | bits flipped | refused by name | read as it was | read otherwise | refused, no name | `verify` |")
    print("|---|" + "--:|" * 6)
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        for name in READERS:
            rows = list(flips(name, Path(folder) / name, given.flips, given.seed))
            counts = collections.Counter(kind for kind, _, _ in rows)
            detected = sum(verified for _, verified, _ in rows)
            store = (Path(folder) / name).is_dir()
            cells = [len(rows), *(counts[kind] for kind in KINDS), detected if store else ""]
            print(f"| {name} | " + " | ".join(map(str, cells)) + " |", flush=True)
            bad += counts["wrong"] + counts["unnamed"] + (len(rows) - detected if store else 0)
    raise SystemExit(1 if bad else 0)
