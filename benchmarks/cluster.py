"""`python -m benchmarks.cluster`: what dask costs a part, what a run does outside its parts, and two workers over one.

Costs are processor time, so that they hold on a machine that does other work too; the measured ratio of two workers to
one is wall time, and says something on a machine with two idle processors only. Takes about a minute and a half.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import mars_lidar as ml
from benchmarks.machine import processor
from mars_lidar.dataset import begin, finish, open_dataset
from mars_lidar.dataset.cluster import Dispatch, Run, Team, crew
from mars_lidar.dataset.run import _make_all
from mars_lidar.dataset.store import Item
from mars_lidar.dataset.write import Made, Maker

TASKS, PARTS, WORKERS = 1500, (1, 20), 2  # tasks of a measurement, parts in each, processes that return at once
SCENES, SIGNAL, TURNS = 24, 1.0, 2
SYSTEM = ml.System(
    period_ns=1e3 / 7.5,
    cycles=1000,
    bins=1024,
    pulse=ml.GaussianPulse(sigma_ns=0.5),
    detector=ml.Detector(dead_time_ns=75.0),
)


def recipe(scenes: int, cubes: int, signal: float = SIGNAL) -> dict[str, Any]:
    """So many parts of so many cubes of 64 x 64 x 1024 bins, layout sparse."""
    return {
        "scenes": {"example": "room", "size": 64, "seeds": {"count": scenes}},
        "systems": [SYSTEM],
        "light": {"signal": signal},
        "realizations": cubes,
        "store": {"layout": "sparse", "shard_mib": max(8, 8 * cubes)},
    }


def of_a_task() -> dict[str, tuple[float, float]]:
    """Processor seconds of the client and of the scheduler: for a task, and for each part in it beyond the first."""
    with _scheduler() as (address, spent):
        totals = []
        for parts in PARTS:
            items = [Item("histogram", (k, 0, 0, 0, 0), (slice(k, k + 1),) * 5) for k in range(TASKS * parts)]
            with crew(None, address) as there:
                run = Run("/there/set.zarr", "a" * 32, 1, "0.3.0", "b" * 16)
                make = partial(_nothing, run)
                team = _Fixed(there.executor, make, there.threads, Dispatch(), parts=parts)
                _make_all(nullcontext(team), items[: 50 * parts], lambda _: None)
                before, client = spent(), time.process_time()
                _make_all(nullcontext(team), items, lambda _: None)
                totals.append((time.process_time() - client, spent() - before))
    (single, one_scheduled), (many, many_scheduled) = totals
    more = PARTS[1] - PARTS[0]
    return {
        "client": (single / TASKS, max(0.0, many - single) / TASKS / more),
        "scheduler": (one_scheduled / TASKS, max(0.0, many_scheduled - one_scheduled) / TASKS / more),
    }


class _Fixed(Team):
    """A team whose tasks have a given number of parts."""

    def __init__(self, *arguments: Any, parts: int) -> None:
        super().__init__(*arguments)
        object.__setattr__(self, "_parts", parts)

    def parts_of_a_task(self, seconds: float, remaining: int) -> int:
        return int(self._parts)  # type: ignore[attr-defined]


def _nothing(run: Run, items: Sequence[Item]) -> list[Made]:
    """What workers do here: they return as many results as parts."""
    return [Made(0.5, 0.01) for _ in items]


@contextmanager
def _scheduler() -> Iterator[tuple[str, Any]]:
    """Address of a scheduler with workers in a process of its own, and a function for that process's seconds."""
    command = [sys.executable, "-m", "benchmarks.cluster", "--serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        to_server, from_server = server.stdin, server.stdout
        assert to_server is not None
        assert from_server is not None
        address = from_server.readline().strip()

        def spent() -> float:
            print("spent", file=to_server, flush=True)
            return float(from_server.readline())

        yield address, spent
        to_server.close()


def serve() -> None:
    """Run a scheduler; print its address, and its processor seconds for each line that comes."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        print(cluster.scheduler_address, flush=True)
        for _ in sys.stdin:
            print(time.process_time(), flush=True)


def outside_of_parts() -> dict[str, float]:
    """Processor seconds of a run of `SCENES` parts in one process: its scenes, its parts, and what one process does.

    The last is the layout of the store with a single scene, and the closing: scenes and parts are made by all workers.
    """
    with tempfile.TemporaryDirectory(dir=os.environ.get("MARS_BENCH_TMP")) as folder:
        store = Path(folder) / "set.zarr"
        begin(recipe(1, 1), Path(folder) / "first.zarr")  # imports
        marks = [time.process_time()]
        begin(recipe(1, 16), Path(folder) / "one.zarr")
        marks.append(time.process_time())
        begin(recipe(SCENES, 16), store)
        marks.append(time.process_time())
        dataset = open_dataset(store, allow_incomplete=True)
        maker = Maker(dataset, 1)
        for item in dataset.items():
            maker.make(item)
        marks.append(time.process_time())
        finish(store)
        marks.append(time.process_time())
    layout, scenes, parts, closing = (b - a for a, b in itertools.pairwise(marks))
    return {"layout": layout, "scenes": scenes - layout, "parts": parts, "closing": closing}


def rates() -> dict[int, list[tuple[float, float]]]:
    """Parts a second between the first parts and the last, and seconds from there to the end, of 1 and 2 workers."""
    out: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
    with tempfile.TemporaryDirectory(dir=os.environ.get("MARS_BENCH_TMP")) as folder:
        for turn in range(TURNS):
            for workers in (1, 2):
                marks: list[tuple[float, int]] = []
                ml.generate(
                    recipe(SCENES, 16),
                    Path(folder) / f"{turn}_{workers}.zarr",
                    workers=workers,
                    progress=lambda done, _, marks=marks: marks.append((time.perf_counter(), done)),
                )
                ended = time.perf_counter()
                (first, before), (last, done) = marks[4], marks[-1]  # the maps are among the first
                out[workers].append(((done - before) / (last - first), ended - last))
    return out


def main() -> None:
    """Print what was measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cluster", description=__doc__)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--cpu", action="store_true", help="processor times only, which hold on a busy machine")
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    print(f"{processor()}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    costs = of_a_task()
    for name, (task, part) in costs.items():
        print(f"{name}: {1e3 * task:.2f} ms of processor time a task of one part, {1e3 * part:.3f} ms a further part")
    took = outside_of_parts()
    shared = took["scenes"] + took["parts"]
    serial = took["layout"] + took["closing"] + SCENES * costs["client"][0]
    tasks = SCENES * costs["client"][0]
    print(f"{SCENES} parts of {took['parts'] / SCENES:.2f} s; processor time")
    print(f"  of all workers: scenes {took['scenes']:.2f} s, parts {took['parts']:.2f} s")
    print(f"  of one process: layout {took['layout']:.2f} s, tasks {tasks:.2f} s, closing {took['closing']:.2f} s")
    print(f"  share of one process: {100 * serial / (serial + shared):.1f} %")
    print(f"two workers over one, as far as that decides: {(serial + shared) / (serial + shared / 2):.2f}")
    if options.cpu:
        return
    measured = rates()
    for workers, turns in measured.items():
        text = "; ".join(f"{rate:.2f} parts/s, then {end:.2f} s to the end" for rate, end in turns)
        print(f"{workers} worker{'s' * (workers > 1)}: {text}")
    best = {workers: max(rate for rate, _ in turns) for workers, turns in measured.items()}
    print(f"two workers over one, wall time, best turns: {best[2] / best[1]:.2f} (goal 1.8, on idle processors)")


if __name__ == "__main__":
    main()
