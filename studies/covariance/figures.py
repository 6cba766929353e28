"""Figures of the study of covariances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.common.draw import legend_below, maps, panels
from studies.covariance.settings import (
    CUTOFFS,
    SPECTRAL_NAME,
    TOLERANCES,
    Cell,
    Settings,
    automatic_name,
    cutoff_name,
    one_cell,
)

_DECAY = ((1.0, 1.0), (10.0, 0.1))  # S, B
_DECAY_LAGS = 20
_NOTE: dict[str, Any] = {"ha": "right", "fontsize": 7, "color": MUTED}
_FLOOR = 1e-9  # of sigma_ss^2; below it covariances are not drawn


def decay(settings: Settings) -> Figure:
    """|gamma_l| / sigma_ss^2 against the lag, sign in the marker."""
    figure, axes = panels(2.7, 1, len(_DECAY), sharey=True)
    lags = np.arange(1, _DECAY_LAGS + 1)
    for ax, (signal, background) in zip(axes[0], _DECAY, strict=True):
        for k, dead in enumerate(settings.decay_dead):
            terms = one_cell(settings, signal, background, dead, "centre").terms
            size = terms.gamma[:_DECAY_LAGS] / terms.sigma_ss2
            selected = np.abs(size) > _FLOOR
            colour = COLOURS[k % len(COLOURS)]
            ax.plot(lags[selected], np.abs(size)[selected], color=colour, lw=0.9, label=f"{dead:g}")
            for sign, face in ((1.0, colour), (-1.0, "white")):
                chosen = selected & (np.sign(size) == sign)
                ax.plot(lags[chosen], np.abs(size)[chosen], "o", ms=3.2, mfc=face, mec=colour, mew=0.8)
        ax.set(yscale="log", xlabel="lag $l$", ylim=(_FLOOR, 2.0), xlim=(0, _DECAY_LAGS + 1))
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.set_title(f"S = {signal:g}, B = {background:g} photons per period", loc="left")
    axes[0, 0].set_ylabel(r"$|\gamma_l|\,/\,\sigma_{ss}^2$")
    axes[0, -1].legend(
        title="$t_d / t_r$", title_fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    axes[0, 0].annotate("filled: positive\nopen: negative", (0.97, 0.97), xycoords="axes fraction", va="top", **_NOTE)
    return figure


def eigenvalues(settings: Settings, cells: Sequence[Cell]) -> Figure:
    """Magnitudes of the leading eigenvalues: every cell a point, median and largest as lines."""
    figure, axes = panels(2.5, 1, len(settings.grids), sharey=True)
    random = np.random.default_rng(0)
    for ax, grid in zip(axes[0], settings.grids, strict=True):
        size = np.array([cell.sizes[:12] for cell in cells if cell.grid is grid])
        place = np.arange(1, size.shape[1] + 1)
        jitter = random.uniform(-0.28, 0.28, size.shape)
        ax.plot(place + jitter, size, ".", ms=1.6, color=COLOURS[0], alpha=0.35, mew=0, rasterized=True)
        ax.plot(place, size.max(axis=0), color=INK, lw=0.9, marker="_", ms=8, label="largest")
        ax.plot(place, np.median(size, axis=0), color=COLOURS[1], lw=0.9, marker="_", ms=8, label="median")
        ax.axhline(0.7, color=MUTED, lw=0.7, ls=(0, (4, 2)))
        ax.axvline(5.5, color=MUTED, lw=0.7, ls=(0, (1, 2)))
        ax.set(xlabel="$k$", ylim=(0, 1.05), xlim=(0.3, size.shape[1] + 0.7))
        ax.set_xticks(place[::2])
        ax.set_title(f"{grid.name}, {grid.size} cells", loc="left")
    axes[0, 0].set_ylabel(r"$|\lambda_k|$")
    axes[0, -1].legend(frameon=False, loc="upper right")
    axes[0, 0].annotate("0.7", (0.97, 0.7), xycoords=("axes fraction", "data"), va="bottom", **_NOTE)
    return figure


def truncation(settings: Settings, cells: Sequence[Cell]) -> Figure:
    """Mean absolute error of the sum against the fixed cut-off, with the other rules as levels."""
    figure, axes = panels(2.7, 1, len(settings.grids), sharey=True)
    levels = [(SPECTRAL_NAME, COLOURS[1], "-")]
    levels += [(automatic_name(t), c, "--") for t, c in zip(TOLERANCES, (COLOURS[2], COLOURS[3]), strict=True)]
    for ax, grid in zip(axes[0], settings.grids, strict=True):
        here = [cell for cell in cells if cell.grid is grid]
        error = [np.mean([abs(cell.error(cutoff_name(c))) for cell in here]) for c in CUTOFFS]
        ax.plot(CUTOFFS, error, "o-", ms=2.4, lw=0.9, color=COLOURS[0], label="first $c$ lags")
        for name, colour, line in levels:
            level = np.mean([abs(cell.error(name)) for cell in here])
            ax.axhline(level, color=colour, lw=1.0, ls=line, label=name)
        ax.set_xscale("symlog", linthresh=10, linscale=1.2)
        ax.set_yscale("log")
        ax.set_xticks([0, 5, 10, 20, 50, 100, 500], ["0", "5", "10", "20", "50", "", "500"])
        ax.set(xlabel="cut-off $c$", xlim=(-0.5, 600), ylim=(1e-6, None))
        ax.set_title(f"{grid.name}, {grid.size} cells", loc="left")
    axes[0, 0].set_ylabel(r"mean |error| of $\sum\gamma_l$, ns$^2$")
    legend_below(figure, axes[0, :1], 4)
    return figure


def error_map(settings: Settings, cells: Sequence[Cell]) -> Figure:
    """Relative error of sigma^2 over (S, B) for three rules, at each dead time of the last grid."""
    grid = settings.grids[-1]
    flux, dead = grid.flux, grid.dead_ns
    by = {(c.signal, c.background, c.dead_ns): c for c in cells if c.grid is grid}

    def error(rule: str, dead_ns: float) -> list[list[float]]:
        return [[abs(by[s, b, dead_ns].relative_error(rule)) for s in flux] for b in flux]

    rules = ("cut-off 0", "cut-off 20", SPECTRAL_NAME)
    rows = {f"{rule.replace('spectral ', '')}\nB": (flux, [error(rule, d) for d in dead]) for rule in rules}
    titles = [f"$t_d$ = {d / grid.period_ns:g} $t_r$" for d in dead]
    figure, axes, _ = maps(3.3, flux, rows, titles, LogNorm(1e-6, 1.0), r"|relative error of $\sigma^2$|")
    for ax in axes[0]:
        ax.title.set_fontsize(7)
    return figure
