"""Figures of the study "reconstruction"."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from mars_lidar.plot.figures import _draw_map, _limits
from mars_lidar.plot.style import COLOURS, INK
from mars_lidar.reconstruction import METHODS
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.reconstruction.settings import Picture

_ALONE = [name for name, method in METHODS.items() if not method.of_images]
_COLOUR = dict(zip(_ALONE, (*COLOURS, INK), strict=True))
TITLE = {"nonparalyzable": "free-running, t_d = 75 ns", "synchronous": "synchronous"}


def flux_figure(rows: Sequence[Row]) -> Figure:
    """RMSE and bias of depth and signal over flux: a column for each detector."""
    quantities = (
        ("depth RMSE mm", "depth bound mm", "depth RMSE (mm)"),
        ("depth bias mm", None, "depth |bias| (mm)"),
        ("signal RMSE %", "signal bound %", "signal RMSE (%)"),
        ("signal bias %", None, "signal |bias| (%)"),
    )
    figure, axes = panels(5.7, 4, 2, sharex=True, sharey="row")
    for column, detector in enumerate(TITLE):
        mine = [row for row in rows if row["detector"] == detector]
        for line, (name, bound, label) in enumerate(quantities):
            ax = axes[line, column]
            for method in dict.fromkeys(row["method"] for row in mine):
                here = [row for row in mine if row["method"] == method]
                x = [row["signal"] for row in here]
                y = np.abs([row[name] for row in here])
                ax.plot(x, y, "o-", ms=2.5, lw=1.0, color=_COLOUR[method], label=method.replace("_", " "))
                if bound and method == "maximum_likelihood":
                    ax.plot(x, [row[bound] for row in here], "--", lw=1.2, color=INK, label="bound", zorder=5)
            ax.set(xscale="log", yscale="log")
            ax.minorticks_off()
            if column == 0:
                ax.set_ylabel(label)
            if line == 0:
                ax.set_title(TITLE[detector], loc="left")
            if line == len(quantities) - 1:
                ax.set_xlabel("signal = background photons per period")
    methods = dict.fromkeys(row["method"] for row in rows)
    legend_below(figure, axes[0], len(methods) + 1, handlelength=1.2, columnspacing=1.0)
    axes[2, 0].set_ylim(1.0, 1e3)
    axes[3, 0].set_ylim(1e-2, 1e3)
    axes[0, 0].set_ylim(1.0, 3e2)
    axes[1, 0].set_ylim(1e-2, 1e2)
    return figure


def maps_figure(picture: Picture) -> Figure:
    """A bright room: true maps, and those of two methods."""
    limits = _limits(picture.depth_m)
    errors = {name: 1e3 * (each.depth_m - picture.depth_m) for name, each in picture.estimates.items()}
    reach = float(np.percentile(np.abs(errors["matched_filter"]), 98))
    share = _limits(picture.signal)
    figure, axes = panels(4.3, 2, 3)
    for ax, name in zip(axes[0, 1:], picture.estimates, strict=True):
        words = "matched filter, raw counts" if name == "matched_filter" else "maximum likelihood"
        _draw_map(ax, errors[name], "depth error (mm)", "RdBu_r", (-reach, reach), words)
    for ax, (name, each) in zip(axes[1, 1:], picture.estimates.items(), strict=True):
        raw = name == "matched_filter"
        words = "signal, raw counts (own scale)" if raw else "signal, maximum likelihood"
        _draw_map(ax, each.signal, "photons per period", "gray", _limits(each.signal) if raw else share, words)
    _draw_map(axes[0, 0], picture.depth_m, "depth (m)", "viridis", limits, "true depth")
    _draw_map(axes[1, 0], picture.signal, "photons per period", "gray", share, "true signal")
    for ax in axes.flat:
        ax.images[0].set_interpolation("nearest")  # a file a third as large
    return figure
