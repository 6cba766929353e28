"""What the figures of the studies share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from mars_lidar.plot.style import DPI

WIDTH = 7.0  # inches: two columns of a paper


def panels(height: float, rows: int, columns: int, **options: Any) -> tuple[Figure, Any]:
    """A figure of the common width, `height` in inches, with its axes (rows, columns)."""
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def legend_below(figure: Any, axes: Iterable[Axes], columns: int, **options: Any) -> None:
    """One legend of all labels of some axes, each once, below them."""
    handles = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), frameon=False, loc="outside lower center", ncols=columns, **options)


def log_edges(centres: Sequence[float]) -> NDArray[np.float64]:
    """Edges (n + 1,) of cells around positive `centres` (n,), n >= 2, midway between them on a log axis."""
    at = np.log(np.asarray(centres, dtype=np.float64))
    middle = 0.5 * (at[1:] + at[:-1])
    ends = 2 * at[0] - middle[0], 2 * at[-1] - middle[-1]
    return np.asarray(np.exp(np.concatenate([ends[:1], middle, ends[1:]])), dtype=np.float64)


def heat(ax: Axes, x: Sequence[float], y: Sequence[float], values: ArrayLike, norm: LogNorm) -> Any:
    """A square map of `values` (y, x) on log axes, ticks at decades, the ends labelled; returns the mesh."""
    image = np.maximum(np.asarray(values, dtype=np.float64), 1e-300)
    mesh = ax.pcolormesh(log_edges(x), log_edges(y), image, norm=norm, cmap="magma_r", rasterized=True)
    ax.set(xscale="log", yscale="log")
    ax.set_box_aspect(1)
    ax.tick_params(which="minor", length=0)
    ax.minorticks_off()
    for axis, centres in ((ax.xaxis, x), (ax.yaxis, y)):
        low, high = (np.log10(c) for c in (min(centres), max(centres)))
        decades = np.arange(np.ceil(low - 1e-9), np.floor(high + 1e-9) + 1)
        inner = [""] * max(len(decades) - 2, 0)
        ends = [f"{10.0**d:g}" for d in decades]
        axis.set_ticks(10.0**decades, [ends[0], *inner, ends[-1]] if len(ends) > 1 else ends)
    return mesh


def maps(
    height: float,
    x: Sequence[float],
    rows: Mapping[str, tuple[Sequence[float], Sequence[ArrayLike]]],
    titles: Sequence[str],
    norm: LogNorm,
    label: str,
) -> tuple[Figure, Any, Any]:
    """Square maps (y, x) over the signal `x` in rows and columns: `rows` by label, points of y and images.

    Returns the figure, its axes (rows, columns) and the colour bar.
    """
    figure, grid = panels(height, len(rows), len(titles), sharex=True, sharey="row")
    for row, (words, (y, images)) in zip(grid, rows.items(), strict=True):
        for ax, image in zip(row, images, strict=True):
            mesh = heat(ax, x, y, image, norm)
        row[0].set_ylabel(words)
    for ax, title in zip(grid[0], titles, strict=True):
        ax.set_title(title)
    grid[-1, len(titles) // 2].set_xlabel("S, photons per period")
    bar = figure.colorbar(mesh, ax=grid, extend="both", aspect=50, pad=0.01)
    bar.set_label(label)
    return figure, grid, bar
