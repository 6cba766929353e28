"""What `generate` and `info` tell of a dataset, in tables."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mars_lidar._base import manifest
from mars_lidar._base.files import size_on_disk
from mars_lidar._base.progress import span
from mars_lidar.cli.console import BAD_INPUT, say, table

if TYPE_CHECKING:
    from mars_lidar.dataset.estimate import Estimate
    from mars_lidar.dataset.run import Generated
    from mars_lidar.io import Problem


def dataset_rows(path: Path) -> list[tuple[str, str]] | None:
    """What `mars-lidar info` tells of a dataset; None for anything else."""
    from mars_lidar.dataset.store import is_dataset, open_dataset

    if not is_dataset(path):
        return None
    stored = open_dataset(path, allow_incomplete=True)
    rows = [("file", f"{path} (mars-lidar {stored.attrs['version']})")]
    if not stored.planned:
        return [*rows, ("complete", "NO: stopped before its scenes were in; generate it again with --resume")]
    left = [] if stored.complete else stored.missing()
    total = sum(1 for _ in stored.items())
    array, recipe = stored.histogram, stored.recipe
    levels = ", ".join(f"{s:g}/{b:g}" for s, b in recipe.light.levels[:8])
    problems = len(stored.problems)
    whole = (
        f"yes; {manifest.description(path)}" if stored.complete else "NO: all parts are there; continue with --resume"
    )
    return [
        *rows,
        ("complete", f"NO: {total - len(left)} of {total} parts are there; continue with --resume" if left else whole),
        ("counts", f"{_shape(array.shape)} {array.dtype}, {recipe.layout}"),
        (
            "size",
            f"{_bytes(math.prod(array.shape) * array.dtype.itemsize)} dense, {_bytes(size_on_disk(path))} on disk",
        ),
        ("chunk", f"{_size(array.chunks)} of a shard of {_size(array.shards)}"),
        ("engine", f"{recipe.engine}, seed {recipe.seed}"),
        *((f"system {k}", one.to_json()) for k, one in enumerate(recipe.systems)),
        ("light", f"signal/sbr {levels}{', ...' if len(recipe.light.levels) > 8 else ''}"),
        ("scenes", ", ".join(json.dumps(one) for one in recipe.scenes)),
        ("left out", files(problems)),
        *(("", str(problem)) for problem in stored.problems[:20]),
        ("open with", f"xarray.open_zarr({str(path)!r})"),
    ]


def tell(done: Generated) -> None:
    """What `generate` did."""
    exposures = math.prod(done.shape[:4])
    busy = done.simulate_s + done.write_s
    share = f"; {100 * done.simulate_s / busy:.0f} % of the threads' time simulating" if busy else ""
    before = f", {done.parts_before} were there" if done.parts_before else ""
    table(
        {
            "generated": _shape(done.shape),
            "parts": f"{done.parts} made{before}",
            "time": f"{done.seconds:.3g} s for {exposures:,} pixel exposures{share}",
            "dataset": f"{done.path}, {_bytes(size_on_disk(done.path))}",
            "open with": f"xarray.open_zarr({str(done.path)!r})",
            "left out": files(len(done.problems)),
        }
    )
    _tell_problems(done.problems)


def _tell_problems(problems: tuple[Problem, ...]) -> None:
    for problem in problems:
        say(f"left out: {problem}")


def tell_estimate(told: Estimate) -> None:
    """What `--dry-run` expects; exit code 2 where the disk is too small."""
    shards = f"{told.shards:,} shard{'s' * (told.shards > 1)}"
    rows = [
        ("dataset", _shape(told.shape)),
        ("scenes", f"{told.scenes:,}"),
        ("size", f"about {_bytes(told.bytes)} on disk, of {_bytes(told.dense_bytes)} dense; {shards}"),
        ("chunk", _size(told.chunk)),
        ("time", f"about {span(told.seconds)} on {told.threads} threads of this machine"),
        ("memory", f"at most {_bytes(told.memory_bytes)}"),
    ]
    short = told.free_bytes is not None and told.bytes > told.free_bytes
    if told.free_bytes is not None:
        rows.append(("disk", f"{_bytes(told.free_bytes)} free{': NOT ENOUGH' if short else ''}"))
    table(rows)
    _tell_problems(told.problems)
    if short:
        raise typer.Exit(BAD_INPUT)


def _shape(shape: tuple[int, ...]) -> str:
    return f"{_size(shape)} (sample, realization, y, x, time)"


def _size(shape: tuple[int, ...]) -> str:
    return " × ".join(map(str, shape))


def files(number: int) -> str:
    """How many files, in words."""
    return f"{number:,} file{'s' * (number > 1)}" if number else "nothing"


def _bytes(number: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if number < 1000 or unit == "TB":
            break
        number /= 1000
    return f"{number:.3g} {unit}"
