"""``python -m studies compare``: several engines on one scene, in tables."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from cyclopts import App
from rich.console import Console
from rich.text import Text as Coloured

from mars_lidar._base import checks
from mars_lidar._base.progress import span
from mars_lidar.cli.console import grid, progress_bar, screen, table
from mars_lidar.cli.console import run as execute
from mars_lidar.cli.options import Integer, LightOptions, SceneOptions, Text, read_scene, two
from mars_lidar.cli.options import command as as_command
from mars_lidar.cli.system_options import Effects, SystemOptions
from mars_lidar.engines import ENGINES
from mars_lidar.plot.views import instrument as in_words
from studies.compare.comparison import SIGNIFICANT, Comparison, Estimate
from studies.compare.comparison import compare as run


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


_MARK = "!"


def show(result: Comparison) -> None:
    """Print all tables on standard output; what is significantly wrong is red and marked."""
    console = screen()
    console.print(in_words(result.system))
    _scene_table(console, result)
    for pixel in result.pixels:
        _pixel_table(console, result, pixel)
    for line in (
        "",
        f"{_MARK} deviates by more than {SIGNIFICANT:g} standard errors from what is predicted, or else from "
        f"{result.against}.",
        "In brackets: standard error in the last digits. Window: +-3 sigma around the return.",
        "lag-1: covariance of neighbouring bins over the mean count, in 1/1000.",
    ):
        console.print(line, style="dim")


def _scene_table(console: Console, result: Comparison) -> None:
    height, width = result.flux.shape
    goal = f"the exact mean of {result.expected.mean.size:,} pixels" if result.expected else result.against
    columns = ("engine", "ms", "cubes", "ns/count", "registrations", "bias %", "dispersion")
    view = grid(f"Whole image, {width} × {height} pixels; bias against {goal}", columns)
    for name, s in result.scenes.items():
        percent = Estimate(100 * s.relative_bias.value, 100 * s.relative_bias.error, s.relative_bias.z)
        each = 1e9 * s.median_s / s.registrations if s.registrations else math.nan
        numbers = _number(1e3 * s.median_s), str(len(s.seconds)), _number(each), f"{s.registrations:,.0f}"
        view.add_row(name, *numbers, cell(percent), cell(s.dispersion))
    console.print()
    console.print(view)
    for name, why in result.skipped.items():
        console.print(f"{name} was not run: {why}")


def _pixel_table(console: Console, result: Comparison, pixel: str) -> None:
    y, x = result.pixels[pixel]
    light = f"S = {result.flux.signal[y, x]:.3g}, B = {result.flux.background[y, x]:.3g}"
    view = grid(
        f"{pixel} pixel (y {y}, x {x}): {light}; {result.realizations:,} exposures",
        ("engine", "mean", "variance", "window mean", "window var", f"/ {result.against}", "lag-1"),
    )
    law = result.laws.get(pixel)
    if law is not None:
        window = (math.nan, math.nan) if law.window is None else law.window[:2]
        exact = [f"{value:.6g} " for value in (*law.cumulants[:2], *window)]
        view.add_row("predicted", *exact, "", f"{1e3 * law.lag1:.3g} ", style="bold")
    for name, s in result.statistics[pixel].items():
        values = dict(s.scored)
        values["lag1"] = Estimate(1e3 * s.lag1.value, 1e3 * s.lag1.error, s.lag1.z)
        view.add_row(name, *map(cell, values.values()))
    console.print()
    console.print(view)
    if pixel in result.unpredicted:
        console.print(f"{pixel} pixel has no prediction: {result.unpredicted[pixel]}")


def cell(result: Estimate) -> Coloured:
    """A value with its error; red with a mark where it is wrong."""
    words = with_error(result.value, result.error)
    return Coloured(words + _MARK, style="bold red") if result.wrong else Coloured(words + " ")


def with_error(value: float, error: float) -> str:
    """The value with its standard error in brackets, in units of the last digit: 858.44(12), 858.4(3).

    One digit of the error, two where it begins with 1, so that rounding changes it by no more than a third.
    """
    if math.isnan(value):
        return "–"
    if not (math.isfinite(error) and error > 0.0) or abs(value) >= 1e7:
        return _number(value)
    lead = math.floor(math.log10(error))
    digits = (1 if error < 1.95 * 10.0**lead else 0) - lead
    if digits > 8:
        return f"{value:.3g}"
    if digits <= 0:
        return f"{value:.0f}({error:.0f})"
    return f"{value:.{digits}f}({round(error * 10**digits)})"


def _number(value: float) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"
