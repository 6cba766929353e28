"""`python -m benchmarks.scale`: the table of docs/scale.md, a simulation of the scheduler with measured part times.

Parts are measured by processor time on one thread, in this process. The simulation has their times, drawn anew, the
rules of `mars_lidar.dataset.cluster` for what is given out, dask, whose client and scheduler handle tasks one after the
other in the time that is measured here, and one file system for all workers together.
"""

from __future__ import annotations

import argparse
import datetime
import heapq
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.config import Config
from benchmarks.machine import load, processor
from benchmarks.report import write_block
from benchmarks.workload import system
from mars_lidar.dataset import begin, open_dataset
from mars_lidar.dataset.cluster import Dispatch, Run, Team, crew
from mars_lidar.dataset.run import _make_all
from mars_lidar.dataset.store import Item
from mars_lidar.dataset.write import Made, Maker

PAGE = Path(__file__).parents[1] / "docs" / "scale.md"
TASKS, PARTS, WORKERS = 1500, (1, 20), 2  # tasks of a measurement, parts in each, processes that return at once
CUBES, CUBES_OF_A_PART = 1_000_000, 50  # the shards that a recipe of so many cubes gets
PLANS = (
    (16, 2e9),
    (160, 2e9),
    (160, 20e9),
    (1600, 2e9),
    (1600, 50e9),
)  # workers, and bytes a second of the file system


@dataclass(frozen=True)
class Parts:
    """Processor seconds of some parts, and their mean size on disk."""

    seconds: np.ndarray
    nbytes: float


def recipe(scenes: int, signal: float) -> dict[str, Any]:
    """So many parts of `CUBES_OF_A_PART` cubes of 64 x 64 x 1024 bins at 1000 cycles, SBR 1, layout sparse."""
    return {
        "scenes": {"example": "room", "size": 64, "seeds": {"count": scenes}},
        "systems": [system(Config(mode=""), dead_time_ns=75.0)],
        "light": {"signal": signal},
        "realizations": CUBES_OF_A_PART,
        "store": {"layout": "sparse", "shard_mib": 8 * CUBES_OF_A_PART},
    }


def of_a_task() -> tuple[float, float]:
    """Processor seconds of dask's client and scheduler, in this process: for a task, and each further part in it."""
    from distributed import LocalCluster

    run, seconds = Run("/there/set.zarr", "a" * 32, 1, "0.3.0", "b" * 16), []
    with LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        for parts in PARTS:
            items = [Item("histogram", (k, 0, 0, 0, 0), (slice(k, k + 1),) * 5) for k in range(TASKS * parts)]
            with crew(None, cluster.scheduler_address) as there:
                team = _Fixed(there.executor, partial(_nothing, run), there.threads, Dispatch(), parts=parts)
                _make_all(nullcontext(team), items[: 50 * parts], lambda _: None)
                before = time.process_time()
                _make_all(nullcontext(team), items, lambda _: None)
                seconds.append((time.process_time() - before) / TASKS)
    return seconds[0], max(0.0, seconds[1] - seconds[0]) / (PARTS[1] - PARTS[0])


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


def measured(signal: float, parts: int = 4) -> Parts:
    """Made in this process."""
    with tempfile.TemporaryDirectory() as folder:
        begin(recipe(parts, signal), Path(folder) / "set.zarr")
        dataset = open_dataset(Path(folder) / "set.zarr", allow_incomplete=True)
        maker, seconds, nbytes = Maker(dataset, 1), [], 0
        for item in dataset.items():
            began = time.process_time()
            maker.make(item)
            if item.kind == "histogram":
                seconds.append(time.process_time() - began)
                nbytes += dataset.files(item)[0].stat().st_size
    return Parts(np.array(seconds), nbytes / len(seconds))


def with_scheduler(
    parts: Parts,
    workers: int,
    disk_bytes_s: float,
    number: int,
    cost: tuple[float, float],
    random: np.random.Generator,
) -> tuple[float, float, int]:
    """Seconds until the last part, share of the time in which workers make parts, and tasks."""
    team = Team(None, None, lambda: workers, Dispatch())  # type: ignore[arg-type]
    times = random.choice(parts.seconds, number)
    tasks: list[tuple[float, int]] = []  # seconds and parts of each
    events: list[tuple[float, int, str]] = []  # when, which task, what happens to it: it comes, is made, is on disk
    waiting, idle = deque[int](), workers
    dask = disk = now = mean = 0.0  # the mean is not known before a task has ended
    given = ended = 0
    while ended < len(tasks) or given < number:
        while given < number and len(tasks) - ended < team.capacity():
            count = min(team.parts_of_a_task(mean, number - given), number - given)
            tasks.append((float(times[given : given + count].sum()), count))
            given += count
            dask = max(dask, now) + cost[0] + (count - 1) * cost[1]
            heapq.heappush(events, (dask, len(tasks) - 1, "comes"))
        now, task, what = heapq.heappop(events)
        if what == "comes":
            waiting.append(task)
        elif what == "made":
            disk = max(disk, now) + tasks[task][1] * parts.nbytes / disk_bytes_s
            heapq.heappush(events, (disk, task, "written"))
        else:
            ended, idle, mean = ended + 1, idle + 1, float(parts.seconds.mean())
        while waiting and idle:
            task, idle = waiting.popleft(), idle - 1
            heapq.heappush(events, (now + tasks[task][0], task, "made"))
    return now, float(times.sum()) / (workers * now), len(tasks)


def by_jobs(
    parts: Parts, jobs: int, disk_bytes_s: float, number: int, random: np.random.Generator
) -> tuple[float, float]:
    """The same for `--part K/N` with as many jobs as workers."""
    times = [float(each.sum()) for each in np.array_split(random.choice(parts.seconds, number), jobs)]
    last = max(max(times), number * parts.nbytes / disk_bytes_s)
    return last, sum(times) / (jobs * last)


def table() -> str:
    """The block of the page."""
    random, cost = np.random.default_rng(20261123), of_a_task()
    number = CUBES // CUBES_OF_A_PART
    rows = [
        "| S | workers | disk, GB/s | tasks | scheduler: time | workers busy | jobs: time | busy |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    facts = []
    for signal in (1.0, 0.1):
        parts = measured(signal)
        facts.append(
            f"S = {signal:g}: {1e3 * parts.seconds.mean() / CUBES_OF_A_PART:.1f} ms and "
            f"{parts.nbytes / CUBES_OF_A_PART / 1e6:.2f} MB a cube"
        )
        for workers, disk in PLANS:
            took, busy, tasks = with_scheduler(parts, workers, disk, number, cost, random)
            alone, share = by_jobs(parts, workers, disk, number, random)
            rows.append(
                f"| {signal:g} | {workers} | {disk / 1e9:g} | {tasks:,} "
                f"| {_span(took)} | {100 * busy:.0f} % | {_span(alone)} | {100 * share:.0f} % |"
            )
    date = datetime.datetime.now(datetime.UTC).date()
    note = (
        f"A million cubes on 1, 10 and 100 nodes of 16 cores, one file system for all; {date}, processor times on\n"
        f"{processor()} (load {load()}): {'; '.join(facts)}; a task\n"
        f"{1e3 * cost[0]:.1f} ms of dask's client and scheduler, each further part in it {1e3 * cost[1]:.2f} ms."
    )
    return "\n".join([*rows, "", note])


def _span(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{seconds / 60:.1f} min"


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write it into docs/scale.md")
    options = parser.parse_args()
    made = table()
    print(made)
    if options.write:
        write_block(PAGE, "python -m benchmarks.scale", made)


if __name__ == "__main__":
    main()
