"""`mars-lidar generate` and `mars-lidar verify`: from scenes to a training set, and whether it is what it should be."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mars_lidar.cli.console import FAILED, progress_bar, reported, say, table
from mars_lidar.cli.dataset_tables import tell, tell_estimate
from mars_lidar.cli.effect_options import Effects
from mars_lidar.cli.groups import argument, examples, option, panel
from mars_lidar.cli.options import THREADS, of_output, of_run, of_system
from mars_lidar.cli.options import out as out_option
from mars_lidar.cli.scene_options import AMBIENT, ATTENUATION, of_light
from mars_lidar.cli.system_options import DEFAULT_SYSTEM, SystemChanges
from mars_lidar.scene.scene import Scene

if TYPE_CHECKING:
    from mars_lidar.dataset import DatasetRecipe

GENERATE_EPILOG = examples(
    "mars-lidar generate recipe.yaml -o set.zarr --dry-run",
    "mars-lidar generate recipe.yaml -o set.zarr --resume",
    "mars-lidar generate room --size 64 --scene-seeds 100 --signal 0.1 --signal 1 --sbr 0.5 -o rooms.zarr",
    "mars-lidar generate nyu_depth_v2_labeled.mat --focal-px 519 --crop 64 --crops 4 -o nyu.zarr",
    "mars-lidar generate recipe.yaml -o set.zarr --scheduler tcp://10.0.0.1:8786",
    "Recipes: docs/generate.md. Clusters: docs/scale.md.",
)
_RECIPES = (".yaml", ".yml")
_TRANSIENTS = (".h5", ".hdf5")  # a depth is never in one; the other files of transients need a recipe
_of_scenes = panel("Scenes")


def generate(
    *,
    source: Path | None = argument(
        "A recipe (.yaml, .yml), a built-in scene (room), RGB-D (a file or a folder), or a rendered transient "
        "(.h5, .hdf5).",
        None,
    ),
    size: str | None = _of_scenes(
        "Resample every scene: the longer side, or HEIGHT,WIDTH.", "as it is; room: 128", metavar="SIDE"
    ),
    crop: str | None = _of_scenes("Cut out parts at random places: side, or HEIGHT,WIDTH.", metavar="SIDE"),
    crops: int | None = _of_scenes("Parts per scene.", "1"),
    scene_seeds: int | None = _of_scenes("Built-in scene: that many, of seeds 0, 1, ...", "1"),
    depth_unit_m: float | None = _of_scenes(
        "RGB-D: metres per stored unit of depth.", "0.001 for images, 1 for arrays"
    ),
    focal_px: float | None = _of_scenes(
        "RGB-D: focal length, pixels of the file: turns depth along the axis into range along the ray.",
        "depth as it is",
    ),
    max_depth_m: float | None = _of_scenes("RGB-D: depths beyond this are no return, m.", "none"),
    system: list[Path] | None = of_system(
        "YAML or JSON file (see mars-lidar init), repeated for several; single options replace its values."
    ),
    changes: SystemChanges,
    effects: Effects,
    signal: list[float] | None = of_light("Mean signal photons per laser period, repeated for several levels.", "1"),
    sbr: list[float] | None = of_light(
        "Mean signal / mean ambient photons, repeated for several: each with each signal.", "1"
    ),
    attenuation: str | None = ATTENUATION,
    ambient: str | None = AMBIENT,
    engine: str | None = of_run("As for mars-lidar simulate.", "exact"),
    realizations: int | None = of_run("Exposures of each sample.", "1"),
    seed: int | None = of_run("Seed of the dataset.", "0"),
    threads: int | None = THREADS,
    workers: int | None = of_run("Worker processes on this machine (extra cluster)."),
    scheduler: str | None = of_run("Address of a dask scheduler whose workers see --out (extra cluster)."),
    out: Path = out_option("The dataset, NAME.zarr."),
    layout: str | None = of_output(
        "dense (any Zarr library reads it) or sparse (bins that are not zero, packed: smaller in dim light).", "dense"
    ),
    resume: bool = of_output("Continue what was stopped.", default=False),
    overwrite: bool = of_output("Replace an existing dataset.", default=False),
    begin: bool = of_output("Read the scenes and lay the store out; --part jobs make its counts.", default=False),
    part: str | None = of_output("Make part K of N of a store that --begin began, in any order.", metavar="K/N"),
    finish: bool = of_output("Check that all parts are there, and mark the store complete.", default=False),
    dry_run: bool = of_output("Tell size, time and memory; write nothing.", default=False),
) -> None:
    """Simulate a dataset: scenes x systems x levels of light x realizations, into one Zarr store.

    With a recipe, options replace its values. The store does not depend on threads, workers or interruptions: the
    same recipe gives the same files, byte for byte. Files that cannot be used are left out and told at the end.
    Fog, panes, folders of transients and all else that has no option stand in a recipe.
    """
    with reported():
        from mars_lidar import dataset

        if sum((begin, part is not None, finish, dry_run)) > 1:
            raise ValueError("--begin, --part, --finish and --dry-run are four steps: give one of them")
        if (part or finish) and (workers is not None or scheduler is not None):
            raise ValueError("--part and --finish need no --workers and no --scheduler")
        if (part or finish) and (source is not None or resume or overwrite):
            raise ValueError("--part and --finish go on with the store: no SOURCE, --resume or --overwrite")
        if part is not None:
            numbers = _part(part)
            with progress_bar("generating") as progress:
                tell(dataset.make_part(out, numbers, threads=threads, progress=progress))
            return
        if finish:
            tell(dataset.finish(out))
            return
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
        if dry_run:
            if recipe is None:
                raise ValueError("--dry-run needs a source")
            tell_estimate(dataset.estimate(recipe, out, threads=threads))
            return
        if begin:
            if recipe is None:
                raise ValueError("--begin needs a SOURCE")
            tell(dataset.begin(recipe, out, resume=resume, overwrite=overwrite, workers=workers, scheduler=scheduler))
            return
        here = workers is None and scheduler is None and not (resume and out.exists())
        if here and recipe is not None and (told := str(dataset.quick_advice(recipe, threads))):
            say(told)
        with progress_bar("generating") as progress:
            done = dataset.generate(
                recipe,
                out,
                resume=resume,
                overwrite=overwrite,
                threads=threads,
                workers=workers,
                scheduler=scheduler,
                progress=progress,
            )
        tell(done)


def verify(
    path: Path = argument("A dataset that generate wrote."),
    chunks: int = option("How many, chosen at random.", default=16),
    every: bool = option("All of them.", None, "--all", default=False),
    seed: int = option("Seed of the choice.", default=0),
    threads: int | None = option("Threads.", "all cores"),
) -> None:
    """Simulate random chunks of a dataset again and compare every count; exit code 1 if they differ."""
    with reported():
        from mars_lidar.dataset import verify as verified

        with progress_bar("verifying") as progress:
            told = verified(path, chunks=None if every else chunks, seed=seed, threads=threads, progress=progress)
        if told.good:
            table([("verified", f"{told.chunks} of {told.of} chunks simulated again, every count is the same")])
            return
        table([("verified", f"NO: see below; {told.chunks} of {told.of} chunks simulated again")])
        for line in told.different:
            say(line)
        raise typer.Exit(FAILED)


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
