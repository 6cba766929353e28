"""A comparison as tables for a terminal of 100 columns, as plain data, and as a picture."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar.cli.console import grid, screen
from mars_lidar.instrument.system import System
from mars_lidar.plot.figures import _draw_map
from mars_lidar.plot.style import COLOURS, DPI, INK, MUTED, style
from mars_lidar.plot.views import instrument
from studies.compare.sample import SIGNIFICANT, Distance, Estimate, Moments

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import Console
    from rich.text import Text

    from studies.compare.comparison import Comparison

_MARK = "!"
_SMALL = 4  # numbers in an array that is written as such


def show(result: Comparison) -> None:
    """Print all tables on standard output; what is significantly wrong is red and marked."""
    console = screen()
    _scene_table(console, result)
    for pixel in result.pixels:
        _pixel_table(console, result, pixel)
    for line in (
        "",
        f"{_MARK} deviates by more than {SIGNIFICANT:g} standard errors from what is predicted, or else from "
        f"{result.against}.",
        "In brackets: standard error in the last digits. Window: +-3 sigma around the return.",
        "lag-1: covariance of neighbouring bins over the mean count, in 1/1000.",
        "TV: total variation of the mean histogram's shape and of the law of the count, in 1/1000;",
        "in brackets what chance makes of it.",
    ):
        console.print(line, style="dim")


def as_data(result: Any) -> Any:
    """A comparison as JSON can hold it, its attributes by their names.

    NaN is None, infinity 1e308; maps, laws and histograms are left out.
    """
    if isinstance(result, System):
        return result.to_dict()
    if isinstance(result, float):
        return result if math.isfinite(result) else None if math.isnan(result) else math.copysign(1e308, result)
    if isinstance(result, np.ndarray | np.generic):
        return as_data(result.tolist())
    if dataclasses.is_dataclass(result):
        result = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    if isinstance(result, dict):
        small = {
            name: item for name, item in result.items() if not (isinstance(item, np.ndarray) and item.size > _SMALL)
        }
        return {name: as_data(item) for name, item in small.items()}
    return [as_data(item) for item in result] if isinstance(result, tuple | list) else result


def _scene_table(console: Console, result: Comparison) -> None:
    known = int(result.expected.known.sum())
    height, width = result.flux.shape
    goal = f"against the exact mean of {known:,} pixels" if known > 1 else f"against {result.against}"
    view = grid(
        f"Whole image, {width} × {height} pixels, {result.threads} threads; bias {goal}",
        (
            "engine",
            "ms",
            "cubes",
            "ns/count",
            "registrations",
            "bias/sd",
            "bias %",
            "dispersion",
        ),
    )
    for name, s in result.scenes.items():
        percent = Estimate(100 * s.relative_bias.value, 100 * s.relative_bias.error, s.relative_bias.z)
        view.add_row(
            name,
            _number(1e3 * s.median_s),
            str(len(s.seconds)),
            _number(s.ns_per_registration),
            f"{s.registrations:,.0f}",
            cell(s.bias),
            cell(percent),
            cell(s.dispersion),
        )
    console.print()
    console.print(view)
    for name, why in result.skipped.items():
        console.print(f"{name} was not run: {why}")


def _pixel_table(console: Console, result: Comparison, pixel: str) -> None:
    y, x = result.pixels[pixel]
    statistics, law = result.statistics[pixel], result.laws[pixel]
    drawn = {name: s.realizations for name, s in statistics.items()}
    most = max(drawn.values())
    fewer = "".join(f", {name} {n:,}" for name, n in drawn.items() if n < most)
    view = grid(
        f"{pixel} pixel (y {y}, x {x}): S = {result.flux.signal[y, x]:.3g}, "
        f"B = {result.flux.background[y, x]:.3g}; {most:,} exposures{fewer}",
        ("engine", "mean", "variance", "Fano", "window var", f"/ {result.against}", "lag-1", "TV shape", "TV count"),
    )
    if law is not None:
        known: Moments = law.counts
        exact = [f"{e.value:.6g}" for e in (known.mean, known.variance)] + [_number(known.fano.value)]
        window = "" if law.window is None else _number(float(law.window[1]))
        lag = "" if math.isnan(law.lag1) else f"{1e3 * law.lag1:.3g}"
        view.add_row("predicted", *(f"{words} " for words in (*exact, window, "", lag)), "", "", style="bold")
    for name, s in statistics.items():
        relative = cell(s.window_ratio)
        if name == result.against and math.isfinite(s.window_ratio.value):
            relative = cell(Estimate(1.0))
        lag1 = Estimate(1e3 * s.lag1.value, 1e3 * s.lag1.error, s.lag1_error.z)
        view.add_row(
            name,
            cell(s.counts.mean),
            cell(s.counts.variance),
            cell(s.counts.fano),
            cell(s.window.variance),
            relative,
            cell(lag1),
            cell(s.shape),
            cell(s.law),
        )
    console.print()
    console.print(view)
    if pixel in result.unpredicted:
        console.print(f"{pixel} pixel has no prediction: {result.unpredicted[pixel]}")


def cell(result: Estimate | Distance) -> Text:
    """A value with its error, or a distance (in 1/1000) with its floor; red with a mark where it is wrong."""
    from rich.text import Text

    if isinstance(result, Distance):
        words = "–" if math.isnan(result.value) else f"{_short(1e3 * result.value)} ({_short(1e3 * result.floor)})"
    else:
        words = with_error(result.value, result.error)
    return Text(words + _MARK, style="bold red") if result.wrong else Text(words + " ")


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


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"


def _number(value: float) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:,.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"


_SCORES = 4.0  # limit of the maps of deviations, in standard errors
_PANELS = {  # attributes of `PixelStatistics`
    "window_ratio": "Variance of the signal window / {against}",
    "lag1": "Covariance of neighbouring bins / mean count",
    "shape": "Shape of the mean histogram: TV (- by chance)",
}


def comparison(result: Comparison) -> Figure:
    """Maps and joint statistics of a `compare` run; dashes are predictions, bars two standard errors."""
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(13.0, 6.0), dpi=DPI, layout="constrained")
        halves: Any = figure.subfigures(2, 1)
        upper, lower = halves
        _draw_maps(list(upper.subplots(1, 1 + len(result.engines), squeeze=False).flat), result)
        for ax, (quantity, title) in zip(lower.subplots(1, len(_PANELS)), _PANELS.items(), strict=True):
            _draw_points(ax, result, quantity)
            ax.set_title(title.format(against=result.against), loc="left")
        lower.axes[0].legend(loc="best", fontsize=6.0)
        height, width = result.flux.shape
        figure.suptitle(f"{height} x {width} pixels, {instrument(result.system)}", x=0.01, ha="left", fontsize=9.0)
    return figure


def _draw_maps(axes: list[Axes], result: Comparison) -> None:
    """The expected count with the pixels, then each engine's deviation from it in standard errors of its mean."""
    expected = result.expected
    known, reference = bool(expected.known.any()), result.scenes[result.against].mean_counts
    words = "Expected count" if known else result.against
    _draw_map(axes[0], expected.mean if known else reference, "registrations", "magma", None, words)
    for name, (y, x) in result.pixels.items():
        scale = expected.step if known else 1
        axes[0].plot(x / scale, y / scale, "o", ms=5, mfc="none", mec="white", mew=1.0)
        axes[0].annotate(name, (x / scale, y / scale), (5, 0), textcoords="offset points", color="white", fontsize=6.5)
    for ax, (engine, scene) in zip(axes[1:], result.scenes.items(), strict=True):
        if known:
            error = np.sqrt(np.where(expected.variance > 0, expected.variance, np.nan) / len(scene.seconds))
            values, label = (expected.on_grid(scene.mean_counts) - expected.mean) / error, "standard errors"
        else:
            values, label = scene.mean_counts - reference, f"count minus {result.against}"
        most = float(np.nanpercentile(np.abs(values), 99)) if np.isfinite(values).any() else 0.0
        if known and most <= 2.0 * _SCORES:  # an engine that is off everywhere has a scale of its own
            most = _SCORES
        _draw_map(ax, values, label, "RdBu_r", (-(most or 1.0), most or 1.0))
        ax.set_title(engine, loc="left")


def _draw_points(ax: Axes, result: Comparison, quantity: str) -> None:
    """A point for each engine at each pixel, with the prediction."""
    pixels, engines = list(result.pixels), result.engines
    for k, engine in enumerate(engines):
        at = np.arange(len(pixels)) + 0.8 * ((k + 0.5) / len(engines) - 0.5)
        values = [getattr(result.statistics[pixel][engine], quantity) for pixel in pixels]
        error = [2.0 * getattr(value, "error", 0.0) for value in values]
        colour = COLOURS[k % len(COLOURS)]
        ax.errorbar(at, [value.value for value in values], error, fmt="o", ms=3.5, lw=1.0, color=colour, label=engine)
        if quantity == "shape":
            ax.plot(at, [value.floor for value in values], "_", ms=8, color=INK)
    if quantity != "shape":
        for k, pixel in enumerate(pixels):
            ax.plot([k - 0.45, k + 0.45], [_predicted(result, pixel, quantity)] * 2, "--", color=MUTED, lw=0.9)
    elif any(line > 0 for line in ax.dataLim.intervaly):
        ax.set_yscale("log")
    ax.set_xticks(range(len(pixels)), pixels)


def _predicted(result: Comparison, pixel: str, quantity: str) -> float:
    law, drawn = result.laws[pixel], result.statistics[pixel][result.against].window.variance.value
    if law is None or quantity == "lag1":
        return math.nan if law is None else law.lag1
    return math.nan if law.window is None or not drawn > 0 else float(law.window[1]) / drawn
