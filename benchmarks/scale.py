"""`python -m benchmarks.scale`: the table of docs/scale.md, a simulation of the scheduler with measured part times.

Parts are measured by processor time on one thread, in this process. The simulation has their times, drawn anew, the
rules of `mars_lidar.dataset.cluster` for what is given out, a client that needs `CLIENT_S` a task, one after the other,
and one file system, which writes `DISK_BYTES_S` for all workers together.
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

import mars_lidar as ml
from benchmarks.machine import processor
from mars_lidar.dataset import begin, open_dataset
from mars_lidar.dataset.cluster import _AHEAD, _LEAST_QUEUED, _TASKS_PER_S, Team
from mars_lidar.dataset.write import Maker

PAGE = Path(__file__).parents[1] / "docs" / "scale.md"
BEGIN, END = "<!-- python -m benchmarks.scale -->", "<!-- end -->"
CUBES, CUBES_OF_A_PART = 1_000_000, 8
CLIENT_S = 2.5e-3  # of the dask client for a task: an earlier measurement, not repeated by this program
DISK_BYTES_S = 2e9


@dataclass(frozen=True)
class Parts:
    """Processor seconds of some parts, and their mean size on disk."""

    seconds: np.ndarray
    nbytes: float


def measured(signal: float, parts: int = 12) -> Parts:
    """Parts of eight cubes of 64 x 64 x 1024 at 1000 cycles, SBR 1, layout sparse."""
    system = ml.System(
        period_ns=1e3 / 7.5,
        cycles=1000,
        bins=1024,
        pulse=ml.GaussianPulse(sigma_ns=0.5),
        detector=ml.Detector(dead_time_ns=75.0),
    )
    with tempfile.TemporaryDirectory() as folder:
        recipe = {
            "scenes": {"example": "room", "size": 64, "seeds": {"count": parts}},
            "systems": [system],
            "light": {"signal": signal},
            "realizations": CUBES_OF_A_PART,
            "store": {"layout": "sparse"},
        }
        begin(recipe, Path(folder) / "set.zarr")
        dataset = open_dataset(Path(folder) / "set.zarr", allow_incomplete=True)
        maker, seconds, nbytes = Maker(dataset, 1), [], 0
        for item in dataset.items():
            began = time.process_time()
            maker.make(item)
            if item.kind == "histogram":
                seconds.append(time.process_time() - began)
                nbytes += dataset.files(item)[0].stat().st_size
    return Parts(np.array(seconds), nbytes / len(seconds))


def with_scheduler(parts: Parts, workers: int, number: int, random: np.random.Generator) -> tuple[float, float, int]:
    """Seconds until the last part, share of the time in which workers make parts, and tasks."""
    mean = float(parts.seconds.mean())
    team = Team(None, None, lambda: workers, _AHEAD, _LEAST_QUEUED, _TASKS_PER_S)  # type: ignore[arg-type]
    of_a_task, capacity = team.parts_of_a_task(mean), team.capacity()
    times = random.choice(parts.seconds, number)
    sums = np.add.reduceat(times, np.arange(0, number, of_a_task))
    sizes = np.diff(np.append(np.arange(0, number, of_a_task), number)) * parts.nbytes
    events: list[tuple[float, int, str]] = []  # when, which task, what happens to it: it comes, is made, is on disk
    waiting, idle = deque[int](), workers
    client = disk = 0.0
    given = ended = 0
    now = 0.0
    while ended < len(sums):
        while given < len(sums) and given - ended < capacity:
            client = max(client, now) + CLIENT_S
            heapq.heappush(events, (client, given, "comes"))
            given += 1
        now, task, what = heapq.heappop(events)
        if what == "comes":
            waiting.append(task)
        elif what == "made":
            disk = max(disk, now) + float(sizes[task]) / DISK_BYTES_S
            heapq.heappush(events, (disk, task, "written"))
        else:
            ended, idle = ended + 1, idle + 1
        while waiting and idle:
            task, idle = waiting.popleft(), idle - 1
            heapq.heappush(events, (now + float(sums[task]), task, "made"))
    return now, float(times.sum()) / (workers * now), len(sums)


def by_jobs(parts: Parts, jobs: int, number: int, random: np.random.Generator) -> tuple[float, float]:
    """The same for `--part K/N` with as many jobs as workers."""
    times = [float(each.sum()) for each in np.array_split(random.choice(parts.seconds, number), jobs)]
    last = max(max(times), number * parts.nbytes / DISK_BYTES_S)
    return last, sum(times) / (jobs * last)


def table() -> str:
    """The block of the page."""
    random = np.random.default_rng(20261123)
    number = CUBES // CUBES_OF_A_PART
    rows = [
        "| S | workers | parts a task | tasks | scheduler: time | workers busy | jobs: time | workers busy |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    facts = []
    for signal in (1.0, 0.1):
        parts = measured(signal)
        facts.append(
            f"S = {signal:g}: {1e3 * parts.seconds.mean() / CUBES_OF_A_PART:.1f} ms and "
            f"{parts.nbytes / CUBES_OF_A_PART / 1e6:.2f} MB a cube"
        )
        for workers in (16, 160, 1600):
            took, busy, tasks = with_scheduler(parts, workers, number, random)
            alone, share = by_jobs(parts, workers, number, random)
            rows.append(
                f"| {signal:g} | {workers} | {-(-number // tasks)} | {tasks:,} | {_span(took)} | {100 * busy:.0f} % | "
                f"{_span(alone)} | {100 * share:.0f} % |"
            )
    date = datetime.datetime.now(datetime.UTC).date()
    note = (
        f"A million cubes on 1, 10 and 100 nodes of 16 cores; {date}, part times measured on {processor()} by\n"
        f"processor time ({'; '.join(facts)}), a disk of {DISK_BYTES_S / 1e9:g} GB/s for all workers,\n"
        f"{1e3 * CLIENT_S:g} ms of the client for a task."
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
