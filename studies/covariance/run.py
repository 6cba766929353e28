"""Study "covariance", T4 of the MaRS paper (arXiv 2512.04924): covariances of holding times, and truncating their sum.

What each rule leaves out of gamma_1 + gamma_2 + ... in every cell of declared grids over (S, B, t_d), against
the sum without truncation. Equation numbers refer to docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from studies import Facts, Request
from studies.common.report import Row, picked
from studies.covariance.settings import (
    CUTOFFS,
    FULL,
    QUICK,
    SPECTRAL_NAME,
    TOLERANCES,
    Cell,
    Settings,
    automatic_name,
    compute,
    cutoff_name,
    one_cell,
)

_USUAL_CUTOFFS = range(21)  # among these the best fixed one is looked for
_HARD = (10.0, 1.0, 1.0)  # S, B, t_d / t_r


def mean_error(cells: Sequence[Cell], rule: str) -> float:
    """Mean absolute error of the sum by `rule`, ns^2."""
    return float(np.mean([abs(cell.error(rule)) for cell in cells]))


def best_cutoff(cells: Sequence[Cell]) -> int:
    """The fixed cut-off of least mean absolute error among those commonly used, 0 to 20."""
    return min(_USUAL_CUTOFFS, key=lambda c: mean_error(cells, cutoff_name(c)))


def run(request: Request) -> Facts:
    """Both ways of re-arming on all grids, and the check by dense matrices."""
    from studies.covariance import figures
    from studies.covariance.dense import dense_checks

    settings = QUICK if request.quick else FULL
    centre = compute(settings, "centre", request.tell)
    edge = compute(settings, "edge", request.tell)
    checks = dense_checks(settings, centre, settings.dense_random, request.tell)
    checks += dense_checks(settings, edge, 0, request.tell)
    grids = [(grid, [cell for cell in centre if cell.grid is grid]) for grid in settings.grids]
    cut20, spectral = cutoff_name(20), SPECTRAL_NAME
    against = [
        _against_paper(settings, name, here)
        for name, here in (*((grid.name, here) for grid, here in grids), ("all", centre), ("all, edge re-arming", edge))
    ]
    off = sorted(abs(c.relative_error(spectral)) for c in centre)
    poisson, bias = _poisson(centre)
    return {
        "s": settings,
        "centre": centre,
        "edge": edge,
        "wanted": sum(grid.size for grid in settings.grids),
        "grids": grids,
        "against": against,
        "cut20": cut20,
        "spectral": spectral,
        "ratios": {row["grid"]: row["ratio"] for row in against[: len(grids)]},
        "beyond": max(centre, key=lambda c: c.sizes[5]),
        "hard": sum(abs(c.relative_error(cut20)) > 0.01 for c in centre),
        "worst20": max(centre, key=lambda c: abs(c.relative_error(cut20))),
        "off": off,
        "off_95": off[int(0.95 * len(off))],
        "worst": max(centre, key=lambda c: abs(c.relative_error(spectral))),
        "hard_cells": [one_cell(settings, *_HARD, "centre"), one_cell(settings, *_HARD, "edge")],
        "poisson": poisson,
        "bias": bias,
        "checks": checks,
        "spoiled": sum(not abs(c["inverse"]) < 0.01 for c in checks),
        "by_rule": {grid.name: [_rule(here, rule) for rule in _RULES] for grid, here in grids},
        "edge_rules": [_rule(edge, rule) for rule in _RULES],
        "automatic": {t: np.array([c.rules[automatic_name(t)] for c in centre]).T for t in TOLERANCES},
        "rows": [_csv_row(c) for c in (*centre, *edge)],
        "figures": {
            "decay": figures.decay(settings),
            "eigenvalues": figures.eigenvalues(settings, centre),
            "truncation": figures.truncation(settings, centre),
            "map": figures.error_map(settings, centre),
        },
    }


def _poisson(cells: Sequence[Cell]) -> tuple[Cell | None, float]:
    """The cell without dead time whose sigma^2 is furthest from that of a Poisson count, and by what share."""
    # without dead time N is Poisson: sigma^2 = mu^2 = (t_r / Lambda)^2
    known = {c: (c.grid.period_ns / (c.signal + c.background)) ** 2 for c in cells if c.dead_ns == 0.0}
    bias = {c: c.terms.sigma2 / expected - 1.0 for c, expected in known.items()}
    far = max(bias, key=lambda c: abs(bias[c]), default=None)
    return far, bias[far] if far else 0.0


def _against_paper(settings: Settings, name: str, cells: Sequence[Cell]) -> Row:
    best = best_cutoff(cells)
    cut, spectral = mean_error(cells, cutoff_name(best)), mean_error(cells, SPECTRAL_NAME)
    # the least fixed cut-off tried that does as well as the spectral rule
    match = next((str(c) for c in CUTOFFS if mean_error(cells, cutoff_name(c)) <= spectral), f"> {CUTOFFS[-1]}")
    in_bins = [
        float(np.mean([abs(c.error(rule)) * (settings.bins / c.grid.period_ns) ** 2 for c in cells]))
        for rule in (cutoff_name(best), SPECTRAL_NAME)
    ]
    return {
        "grid": name,
        "best of c = 0..20": best,
        "best cut-off, ns²": cut,
        "spectral, ns²": spectral,
        "best cut-off, bins²": in_bins[0],
        "spectral, bins²": in_bins[1],
        "ratio": cut / spectral,
        "match": match,
    }


def _rule(cells: Sequence[Cell], rule: str) -> dict[str, object]:
    return {
        "rule": rule,
        "error": mean_error(cells, rule),
        "relative": float(np.mean([abs(c.relative_error(rule)) for c in cells])),
        "worst": max(cells, key=lambda cell: abs(cell.relative_error(rule))),
        "negative": sum(c.terms.sigma_ss2 + 2.0 * c.sums[rule] < 0 for c in cells),
    }


_RULES = (
    *(cutoff_name(c) for c in (0, 1, 2, 3, 5, 6, 10, 15, 20, 50, 100, 500)),
    SPECTRAL_NAME,
    *(automatic_name(t) for t in TOLERANCES),
)

_CSV_RULES = {
    rule: rule.replace(" = ", "").replace(",", "").replace("cut-off", "cutoff").replace(" ", "_")
    for rule in _RULES
    if rule not in {cutoff_name(c) for c in (1, 2, 3, 15)}
}


def _csv_row(cell: Cell) -> Row:
    return {
        "grid": cell.grid.name,
        **picked(cell, "rearm signal background dead_time_ns=dead_ns"),
        "period_ns": cell.grid.period_ns,
        **picked(cell.terms, "mu_ns=mu sigma_ss2_ns2=sigma_ss2 sigma2_ns2=sigma2 exact_sum_ns2=exact_sum defect"),
        **{f"abs_lambda_{k}": float(cell.sizes[k - 1]) for k in (2, 3, 4, 5, 6)},
        **{f"error_{column}_ns2": cell.error(rule) for rule, column in _CSV_RULES.items()},
    }
