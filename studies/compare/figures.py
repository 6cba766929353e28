"""Picture of a comparison of engines: where they deviate over the image, and what they draw at a few pixels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar.plot.figures import _draw_map
from mars_lidar.plot.pixel import _steps, _zoom_ns, quiet_corner
from mars_lidar.plot.style import DPI, INK, style
from mars_lidar.plot.views import instrument
from studies.compare.panels import draw_points, draw_times, engine_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from studies.compare.comparison import Comparison

_WIDTH = 13.0  # inches
_ACROSS = 5  # maps in a row
_HISTOGRAM, _LAWS, _POINTS = 2.2, 1.75, 2.0  # heights of the rows of panels, inches
_GAP, _TOP = 0.62, 0.5
_SCORES = 4.0  # limit of the maps of deviations, in standard errors


def comparison(result: Comparison) -> Figure:
    """Maps, mean histograms, count laws, joint statistics and times of a `compare` run.

    Predictions are black, dashed and on top; each engine has its colour throughout. Values off the scale of a panel
    are written at its edge.
    """
    with style():
        from matplotlib.figure import Figure

        maps = 1 + len(result.engines)
        rows = math.ceil(maps / _ACROSS)
        across = max(math.ceil(maps / rows), 4)
        wide = (_WIDTH - 0.2) / across
        tall = min((wide - 0.85) * result.flux.shape[0] / result.flux.shape[1], 3.0)
        heights = [rows * tall + (rows - 1) * 0.25, _HISTOGRAM, _LAWS, _POINTS]
        height = _TOP + sum(heights) + _GAP * (len(heights) - 1) + 0.3
        figure = Figure(figsize=(_WIDTH, height), dpi=DPI)
        colours = engine_colours(result.engines)
        boxes = []
        top = height - _TOP
        for h in heights:
            boxes.append((top / height, (top - h) / height))
            top -= h + _GAP
        grid = figure.add_gridspec(
            rows,
            across,
            left=0.008,
            right=1.0 - 0.82 / _WIDTH,
            top=boxes[0][0],
            bottom=boxes[0][1],
            wspace=0.85 / (wide - 0.85),
            hspace=0.25 / tall,
        )
        _draw_maps(list(grid.subplots(squeeze=False).flat), result, colours)
        _draw_histograms(figure, boxes[1], result, colours)
        _draw_laws(figure, boxes[2], result, colours)
        _draw_joint(figure, boxes[3], result, colours)
        figure.text(0.008, 1.0 - 0.18 / height, _headline(result), fontsize=9.0, va="center")
    return figure


def _draw_maps(axes: list[Axes], result: Comparison, colours: dict[str, str]) -> None:
    """The expected count with the pixels, then each engine's deviation from it in standard errors of its mean."""
    from matplotlib.patheffects import withStroke

    expected = result.expected
    if expected.known.any():
        _draw_map(axes[0], expected.mean, "registrations", "magma", None, "Expected count")
    else:
        _draw_map(axes[0], result.scenes[result.against].mean_counts, "registrations", "magma", None, result.against)
    shadow = [withStroke(linewidth=1.6, foreground=INK)]
    scale = expected.step if expected.known.any() else 1
    for name, (y, x) in result.pixels.items():
        at, leftwards = (x / scale, y / scale), x > 0.7 * result.flux.shape[1]
        axes[0].plot(*at, "o", ms=5, mfc="none", mec=INK, mew=2.0)
        axes[0].plot(*at, "o", ms=5, mfc="none", mec="white", mew=1.0)
        axes[0].annotate(
            name,
            at,
            (-5 if leftwards else 5, 0),
            textcoords="offset points",
            color="white",
            fontsize=6.5,
            ha="right" if leftwards else "left",
            va="center",
            path_effects=shadow,
        )
    for ax, (engine, scene) in zip(axes[1:], result.scenes.items(), strict=False):
        if expected.known.any():
            error = np.sqrt(np.where(expected.variance > 0, expected.variance, np.nan) / len(scene.seconds))
            values = (expected.on_grid(scene.mean_counts) - expected.mean) / error
            most = float(np.nanpercentile(np.abs(values), 99)) if np.isfinite(values).any() else 0.0
            most = most if most > 2.0 * _SCORES else _SCORES  # an engine that is off everywhere has a scale of its own
            label, limit = "standard errors", (-most, most)
        else:
            values = scene.mean_counts - result.scenes[result.against].mean_counts
            most = float(np.abs(values).max()) or 1.0
            label, limit = f"count minus {result.against}", (-most, most)
        _draw_map(ax, values, label, "RdBu_r", limit)
        bias = 100 * scene.relative_bias.value
        text = f", bias {bias:+.{0 if abs(bias) >= 10 else 3}f} %" if math.isfinite(bias) else ""
        ax.set_title(engine + text, loc="left", color=colours[engine])
    for ax in axes[1 + len(result.scenes) :]:
        ax.set_visible(False)


def _draw_histograms(figure: Figure, box: tuple[float, float], result: Comparison, colours: dict[str, str]) -> None:
    """Mean histogram of the first pixel: the whole period, and the signal close up."""
    grid = figure.add_gridspec(
        1, 2, left=0.056, right=0.99, top=box[0], bottom=box[1], wspace=0.1, width_ratios=(2.2, 1.0)
    )
    whole, zoom = grid.subplots(squeeze=False)[0]
    name, (y, x) = next(iter(result.pixels.items()))
    system, flux = result.system, result.flux
    edges = np.linspace(0.0, system.period_ns, system.bins + 1)
    lines = {e: result.statistics[name][e].mean_histogram for e in _first(result.engines, result.against)}
    law = result.laws[name]
    highest = max(float(h.max()) for h in lines.values()) or 1.0
    positive = np.concatenate([h[h > 0] for h in lines.values()] or [np.ones(1)])
    lowest = float(np.quantile(positive, 0.002)) if positive.size else highest
    centre = float(flux.delay_ns[y, x] % system.period_ns)
    if not np.isfinite(centre):
        centre = float(system.time_ns[next(iter(lines.values())).argmax()])
    low, high = _zoom_ns(system)
    first, last = (math.floor((centre + t) / system.bin_ns) for t in (low, high))
    near = np.arange(first, max(last, first) + 1)
    near_edges = np.append(near, near[-1] + 1) * system.bin_ns - centre
    for engine, histogram in lines.items():
        own = {**_line(colours[engine], engine == result.against), "label": engine}
        whole.plot(*_steps(edges, histogram), **own)
        zoom.plot(*_steps(near_edges, histogram[near % system.bins]), **own)
    if law is not None:
        own = {"color": INK, "lw": 0.8, "ls": (0, (4, 1.5)), "label": "predicted"}
        whole.plot(*_steps(edges, law.histogram), **own)
        zoom.plot(*_steps(near_edges, law.histogram[near % system.bins]), **own)
    if highest > 20 * lowest:
        whole.set_yscale("log")
        whole.set_ylim(0.5 * lowest, 2.0 * highest)
        whole.yaxis.set_major_formatter("{x:g}")
        whole.yaxis.set_minor_formatter("")
    whole.set_xlim(0.0, system.period_ns)
    zoom.set_xlim(near_edges[0], near_edges[-1])
    zoom.set_ylim(0.0, None)
    whole.set_title(
        f"Mean histogram, {name} pixel (y {y}, x {x}): S = {flux.signal[y, x]:.3g}, B = {flux.background[y, x]:.3g}",
        loc="left",
    )
    whole.set_ylabel("counts per bin")
    whole.set_xlabel("time in the laser period (ns)")
    zoom.set_title("Its signal", loc="left")
    zoom.set_xlabel("around the return (ns)")
    rate = next(iter(lines.values()))
    whole.legend(loc=quiet_corner(rate), frameon=False, ncols=2, handlelength=1.6, columnspacing=1.0)


def _draw_laws(figure: Figure, box: tuple[float, float], result: Comparison, colours: dict[str, str]) -> None:
    """Frequencies of the count at each pixel; the exact law on top, and what lies off the scale in words."""
    grid = figure.add_gridspec(1, len(result.pixels), left=0.056, right=0.99, top=box[0], bottom=box[1], wspace=0.3)
    axes = list(grid.subplots(squeeze=False).flat)
    for ax, name in zip(axes, result.pixels, strict=True):
        statistics, law = result.statistics[name], result.laws[name]
        moments = statistics[result.against].counts if law is None else law.counts
        spread = max(math.sqrt(max(moments.variance.value, 0.0)), 0.7)
        low = max(math.floor(moments.mean.value - 5.5 * spread), 0)
        high = math.ceil(moments.mean.value + 5.5 * spread)
        group = max(1, round(0.25 * spread))  # frequencies of single counts are mostly noise
        last = low + math.ceil((high - low + 1) / group) * group - 1
        edges = np.asarray(np.arange(low, last + 2, group) - 0.5, dtype=np.float64)
        away = []
        for engine in _first(result.engines, result.against):
            drawn = statistics[engine]
            frequency = drawn.frequencies.on(low, last).reshape(-1, group).mean(1)
            if frequency.sum() * group < 0.02:
                away.append((engine, drawn.counts.mean.value))
                continue
            ax.plot(*_steps(edges, frequency), **_line(colours[engine], engine == result.against))
        if law is not None:
            inside = np.arange(low, last + 1)
            ax.plot(inside, law.pmf.on(low, last), color=INK, lw=0.8, ls=(0, (4, 1.5)))
        for k, (engine, mean) in enumerate(away):
            right = mean > moments.mean.value
            ax.text(
                0.99 if right else 0.01,
                0.97 - 0.12 * k,
                f"{engine}: {mean:,.0f} →" if right else f"← {engine}: {mean:,.0f}",
                transform=ax.transAxes,
                color=colours[engine],
                ha="right" if right else "left",
                va="top",
                fontsize=6.5,
            )
        ax.set_title(f"Law of the count, {name}", loc="left")
        ax.set_xlabel("registrations")
        ax.set_xlim(edges[0], edges[-1])
        ax.set_ylim(0.0, None)
        ax.locator_params(axis="both", nbins=5)
    axes[0].set_ylabel("probability")


def _draw_joint(figure: Figure, box: tuple[float, float], result: Comparison, colours: dict[str, str]) -> None:
    grid = figure.add_gridspec(
        1, 4, left=0.056, right=0.985, top=box[0], bottom=box[1], wspace=0.3, width_ratios=(1.3, 1.3, 1.3, 1.0)
    )
    ratios, lags, shapes, times = grid.subplots(squeeze=False)[0]
    table, against = result.statistics, result.against
    window = {p: {e: s.window_ratio for e, s in row.items()} for p, row in table.items()}
    variances = {p: row[against].window.variance.value for p, row in table.items()}
    known = {
        p: float(law.window[1]) / variances[p]
        for p, law in result.laws.items()
        if law is not None and law.window is not None and variances[p] > 0
    }
    draw_points(ratios, window, colours, 1.0, against, known)
    ratios.set_title(f"Variance of the signal window / {result.against}", loc="left")
    lag1 = {p: {e: s.lag1 for e, s in row.items()} for p, row in table.items()}
    known = {p: law.lag1 for p, law in result.laws.items() if law is not None}
    draw_points(lags, lag1, colours, 0.0, against, known)
    lags.set_title("Covariance of neighbouring bins / mean count", loc="left")
    distances = {p: {e: s.shape for e, s in row.items()} for p, row in table.items()}
    draw_points(shapes, distances, colours, None, against)
    shapes.set_title("Shape of the mean histogram: TV (– by chance)", loc="left")
    draw_times(times, result, colours)


def _first(engines: list[str], name: str) -> list[str]:
    """The reference before the others: it is drawn wide and pale behind them."""
    return [name, *(e for e in engines if e != name)]


def _line(colour: str, reference: bool) -> dict[str, Any]:
    return {"color": colour, "lw": 3.0 if reference else 0.9, "alpha": 0.45 if reference else 1.0}


def _headline(result: Comparison) -> str:
    system, flux = result.system, result.flux
    height, width = flux.shape
    drawn = [s.realizations for row in result.statistics.values() for s in row.values()]
    each = f"{min(drawn):,}" if min(drawn) == max(drawn) else f"{min(drawn):,} to {max(drawn):,}"
    return (
        f"{height} × {width} pixels, {instrument(system)}; mean S = {flux.signal.mean():.3g}, "
        f"B = {flux.background.mean():.3g} photons per period; {each} exposures of each pixel"
    )
