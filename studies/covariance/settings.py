"""Cells of the study "covariance", the rules that truncate their sums, and leading eigenpairs by Arnoldi iteration.

The paper decomposes the dense matrix, seconds a cell at n = 1024; its rule needs five eigenpairs of them. The
implicitly restarted Arnoldi method (ARPACK) finds those from some hundred products in either direction, in
hundredths of a second. Equation numbers refer to docs/theory.md, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, System, holding_time_covariance
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.chain import Rearm
from mars_lidar.statistics.renewal import weighted_waits
from studies import Tell
from studies.common.sample import NEAR_NS, PERIOD_NS, WIDE_NS, Grid, log_points, paper_grids, system_of
from studies.covariance.rules import ComplexArray, TruncatedSums

MODES = 14  # two more than the automatic rule looks at, so that its last pair is whole
_SUBSPACE = 80
_WORST = 1e-11  # residual |P v - lambda v| for |v| = 1 that is refused: measured 1e-13
_PAIRED = 1e-5  # eigenvalues from left and right: with edge re-arming they are worst conditioned, 8e-8
_MATTERS = 0.03  # below it lambda^7 has left the tail


@dataclass(frozen=True, eq=False)
class LeadingTerms(TruncatedSums):
    """`TruncatedSums` whose `eigenvalues` are the leading `MODES`, by O(n) products.

    The sums by rule are those of the parent. A cell whose eigenpairs do not meet their checks raises
    `ConvergenceError`.
    """

    @cached_property
    def _modes(self) -> tuple[ComplexArray, ComplexArray]:
        chain, times = self.chain, self.times
        values, right = _eigenpairs(chain.backward, chain.bins, chain.describe())
        others, left_vectors = _eigenpairs(chain.forward, chain.bins, chain.describe())
        partner = _partners(values, others, chain.describe())
        left_vectors = left_vectors[:, partner]
        pdf = times.stationary.pdf
        row = weighted_waits(chain, pdf) - times.mu * pdf
        overlap = np.sum(left_vectors * right, axis=0)  # u_k v_k without conjugation: left vectors of P itself
        weights = (row @ right) * (left_vectors.T @ (times.mean - times.mu)) / overlap
        return values, weights * (self.mu / times.mu) ** 2


def _eigenpairs(product: Callable[[FloatArray], FloatArray], n: int, cell: str) -> tuple[ComplexArray, ComplexArray]:
    """Leading eigenvalues (MODES,) by falling magnitude and unit vectors (n, MODES), residuals checked."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    operator: Any = LinearOperator((n, n), matvec=lambda x: product(x.reshape(n)), dtype=np.float64)
    start = 1.0 + np.random.default_rng(0).random(n)  # fixed: the result must not depend on a global state
    try:
        values, vectors = eigs(operator, k=MODES, ncv=min(_SUBSPACE, n), tol=0, v0=start, maxiter=200)
    except ArpackNoConvergence as error:
        raise ConvergenceError(f"{cell}: {len(error.eigenvalues)} of {MODES} eigenvalues converged") from None
    order = np.argsort(-np.round(np.abs(values), 12), kind="stable")  # keeps conjugates side by side
    values, vectors = values[order], vectors[:, order]
    for k in range(MODES):
        v = vectors[:, k]
        image = product(v.real.copy()) + 1j * product(v.imag.copy())
        residual = float(np.linalg.norm(image - values[k] * v))
        if not residual <= _WORST:
            raise ConvergenceError(f"{cell}: eigenvalue {k + 1} has a residual of {residual:.1e}")
    return values, vectors


def _partners(values: ComplexArray, others: ComplexArray, cell: str) -> NDArray[np.intp]:
    """For each eigenvalue from the right the place of the same one from the left."""
    distance = np.abs(values[:, None] - others[None, :])
    partner = np.asarray(distance.argmin(axis=1), dtype=np.intp)
    closest = distance.min(axis=1)
    # the last may be one of a pair that was cut; small ones have left the tail long before
    counted = np.flatnonzero(np.abs(values[:-1]) > _MATTERS)
    if counted.size and closest[counted].max() > _PAIRED:
        k = int(counted[closest[counted].argmax()])
        raise ConvergenceError(f"{cell}: eigenvalue {k + 1} from left and right differ by {closest[k]:.1e}")
    return partner


CUTOFFS = (*range(21), 25, 30, 40, 50, 75, 100, 150, 200, 300, 500)
SPECTRAL = (6, 5)  # the paper's L and p
SPECTRAL_NAME = "spectral L = {}, p = {}".format(*SPECTRAL)
TOLERANCES = (1e-3, 1e-6)  # of the automatic rule
PAPER_CUTOFF, PAPER_SPECTRAL = 125.91, 10.00  # mean absolute errors, in a unit the paper does not state
PAPER_BEYOND_FIFTH = 0.7
_LOCKED = (0.0, 0.5, 0.9, 0.95, 0.98, 0.99, 0.999)  # t_d / t_r


@dataclass(frozen=True)
class Settings:
    """Configuration of the study."""

    grids: tuple[Grid, ...]
    decay_dead: tuple[float, ...]  # periods
    dense_random: int  # cells of each grid drawn for the dense check, besides slowest and worst
    bins: int = 1024
    sigma_ns: float = 0.5
    seed: int = 20264

    def system(self, period_ns: float, dead_ns: float) -> System:
        """The system of a cell. Its cycles do not enter: these are statistics of holding times."""
        return system_of(dead_ns, 1000, period_ns=period_ns, bins=self.bins, sigma_ns=self.sigma_ns)


FULL = Settings(
    grids=(
        *paper_grids(8, WIDE_NS, NEAR_NS),
        Grid("locked", PERIOD_NS, log_points(8), tuple(PERIOD_NS * d for d in _LOCKED)),
    ),
    decay_dead=(0.0, 0.1875, 0.5, 0.6375, 0.95, 0.99),
    dense_random=2,
)

QUICK = Settings(
    grids=(
        Grid("wide", PERIOD_NS, log_points(2), (50.0,)),
        Grid("locked", PERIOD_NS, log_points(2), (0.0, 0.95 * PERIOD_NS)),
    ),
    decay_dead=(0.0, 0.6375, 0.95),
    dense_random=0,
    bins=256,
    sigma_ns=2.0,
)


@dataclass(frozen=True, eq=False)
class Cell:
    """One pixel: times in ns, covariances in ns^2; `sums` by rule, `rules` the (L, p) of the automatic."""

    grid: Grid
    signal: float
    background: float
    dead_ns: float
    rearm: Rearm
    terms: LeadingTerms
    sizes: FloatArray
    sums: dict[str, float]
    rules: dict[str, tuple[int, int]]

    @property
    def slowness(self) -> float:
        """Magnitude of the second eigenvalue."""
        return float(self.sizes[1])

    def error(self, rule: str) -> float:
        """What `rule` misses of the sum, ns^2: its sum less the exact one."""
        return self.sums[rule] - self.terms.exact_sum

    def relative_error(self, rule: str) -> float:
        """Error of sigma^2, and so of the variance of the count, by `rule`: 2 error / sigma^2."""
        return 2.0 * self.error(rule) / self.terms.sigma2

    def name(self) -> str:
        """S, B and t_d in words."""
        periods = self.dead_ns / self.grid.period_ns
        return f"S = {self.signal:.3g}, B = {self.background:.3g}, t_d = {periods:.4g} t_r"


def cutoff_name(cutoff: int) -> str:
    """Name of the rule that sums the first `cutoff` lags."""
    return f"cut-off {cutoff}"


def automatic_name(tolerance: float) -> str:
    """Name of the automatic rule (4.3) at a tolerance."""
    return f"automatic {tolerance:.0e}"


def compute(settings: Settings, rearm: Rearm, tell: Tell) -> list[Cell]:
    """Every cell of every grid; none is skipped, one that fails raises."""
    cells = []
    for grid in settings.grids:
        for dead_ns in grid.dead_ns:
            system = settings.system(grid.period_ns, dead_ns)
            for signal, background in zip(*grid.cells, strict=True):
                cells.append(_cell(settings, grid, system, float(signal), float(background), rearm))
        tell(f"covariance: grid {grid.name}, re-arming at the {rearm}: {grid.size} cells")
    return cells


def one_cell(settings: Settings, signal: float, background: float, dead_periods: float, rearm: Rearm) -> Cell:
    """A cell outside of the grids, at the period of the canonical system."""
    grid = Grid("single", PERIOD_NS, (), (dead_periods * PERIOD_NS,))
    system = settings.system(PERIOD_NS, grid.dead_ns[0])
    return _cell(settings, grid, system, signal, background, rearm)


def _cell(settings: Settings, grid: Grid, system: System, signal: float, background: float, rearm: Rearm) -> Cell:
    full = holding_time_covariance(
        Flux(signal, background, 0.5 * system.period_ns), system, lags=CUTOFFS[-1], rearm=rearm, bins=settings.bins
    )
    terms = LeadingTerms.of(full)
    sums = {cutoff_name(c): terms.cutoff_sum(c) for c in CUTOFFS}
    sums[SPECTRAL_NAME] = terms.spectral_sum(*SPECTRAL)
    rules = {}
    for tolerance in TOLERANCES:
        rule = terms.automatic_rule(tolerance)
        rules[automatic_name(tolerance)] = rule
        sums[automatic_name(tolerance)] = terms.spectral_sum(*rule)
    sizes = np.abs(terms.eigenvalues)
    return Cell(grid, signal, background, system.detector.dead_time_ns, rearm, terms, sizes, sums, rules)
