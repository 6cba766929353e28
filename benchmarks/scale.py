"""`python -m benchmarks.scale`: the table of docs/scale.md, a simulation of the scheduler with measured part times.

Parts are measured by processor time on one thread, in this process. The simulation has their times, drawn anew, the
rules of `mars_lidar.dataset.cluster` for what is given out, the client and the scheduler, each of which handles tasks
one after the other in the time that `benchmarks.cluster` measures, and one file system for all workers together.
"""

from __future__ import annotations

import argparse
import datetime
import heapq
import tempfile
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.cluster import of_a_task, recipe
from benchmarks.machine import processor
from mars_lidar.dataset import begin, open_dataset
from mars_lidar.dataset.cluster import Dispatch, Team
from mars_lidar.dataset.write import Maker

PAGE = Path(__file__).parents[1] / "docs" / "scale.md"
BEGIN, END = "<!-- python -m benchmarks.scale -->", "<!-- end -->"
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


def measured(signal: float, parts: int = 4) -> Parts:
    """Parts of `CUBES_OF_A_PART` cubes of 64 x 64 x 1024 at 1000 cycles, SBR 1, layout sparse."""
    with tempfile.TemporaryDirectory() as folder:
        begin(recipe(parts, CUBES_OF_A_PART, signal), Path(folder) / "set.zarr")
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
    costs: dict[str, tuple[float, float]],
    random: np.random.Generator,
) -> tuple[float, float, int]:
    """Seconds until the last part, share of the time in which workers make parts, and tasks."""
    team = Team(None, None, lambda: workers, Dispatch())  # type: ignore[arg-type]
    times = random.choice(parts.seconds, number)
    tasks: list[tuple[float, int]] = []  # seconds and parts of each
    events: list[tuple[float, int, str]] = []  # when, which task, what happens to it: it comes, is made, is on disk
    waiting, idle = deque[int](), workers
    client = scheduler = disk = now = mean = 0.0  # the mean is not known before a task has ended
    given = ended = 0
    while ended < len(tasks) or given < number:
        while given < number and len(tasks) - ended < team.capacity():
            count = min(team.parts_of_a_task(mean, number - given), number - given)
            tasks.append((float(times[given : given + count].sum()), count))
            given += count
            client_s, scheduler_s = (task + (count - 1) * part for task, part in costs.values())
            client = max(client, now) + client_s
            scheduler = max(scheduler, client) + scheduler_s
            heapq.heappush(events, (scheduler, len(tasks) - 1, "comes"))
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
    random, costs = np.random.default_rng(20261123), of_a_task()
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
            took, busy, tasks = with_scheduler(parts, workers, disk, number, costs, random)
            alone, share = by_jobs(parts, workers, disk, number, random)
            rows.append(
                f"| {signal:g} | {workers} | {disk / 1e9:g} | {tasks:,} "
                f"| {_span(took)} | {100 * busy:.0f} % | {_span(alone)} | {100 * share:.0f} % |"
            )

    (client, of_client), (scheduler, of_scheduler) = ((1e3 * task, 1e3 * part) for task, part in costs.values())
    date = datetime.datetime.now(datetime.UTC).date()
    note = (
        f"A million cubes on 1, 10 and 100 nodes of 16 cores, one file system for all; {date}, processor times on\n"
        f"{processor()}: {'; '.join(facts)}; a task\n"
        f"{client:.1f} ms of the client and {scheduler:.1f} ms of the scheduler, each further part in it "
        f"{of_client:.2f} and {of_scheduler:.2f} ms."
    )
    return "\n".join([*rows, "", note])


def _span(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{seconds / 60:.1f} min"


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write it into docs/scale.md")
    made = table()
    print(made)
    if parser.parse_args().write:
        text = PAGE.read_text()
        before, rest = text.split(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
