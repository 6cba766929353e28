"""The report on covariances: tables beside the paper's figures, and where they disagree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from studies import Request
from studies.covariance import (
    CUTOFFS,
    FULL,
    QUICK,
    TOLERANCES,
    Cell,
    DenseCheck,
    Grid,
    Settings,
    automatic_name,
    compute,
    cutoff_name,
    dense_checks,
    spectral_name,
)
from studies.covariance_figures import draw_all
from studies.covariance_findings import (
    PAPER_CUTOFF,
    PAPER_SPECTRAL,
    best_cutoff,
    findings,
    mean_error,
)
from studies.report import Row, configuration, number, save_csv, save_text, table

_RULES = (
    *(cutoff_name(c) for c in (0, 1, 2, 3, 5, 6, 10, 15, 20, 50, 100, 500)),
    spectral_name(),
    *(automatic_name(t) for t in TOLERANCES),
)

_CSV_RULES = tuple(rule for rule in _RULES if rule not in {cutoff_name(c) for c in (1, 2, 3, 15)})


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    centre = compute(settings, "centre", request.tell)
    edge = compute(settings, "edge", request.tell)
    checks = dense_checks(settings, centre, settings.dense_random, request.tell)
    checks += dense_checks(settings, edge, 0, request.tell)
    figures = draw_all(request.out, settings, centre)
    found = findings(settings, centre, checks)
    for line in found:
        request.tell(line)
    text = save_text(request.out / "covariance.md", _text(settings, centre, edge, checks, found, request.quick))
    return [text, *figures, save_csv(request.out / "covariance.csv", [_csv_row(c) for c in (*centre, *edge)])]


def matching_cutoff(cells: Sequence[Cell]) -> str:
    """The least fixed cut-off tried that does as well as the spectral rule."""
    goal = mean_error(cells, spectral_name())
    enough = [c for c in CUTOFFS if mean_error(cells, cutoff_name(c)) <= goal]
    return str(enough[0]) if enough else f"> {CUTOFFS[-1]}"


def _on(cells: Sequence[Cell], grid: Grid) -> list[Cell]:
    return [cell for cell in cells if cell.grid is grid]


def _text(
    settings: Settings,
    centre: list[Cell],
    edge: list[Cell],
    checks: list[DenseCheck],
    found: list[str],
    quick: bool,
) -> list[str]:
    wanted = sum(grid.size for grid in settings.grids)
    grids = [
        {
            "grid": grid.name,
            "t_r, ns": grid.period_ns,
            "S and B, photons per period": f"{len(grid.signal)} x {len(grid.background)}, "
            + ("log-spaced" if _is_log(grid) else "linear")
            + f" on [{grid.signal[0]:g}, {grid.signal[-1]:g}]",
            "t_d / t_r": ", ".join(f"{d / grid.period_ns:.4g}" for d in grid.dead_ns),
            "cells": grid.size,
            "computed": len(_on(centre, grid)),
            "skipped": grid.size - len(_on(centre, grid)),
        }
        for grid in settings.grids
    ]
    return [
        "# Covariance of holding times, and the truncation of its sum",
        "_Quick form: a look, not for citing._" if quick else "",
        "The times between registrations of a pixel with dead time are correlated. The variance of the count "
        "needs the sum of all lag covariances $\\gamma_1 + \\gamma_2 + \\dots$; this study measures what "
        "each "
        "way of truncating it leaves out, in every cell of declared grids, against the sum without "
        "truncation "
        "(one O(n) solution, `docs/theory.md` 3.10). Source of the rules and of the figures quoted as "
        "*paper*: "
        "arXiv 2512.04924.",
        "## Configuration",
        f"Command: `python -m studies covariance{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "statistics grid": f"{settings.bins} bins per period in every cell",
                "pulse": f"Gaussian, sigma = {settings.sigma_ns:g} ns; delay t_r / 2",
                "seed": f"{settings.seed} (draws the cells of the dense check only; nothing else is random)",
                "cells computed": f"{len(centre)} of {wanted}, each with re-arming at bin centre and at bin edge",
                "cells skipped": wanted - len(centre) + wanted - len(edge),
            }
        ),
        table(grids),
        "A dead time of whole periods more changes neither the chain nor any covariance: the column 0 stands "
        "for "
        "$t_d = t_r, 2 t_r, \\dots$ as well.",
        "## Result beside the paper",
        table(
            [_against_paper(settings, grid.name, _on(centre, grid)) for grid in settings.grids]
            + [_against_paper(settings, "all", centre)]
            + [_against_paper(settings, "all, edge re-arming", edge)]
            + [_paper_row(_against_paper(settings, "", centre))]
        ),
        "Mean absolute error of $\\sum_l \\gamma_l$. The paper states neither the unit nor the grid of its "
        "two figures, so "
        "they cannot be compared in size; the ratio has no unit and can. Errors are given in ns² and in "
        "squared bins "
        f"(t_r / {settings.bins}). *match* is the least fixed cut-off tried that does as well as the "
        "spectral rule. "
        "*Noted before* are estimates from a few cells, with which this project began.",
        "\n".join(found),
        "## Every rule",
        "Re-arming at the bin centre. *relative* is the error of $\\sigma^2 = \\sigma_{ss}^2 + "
        "2\\sum\\gamma$ relative to "
        "$\\sigma^2$, which is the relative error of the variance of the count; mean of its size, and the "
        "worst cell with its sign.",
        *[
            f"### Grid {grid.name}\n\n" + table([_rule_row(_on(centre, grid), r) for r in _RULES])
            for grid in settings.grids
        ],
        "Re-arming at the bin edge, as in Rapp's code, all grids:",
        table([_rule_row(edge, rule) for rule in _RULES]),
        _automatic_words(centre),
        "![Mean absolute error of the sum against the cut-off](covariance_truncation.png)",
        "![Relative error of sigma^2 over S and B](covariance_map.png)",
        "## Decay and eigenvalues",
        "![Decay of the lag covariances](covariance_decay.png)",
        "![Magnitudes of the leading eigenvalues](covariance_eigenvalues.png)",
        table([_eigen_row(grid.name, _on(centre, grid)) for grid in settings.grids]),
        "## The dense way, checked",
        "Eigenpairs are found by Arnoldi iteration on O(n) products (residual of each below 1e-11, "
        f"checked). In {len(checks)} "
        "cells, of each grid the slowest at each dead time, the worst for the paper's rule, and some at "
        "random, the same figures were computed "
        "from dense matrices: "
        "LAPACK's eigenpairs, a dense solution of $(I - P + 1\\pi)z = Q_\\mu 1 - \\mu$, and plain summation "
        "of 3000 lags. Differences of "
        "sums are relative to $\\sigma^2$. The last columns use rows of $V^{-1}$ as left eigenvectors "
        "instead of LAPACK's.",
        table([_check_row(check) for check in checks]),
    ]


def _is_log(grid: Grid) -> bool:
    steps = np.diff(grid.signal)
    return len(grid.signal) < 3 or float(np.ptp(steps)) > 1e-6 * float(steps.max())


def _against_paper(settings: Settings, name: str, cells: Sequence[Cell]) -> Row:
    best = best_cutoff(cells)
    cut, spectral = mean_error(cells, cutoff_name(best)), mean_error(cells, spectral_name())
    bin2 = [(settings.bins / cell.grid.period_ns) ** 2 for cell in cells]
    in_bins = [
        float(np.mean([abs(c.error(rule)) * b for c, b in zip(cells, bin2, strict=True)]))
        for rule in (cutoff_name(best), spectral_name())
    ]
    return {
        "grid": name,
        "best of c = 0..20": best,
        "best cut-off, ns²": cut,
        "spectral, ns²": spectral,
        "best cut-off, bins²": in_bins[0],
        "spectral, bins²": in_bins[1],
        "ratio": cut / spectral,
        "match": matching_cutoff(cells),
    }


def _paper_row(like: Row) -> Row:
    row = {**dict.fromkeys(like, "-"), "grid": "paper", "ratio": number(PAPER_CUTOFF / PAPER_SPECTRAL)}
    for key, value in (("best cut-off, ns²", PAPER_CUTOFF), ("spectral, ns²", PAPER_SPECTRAL)):
        row[key] = f"{value:.2f} (unit not stated)"
    return row


def _rule_row(cells: Sequence[Cell], rule: str) -> Row:
    worst = max(cells, key=lambda cell: abs(cell.relative_error(rule)))
    return {
        "rule": rule,
        "mean abs. error, ns²": mean_error(cells, rule),
        "mean relative": f"{np.mean([abs(c.relative_error(rule)) for c in cells]):.2e}",
        "worst relative": f"{worst.relative_error(rule):+.2e}",
        "in the cell": worst.name(),
        "sigma² < 0": sum(c.terms.sigma_ss2 + 2.0 * c.sums[rule] < 0 for c in cells),
    }


def _eigen_row(name: str, cells: Sequence[Cell]) -> Row:
    size = np.array([cell.sizes[:7] for cell in cells])
    slowest = max(cells, key=lambda cell: cell.sizes[1])
    return {
        "grid": name,
        **{f"largest size of lambda_{k}": float(size[:, k - 1].max()) for k in (2, 4, 5, 6, 7)},
        "slowest cell": slowest.name(),
    }


def _automatic_words(cells: Sequence[Cell]) -> str:
    parts = []
    for tolerance in TOLERANCES:
        rules = np.array([cell.rules[automatic_name(tolerance)] for cell in cells])
        lags, modes = (f"{column.min()} to {column.max()}" for column in rules.T)
        parts.append(f"at {tolerance:.0e} L = {lags}, p = {modes}")
    return f"The automatic rule chose, {'; '.join(parts)} (tolerances relative to $\\sigma_{{ss}}^2$)."


def _check_row(check: DenseCheck) -> Row:
    return {
        "grid": check.cell.grid.name,
        "re-arming": check.cell.rearm,
        "cell": check.cell.name(),
        "size of lambda_2": float(check.cell.sizes[1]),
        "eigenvalues": f"{check.eigenvalues:.0e}",
        "spectral sum": f"{check.spectral:.0e}",
        "sum by dense solve": f"{check.exact:.0e}",
        "sum of 3000 lags": f"{check.summed:.0e}",
        "V^-1: change of sigma²": f"{check.inverse:+.1e}",
        "V^-1: sigma² < 0": "yes" if check.negative else "no",
    }


def _csv_row(cell: Cell) -> Row:
    terms = cell.terms
    return {
        "grid": cell.grid.name,
        "rearm": cell.rearm,
        "signal": cell.signal,
        "background": cell.background,
        "dead_time_ns": cell.dead_ns,
        "period_ns": cell.grid.period_ns,
        "mu_ns": terms.mu,
        "sigma_ss2_ns2": terms.sigma_ss2,
        "sigma2_ns2": terms.sigma2,
        "exact_sum_ns2": terms.exact_sum,
        "defect": terms.defect,
        **{f"abs_lambda_{k}": float(cell.sizes[k - 1]) for k in (2, 3, 4, 5, 6)},
        **{f"error_{_column(rule)}_ns2": cell.error(rule) for rule in _CSV_RULES},
    }


def _column(rule: str) -> str:
    return rule.replace(" = ", "").replace(",", "").replace("cut-off", "cutoff").replace(" ", "_")
