"""Figures of the study "uncertainty": reliability, maps of coverage, exposures of a measured stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from mars_lidar.plot.style import COLOURS
from studies.common.draw import legend_below, panels
from studies.uncertainty.data import BACKGROUND, SIGNAL, Config
from studies.uncertainty.run import LEVELS, Run, by_simulator

_LOOKS = {"exact": (COLOURS[0], "-"), "feedback": (COLOURS[2], ":"), "mars": (COLOURS[1], "-")}


def reliability(found: Mapping[Run, Any], predicted: Mapping[float, Any], dead: Sequence[float]) -> Figure:
    """Coverage less its level on gold-standard data, by level: each seed, and the closed form for MaRS dashed."""
    figure, axes = panels(2.9, 1, len(dead), sharey=True)
    for ax, one in zip(axes.flat, dead, strict=True):
        for name, results in by_simulator(found, one):
            if name in _LOOKS:
                colour, line = _LOOKS[name]
                for result in results:
                    covered = np.array(result["tests"]["gold"]["log S"]["coverage"])
                    ax.plot(LEVELS, covered - LEVELS, line, color=colour, lw=1.2, label=f"trained on {name}")
        closed = np.mean([cell["coverage"] for cell in predicted[one]], axis=0)
        ax.plot(LEVELS, closed - LEVELS, "--", color="k", lw=1.2, label="closed form for mars")
        ax.axhline(0.0, color="0.7", lw=0.8, zorder=0)
        ax.set_title(f"$t_d$ = {one:g} $t_r$")
        ax.set_xlabel("level of the interval")
    axes.flat[0].set_ylabel("share that holds the true log S, less level")
    legend_below(figure, axes.flat, 4)
    return figure


def maps(found: Mapping[Run, Any], predicted: Mapping[float, Any], dead: Sequence[float], config: Config) -> Figure:
    """Coverage of the 90 % intervals over S and B: trained on exact and on MaRS data, predicted for the latter."""
    edges = [np.geomspace(*ends, config.cells + 1) for ends in (SIGNAL, BACKGROUND)]
    norm = TwoSlopeNorm(0.9, 0.55, 1.0)
    figure, axes = panels(2.1 * len(dead) + 0.3, len(dead), 3, sharex=True, sharey=True)
    for row, one in zip(axes, dead, strict=True):
        arms = dict(by_simulator(found, one))
        closed = [cell["coverage"][LEVELS.index(0.9)] for cell in predicted[one]]
        shown = [
            (f"trained on {name}", np.mean([result["tests"]["gold"]["map"] for result in arms[name]], axis=0))
            for name in ("exact", "mars")
        ]
        shown.append(("closed form for mars", np.reshape(closed, (config.cells, config.cells))))
        for ax, (title, image) in zip(row, shown, strict=True):
            mesh = ax.pcolormesh(*edges, image.T, norm=norm, cmap="RdBu", rasterized=True)
            ax.set(xscale="log", yscale="log")
            for axis in (ax.xaxis, ax.yaxis):
                _plain(axis, (0.1, 0.3, 1.0, 3.0))
            ax.set_title(f"{title}, {one:g} $t_r$", fontsize=8)
        row[0].set_ylabel("B, photons per period")
    for ax in axes[-1]:
        ax.set_xlabel("S, photons per period")
    figure.colorbar(mesh, ax=axes, label="share of 90 % intervals that hold the true log S", shrink=0.7)
    return figure


def exposures(stream: Mapping[str, Any]) -> Figure:
    """Light of each exposure of a measured stream, in order of its estimate, with its 90 % interval."""
    truth, error = stream["about"]["light"], stream["about"]["error"]
    figure, axes = panels(2.8, 1, len(stream["rows"]), sharey=True)
    for ax, (name, row) in zip(axes.flat, stream["rows"].items(), strict=True):
        order = np.argsort(row["mean"])
        mean, deviation = (np.array(row[key])[order] for key in ("mean", "deviation"))
        low, high = (np.exp(mean + side * 1.645 * deviation) for side in (-1.0, 1.0))
        missed = (low > truth) | (high < truth)
        for some, colour in ((~missed, COLOURS[0]), (missed, COLOURS[1])):
            ax.vlines(np.flatnonzero(some), low[some], high[some], color=colour, lw=0.8)
        ax.axhspan(truth - 1.645 * error, truth + 1.645 * error, color="0.8", zorder=0)
        ax.set(title=f"trained on {name}: {1.0 - missed.mean():.2f}", xlabel="exposure", yscale="log")
        _plain(ax.yaxis, (0.5, 1.0, 2.0))
    axes.flat[0].set_ylabel("photons per period")
    return figure


def _plain(axis: Any, ticks: Sequence[float]) -> None:
    axis.set_ticks(ticks, [f"{one:g}" for one in ticks])
    axis.set_ticks([], minor=True)
