"""``python -m studies compare``: several engines on one scene, in tables and a picture."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App

from mars_lidar._base import checks
from mars_lidar._base.files import beside
from mars_lidar._base.progress import span
from mars_lidar.cli.console import check_new, check_picture, progress_bar, save_picture, table
from mars_lidar.cli.console import run as execute
from mars_lidar.cli.options import (
    COMMAND_LINE,
    Integer,
    LightOptions,
    Number,
    SceneOptions,
    Seed,
    Text,
    Threads,
    examples,
    out_option,
    output_option,
    read_scene,
    run_option,
    two_integers,
)
from mars_lidar.cli.system_options import Effects, SystemOptions
from mars_lidar.engines import ENGINES
from studies.compare.comparison import compare as run
from studies.compare.figures import comparison
from studies.compare.tables import as_data, show

_EXAMPLES = examples(
    "python -m studies compare --scene room --size 64 -o compare.png",
    "python -m studies compare --scene room --engines exact,poisson --signal 0.1 --realizations 40000 -o dim.png",
    "python -m studies compare --depth depth.png --system spad.yaml --against sequential --json all.json -o all.pdf",
    notes="Values that deviate by more than 5 standard errors are red and marked with !. Numbers in brackets are the "
    "standard error in the last digits.",
)


def compare(
    *,
    scene: SceneOptions = SceneOptions(),
    instrument: SystemOptions = SystemOptions(),
    effects: Effects = Effects(),
    light: LightOptions = LightOptions(),
    engines: Annotated[Text | None, run_option("Engines, separated by commas.", "all there are")] = None,
    against: Annotated[Text, run_option("The reference engine, run in any case.", "exact")] = "exact",
    realizations: Annotated[
        Integer, run_option("Exposures of each representative pixel and engine.", "10000")
    ] = 10_000,
    pixels: Annotated[
        Integer,
        run_option("Representative pixels: bright, dim, edge, median, most and least photons, in this order.", "4"),
    ] = 4,
    pixel: Annotated[
        list[Text] | None, run_option("A pixel of your own (row, column) instead; up to 6 times.", metavar="Y,X")
    ] = None,
    repeats: Annotated[Integer, run_option("Timed cubes of the whole image.", "5")] = 5,
    budget_s: Annotated[
        Number, run_option("Seconds for an engine's cubes, and again for its pixels; then it draws fewer.", "4.0")
    ] = 4.0,
    seed: Seed = 0,
    threads: Threads = None,
    out: Annotated[Path, out_option("The picture: .png, .pdf or .svg.")],
    numbers: Annotated[Path | None, output_option("All numbers as JSON, into this file.", "", "--json")] = None,
    overwrite: Annotated[bool, output_option("Replace an existing picture and JSON file.")] = False,
) -> None:
    """Run several engines on one scene: time, count and joint statistics side by side, with a picture.

    Everything is compared with the exact finite-exposure statistics ("predicted"), and where there is no
    prediction with the reference engine. The joint statistics are the variance of the count in the +-3 sigma
    signal window and the covariance of neighbouring bins: what count x shape models get wrong.
    """
    began = time.perf_counter()
    check_picture(out, overwrite)
    check_new(numbers, overwrite)
    asked = [] if engines is None else engines.split(",")
    names = [checks.choice("--engines", name.strip(), tuple(ENGINES)) for name in asked]
    places = {text.replace(" ", ""): two_integers("--pixel", text) for text in pixel or ()}
    system = instrument.build(effects)
    view = read_scene(scene, light, system)
    with progress_bar("comparing") as progress:
        found = run(
            view.flux,
            system,
            names,
            against=against,
            realizations=realizations,
            repeats=repeats,
            pixels=places or pixels,
            depth_m=view.depth_m,
            seed=seed,
            threads=threads,
            budget_s=budget_s,
            progress=progress,
        )
    save_picture(comparison(found), out)
    if numbers is not None:
        with beside(numbers) as unfinished:
            told = {"scene": view.source, **as_data(found)}
            unfinished.write_text(json.dumps(told, indent=1, allow_nan=False) + "\n")
    show(found)
    rows = [("table", found.table)] if found.table else []
    rows += [("picture", str(out)), ("time", f"{span(time.perf_counter() - began)} in all")]
    table(rows if numbers is None else [*rows, ("numbers", str(numbers))])


def compare_app(command: str = "python -m studies compare") -> App:
    """The command line of the study, called `command`."""
    return App(name=command, default_command=compare, help_epilogue=_EXAMPLES, **COMMAND_LINE)


def main(arguments: Sequence[str], command: str = "python -m studies compare") -> int:
    """Run the command `command` with its arguments; returns the exit code."""
    return execute(compare_app(command), arguments)
