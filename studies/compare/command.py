"""``python -m studies compare``: several engines on one scene, in tables."""

from __future__ import annotations

import time
from collections.abc import Sequence

from cyclopts import App

from mars_lidar._base import checks
from mars_lidar._base.progress import span
from mars_lidar.cli.console import progress_bar, table
from mars_lidar.cli.console import run as execute
from mars_lidar.cli.options import (
    Integer,
    LightOptions,
    SceneOptions,
    Text,
    read_scene,
    two,
)
from mars_lidar.cli.options import command as as_command
from mars_lidar.cli.system_options import Effects, SystemOptions
from mars_lidar.engines import ENGINES
from studies.compare.comparison import compare as run
from studies.compare.report import show


def compare(
    *,
    scene: SceneOptions = SceneOptions(),
    instrument: SystemOptions = SystemOptions(),
    effects: Effects = Effects(),
    light: LightOptions = LightOptions(),
    engines: Text | None = None,
    against: Text = "exact",
    realizations: Integer = 10_000,
    pixel: list[Text] | None = None,
    repeats: Integer = 5,
    seed: Integer = 0,
    threads: Integer | None = None,
) -> None:
    """Run several engines on one scene: time, count and joint statistics side by side.

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
    pixel : Y,X
        Representative pixels (row, column), repeatable. [default: a bright, a dim and an edge pixel]
    repeats
        Timed cubes of the whole image. [default: 5]
    seed
        Seed: the same command gives the same counts. [default: 0]
    threads
        Threads; the counts do not depend on it. [default: all cores]

    Examples
    --------
    python -m studies compare --scene room --size 64
    python -m studies compare --scene room --engines exact,poisson --signal 0.1 --realizations 40000
    python -m studies compare --depth depth.png --system spad.yaml --against sequential

    Notes
    -----
    Values that deviate by more than 5 standard errors are red and marked with !. Numbers in brackets are the standard
    error in the last digits.
    """
    began = time.perf_counter()
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
            pixels=places or None,
            depth_m=view.depth_m,
            seed=seed,
            threads=threads,
            progress=progress,
        )
    show(result)
    rows = [("table", result.table)] if result.table else []
    table([*rows, ("time", f"{span(time.perf_counter() - began)} in all")])


def compare_app(command: str = "python -m studies compare") -> App:
    """The command line of the study, called `command`."""
    return as_command(compare, command)


def main(arguments: Sequence[str], command: str = "python -m studies compare") -> int:
    """Run the command `command` with its arguments; returns the exit code."""
    return execute(compare_app(command), arguments)
