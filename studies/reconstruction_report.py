"""Report and figures of the reconstruction study."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.plot.figures import _draw_map, _limits
from mars_lidar.plot.style import COLOURS, INK, style
from mars_lidar.reconstruct import METHODS
from studies.draw import panels
from studies.machine import load, machine
from studies.reconstruction import (
    BRIGHT,
    OUTLIER_SIGMAS,
    PLAIN,
    SBR,
    SEED,
    SYNCHRONOUS,
    Picture,
    Settings,
    window_lines,
)
from studies.report import Row, configuration, save_csv, save_figure, save_text, table

_COLOUR = dict(zip(METHODS, (*COLOURS, INK), strict=True))
KNOWN = 10.0  # %, of S: a bound above it is not reached by any estimate (section "Near the bound")
_TITLE = {"nonparalyzable": "free-running, t_d = 75 ns", "synchronous": "synchronous"}


def write(
    out: Path, settings: Settings, rows: Sequence[Row], near: Sequence[Row], shown: Picture, times: Sequence[Row]
) -> list[Path]:
    """Write reconstruction.md, reconstruction.csv and the figures."""
    sweep = _flux_figure(out / "reconstruction_flux.png", rows)
    maps = _maps_figure(out / "reconstruction_maps.png", shown)
    parts = [
        "# Reconstruction over flux",
        "Depth and signal of single pixels by every method of `mars_lidar.reconstruct` "
        "([reconstruction.md](../reconstruction.md)), simulated with the exact engine at delays all over the period, "
        "beside the Cramer-Rao bound of the histogram (`ml.cramer_rao`). Depth errors are those of the pixels within "
        f"{OUTLIER_SIGMAS:g} sigma of the pulse; the rest counts as outliers. Signal errors are in % of the "
        "true signal, of the pixels that are not flagged as saturated (unbounded rates); their share is given.",
        configuration(_settings(settings)),
        f"![Errors over flux]({sweep.name})",
        _finding(rows),
        table(_chosen(rows, settings)),
        "All fluxes: `reconstruction.csv`.",
        "## Near the bound",
        "Where the light leaves few passes at the pulse, the errors of S rise above the bound, for three reasons. The "
        "*ends* of the exposure: the bound takes the armed time as known, a histogram hides how many passes its last "
        "dead time took; the covariance of the exact likelihood's score says what that costs any estimate. *Second "
        "order*: no unbiased estimate reaches the bound in so short an exposure; Bhattacharyya's bound, with second "
        "derivatives, is nearer to what can be reached. And the *bias* of a maximum of likelihood, which "
        "`reconstruct` takes off to first order (columns *of the maximum*: as it was before that). All in units of the "
        f"Cramer-Rao bound of {PLAIN.cycles} cycles (of 20,000 cycles for the long exposures), pulse at 50 ns; by "
        "simulation, to 2 %.",
        table(near),
        "## Why dead time must be modelled",
        f"![Depth of a bright room]({maps.name})",
        _picture_words(shown),
        "## The raw window estimate, predicted",
        "Mean and standard deviation of the signal that the window around the return gives, without correction, by the "
        "joint law of the bins (`estimate.window_error`): no simulation. An estimate as biased as this one can spread "
        "less than the bound of unbiased ones.",
        table(window_lines(settings)),
        "## Time",
        f"One cube of {PLAIN.bins} bins, S = 1 on average; the least of {settings.repeats} runs. {machine()}; "
        f"load {load()}. Processor seconds are of all threads.",
        table(times),
    ]
    text = save_text(out / "reconstruction.md", parts)
    return [text, save_csv(out / "reconstruction.csv", rows), sweep, maps]


def _settings(settings: Settings) -> dict[str, Any]:
    return {
        "system": f"period {PLAIN.period_ns:.4g} ns, {PLAIN.cycles} cycles, {PLAIN.bins} bins, {PLAIN.pulse!r}",
        "detectors": f"free-running, dead time {PLAIN.detector.dead_time_ns:g} ns; synchronous, dead time "
        f"{SYNCHRONOUS.detector.dead_time_ns:g} ns",
        "SBR": f"{SBR:g} (S / B of the pixel)",
        "pixels at each flux": settings.pixels,
        "picture": f"room of {settings.size} x {settings.size} pixels, mean S = {BRIGHT:g}",
        "seed": SEED,
    }


def _chosen(rows: Sequence[Row], settings: Settings) -> list[Row]:
    """Three fluxes: dim, ordinary, bright."""
    n = len(settings.signals)
    picked = {settings.signals[k] for k in ((0, 1, 2) if n < 5 else (n // 4, (5 * n) // 8, n - 2))}
    return [row for row in rows if row["signal"] in picked]


def _finding(rows: Sequence[Row]) -> str:
    told = []
    for detector in dict.fromkeys(row["detector"] for row in rows):
        mine = [r for r in rows if r["detector"] == detector and r["method"] == "maximum_likelihood"]
        clean = [r for r in mine if r["outliers %"] == 0.0 and r["saturated %"] == 0.0]
        last = max((r["signal"] for r in clean if r["signal bound %"] < KNOWN), default=0.0)
        sure = [r for r in clean if r["signal"] <= last]
        if not sure:
            continue
        depth = [r["depth RMSE mm"] / r["depth bound mm"] for r in sure]
        signal = [r["signal RMSE %"] / r["signal bound %"] for r in sure]
        raw = [r for r in rows if r["detector"] == detector and r["method"] == "matched_filter"][-1]
        told.append(
            f"{_TITLE[detector].capitalize()}: from S = {sure[0]['signal']:.3g} to {sure[-1]['signal']:.3g} "
            "(no outliers, no saturated pixels, and for bright pixels a bound below "
            f"{KNOWN:g} % of S) maximum likelihood has "
            f"{min(depth):.2f} to {max(depth):.2f} times the bound in depth and "
            f"{min(signal):.2f} to {max(signal):.2f} times in signal. "
            f"At S = {raw['signal']:.3g} the matched filter on raw counts is {raw['depth bias mm']:.1f} mm off and has "
            f"{-raw['signal bias %']:.0f} % of the signal too little."
        )
    return " ".join(told)


def _flux_figure(path: Path, rows: Sequence[Row]) -> Path:
    quantities = (
        ("depth RMSE mm", "depth bound mm", "depth RMSE (mm)"),
        ("depth bias mm", None, "depth |bias| (mm)"),
        ("signal RMSE %", "signal bound %", "signal RMSE (%)"),
        ("signal bias %", None, "signal |bias| (%)"),
    )
    with style():
        figure, axes = panels(5.7, 4, 2, sharex=True, sharey="row")
        for column, detector in enumerate(_TITLE):
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
                    ax.set_title(_TITLE[detector], loc="left")
                if line == len(quantities) - 1:
                    ax.set_xlabel("signal = background photons per period")
        drawn = {text: line for ax in axes[0] for line, text in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(
            drawn.values(),
            drawn.keys(),
            loc="outside lower center",
            ncols=len(drawn),
            frameon=False,
            handlelength=1.2,
            columnspacing=1.0,
        )
        axes[2, 0].set_ylim(1.0, 1e3)
        axes[3, 0].set_ylim(1e-2, 1e3)
        axes[0, 0].set_ylim(1.0, 3e2)
        axes[1, 0].set_ylim(1e-2, 1e2)
        return save_figure(path, figure)


def _maps_figure(path: Path, shown: Picture) -> Path:
    limits = _limits(shown.depth_m)
    errors = {name: 1e3 * (each.depth_m - shown.depth_m) for name, each in shown.found.items()}
    reach = float(np.percentile(np.abs(errors["matched_filter"]), 98))
    share = _limits(shown.signal)
    with style():
        figure, axes = panels(4.3, 2, 3)
        for ax, name in zip(axes[0, 1:], shown.found, strict=True):
            words = "matched filter, raw counts" if name == "matched_filter" else "maximum likelihood"
            _draw_map(ax, errors[name], "depth error (mm)", "RdBu_r", (-reach, reach), words)
        for ax, (name, each) in zip(axes[1, 1:], shown.found.items(), strict=True):
            raw = name == "matched_filter"
            words = "signal, raw counts (own scale)" if raw else "signal, maximum likelihood"
            _draw_map(ax, each.signal, "photons per period", "gray", _limits(each.signal) if raw else share, words)
        _draw_map(axes[0, 0], shown.depth_m, "depth (m)", "viridis", limits, "true depth")
        _draw_map(axes[1, 0], shown.signal, "photons per period", "gray", share, "true signal")
        for ax in axes.flat:
            ax.images[0].set_interpolation("nearest")  # a file a third as large
        return save_figure(path, figure)


def _picture_words(shown: Picture) -> str:
    told = []
    for name, words in (("matched_filter", "the matched filter"), ("maximum_likelihood", "maximum likelihood")):
        error = 1e3 * (shown.found[name].depth_m - shown.depth_m)
        off = shown.found[name].signal / shown.signal - 1.0
        told.append(
            f"{words} is off by {np.mean(error):+.1f} mm on average and {np.sqrt(np.mean(error**2)):.1f} mm RMS in "
            f"depth, by {100 * np.median(off):+.0f} % (median) in signal"
        )
    return (
        f"The same cube of mean S = {BRIGHT:g}, SBR {SBR:g}: " + "; ".join(told) + ". Bright surfaces look nearer on "
        "raw counts, because the first photons of a pulse blind the pixel for the rest of it, so that texture prints "
        "through into depth; and their signal saturates."
    )
