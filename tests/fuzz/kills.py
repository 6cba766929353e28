"""``kill -9`` at random moments of everything that writes: ``python -m tests.fuzz.kills --kills 40``.

Afterwards nothing under the final name may be half written, what was there before must be there or be replaced as a
whole, and the same command must succeed when it is repeated.
"""

import argparse
import collections
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mars_lidar import io
from mars_lidar.dataset import open_dataset, verify

_CHILD = """
import os, sys
import numpy as np
import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import export
what, path, source = sys.argv[1:]
system = ml.System(period_ns=100.0, cycles=3000, bins=64, pulse=ml.GaussianPulse(sigma_ns=1.0),
                   detector=ml.Detector(dead_time_ns=10.0))
recipe = {"scenes": {"example": "room", "size": [16, 16], "seeds": {"count": 6}}, "systems": [system],
          "light": {"signal": [0.5, 1.0]}, "seed": 2, "store": {"shard_mib": 0.1, "chunk_mib": 0.05}}
print("begin", flush=True)
if what == "export":
    export(source, path, layout="gutierrez")
elif what == "generate":
    ml.generate(recipe, path, threads=1, resume=os.path.exists(path))
elif what == "overwrite":
    ml.generate(recipe, path, threads=1, overwrite=True)
else:
    io.simulate_to(path, ml.Flux(np.full((48, 48), 2.0), 0.5, 40.0), system, realizations=3, overwrite=True)
print("end", flush=True)
"""
WRITERS = {"export": "files", "generate": "set.zarr", "overwrite": "old.zarr"}
WRITERS |= {name: name for name in ("cube.zarr", "replaced.zarr", "cube.h5", "cube.npz", "cube.mat")}


def run(what: str, path: Path, source: Path, after_s: float | None) -> float:
    """Seconds from the first to the last line; killed `after_s` the first one, if that is given."""
    code = _CHILD.replace("realizations=3, ", "") if what == "cube.mat" else _CHILD  # one exposure
    child = subprocess.Popen([sys.executable, "-c", code, what, str(path), str(source)], stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"begin\n"
    began = time.perf_counter()
    if after_s is None:
        assert child.stdout.readline() == b"end\n"
        spent = time.perf_counter() - began
        assert child.wait() == 0
        return spent
    time.sleep(after_s)
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    return after_s


def is_good(what: str, path: Path) -> bool:
    """Whether what is under the final name is nothing, all of it, or marked as what it is."""
    if not path.exists():
        return True
    if what == "export":
        return (path / "list.txt").is_file()
    if path.name in ("set.zarr", "old.zarr"):
        try:
            open_dataset(path)
        except io.IncompleteFileError:
            return what == "generate"
        except ValueError:  # stopped before its first document
            return what == "generate" and not (path / "zarr.json").exists()
        return bool(verify(path, chunks=2).good)
    try:
        with io.load(path) as cube:
            return bool(np.asarray(cube.histogram).any()) and cube.complete
    except (io.IncompleteFileError, FileNotFoundError):
        return what == "cube.zarr"
    except ValueError:
        return what == "cube.zarr" and not (path / "zarr.json").exists()


def kills(number: int, seed: int, folder: Path) -> collections.Counter[str]:
    """How many of `number` kills left nothing half written and could be repeated."""
    random = np.random.default_rng(seed)
    source, counts = folder / "source.zarr", collections.Counter[str]()
    run("overwrite", source, source, None)
    lasts = {what: run(what, folder / f"timed_{name}", source, None) for what, name in WRITERS.items()}
    shutil.copytree(source, folder / "old.zarr")
    run("replaced.zarr", folder / "replaced.zarr", source, None)
    for k in range(number):
        what, name = list(WRITERS.items())[k % len(WRITERS)]
        path = folder / name
        if what not in ("overwrite", "replaced.zarr") and path.exists():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        after = float(random.random()) * lasts[what]
        run(what, path, source, after)
        good = is_good(what, path)
        if what == "generate" and path.exists() and not (path / "zarr.json").exists():
            shutil.rmtree(path)
        if what == "export" and path.exists():
            shutil.rmtree(path)
        run(what, path, source, None)
        good = good and is_good(what, path) and path.exists()
        leftovers = [each.name for each in folder.iterdir() if "incomplete" in each.name]
        counts["good" if good and not leftovers else "bad"] += 1
        if not good or leftovers:
            print(f"{what}, killed after {after:.3f} s: good {good}, left {leftovers}", flush=True)
    return counts


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        counted = kills(given.kills, given.seed, Path(place))
    print(f"{counted['good']} of {given.kills} kills left nothing half written and were repeated")
    raise SystemExit(counted["bad"] > 0)
