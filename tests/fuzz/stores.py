"""Attacks on stores before and after they are opened: ``python -m tests.fuzz.stores --attacks 200``.

A file of a store is flipped, cut short, emptied, exchanged for another of the store or of a store of the same recipe
with another seed, replaced or deleted; or the whole store is replaced or deleted. Every value that a reader hands out
afterwards must be the one that was stored when it was opened, or an error must name the store.
"""

import argparse
import collections
import pickle
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import FileError
from mars_lidar.dataset import open_dataset, read_sparse
from tests.fuzz.formats import SYSTEM

KINDS = ("refused", "same", "wrong", "unnamed")
ATTACKS = ("flip", "cut", "empty", "swap", "foreign", "delete", "replace_store", "delete_store")
READERS = ("dataset", "sparse", "scenes", "cube", "pickled", "learn")


def make(folder: Path) -> None:
    """A dataset and a cube, and a second one of each with another seed."""
    for name, seed in (("a", 1), ("b", 2)):
        recipe = {
            "scenes": {"example": "room", "size": [6, 8], "seeds": {"count": 2}},
            "systems": [SYSTEM],
            "light": {"signal": [0.5, 1.0]},
            "realizations": 2,
            "seed": seed,
            "store": {"layout": "sparse", "shard_mib": 0.004, "chunk_mib": 0.002},
        }
        ml.generate(recipe, folder / f"{name}.zarr")
        flux = ml.Flux(np.linspace(0.1, 2.0, 12).reshape(3, 4), 0.1, 40.0)
        io.simulate_to(folder / f"{name}_cube.zarr", flux, SYSTEM, realizations=3, seed=seed)


def opened(reader: str, store: Path) -> Callable[[], Iterator[Any]]:
    """Open a store; what is returned reads all of it."""
    if reader in ("cube", "pickled"):
        cube: Any = io.load(store)
        again = pickle.dumps(cube)

        def counts() -> Iterator[Any]:
            yield np.asarray((pickle.loads(again) if reader == "pickled" else cube).histogram)

        return counts
    stored: Any = open_dataset(store)
    if reader == "learn":
        from mars_lidar.learn import StoredDataset

        examples = StoredDataset(store, shuffle=False)

        def epoch() -> Iterator[Any]:
            yield from (
                value for example in examples for value in (example["counts"].numpy(), example["depth"].numpy())
            )

        return epoch

    def values() -> Iterator[Any]:
        if reader == "sparse":
            yield from (read_sparse(stored, k, r).toarray() for k in range(4) for r in range(2))
        elif reader == "scenes":
            yield from (stored.scene(k).depth_m for k in range(len(stored.scene_names())))
        else:
            yield np.asarray(stored.histogram)
            yield from (np.asarray(array) for array in stored.maps.values())

    return values


def attack(kind: str, store: Path, other: Path, random: np.random.Generator) -> str:
    """Change a store; returns what was done."""
    if kind == "delete_store":
        shutil.rmtree(store)
        return "the store deleted"
    if kind == "replace_store":
        shutil.rmtree(store)
        shutil.copytree(other, store)
        return "the store replaced"
    files = sorted(path for path in store.rglob("*") if path.is_file() and path.stat().st_size)
    chunks = [path for path in files if "/c/" in path.as_posix() or path.name.startswith("c.")]
    file = chunks[random.integers(len(chunks))] if random.random() < 0.8 else files[random.integers(len(files))]
    inside = file.relative_to(store)
    content = file.read_bytes()
    if kind == "flip":
        at = int(random.integers(len(content)))
        file.write_bytes(content[:at] + bytes([content[at] ^ (1 << int(random.integers(8)))]) + content[at + 1 :])
    elif kind == "cut":
        file.write_bytes(content[: int(random.integers(len(content)))])
    elif kind == "empty":
        file.write_bytes(b"")
    elif kind == "delete":
        file.unlink()
    elif kind == "foreign":
        shutil.copy(other / inside, file) if (other / inside).is_file() else file.unlink()
    elif kind == "swap":
        same = [path for path in chunks if path.parts[-4:-3] == file.parts[-4:-3] and path != file] or chunks
        partner = same[random.integers(len(same))]
        file.write_bytes(partner.read_bytes())
        partner.write_bytes(content)
    return f"{kind} {inside}"


def attacks(folder: Path, number: int, seed: int) -> Iterator[tuple[str, str, str, str]]:
    """(reader, when and what, kind of outcome, error), of stores that `make` wrote into `folder`."""
    random = np.random.default_rng(seed)
    for k in range(number):
        reader = READERS[k % len(READERS)]
        name = "_cube.zarr" if reader in ("cube", "pickled") else ".zarr"
        store, other = folder / f"attacked{name}", folder / f"b{name}"
        shutil.rmtree(store, ignore_errors=True)
        shutil.copytree(folder / f"a{name}", store)
        good = [np.array(part) for part in opened(reader, store)()]
        after = bool(k // len(READERS) % 2)
        kind = ATTACKS[k // (2 * len(READERS)) % len(ATTACKS)]
        if not after and kind == "replace_store":
            kind = "swap"  # a whole store is another store
        note, outcome = "", "same"
        try:
            read = opened(reader, store) if after else None
            note = attack(kind, store, other, random)
            results = [np.array(part) for part in (read or opened(reader, store))()]
            same = len(results) == len(good) and all(
                np.array_equal(a, b, equal_nan=True) for a, b in zip(results, good, strict=True)
            )
            outcome, error = "same" if same else "wrong", ""
        except (FileError, FileNotFoundError) as refusal:
            error = str(refusal)
            outcome = "refused" if str(store) in error else "unnamed"
        except Exception as foreign:
            outcome, error = "unnamed", f"{type(foreign).__name__}: {foreign}"
        yield reader, f"{'after' if after else 'before'} opening: {note or kind}", outcome, error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--attacks", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    counts: dict[str, collections.Counter[str]] = {}
    with tempfile.TemporaryDirectory() as place:
        make(Path(place))
        for reader, what, outcome, error in attacks(Path(place), given.attacks, given.seed):
            word = what.partition(": ")[2].split()[0].replace("the", "store")
            counts.setdefault(f"{word}, {what.split()[0]}", collections.Counter())[outcome] += 1
            if outcome in ("wrong", "unnamed"):
                print(f"{reader}: {what}: {outcome} {error}", flush=True)
    print("| attack | " + " | ".join(KINDS) + " |")
    print("|---|" + "--:|" * len(KINDS))
    for word, row in sorted(counts.items()):
        print(f"| {word} opening | " + " | ".join(str(row[kind]) for kind in KINDS) + " |")
    total = sum(counts.values(), collections.Counter())
    print(f"| all {sum(total.values())} | " + " | ".join(str(total[kind]) for kind in KINDS) + " |")
    raise SystemExit(1 if total["wrong"] + total["unnamed"] else 0)
