"""`mars-lidar generate`, `verify` and `export`: training sets from scenes, their check, and files for networks."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from mars_lidar._base import manifest
from mars_lidar._base.files import size_on_disk
from mars_lidar._base.progress import span
from mars_lidar.cli.console import Exit, progress_bar, say, table
from mars_lidar.cli.options import Integer, Number, Numbers, OutPath, Text, command
from mars_lidar.cli.system_options import DEFAULT_SYSTEM, Effects, SystemChanges
from mars_lidar.scene.scene import Scene

if TYPE_CHECKING:
    from mars_lidar.dataset import DatasetRecipe
    from mars_lidar.dataset.estimate import Estimate
    from mars_lidar.dataset.run import Generated
    from mars_lidar.io import Problem


_RECIPES = (".yaml", ".yml")
_TRANSIENTS = (".h5", ".hdf5")  # a depth is never in one; the other files of transients need a recipe


def generate(
    source: Path | None = None,
    /,
    *,
    size: Text | None = None,
    crop: Text | None = None,
    crops: Integer | None = None,
    scene_seeds: Integer | None = None,
    depth_unit_m: Number | None = None,
    focal_px: Number | None = None,
    max_depth_m: Number | None = None,
    system: list[Path] | None = None,
    changes: SystemChanges = SystemChanges(),
    effects: Effects = Effects(),
    signal: Numbers | None = None,
    sbr: Numbers | None = None,
    attenuation: Text | None = None,
    ambient: Text | None = None,
    engine: Text | None = None,
    realizations: Integer | None = None,
    seed: Integer | None = None,
    threads: Integer | None = None,
    workers: Integer | None = None,
    scheduler: Text | None = None,
    out: OutPath,
    layout: Text | None = None,
    resume: bool = False,
    overwrite: bool = False,
    begin: bool = False,
    part: Text | None = None,
    finish: bool = False,
    dry_run: bool = False,
) -> int | None:
    """Simulate a dataset of many scenes, systems and levels of light.

    Simulates every scene with every system, level of light and realization into one Zarr store. With a recipe, options
    replace its values. The store does not depend on threads, workers or interruptions: the same recipe gives the
    same files, byte for byte. Unusable files are skipped and listed at the end. Fog, panes, folders of transients
    and everything else without an option are set in a recipe.

    Arguments
    ---------
    source
        A recipe (.yaml, .yml), a built-in scene (room), RGB-D (a file or a folder), or a rendered transient (.h5,
        .hdf5).

    Scenes
    ------
    size : SIDE
        Resample every scene: the longer side, or HEIGHT,WIDTH. [default: as it is; room: 128]
    crop : SIDE
        Crops at random positions: side, or HEIGHT,WIDTH.
    crops
        Crops per scene. [default: 1]
    scene_seeds
        Built-in scene: that many, of seeds 0, 1, ... [default: 1]
    depth_unit_m
        RGB-D: metres per stored unit of depth. [default: 0.001 for images, 1 for arrays]
    focal_px
        RGB-D: focal length, pixels of the file: turns depth along the axis into range along the ray. [default: depth as
        it is]
    max_depth_m
        RGB-D: depths beyond this are no return, m. [default: none]

    System
    ------
    system
        YAML or JSON file (see mars-lidar init), repeated for several; single options replace its values.

    Light
    -----
    signal
        Mean signal photons per laser period, repeated for several levels. [default: 1]
    sbr
        Mean signal / mean ambient photons, repeated for several: each with each signal. [default: 1]
    attenuation : {none, inverse_square}
        Signal against depth z: none or inverse_square (1 / z^2). [default: none]
    ambient : {uniform, reflectivity, map}
        Ambient light over the image: uniform, reflectivity, or map (of the scene). [default: map where the scene has
        one, else uniform]

    Simulation
    ----------
    engine
        As for mars-lidar simulate. [default: exact]
    realizations
        Exposures of each sample. [default: 1]
    seed
        Seed of the dataset. [default: 0]
    threads
        Threads; the counts do not depend on it. [default: all cores]
    workers
        Worker processes on this machine (extra cluster).
    scheduler
        Address of a dask scheduler whose workers see --out (extra cluster).

    Output
    ------
    out
        The dataset, NAME.zarr.
    layout
        dense (any Zarr library reads it) or sparse (bins that are not zero, packed: smaller in dim light). [default:
        dense]
    resume
        Continue a stopped run.
    overwrite
        Replace an existing dataset.
    begin
        Read the scenes and create the store without counts, which --part jobs make.
    part : K/N
        Make part K of N of a store that --begin created, in any order.
    finish
        Check that all parts exist, and mark the store complete.
    dry_run
        Print size, time and memory; write nothing.

    Examples
    --------
    mars-lidar generate recipe.yaml -o set.zarr --dry-run
    mars-lidar generate recipe.yaml -o set.zarr --resume
    mars-lidar generate room --size 64 --scene-seeds 100 --signal 0.1 --signal 1 --sbr 0.5 -o rooms.zarr
    mars-lidar generate nyu_depth_v2_labeled.mat --focal-px 519 --crop 64 --crops 4 -o nyu.zarr
    mars-lidar generate recipe.yaml -o set.zarr --scheduler tcp://10.0.0.1:8786

    Notes
    -----
    Recipes: docs/generate.md. Clusters: docs/scale.md.
    """
    from mars_lidar import dataset
    from mars_lidar.dataset.estimate import quick_advice

    if sum((begin, part is not None, finish, dry_run)) > 1:
        raise ValueError("--begin, --part, --finish and --dry-run are four steps: give one of them")
    if (part or finish) and (workers is not None or scheduler is not None):
        raise ValueError("--part and --finish need no --workers and no --scheduler")
    if (part or finish) and (source is not None or resume or overwrite):
        raise ValueError("--part and --finish go on with the store: no SOURCE, --resume or --overwrite")
    if part is not None:
        with progress_bar("generating") as progress:
            print_result(dataset.make_part(out, _part(part), threads=threads, progress=progress))
        return None
    if finish:
        print_result(dataset.finish(out))
        return None
    of_systems = bool(system) or changes != SystemChanges() or effects != Effects()
    replaced = {
        "size": _size("--size", size),
        "crop": None if crop is None else {"size": _size("--crop", crop), "count": crops or 1},
        "systems": [changes.of(file, effects) for file in system or (None,)] if of_systems else None,
        "light": _given(signal=signal or None, sbr=sbr or None, attenuation=attenuation, ambient=ambient) or None,
        "engine": engine,
        "realizations": realizations,
        "seed": seed,
        "store": None if layout is None else {"layout": layout},
    }
    replaced = _given(**replaced)
    if source is not None and source.suffix in _RECIPES and not system and "systems" in replaced:
        raise ValueError("with a recipe, single options of the system need the --system whose values they replace")
    if crops is not None and crop is None:
        raise ValueError("--crops belongs to --crop, which is not given")
    rgbd = _given(depth_unit_m=depth_unit_m, focal_px=focal_px, max_depth_m=max_depth_m)
    recipe = _recipe(source, replaced, scene_seeds, rgbd, resume)
    if (dry_run or begin) and recipe is None:
        raise ValueError(f"--{'dry-run' if dry_run else 'begin'} needs a SOURCE")
    if dry_run and recipe is not None:
        return print_estimate(dataset.estimate(recipe, out, threads=threads))
    where: dict[str, Any] = {"resume": resume, "overwrite": overwrite, "workers": workers, "scheduler": scheduler}
    if begin and recipe is not None:
        print_result(dataset.begin(recipe, out, **where))
        return None
    here = workers is None and scheduler is None and not (resume and out.exists())
    if here and recipe is not None and (advice := str(quick_advice(recipe, threads))):
        say(advice)
    with progress_bar("generating") as progress:
        print_result(dataset.generate(recipe, out, threads=threads, progress=progress, **where))
    return None


def verify(
    path: Path,
    /,
    *,
    chunks: Integer = 16,
    every: Annotated[bool, Parameter(("--all",))] = False,
    seed: Integer = 0,
    threads: Integer | None = None,
) -> int | None:
    """Simulate chunks of a dataset again and compare every count.

    The chunks are chosen at random; exit code 1 if a count differs.

    Arguments
    ---------
    path
        A dataset that generate wrote.

    Options
    -------
    chunks
        How many, chosen at random. [default: 16]
    every
        All of them.
    seed
        Seed of the choice. [default: 0]
    threads
        Threads. [default: all cores]
    """
    from mars_lidar.dataset import verify as verified

    with progress_bar("verifying") as progress:
        checked = verified(path, chunks=None if every else chunks, seed=seed, threads=threads, progress=progress)
    again = f"{checked.chunks} of {checked.of} chunks simulated again"
    table([("verified", f"{again}, every count is the same" if checked.good else f"NO: see below; {again}")])
    for line in checked.different:
        say(line)
    return None if checked.good else Exit.FAILED


def _recipe(
    source: Path | None, replaced: dict[str, Any], scene_seeds: int | None, rgbd: dict[str, Any], resume: bool
) -> DatasetRecipe | None:
    from mars_lidar.dataset.recipe import DatasetRecipe

    if source is None:
        if not resume:
            raise ValueError("SOURCE is missing: a recipe, a built-in scene, or RGB-D")
        if replaced or scene_seeds is not None or rgbd:
            raise ValueError("--resume without SOURCE takes the recipe of the store: no other options")
        return None
    if source.suffix in _RECIPES:
        if scene_seeds is not None or rgbd:
            raise ValueError("--scene-seeds, --depth-unit-m and --focal-px stand in the recipe's scenes")
        return DatasetRecipe.load(source, **replaced)
    if str(source) in Scene.example_names():
        scene: dict[str, Any] = {"example": str(source), "seeds": {"count": scene_seeds or 1}}
        scene["size"] = replaced.pop("size", 128)
    elif scene_seeds is not None:
        raise ValueError(f"--scene-seeds belongs to a built-in scene, and {source} is none")
    else:
        transient = source.suffix.lower() in _TRANSIENTS
        scene = {"transient": str(source)} if transient else {"path": str(source), **rgbd}
    if rgbd and "path" not in scene:
        raise ValueError("--depth-unit-m and --focal-px belong to RGB-D")
    return DatasetRecipe.from_dict({"systems": [DEFAULT_SYSTEM], **replaced, "scenes": scene})


def _part(text: str) -> tuple[int, int]:
    which, _, of = text.partition("/")
    if not (which.isdecimal() and of.isdecimal() and 1 <= int(which) <= int(of)):
        raise ValueError(f"--part must be K/N with K from 1 to N, got {text!r}")
    return int(which), int(of)


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _size(option: str, text: str | None) -> Any:
    if text is None:
        return None
    try:
        numbers = [int(part) for part in text.split(",", 1)]
    except ValueError:
        raise ValueError(f"{option} must be one integer or HEIGHT,WIDTH, got {text!r}") from None
    return numbers[0] if len(numbers) == 1 else numbers


def export(dataset: Path, /, *, out: OutPath, layout: Text, fill: bool = False) -> None:
    """Write a dataset as the files that depth networks load.

    One .mat for each exposure and a list of them, or tar archives.

    Arguments
    ---------
    dataset
        A dataset that mars-lidar generate wrote.

    Options
    -------
    out
        A new folder.
    layout
        Whose loader reads it: lindell, deepsensorfusion, sun, gutierrez or webdataset.
    fill
        Give pixels without a return the depth and rates of the nearest pixel with one.

    Examples
    --------
    mars-lidar generate room --size 64 --scene-seeds 20 -o rooms.zarr
    mars-lidar export rooms.zarr --layout lindell --fill -o lindell

    Notes
    -----
    docs/formats.md describes each file.
    """
    from mars_lidar.dataset.network_files import export as exported

    with progress_bar("exporting") as progress:
        done = exported(dataset, out, layout=layout, fill=fill, progress=progress)
    rows = [("wrote", f"{done.files} exposures in {out}"), ("list", str(done.listed))]
    table(rows + [("note", text) for text in done.notes])


def dataset_rows(path: Path) -> list[tuple[str, str]] | None:
    """Rows that `mars-lidar info` prints for a dataset; None for anything else."""
    from mars_lidar.dataset.store import is_dataset, open_dataset

    if not is_dataset(path):
        return None
    stored = open_dataset(path, allow_incomplete=True)
    rows = [("file", f"{path} (mars-lidar {stored.attrs['version']})")]
    if not stored.planned:
        return [*rows, ("complete", "NO: stopped before its scenes were in; generate it again with --resume")]
    missing = [] if stored.complete else stored.missing()
    total = sum(1 for _ in stored.items())
    array, recipe = stored.histogram, stored.recipe
    levels = ", ".join(f"{s:g}/{b:g}" for s, b in recipe.light.levels[:8])
    problems = len(stored.problems)
    whole = f"NO: {total - len(missing)} of {total} parts are there; continue with --resume"
    if stored.complete:
        whole = f"yes; {manifest.description(path)}"
    return [
        *rows,
        ("complete", whole),
        ("counts", f"{_shape(array.shape)} {array.dtype}, {recipe.layout}"),
        (
            "size",
            f"{_bytes(math.prod(array.shape) * array.dtype.itemsize)} dense, {_bytes(size_on_disk(path))} on disk",
        ),
        ("chunk", f"{_dimensions(array.chunks)} of a shard of {_dimensions(array.shards)}"),
        ("engine", f"{recipe.engine}, seed {recipe.seed}"),
        *((f"system {k}", system.to_json()) for k, system in enumerate(recipe.systems)),
        ("light", f"signal/sbr {levels}{', ...' if len(recipe.light.levels) > 8 else ''}"),
        ("scenes", ", ".join(json.dumps(scene) for scene in recipe.scenes)),
        ("left out", files(problems)),
        *(("", str(problem)) for problem in stored.problems[:20]),
        ("open with", f"xarray.open_zarr({str(path)!r})"),
    ]


def print_result(done: Generated) -> None:
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
    _print_problems(done.problems)


def _print_problems(problems: tuple[Problem, ...]) -> None:
    for problem in problems:
        say(f"left out: {problem}")


def print_estimate(expected: Estimate) -> int | None:
    """Print the estimate of `--dry-run`; exit code 2 if the disk is too small."""
    shards = f"{expected.shards:,} shard{'s' * (expected.shards > 1)}"
    rows = [
        ("dataset", _shape(expected.shape)),
        ("scenes", f"{expected.scenes:,}"),
        ("size", f"about {_bytes(expected.bytes)} on disk, of {_bytes(expected.dense_bytes)} dense; {shards}"),
        ("chunk", _dimensions(expected.chunk)),
        ("time", f"about {span(expected.seconds)} on {expected.threads} threads of this machine"),
        ("memory", f"at most {_bytes(expected.memory_bytes)}"),
    ]
    short = expected.free_bytes is not None and expected.bytes > expected.free_bytes
    if expected.free_bytes is not None:
        rows.append(("disk", f"{_bytes(expected.free_bytes)} free{': NOT ENOUGH' if short else ''}"))
    table(rows)
    _print_problems(expected.problems)
    return Exit.BAD_INPUT if short else None


def _shape(shape: tuple[int, ...]) -> str:
    return f"{_dimensions(shape)} (sample, realization, y, x, time)"


def _dimensions(shape: tuple[int, ...]) -> str:
    return " × ".join(map(str, shape))


def files(number: int) -> str:
    """A number of files as text."""
    return f"{number:,} file{'s' * (number > 1)}" if number else "nothing"


def _bytes(number: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if number < 1000 or unit == "TB":
            break
        number /= 1000
    return f"{number:.3g} {unit}"


generate_command = command(generate)
verify_command = command(verify)
export_command = command(export)
