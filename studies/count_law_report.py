"""The report on count laws: T1 of the MaRS paper, the paper's own table beside it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mars_lidar.statistics.distance import KL_FLOOR
from studies import Request
from studies.count_law import FIGURES, FULL, QUICK, Cell, Settings, compute
from studies.count_law_figures import HISTOGRAM, HISTOGRAM_CYCLES, draw_all
from studies.count_law_shape import shape_sweep
from studies.machine import machine
from studies.report import Row, configuration, save_csv, save_text, table
from studies.simulators import simulators

PAPER = {  # T1 of arXiv 2512.04924: Wasserstein, KL, mean difference, variance difference
    "poisson": (7966.130, 24.208, 7966.130, 9257.464),
    "renewal": (207.565, 18.821, 207.564, 45.927),
    "neural": (2.337, 0.409, 0.282, 64.558),
    "mars_centre": (0.309, 0.013, 0.269, 1.588),
    "mars_edge": (0.309, 0.013, 0.269, 1.588),
}
PAPER_ROWS = {"Poisson": "poisson", "renewal": "renewal", "Zhang et al.": "neural", "MaRS": "mars_centre"}
OURS = ("mars_exact", "mars_matched")
KL_ABOVE_FLOOR = 0.001  # what ours may have
_ONE_IN_1000 = 3.09  # standard deviations of the average's own noise

# right: in at least RIGHT_CELLS of the cells off by at most this, or by SCORES of the simulation's own errors
RIGHT_MEAN, RIGHT_VARIANCE, RIGHT_SHAPE = 0.01, 0.05, 0.01
RIGHT_CELLS, SCORES = 0.95, 4.0


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    cells = compute(settings, request.truth, request.tell)
    sweep = shape_sweep(settings, request.tell)
    figures = draw_all(request.out, settings, cells, sweep, request.truth)
    findings = [line for grid in settings.grids for line in _findings(_of(cells, grid.name))]
    for line in findings:
        request.tell(line)
    spent = time.monotonic() - began
    text = save_text(request.out / "count_law.md", _text(settings, cells, findings, request, spent))
    return [text, *figures, save_csv(request.out / "count_law.csv", [_csv_row(cell) for cell in cells])]


def _of(cells: Sequence[Cell], grid: str) -> list[Cell]:
    return [cell for cell in cells if cell.grid == grid]


def average(cells: Sequence[Cell], name: str) -> tuple[list[float], list[float], list[float]]:
    """Of one simulator over cells: figures, their sampling floors, and limits that chance exceeds once in 1000."""
    figures = np.mean([c.scores[name].figures for c in cells], axis=0)
    floors = np.mean([c.scores[name].floors for c in cells], axis=0)  # (resamplings, 4)
    floor = floors.mean(0)
    limit = floor + _ONE_IN_1000 * floors.std(0, ddof=1)
    return figures.tolist(), floor.tolist(), limit.tolist()


def right(cell: Cell, name: str) -> dict[str, bool]:
    """Whether a simulator has the cell's mean, variance and shape right, to the stated thresholds."""
    score = cell.scores[name]
    errors = SCORES * score.noise
    mean, variance = (float(score.figures[FIGURES.index(key)]) for key in ("mean", "variance"))
    return {
        "mean": mean <= max(RIGHT_MEAN * float(cell.exact[0]), errors * cell.mean_error),
        "variance": variance <= max(RIGHT_VARIANCE * float(cell.exact[1]), errors * cell.variance_error),
        "shape": score.shape <= max(RIGHT_SHAPE, 2.0 * score.shape_floor),
    }


def _words(cells: Sequence[Cell]) -> dict[str, str]:
    return {one.name: one.words for one in simulators(1, 0) if one.name in cells[0].scores}


def _text(settings: Settings, cells: list[Cell], findings: list[str], request: Request, spent: float) -> list[str]:
    flag = (" --quick" if request.quick else "") + f" --truth {request.truth}"
    grids = {
        f"grid {grid.name}": f"t_r = {grid.period_ns:.6g} ns, S x B = {len(grid.flux)} x {len(grid.flux)} {grid.words} "
        f"photons per period, t_d = {', '.join(f'{d:g}' for d in grid.dead_ns)} ns: {grid.size} cells"
        for grid in settings.grids
    }
    sampled = [name for name in cells[0].scores if cells[0].scores[name].noise > 1.0]
    return [
        "# Count laws against simulation (T1)",
        "_Quick form: a look, not for citing._" if request.quick else "",
        "Law of the number N of registrations in one exposure, and shape of the mean histogram, by every simulator "
        "of arXiv 2512.04924 and ours, against photon-by-photon simulation. The paper does not state its grid, "
        "exposure or pulse; two grids are declared here. The paper's rows for Poisson and renewal, which have no "
        "freedom but the grid, come closest on *near*, so the comparison with the paper is made there.",
        "## Configuration",
        f"Command: `python -m studies count-law{flag} --out DIR`",
        configuration(
            {
                **grids,
                "exposure": f"N_r = {settings.cycles}, armed start, delay t_r / 2",
                "histogram and statistics grid of the chain": f"{settings.bins} bins",
                "pulse": f"Gaussian, sigma = {settings.sigma_ns:g} ns",
                "truth": f"engine `{request.truth}`, {settings.realizations} realizations a cell, seed {settings.seed}",
                "floors": f"{settings.resamplings} samples of the exact law of that size in each cell",
                "machine": machine(),
                "run time": f"{spent:.0f} s",
            }
        ),
        "- Wasserstein: first distance, in counts. KL: KL(simulation || law) in nats over the integers, the law "
        f"floored at {KL_FLOOR:g}. Mean and variance: absolute differences of the law's moments to the sample's. "
        "All averaged over the cells of a grid.\n"
        "- A Gaussian law on the integers is its integral from n - 1/2 to n + 1/2, what lies below 0 counted as 0; "
        "its moments are those stated by the method.\n"
        "- *floor*: what the exact law itself scores against a sample of its own of that size, on average. *limit*: "
        "what it exceeds once in 1000 runs.\n"
        "- Shape: total variation of the mean histogram to the simulated one; its floor comes from the scatter "
        "between blocks of realizations.",
        f"Known by sampling only ({settings.sampled} exposures a cell; the floors include their noise): "
        f"{', '.join(sampled)}."
        if sampled
        else "",
        "## Result",
        "\n".join(findings),
        *[part for grid in settings.grids for part in _grid_text(_of(cells, grid.name), grid.name)],
        "## Which simulator gets what right",
        f"Right: in at least {100 * RIGHT_CELLS:g} % of the cells the mean is within {100 * RIGHT_MEAN:g} %, the "
        f"variance within {100 * RIGHT_VARIANCE:g} %, the shape within a total variation of {RIGHT_SHAPE:g}, or else "
        f"within {SCORES:g} standard errors of the simulation (2 floors for the shape). In brackets the share of "
        "cells. Computed from this run.",
        *[part for grid in settings.grids for part in _ablation(_of(cells, grid.name), grid.name)],
        "## Figures",
        "![Four count laws](count_law_panels.png)",
        "Cells of *wide*. A law further off than the panel reaches is named at its side.",
        "![Shape over dead time](count_law_shape.png)",
        f"Lines: to the exact mean histogram of the exposure, over {len(settings.sweep_flux)} x "
        f"{len(settings.sweep_flux)} cells log-spaced on [{settings.sweep_flux[0]:g}, {settings.sweep_flux[-1]:g}], "
        "without noise. Marks: to the simulation, on the cells of *wide*.",
        "![A histogram before and after dead time](count_law_dead_time.png)",
        f"S = {HISTOGRAM[0]:g}, B = {HISTOGRAM[1]:g}, one exposure of {HISTOGRAM_CYCLES} cycles.",
    ]


def _grid_text(cells: Sequence[Cell], grid: str) -> list[str]:
    rows: list[Row] = []
    for name, words in _words(cells).items():
        figures, floor, _ = average(cells, name)
        shape = float(np.mean([c.scores[name].shape for c in cells]))
        noise = float(np.mean([c.scores[name].shape_floor for c in cells]))
        rows.append(_result_row(words, figures, floor) | {"shape": _beside(shape, noise)})
    rows += [
        _result_row(f"_paper: {words}_", list(PAPER[key]), None) | {"shape": "-"} for words, key in PAPER_ROWS.items()
    ]
    parts = [f"### Grid {grid}", "In brackets the sampling floor.", table(rows)]
    return parts + (["Beside the paper:", table(_judgement(cells))] if grid == "near" else [])


def _result_row(words: str, figures: list[float], floor: list[float] | None) -> dict[str, object]:
    keys = ("Wasserstein", "KL", "mean difference", "variance difference")
    noise: list[float | None] = [None] * 4 if floor is None else list(floor)
    return {"simulator": words, **{k: _beside(f, n) for k, f, n in zip(keys, figures, noise, strict=True)}}


def _beside(value: float, floor: float | None) -> str:
    return f"{value:.4g}" if floor is None else f"{value:.4g} ({floor:.2g})"


def _judgement(cells: Sequence[Cell]) -> list[Row]:
    rows: list[Row] = []
    for name, words in _words(cells).items():
        if name not in ("mars_centre", "mars_edge"):
            continue
        figures, _, _ = average(cells, name)
        row: dict[str, object] = {"simulator": words}
        for key, own, paper in zip(FIGURES, figures, PAPER[name], strict=True):
            verdict = "no worse" if own <= paper else "**worse**"
            row[key] = f"{own:.4g}, paper {paper:g}: {verdict}"
        rows.append(row)
    return rows


def _ablation(cells: Sequence[Cell], grid: str) -> list[str]:
    rows = []
    for name, words in _words(cells).items():
        found = [right(cell, name) for cell in cells]
        row: dict[str, object] = {"simulator": words}
        for key in ("mean", "variance", "shape"):
            share = float(np.mean([one[key] for one in found]))
            row[key] = f"{'right' if share >= RIGHT_CELLS else 'wrong'} ({100 * share:.0f} %)"
        rows.append(row)
    return [f"### Grid {grid}", table(rows)]


def _findings(cells: Sequence[Cell]) -> list[str]:
    grid = cells[0].grid
    lines = []
    for name, words in _words(cells).items():
        figures, floor, limit = average(cells, name)
        kl, mean, variance = (FIGURES.index(key) for key in ("kl", "mean", "variance"))
        if name in OURS:
            within = figures[mean] <= limit[mean] and figures[variance] <= limit[variance]
            excess, allowed = figures[kl] - floor[kl], max(KL_ABOVE_FLOOR, limit[kl] - floor[kl])
            lines.append(
                f"- {grid}, {words}: mean and variance differences {figures[mean]:.4g} and {figures[variance]:.4g}, "
                f"limits of the simulation's own error {limit[mean]:.4g} and {limit[variance]:.4g}: "
                f"{'within' if within else '**not within**'}. KL above its floor by {excess:.2g} nats: "
                f"{'at most' if excess <= allowed else '**more than**'} {allowed:.2g}."
            )
        elif grid == "near" and name in ("mars_centre", "mars_edge"):
            worse = [k for k, own, paper in zip(FIGURES, figures, PAPER[name], strict=True) if own > paper]
            verdict = f"**worse than the paper** in {', '.join(worse)}" if worse else "no worse than the paper in all"
            lines.append(f"- {grid}, {words}: {verdict}.")
        elif name in ("poisson", "renewal"):
            ratios = ", ".join(f"{own / paper:.3g}" for own, paper in zip(figures, PAPER[name], strict=True))
            lines.append(f"- {grid}, {words}: {ratios} times the paper's four figures.")
    return lines


def _csv_row(cell: Cell) -> Row:
    row: dict[str, object] = {
        "grid": cell.grid,
        "period_ns": cell.period_ns,
        "signal": cell.signal,
        "background": cell.background,
        "dead_time_ns": cell.dead_ns,
        "simulated_mean": cell.mean,
        "simulated_variance": cell.variance,
        "exact_mean": float(cell.exact[0]),
        "exact_variance": float(cell.exact[1]),
    }
    floor = cell.scores["mars_exact"].floors.mean(0)
    row |= {f"floor_{key}": float(v) for key, v in zip(FIGURES, floor, strict=True)}
    row["floor_shape"] = cell.scores["mars_exact"].shape_floor
    for name, score in cell.scores.items():
        row |= {f"{name}_{key}": float(v) for key, v in zip(FIGURES, score.figures, strict=True)}
        row[f"{name}_shape"] = score.shape
    return row
