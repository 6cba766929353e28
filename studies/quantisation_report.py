"""The report on what the lookup of a table costs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mars_lidar.plot.style import COLOURS, style
from studies import Request
from studies.draw import panels
from studies.machine import machine
from studies.quantisation import (
    ERRORS,
    FULL,
    HIGH,
    INTERPOLATIONS,
    LOW,
    PERIOD_NS,
    QUICK,
    Cost,
    Settings,
    compute,
)
from studies.report import Row, configuration, save_csv, save_figure, save_text, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VISIBLE = 0.002  # total variation of the count law, or standard deviations of the mean, that a lookup may cost
_WORDS = {
    "mean": "mean, standard deviations",
    "variance": "variance, relative",
    "shape": "shape, total variation",
    "law": "count law, total variation",
}


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    costs = compute(settings, request.tell)
    findings = _findings(settings, costs)
    for line in findings:
        request.tell(line)
    with style():
        figure = _figure(request.out / "quantisation.png", settings, costs)
    spent = time.monotonic() - began
    text = save_text(request.out / "quantisation.md", _text(settings, costs, findings, request.quick, spent))
    return [text, figure, save_csv(request.out / "quantisation.csv", [_csv_row(cost) for cost in costs])]


def _text(settings: Settings, costs: Sequence[Cost], findings: list[str], quick: bool, spent: float) -> list[str]:
    return [
        "# What a table's lookup costs",
        "_Quick form: a look, not for citing._" if quick else "",
        "Pixels between the entries of a table, nearest entry (the paper's way) and interpolated, against their own "
        "exact statistics, over the number of entries. Interpolated: the mean histogram as a mixture of four, linear "
        "in S and B; the cumulants bicubic in their logarithms.",
        "## Configuration",
        f"Command: `python -m studies quantisation{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "axes": f"S and B log-spaced on [{LOW:g}, {HIGH:g}] photons per period, and 0",
                "system": f"t_r = {PERIOD_NS:.6g} ns, t_d = {', '.join(f'{d:g}' for d in settings.dead_ns)} ns, "
                f"{settings.cycles} cycles, {settings.bins} bins, armed start, delay t_r / 2",
                "pulse": f"Gaussian, sigma = {settings.sigma_ns:g} ns",
                "pixels": f"{settings.pixels}, S and B log-uniform on the same range, seed {settings.seed}",
                "machine": machine(),
                "run time": f"{spent:.0f} s",
            }
        ),
        "Mean: difference in standard deviations of the count. Law: total variation between the laws of the looked-up "
        "and of the pixel's own four cumulants, so that only the lookup counts. What other delays add is in the "
        "table's own report (`Table.provenance`).",
        "## Result",
        "\n".join(findings),
        *[
            part
            for dead in settings.dead_ns
            for part in (
                f"### t_d = {dead:g} ns: mean over pixels (95 % of the pixels)",
                table([_row(cost) for cost in costs if cost.dead_ns == dead]),
            )
        ],
        "![Errors over the number of entries](quantisation.png)",
        "Lines: mean over pixels; thin: 95 % of the pixels.",
    ]


def _row(cost: Cost) -> Row:
    row: dict[str, object] = {"entries": f"{cost.size[0]} x {cost.size[1]}", "lookup": cost.interpolation}
    for key in ERRORS:
        row[_WORDS[key]] = f"{cost.errors[key].mean():.2g} ({np.quantile(cost.errors[key], 0.95):.2g})"
    return row | {"MB of shapes": f"{cost.megabytes:.0f}", "built in, s": f"{cost.seconds:.1f}"}


def _findings(settings: Settings, costs: Sequence[Cost]) -> list[str]:
    lines = []
    for dead in settings.dead_ns:
        for interpolation in INTERPOLATIONS:
            here = [c for c in costs if c.dead_ns == dead and c.interpolation == interpolation]
            good = [c for c in here if np.quantile(c.errors["law"], 0.95) <= VISIBLE]
            least = min(good, key=lambda c: c.size[0] * c.size[1]) if good else None
            reached = f"from {least.size[0]} x {least.size[1]} entries on" if least else "with none of the tables"
            last = here[-1]
            law, shape = (float(np.quantile(last.errors[key], 0.95)) for key in ("law", "shape"))
            lines.append(
                f"- t_d = {dead:g} ns, {interpolation}: the count law of 95 % of the pixels is within {VISIBLE:g} "
                f"{reached}; at {last.size[0]} x {last.size[1]} within {law:.2g}, the shape within {shape:.2g}."
            )
    return lines


def _figure(path: Path, settings: Settings, costs: Sequence[Cost]) -> Path:
    figure, axes = panels(2.5, 1, len(ERRORS), sharex=True)
    for ax, key in zip(axes[0], ERRORS, strict=True):
        _panel(ax, settings, costs, key)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=4)
    return save_figure(path, figure)


def _panel(ax: Axes, settings: Settings, costs: Sequence[Cost], key: str) -> None:
    for k, dead in enumerate(settings.dead_ns):
        for interpolation, dash in zip(INTERPOLATIONS, ("--", "-"), strict=True):
            here = [c for c in costs if c.dead_ns == dead and c.interpolation == interpolation]
            entries = [c.size[0] * c.size[1] for c in here]
            words = f"{interpolation}, $t_d$ = {dead:g} ns"
            ax.plot(entries, [c.errors[key].mean() for c in here], dash, color=COLOURS[k], lw=1.2, label=words)
            ax.plot(entries, [np.quantile(c.errors[key], 0.95) for c in here], dash, color=COLOURS[k], lw=0.5)
    ax.set(xscale="log", yscale="log", xlabel="entries")
    ax.tick_params(axis="x", which="minor", labelbottom=False)
    ax.set_title(_WORDS[key], loc="left", fontsize=7.0)


def _csv_row(cost: Cost) -> Row:
    row: dict[str, object] = {
        "dead_time_ns": cost.dead_ns,
        "signal_points": cost.size[0],
        "background_points": cost.size[1],
        "lookup": cost.interpolation,
        "megabytes": cost.megabytes,
        "build_seconds": cost.seconds,
    }
    for key in ERRORS:
        values = cost.errors[key]
        row |= {f"{key}_mean": float(values.mean()), f"{key}_95": float(np.quantile(values, 0.95))}
        row[f"{key}_largest"] = float(values.max())
    return row
