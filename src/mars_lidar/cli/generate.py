"""`mars-lidar generate` and `mars-lidar verify`: from scenes to a training set, and whether it is what it should be."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mars_lidar.cli import options
from mars_lidar.cli.console import BAD_INPUT, FAILED, progress_bar, reported, say, table
from mars_lidar.cli.system_options import SystemOptions

if TYPE_CHECKING:
    from mars_lidar.dataset import DatasetRecipe
    from mars_lidar.dataset.estimate import Estimate
    from mars_lidar.dataset.run import Generated
    from mars_lidar.io import Problem

GENERATE_EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar generate recipe.yaml -o set.zarr --dry-run",
        "mars-lidar generate recipe.yaml -o set.zarr --resume",
        "mars-lidar generate room --size 64 --scene-seeds 100 --signal 0.1 --signal 1 --sbr 0.5 -o rooms.zarr",
        "mars-lidar generate nyu_depth_v2_labeled.mat --focal-px 519 --crop 64 --crops 4 -o nyu.zarr",
        "mars-lidar generate recipe.yaml -o set.zarr --scheduler tcp://10.0.0.1:8786",
        "Recipes: docs/generate.md. Clusters: docs/scale.md.",
    )
)


_RECIPES = (".yaml", ".yml")
_TRANSIENTS = (".h5", ".hdf5")  # a depth is never in one; the other files of transients need a recipe


def _many(text: str, panel: str = "Light") -> Any:
    return typer.Option(rich_help_panel=panel, help=text, show_default=False)


def generate(
    *,
    source: Annotated[
        Path | None,
        typer.Argument(
            help="A recipe (.yaml, .yml), a built-in scene (room), RGB-D (a file or a folder), or a rendered transient "
            "(.h5, .hdf5).",
            show_default=False,
        ),
    ] = None,
    size: Annotated[
        str | None, _many("Resample every scene: the longer side, or HEIGHT,WIDTH. Room: 128 by default.", "Scenes")
    ] = None,
    crop: Annotated[str | None, _many("Cut out parts at random places: side, or HEIGHT,WIDTH.", "Scenes")] = None,
    crops: Annotated[int | None, _many("Parts per scene. Default: 1.", "Scenes")] = None,
    scene_seeds: Annotated[int | None, _many("Room: that many, of seeds 0, 1, ... Default: 1.", "Scenes")] = None,
    depth_unit_m: Annotated[float | None, _many("RGB-D: metres per stored unit of depth.", "Scenes")] = None,
    focal_px: Annotated[float | None, _many("RGB-D: focal length in pixels of the file.", "Scenes")] = None,
    system: Annotated[
        list[Path] | None, _many("System file (see mars-lidar init); may be repeated.", "System")
    ] = None,
    period_ns: options.PeriodNs = None,
    dead_time_ns: options.DeadTimeNs = None,
    cycles: options.Cycles = None,
    bins: options.Bins = None,
    pulse_sigma_ns: options.PulseSigmaNs = None,
    signal: Annotated[
        list[float] | None, _many("Mean signal photons per period; may be repeated. Default: 1.")
    ] = None,
    sbr: Annotated[
        list[float] | None, _many("Mean signal / mean ambient photons; may be repeated. Default: 1.")
    ] = None,
    engine: Annotated[str | None, _many("As for mars-lidar simulate. Default: exact.", "Simulation")] = None,
    realizations: Annotated[int | None, _many("Exposures of each sample. Default: 1.", "Simulation")] = None,
    seed: Annotated[int | None, _many("Seed of the dataset. Default: 0.", "Simulation")] = None,
    threads: options.Threads = None,
    workers: Annotated[
        int | None, _many("Worker processes on this machine (extra cluster).", "Simulation")
    ] = None,
    scheduler: Annotated[
        str | None, _many("Address of a dask scheduler whose workers see --out (extra cluster).", "Simulation")
    ] = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", rich_help_panel="Output", help="The dataset, NAME.zarr.", show_default=False)
    ],
    layout: Annotated[
        str | None,
        _many("sparse (packed bins that are not zero) or dense (for other Zarr libraries). Default: sparse.", "Output"),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", rich_help_panel="Output", help="Continue what was stopped.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", rich_help_panel="Output", help="Replace an existing dataset.")
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", rich_help_panel="Output", help="Tell size, time and memory; write nothing."),
    ] = False,
) -> None:
    """Simulate a dataset: scenes x systems x levels of light x realizations, into one Zarr store.

    With a recipe, options replace its values. The store does not depend on threads, workers or interruptions: the
    same recipe gives the same files, byte for byte. Files that cannot be used are left out and told at the end.
    """
    with reported():
        from mars_lidar import dataset

        single = {
            "period_ns": period_ns, "dead_time_ns": dead_time_ns, "cycles": cycles, "bins": bins,
            "pulse_sigma_ns": pulse_sigma_ns,
        }  # fmt: skip
        replaced = {
            "size": _size("--size", size),
            "crop": None if crop is None else {"size": _size("--crop", crop), "count": crops or 1},
            "systems": _systems(system, single),
            "light": _light(signal, sbr),
            "engine": engine,
            "realizations": realizations,
            "seed": seed,
            "store": None if layout is None else {"layout": layout},
        }
        replaced = {name: value for name, value in replaced.items() if value is not None}
        if source is not None and source.suffix in _RECIPES and not system and "systems" in replaced:
            raise ValueError("with a recipe, single options of the system need the --system whose values they replace")
        if crops is not None and crop is None:
            raise ValueError("--crops belongs to --crop, which is not given")
        rgbd = {"depth_unit_m": depth_unit_m, "focal_px": focal_px}
        recipe = _recipe(source, replaced, scene_seeds, {k: v for k, v in rgbd.items() if v is not None}, resume)
        if dry_run:
            if recipe is None:
                raise ValueError("--dry-run needs a source")
            _tell_estimate(dataset.estimate(recipe, out, threads=threads))
            return
        with progress_bar("generating") as progress:
            done = dataset.generate(
                recipe, out, resume=resume, overwrite=overwrite, threads=threads, workers=workers,
                scheduler=scheduler, progress=progress,
            )  # fmt: skip
        _tell(done)


def verify(
    path: Annotated[Path, typer.Argument(help="A dataset that generate wrote.", show_default=False)],
    chunks: Annotated[int, typer.Option("--chunks", help="How many, chosen at random.")] = 16,
    every: Annotated[bool, typer.Option("--all", help="All of them.")] = False,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the choice.")] = 0,
    threads: Annotated[
        int | None, typer.Option("--threads", help="Threads. [dim]Default: all cores.[/dim]", show_default=False)
    ] = None,
) -> None:
    """Simulate random chunks of a dataset again and compare every count; exit code 1 if they differ."""
    with reported():
        from mars_lidar.dataset import verify as verified

        with progress_bar("verifying") as progress:
            told = verified(path, chunks=None if every else chunks, seed=seed, threads=threads, progress=progress)
        if told.good:
            table([("verified", f"{told.chunks} of {told.of} chunks simulated again, every count is the same")])
            return
        table([("verified", f"NO: {len(told.different)} of {told.chunks} chunks differ")])
        for line in told.different:
            say(line)
        raise typer.Exit(FAILED)


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
    return [
        *rows,
        ("complete", f"NO: {total - len(left)} of {total} parts are there; continue with --resume" if left else "yes"),
        ("counts", f"{_shape(array.shape)} {array.dtype}, {recipe.layout}"),
        ("size", f"{_bytes(math.prod(array.shape) * array.dtype.itemsize)} dense, {_bytes(_on_disk(path))} on disk"),
        ("chunk", f"{_shape(array.chunks)} of a shard of {_shape(array.shards)}"),
        ("engine", f"{recipe.engine}, seed {recipe.seed}"),
        *((f"system {k}", one.to_json()) for k, one in enumerate(recipe.systems)),
        ("light", f"signal/sbr {levels}{', ...' if len(recipe.light.levels) > 8 else ''}"),
        ("scenes", ", ".join(json.dumps(one) for one in recipe.scenes)),
        ("left out", f"{problems} files" if problems else "nothing"),
        *(("", str(problem)) for problem in stored.problems[:20]),
        ("open with", f"xarray.open_zarr({str(path)!r})"),
    ]


def _recipe(
    source: Path | None, replaced: dict[str, Any], scene_seeds: int | None, rgbd: dict[str, Any], resume: bool
) -> DatasetRecipe | None:
    from mars_lidar.dataset.recipe import DatasetRecipe
    from mars_lidar.scene import Scene

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
        if rgbd:
            raise ValueError("--depth-unit-m and --focal-px belong to RGB-D")
        scene: dict[str, Any] = {"example": str(source), "seeds": {"count": scene_seeds or 1}}
        scene["size"] = replaced.pop("size", 128)
    else:
        if scene_seeds is not None:
            raise ValueError(f"--scene-seeds belongs to a built-in scene, and {source} is none")
        scene = {"path": str(source), **rgbd}
        if source.suffix.lower() in _TRANSIENTS:
            if rgbd:
                raise ValueError("--depth-unit-m and --focal-px belong to RGB-D")
            scene = {"transient": str(source)}
    return DatasetRecipe.from_dict({"systems": _default_systems(), **replaced, "scenes": scene})


def _default_systems() -> list[Any]:
    from mars_lidar.cli.system_options import DEFAULT_SYSTEM

    return [DEFAULT_SYSTEM]


def _systems(files: list[Path] | None, single: dict[str, Any]) -> list[Any] | None:
    """Systems of the command line: each file with the single options in place of its values."""
    if not files and all(value is None for value in single.values()):
        return None
    bases: list[Path | None] = [*files] if files else [None]
    return [SystemOptions(system=file, **single).build() for file in bases]


def _light(signal: list[float] | None, sbr: list[float] | None) -> dict[str, Any] | None:
    given = {"signal": signal or None, "sbr": sbr or None}
    return {name: value for name, value in given.items() if value is not None} or None


def _size(option: str, text: str | None) -> Any:
    if text is None:
        return None
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2):
        raise ValueError(f"{option} must be one integer or HEIGHT,WIDTH, got {text!r}")
    return numbers[0] if len(numbers) == 1 else numbers


def _tell(done: Generated) -> None:
    exposures = math.prod(done.shape[:4])
    busy = done.simulate_s + done.write_s
    share = f"; {100 * done.simulate_s / busy:.0f} % of the threads' time simulating" if busy else ""
    before = f", {done.parts_before} were there" if done.parts_before else ""
    table(
        [
            ("generated", _shape(done.shape)),
            ("parts", f"{done.parts} made{before}"),
            ("time", f"{done.seconds:.3g} s for {exposures:,} pixel exposures{share}"),
            ("dataset", f"{done.path}, {_bytes(_on_disk(done.path))}"),
            ("open with", f"xarray.open_zarr({str(done.path)!r})"),
            ("left out", f"{len(done.problems)} files" if done.problems else "nothing"),
        ]
    )
    _tell_problems(done.problems)


def _tell_problems(problems: tuple[Problem, ...]) -> None:
    for problem in problems:
        say(f"left out: {problem}")


def _tell_estimate(told: Estimate) -> None:
    rows = [
        ("dataset", _shape(told.shape)),
        ("scenes", f"{told.scenes:,}"),
        ("size", f"about {_bytes(told.bytes)} on disk, of {_bytes(told.dense_bytes)} dense; {told.shards:,} shards"),
        ("chunk", " × ".join(map(str, told.chunk))),
        ("time", f"about {_span(told.seconds)} on {told.threads} threads of this machine"),
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
    return " × ".join(map(str, shape)) + " (sample, realization, y, x, time)"


def _on_disk(path: Path) -> int:
    return sum(part.stat().st_size for part in path.rglob("*") if part.is_file())


def _bytes(number: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if number < 1000 or unit == "TB":
            break
        number /= 1000
    return f"{number:.3g} {unit}"


def _span(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.3g} minutes" if seconds < 7200 else f"{seconds / 3600:.3g} hours"
