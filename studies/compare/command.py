"""``python -m studies compare``: several engines on one scene, in tables and a picture."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from mars_lidar._base import checks
from mars_lidar._base.files import beside
from mars_lidar._base.progress import span
from mars_lidar.cli.console import check_new, check_picture, progress_bar, save_picture, table
from mars_lidar.cli.console import run as execute
from mars_lidar.cli.options import (
    Integer,
    LightOptions,
    Number,
    OutPath,
    SceneOptions,
    Text,
    read_scene,
    two,
)
from mars_lidar.cli.options import command as as_command
from mars_lidar.cli.system_options import Effects, SystemOptions
from mars_lidar.engines import ENGINES
from studies.compare.comparison import compare as run
from studies.compare.report import as_data, comparison, show


def compare(
    *,
    scene: SceneOptions = SceneOptions(),
    instrument: SystemOptions = SystemOptions(),
    effects: Effects = Effects(),
    light: LightOptions = LightOptions(),
    engines: Text | None = None,
    against: Text = "exact",
    realizations: Integer = 10_000,
    pixels: Integer = 4,
    pixel: list[Text] | None = None,
    repeats: Integer = 5,
    budget_s: Number = 4.0,
    seed: Integer = 0,
    threads: Integer | None = None,
    out: OutPath,
    numbers: Annotated[Path | None, Parameter("--json")] = None,
    overwrite: bool = False,
) -> None:
    """Run several engines on one scene: time, count and joint statistics side by side, with a picture.

    Everything is compared with the exact finite-exposure statistics ("predicted"), and where there is no
    prediction with the reference engine. The joint statistics are the variance of the count in the +-3 sigma
    signal window and the covariance of neighbouring bins: what count x shape models get wrong.

    Simulation
    ----------
    engines
        Engines, separated by commas. [default: all there are]
    against
        The reference engine, run in any case. [default: exact]
    realizations
        Exposures of each representative pixel and engine. [default: 10000]
    pixels
        Representative pixels: bright, dim, edge, median, most and least photons, in this order. [default: 4]
    pixel : Y,X
        A pixel of your own (row, column) instead; up to 6 times.
    repeats
        Timed cubes of the whole image. [default: 5]
    budget_s
        Seconds for an engine's cubes, and again for its pixels; then it draws fewer. [default: 4.0]
    seed
        Seed: the same command gives the same counts. [default: 0]
    threads
        Threads; the counts do not depend on it. [default: all cores]

    Output
    ------
    out
        The picture: .png, .pdf or .svg.
    numbers
        All numbers as JSON, into this file.
    overwrite
        Replace an existing picture and JSON file.

    Examples
    --------
    python -m studies compare --scene room --size 64 -o compare.png
    python -m studies compare --scene room --engines exact,poisson --signal 0.1 --realizations 40000 -o dim.png
    python -m studies compare --depth depth.png --system spad.yaml --against sequential --json all.json -o all.pdf

    Notes
    -----
    Values that deviate by more than 5 standard errors are red and marked with !. Numbers in brackets are the standard
    error in the last digits.
    """
    began = time.perf_counter()
    check_picture(out, overwrite)
    check_new(numbers, overwrite)
    asked = [] if engines is None else engines.split(",")
    names = [checks.choice("--engines", name.strip(), tuple(ENGINES)) for name in asked]
    places = {text.replace(" ", ""): two("--pixel", text) for text in pixel or ()}
    system = instrument.build(effects)
    view = read_scene(scene, light, system)
    with progress_bar("comparing") as progress:
        result = run(
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
    save_picture(comparison(result), out)
    if numbers is not None:
        with beside(numbers) as unfinished:
            entries = {"scene": view.source, **as_data(result)}
            unfinished.write_text(json.dumps(entries, indent=1, allow_nan=False) + "\n")
    show(result)
    rows = [("table", result.table)] if result.table else []
    rows += [("picture", str(out)), ("time", f"{span(time.perf_counter() - began)} in all")]
    table(rows if numbers is None else [*rows, ("numbers", str(numbers))])


def compare_app(command: str = "python -m studies compare") -> App:
    """The command line of the study, called `command`."""
    return as_command(compare, command)


def main(arguments: Sequence[str], command: str = "python -m studies compare") -> int:
    """Run the command `command` with its arguments; returns the exit code."""
    return execute(compare_app(command), arguments)
