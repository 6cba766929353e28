"""Some cells the paper's way, with dense matrices and LAPACK: a check of the O(n) way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import HoldingTimeCovariance, PhaseChain
from studies import Tell
from studies.covariance.settings import SPECTRAL, SPECTRAL_NAME, Cell, Settings


def dense_checks(settings: Settings, cells: list[Cell], extra: int, tell: Tell) -> list[dict[str, Any]]:
    """Some cells the paper's way: the slowest at each dead time, the worst, `extra` at random, per grid."""
    results = [_dense_check(cell) for cell in _chosen(settings, cells, extra)]
    tell(f"covariance: {len(results)} cells by dense matrices, re-arming at the {cells[0].rearm}")
    return results


def _chosen(settings: Settings, cells: list[Cell], extra: int) -> Iterator[Cell]:
    random = np.random.default_rng(settings.seed)
    for grid in settings.grids:
        here = [cell for cell in cells if cell.grid is grid]
        slowest = [max((c for c in here if c.dead_ns == d), key=lambda c: c.sizes[1]) for d in grid.dead_ns]
        worst = max(here, key=lambda cell: abs(cell.relative_error(SPECTRAL_NAME)))
        first = slowest if worst in slowest else [*slowest, worst]
        rest = [cell for cell in here if cell not in first]
        yield from first
        for k in random.choice(len(rest), extra, replace=False):
            yield rest[k]


def _dense_check(cell: Cell) -> dict[str, Any]:
    """One cell by the paper's way, dense matrices and LAPACK, beside the O(n) way.

    Differences of sums are relative to sigma^2. ``inverse`` is what left vectors from inv(V) in place of LAPACK's
    change of sigma^2 by the paper's rule, relative to it; ``negative`` whether it is below 0.
    """
    terms = cell.terms
    dense = HoldingTimeCovariance(**{name: getattr(terms, name) for name in terms.__dataclass_fields__})
    count = SPECTRAL[1] + 1
    reference, arnoldi = dense.eigenvalues[:count], terms.eigenvalues[:count]
    apart = np.abs(reference[:, None] - arnoldi[None, :]).min(axis=1)
    apart = apart[:-1] if np.abs(reference[-1].imag) > 0 else apart  # the last may be half of a pair
    paper = dense.spectral_sum(*SPECTRAL)
    inverse = _by_inverse(cell)
    sigma2 = terms.sigma2
    return {
        "cell": cell,
        "eigenvalues": float(apart.max()),
        "spectral": 2.0 * abs(paper - cell.sums[SPECTRAL_NAME]) / sigma2,
        "exact": 2.0 * abs(_by_solve(cell) - terms.exact_sum) / sigma2,
        "summed": 2.0 * abs(dense.cutoff_sum(3000) - terms.exact_sum) / sigma2,
        "inverse": 2.0 * (inverse - paper) / sigma2,
        "negative": terms.sigma_ss2 + 2.0 * inverse < 0.0,
    }


def moment_matrices(chain: PhaseChain) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Dense P, mean mu_ij and variance sigma_ij^2 of the holding time given the step i -> j, periods (3.1-3.3)."""
    n = chain.bins
    j = np.arange(n)
    arm = (j + chain.shift) % n
    ahead = (j[None, :] - arm[:, None]) % n
    # M and Sigma away from the re-arming bin: a geometric number of further periods (3.1, 3.2)
    loss, passed = chain.loss, math.exp(-chain.total)
    mean = (chain.blind_bins + ahead) / n + passed / loss
    variance = np.full((n, n), passed / loss**2)
    # the re-arming bin is met once in part, then whole every period (3.3)
    again = chain.again()
    there = chain.refire + again
    with np.errstate(invalid="ignore", divide="ignore"):
        first = np.where(there > 0, again / loss / there, 0.0)
        second = np.where(there > 0, again * (1.0 + passed) / loss**2 / there, 0.0)
    mean[j, arm] = chain.blind_bins / n + first[arm]
    variance[j, arm] = (second - first**2)[arm]
    return chain.dense(), mean, variance


def _parts(cell: Cell) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Dense P, pi, pi Q_mu - mu pi and Q_mu 1 - mu, all from matrices, in periods (3.7)."""
    chain = cell.terms.chain
    pdf = np.asarray(cell.terms.stationary_pdf)
    matrix, waits, _ = moment_matrices(chain)
    q_mu = matrix * waits
    mean = q_mu.sum(axis=1)
    mu = float(pdf @ mean)
    return matrix, pdf, pdf @ q_mu - mu * pdf, mean - mu


def _by_solve(cell: Cell) -> float:
    """The sum without truncation by one dense solution of (I - P + 1 pi) z = Q_mu 1 - mu, ns^2."""
    matrix, pdf, row, value = _parts(cell)
    n = pdf.size
    z = np.linalg.solve(np.eye(n) - matrix + pdf[None, :], value)
    return float(row @ z) * cell.grid.period_ns**2


def _by_inverse(cell: Cell) -> float:
    """The paper's rule with left vectors as rows of inv(V) (4.4), ns^2; infinite where V is singular."""
    matrix, _, row, value = _parts(cell)
    values, vectors = np.linalg.eig(matrix)
    order = np.argsort(-np.round(np.abs(values), 12), kind="stable")
    try:
        inverse = np.linalg.inv(vectors)
    except np.linalg.LinAlgError:
        return float("inf")
    count = SPECTRAL[1]
    if abs(values[order[count - 1]].imag) > 0 and np.count_nonzero(values[order[1:count]].imag) % 2:
        count += 1
    selected = order[1:count]
    weight = (row @ vectors[:, selected]) * (inverse[selected] @ value)
    tail = np.sum(weight * values[selected] ** SPECTRAL[0] / (1.0 - values[selected]))
    return cell.terms.cutoff_sum(SPECTRAL[0]) + float(tail.real) * cell.grid.period_ns**2
