"""``python -m studies compare``: several engines on one scene, in tables and a picture."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

import typer

from mars_lidar._base import checks
from mars_lidar._base.files import beside
from mars_lidar._base.progress import span
from mars_lidar.cli.console import check_new, check_picture, progress_bar, reported, save_picture, table, two_integers
from mars_lidar.cli.effect_options import Effects
from mars_lidar.cli.groups import examples, flowing_help, grouped
from mars_lidar.cli.options import SEED, THREADS, of_output, of_run
from mars_lidar.cli.options import out as out_option
from mars_lidar.cli.scene_options import LightOptions, SceneOptions
from mars_lidar.cli.scene_view import seen
from mars_lidar.cli.system_options import SystemOptions
from mars_lidar.engines import ENGINES
from studies.compare.comparison import compare as run
from studies.compare.figures import comparison
from studies.compare.tables import as_data, show

_EPILOG = examples(
    "python -m studies compare --scene room --size 64 -o compare.png",
    "python -m studies compare --scene room --engines exact,poisson --signal 0.1 --realizations 40000 -o dim.png",
    "python -m studies compare --depth depth.png --system spad.yaml --against sequential --json all.json -o all.pdf",
    "What deviates by more than 5 standard errors is red and marked with !. Numbers in brackets are the standard error "
    "in the last digits.",
)


def compare(
    *,
    scene: SceneOptions,
    instrument: SystemOptions,
    effects: Effects,
    light: LightOptions,
    engines: str | None = of_run("Engines, separated by commas.", "all there are"),
    against: str = of_run("The reference engine, run in any case.", default="exact"),
    realizations: int = of_run("Exposures of each representative pixel and engine.", default=10_000, min=50),
    pixels: int = of_run(
        "Representative pixels: bright, dim, edge, median, most and least photons, in this order.",
        default=4,
        min=1,
        max=6,
    ),
    pixel: list[str] | None = of_run("A pixel of your own (row, column) instead; up to 6 times.", metavar="Y,X"),
    repeats: int = of_run("Timed cubes of the whole image.", default=5, min=1),
    budget_s: float = of_run(
        "Seconds for an engine's cubes, and again for its pixels; then it draws fewer.", default=4.0
    ),
    seed: int = SEED,
    threads: int | None = THREADS,
    out: Path = out_option("The picture: .png, .pdf or .svg."),
    numbers: Path | None = of_output("All numbers as JSON, into this file.", None, "--json"),
    overwrite: bool = of_output("Replace an existing picture and JSON file.", default=False),
) -> None:
    """Run several engines on one scene: time, count and joint statistics side by side, with a picture.

    Everything is compared with the exact finite-exposure statistics ("predicted"), and where there is no
    prediction with the reference engine. The joint statistics are the variance of the count in the +-3 sigma
    signal window and the covariance of neighbouring bins: what count x shape models get wrong.
    """
    with reported():
        began = time.perf_counter()
        check_picture(out, overwrite)
        check_new(numbers, overwrite)
        asked = [] if engines is None else engines.split(",")
        names = [checks.choice("--engines", name.strip(), tuple(ENGINES)) for name in asked]
        places = {text.replace(" ", ""): two_integers("--pixel", text) for text in pixel or ()}
        system = instrument.build(effects)
        view = seen(scene, light, system)
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


app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(help=flowing_help(compare), epilog=_EPILOG, no_args_is_help=True)(grouped(compare))


def main(arguments: Sequence[str], command: str) -> int:
    """Run the command `command` with its arguments; returns the exit code."""
    try:
        app(list(arguments), prog_name=command)
    except SystemExit as end:
        return int(end.code or 0)
    return 0
