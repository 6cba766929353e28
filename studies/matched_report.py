"""The report on the law with four matched cumulants."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mars_lidar.plot.style import COLOURS, style
from studies import Request
from studies.draw import heat, panels
from studies.matched import AIM, FULL, QUICK, Part, Settings, drawn, maps, share, worst
from studies.report import Row, configuration, save_csv, save_figure, save_text, table

_EDGES = (0.0, 0.2, 0.7, 2.3, 9.0, 100.0, np.inf)  # of the variance
_WORST = 12
_LISTED = 0.25  # of the aim
_LOW, _HIGH = 1e-5, 1e-1  # total variation on the colour scale


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    parts, others = maps(settings, request.tell), drawn(settings, request.tell)
    armed = [part for part in parts if part.kind == "armed"]
    figure = _draw(request.out / "matched_map.png", settings, armed)
    text = save_text(request.out / "matched.md", _text(settings, parts, others, request.quick))
    rows = [_csv_row(part, k) for part in [*parts, *others] for k in np.flatnonzero(_listed(part))]
    return [text, figure, save_csv(request.out / "matched.csv", rows)]


def _text(settings: Settings, parts: list[Part], others: list[Part], quick: bool) -> list[str]:
    everything = [*parts, *others]
    kinds = {
        "grid, armed": [p for p in parts if p.kind == "armed"],
        "grid, stationary": [p for p in parts if p.kind == "stationary"],
        "at random": others,
    }
    starts = ", ".join(f"t_d = {d:g} t_r with {n} cycles" for d, n in settings.stationary)
    return [
        "# A law of the count from four cumulants",
        "_Quick form: a look, not for citing._" if quick else "",
        "A table that stores mean, variance, third and fourth cumulant of the number N of registrations needs "
        "a law on the integers that has them (`mars_lidar.statistics.matched.matched_pmf`). Here its total variation "
        'to the exact law, `count_law(method="exact")`, beside that of the Gaussian with the exact mean and '
        f"variance. No sampling, no noise. The aim is {AIM:g}.",
        "## Configuration",
        f"Command: `python -m studies matched{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "laser": "t_r = 133.33 ns, delay t_r / 2",
                "grid": f"S x B = {len(settings.signal)} x {len(settings.background)}, log-spaced on [0.01, 10]^2; "
                f"t_d = {', '.join(f'{d:g}' for d in settings.dead)} t_r; "
                f"{', '.join(map(str, settings.cycles))} cycles; sigma = {settings.sigma_ns:g} ns; armed start",
                "stationary start": f"the same S and B, {starts}",
                "at random": f"{settings.systems} systems of {settings.pixels} cells, seed {settings.seed}: S and "
                "B log-uniform on [0.01, 10], t_d uniform on [0.02, 2.5] t_r, cycles log-uniform on 30 .. 3000, "
                "sigma log-uniform on 0.2 .. 3 ns, armed start. The thresholds of the law and of `trusted` were "
                "set on the grid and on other systems at random, so these cells are the fair test",
            }
        ),
        "## Result",
        table([_share_row(name, cells) for name, cells in kinds.items() if cells]),
        f"*within*: share of cells with a total variation of at most {AIM:g}. `trusted` says from the "
        "cumulants alone where the law is sure to be: *not trusted* is the share of cells for which a table "
        "had better keep the exact probabilities, *missed* are cells that it trusts and that are beyond the "
        "aim, *needless* those that it does not trust but that are within.",
        "![Total variation to the exact law](matched_map.png)",
        "Grid, armed start; columns: dead time; crosses: not trusted. The line on the scale is the aim.",
        "## By variance",
        "All cells. The law errs where the count all but locks to the laser: of few integers, but neither an "
        "integer with rare gains and losses nor smooth.",
        table(_variance_rows(everything)),
        "## Worst cells",
        table([_worst_row(part, k) for part, k in worst(everything, _WORST)]),
        f"`matched.csv` has the cells that are not trusted or beyond {_LISTED:g} of the aim.",
    ]


def _share_row(name: str, parts: Sequence[Part]) -> Row:
    s = share(parts)
    return {
        "cells": name,
        "number": s.cells,
        "within": f"{100 * s.within:.2f} %",
        "worst": s.worst,
        "Gaussian within": f"{100 * s.within_gaussian:.1f} %",
        "Gaussian worst": s.worst_gaussian,
        "not trusted": f"{100 * s.untrusted:.1f} %",
        "missed": s.missed,
        "needless": s.needless,
        "worst trusted": s.worst_trusted,
    }


def _variance_rows(parts: Sequence[Part]) -> list[Row]:
    variance = np.concatenate([part.cumulants[:, 1] for part in parts])
    matched = np.concatenate([part.matched for part in parts])
    gaussian = np.concatenate([part.gaussian for part in parts])
    rows: list[Row] = []
    for low, high in pairwise(_EDGES):
        here = (variance >= low) & (variance < high)
        if here.any():
            rows.append(
                {
                    "Var N": f"{low:g} .. {high:g}",
                    "cells": int(here.sum()),
                    "within": f"{100 * (matched[here] <= AIM).mean():.1f} %",
                    "median": float(np.median(matched[here])),
                    "worst": float(matched[here].max()),
                    "Gaussian, median": float(np.median(gaussian[here])),
                    "Gaussian, worst": float(gaussian[here].max()),
                }
            )
    return rows


def _worst_row(part: Part, k: int) -> Row:
    mean, variance, third, fourth = (float(c) for c in part.cumulants[k])
    return {
        "cell": part.name(k) + ("" if part.kind != "stationary" else ", stationary"),
        "mean": f"{mean:.5g}",
        "variance": variance,
        "k3": third,
        "k4": fourth,
        "matched": float(part.matched[k]),
        "Gaussian": float(part.gaussian[k]),
        "trusted": bool(part.trusted[k]),
    }


def _listed(part: Part) -> NDArray[np.bool_]:
    """Cells of the table: all would be a large file of little news."""
    return np.asarray((part.matched > _LISTED * AIM) | ~part.trusted, dtype=np.bool_)


def _csv_row(part: Part, k: int | np.intp) -> Row:
    system = part.system
    return {
        "kind": part.kind,
        "signal": float(part.signal[k]),
        "background": float(part.background[k]),
        "dead_time": part.dead,
        "cycles": system.cycles,
        "sigma_ns": part.sigma_ns,
        **{f"cumulant_{n + 1}": float(part.cumulants[k, n]) for n in range(4)},
        "tv_exact_matched": float(part.matched[k]),
        "tv_exact_gaussian": float(part.gaussian[k]),
        "trusted": bool(part.trusted[k]),
    }


def _draw(path: Path, settings: Settings, parts: Sequence[Part]) -> Path:
    """Maps over S and B: columns for dead times; rows for cycles, and the Gaussian for comparison."""
    from matplotlib.colors import LogNorm

    shape = len(settings.signal), len(settings.background)
    by = {(round(part.dead, 9), part.system.cycles): part for part in parts}
    rows = [(n, "matched", f"{n} cycles") for n in settings.cycles]
    rows.append((settings.cycles[0], "gaussian", f"Gaussian,\n{settings.cycles[0]} cycles"))
    with style():
        figure, axes = panels(0.5 + 0.95 * len(rows), len(rows), len(settings.dead), sharex=True, sharey=True)
        norm, mesh = LogNorm(_LOW, _HIGH), None
        for row, (cycles, law, words) in zip(axes, rows, strict=True):
            for ax, dead in zip(row, settings.dead, strict=True):
                part = by[round(dead, 9), cycles]
                image = getattr(part, law).reshape(shape).T
                mesh = heat(ax, settings.signal, settings.background, image, norm)
                if law == "matched":
                    at = ~part.trusted
                    ax.plot(part.signal[at], part.background[at], "x", ms=1.4, mew=0.4, color=COLOURS[0])
            row[0].set_ylabel(f"{words}\nB")
        for ax, dead in zip(axes[0], settings.dead, strict=True):
            ax.set_title(f"{dead:g} $t_r$")
        axes[-1, len(settings.dead) // 2].set_xlabel("S, photons per period")
        bar = figure.colorbar(mesh, ax=axes, extend="both", aspect=50, pad=0.01)
        bar.set_label("total variation to the exact law")
        bar.ax.axhline(AIM, color=COLOURS[0], lw=0.8)
        return save_figure(path, figure)
