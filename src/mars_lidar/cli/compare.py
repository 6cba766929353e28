"""`mars-lidar compare`: several engines on one scene, in tables and a picture."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mars_lidar._base.progress import span
from mars_lidar.cli import options
from mars_lidar.cli.console import progress_bar, reported, save_picture, table
from mars_lidar.cli.effect_options import Effects
from mars_lidar.cli.info import parsed_pixel
from mars_lidar.cli.options import _OUTPUT, _RUN, _option
from mars_lidar.cli.scene_options import LightOptions, SceneOptions
from mars_lidar.cli.scene_view import seen
from mars_lidar.cli.system_options import SystemOptions

if TYPE_CHECKING:
    from mars_lidar.compare.comparison import Comparison

COMPARE_EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar compare --scene room --size 64 -o compare.png",
        "mars-lidar compare --scene room --engines exact,poisson --signal 0.1 --realizations 40000 -o dim.png",
        "mars-lidar compare --depth depth.png --system spad.yaml --against sequential --json numbers.json -o all.pdf",
        "What deviates by more than 5 standard errors is red and marked with !. Numbers in brackets are the "
        "standard error in the last digits.",
    )
)

Out = Annotated[Path, _option("-o", "--out", panel=_OUTPUT, help="The picture: .png, .pdf or .svg.")]
Json = Annotated[Path | None, _option("--json", panel=_OUTPUT, help="All numbers as JSON, into this file.")]
Overwrite = Annotated[bool, _option("--overwrite", panel=_OUTPUT, help="Replace an existing picture and JSON file.")]
Engines = Annotated[
    str | None,
    _option("--engines", panel=_RUN, help="Engines, separated by commas.", default="all there are"),
]
Against = Annotated[
    str, _option("--against", panel=_RUN, help="The reference engine, run in any case.", default="exact")
]
Realizations = Annotated[
    int,
    _option(
        "--realizations",
        panel=_RUN,
        min=50,
        default="10000",
        help="Exposures of each representative pixel and engine.",
    ),
]
Pixels = Annotated[
    int,
    _option(
        "--pixels",
        panel=_RUN,
        min=1,
        max=6,
        default="4",
        help="Representative pixels: bright, dim, edge, median, most and least photons, in this order.",
    ),
]
Pixel = Annotated[
    list[str] | None,
    _option(
        "--pixel",
        panel=_RUN,
        metavar="Y,X",
        help="A pixel of your own (row, column) instead; up to 6 times.",
    ),
]
Repeats = Annotated[int, _option("--repeats", panel=_RUN, min=1, help="Timed cubes of the whole image.", default="5")]
BudgetS = Annotated[
    float,
    _option(
        "--budget-s",
        panel=_RUN,
        default="4",
        help="Seconds for an engine's cubes, and again for its pixels; then it draws fewer.",
    ),
]


def compare(
    *,
    scene: SceneOptions,
    instrument: SystemOptions,
    effects: Effects,
    light: LightOptions,
    engines: Engines = None,
    against: Against = "exact",
    realizations: Realizations = 10_000,
    pixels: Pixels = 4,
    pixel: Pixel = None,
    repeats: Repeats = 5,
    budget_s: BudgetS = 4.0,
    seed: options.Seed = 0,
    threads: options.Threads = None,
    out: Out,
    numbers: Json = None,
    overwrite: Overwrite = False,
) -> None:
    """Run several engines on one scene: time, count and joint statistics side by side, with a picture.

    Everything is compared with the exact finite-exposure statistics ("predicted"), and where there is no
    prediction with the reference engine. The joint statistics are the variance of the count in the +-3 sigma
    signal window and the covariance of neighbouring bins: what count x shape models get wrong.
    """
    with reported():
        began = time.perf_counter()
        if out.suffix not in (".png", ".pdf", ".svg"):
            raise ValueError(f"--out must end in .png, .pdf or .svg, got {str(out)!r}")
        for file in (out, numbers):
            if file is not None and file.exists() and not overwrite:
                raise FileExistsError(f"{file} exists already; give --overwrite or another name")
            if file is not None and not file.parent.is_dir():
                raise FileNotFoundError(f"{file} cannot be written: there is no folder {file.parent}")
        names = _names(engines)
        places = {text.replace(" ", ""): parsed_pixel(text) for text in pixel or ()}
        system = instrument.build(effects)
        view = seen(scene, light, system)
        from mars_lidar.cli.compare_tables import as_data, show
        from mars_lidar.compare.comparison import compare as run

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
        _draw(found, out)
        if numbers is not None:
            _write(numbers, json.dumps({"scene": view.source, **as_data(found)}, indent=1, allow_nan=False) + "\n")
        show(found)
        rows = [("table", found.table)] if found.table else []
        rows += [("picture", str(out)), ("time", f"{span(time.perf_counter() - began)} in all")]
        table(rows if numbers is None else [*rows, ("numbers", str(numbers))])


def _names(engines: str | None) -> list[str]:
    from mars_lidar._base import checks
    from mars_lidar.engines import ENGINES

    if engines is None:
        return []
    return [checks.choice("--engines", name.strip(), tuple(ENGINES)) for name in engines.split(",")]


def _draw(found: Comparison, out: Path) -> None:
    from mars_lidar.plot.compare import comparison

    save_picture(comparison(found), out)


def _write(file: Path, text: str) -> None:
    from mars_lidar._base.files import TemporarySibling

    with TemporarySibling(file).writing() as unfinished:
        unfinished.write_text(text)
