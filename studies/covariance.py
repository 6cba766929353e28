"""T4 of the MaRS paper (arXiv 2512.04924): covariances of holding times and the truncation of their sum.

What each rule leaves out of gamma_1 + gamma_2 + ... in every cell of declared grids over (S, B, t_d), against
the sum without truncation. Equation numbers refer to docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.statistics import HoldingTimeCovariance, holding_time_covariance
from mars_lidar.statistics.chain import Rearm
from studies import Tell
from studies.modes import LeadingTerms

FloatArray = NDArray[np.float64]

CUTOFFS = (*range(21), 25, 30, 40, 50, 75, 100, 150, 200, 300, 500)
SPECTRAL = (6, 5)  # the paper's L and p
TOLERANCES = (1e-3, 1e-6)  # of the automatic rule
PERIOD_NS = 1e3 / 7.5


@dataclass(frozen=True)
class Grid:
    """A grid of cells: every S with every B and every dead time."""

    name: str
    period_ns: float
    signal: tuple[float, ...]
    background: tuple[float, ...]
    dead_ns: tuple[float, ...]

    @property
    def size(self) -> int:
        """Number of cells."""
        return len(self.signal) * len(self.background) * len(self.dead_ns)


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
        return System(
            period_ns=period_ns,
            cycles=1000,
            bins=self.bins,
            pulse=GaussianPulse(sigma_ns=self.sigma_ns),
            detector=Detector(dead_time_ns=dead_ns),
        )


def _log(points: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.geomspace(0.01, 10.0, points))


def _linear(points: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.linspace(0.01, 10.0, points))


def _periods(*dead: float) -> tuple[float, ...]:
    return tuple(d * PERIOD_NS for d in dead)


FULL = Settings(
    grids=(
        Grid("wide", PERIOD_NS, _log(8), _log(8), (25.0, 50.0, 75.0, 100.0)),
        Grid("near", 100.0, _linear(8), _linear(8), (25.0, 50.0, 75.0)),
        Grid("locked", PERIOD_NS, _log(8), _log(8), _periods(0.0, 0.5, 0.9, 0.95, 0.98, 0.99, 0.999)),
    ),
    decay_dead=(0.0, 0.1875, 0.5, 0.6375, 0.95, 0.99),
    dense_random=2,
)
QUICK = Settings(
    grids=(
        Grid("wide", PERIOD_NS, _log(2), _log(2), (50.0,)),
        Grid("locked", PERIOD_NS, _log(2), _log(2), _periods(0.0, 0.95)),
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


def spectral_name() -> str:
    """Name of the paper's rule."""
    return f"spectral L = {SPECTRAL[0]}, p = {SPECTRAL[1]}"


def automatic_name(tolerance: float) -> str:
    """Name of the automatic rule (4.3) at a tolerance."""
    return f"automatic {tolerance:.0e}"


def compute(settings: Settings, rearm: Rearm, tell: Tell) -> list[Cell]:
    """Every cell of every grid; none is skipped, one that fails raises."""
    cells = []
    for grid in settings.grids:
        for dead_ns in grid.dead_ns:
            system = settings.system(grid.period_ns, dead_ns)
            for signal in grid.signal:
                for background in grid.background:
                    cells.append(_cell(settings, grid, system, signal, background, rearm))
        tell(f"covariance: grid {grid.name}, re-arming at the {rearm}: {grid.size} cells")
    return cells


def one_cell(settings: Settings, signal: float, background: float, dead_periods: float, rearm: Rearm) -> Cell:
    """A cell outside of the grids, at the period of the canonical system."""
    grid = Grid("single", PERIOD_NS, (signal,), (background,), _periods(dead_periods))
    system = settings.system(PERIOD_NS, grid.dead_ns[0])
    return _cell(settings, grid, system, signal, background, rearm)


def _cell(settings: Settings, grid: Grid, system: System, signal: float, background: float, rearm: Rearm) -> Cell:
    full = holding_time_covariance(signal, background, system, lags=CUTOFFS[-1], rearm=rearm, bins=settings.bins)
    terms = LeadingTerms.of(full)
    sums = {cutoff_name(c): terms.cutoff_sum(c) for c in CUTOFFS}
    sums[spectral_name()] = terms.spectral_sum(*SPECTRAL)
    rules = {}
    for tolerance in TOLERANCES:
        rule = terms.automatic_rule(tolerance)
        rules[automatic_name(tolerance)] = rule
        sums[automatic_name(tolerance)] = terms.spectral_sum(*rule)
    sizes = np.abs(terms.eigenvalues)
    return Cell(grid, signal, background, system.detector.dead_time_ns, rearm, terms, sizes, sums, rules)


@dataclass(frozen=True)
class DenseCheck:
    """One cell by the paper's way, dense matrices and LAPACK, beside the O(n) way.

    Differences of sums are relative to sigma^2. `inverse` is what left vectors from inv(V) in place of
    LAPACK's change of sigma^2 by the paper's rule, relative to it; `negative` whether it is below 0.
    """

    cell: Cell
    eigenvalues: float
    spectral: float
    exact: float
    summed: float
    inverse: float
    negative: bool


def dense_checks(settings: Settings, cells: list[Cell], extra: int, tell: Tell) -> list[DenseCheck]:
    """Some cells the paper's way: the slowest at each dead time, the worst, `extra` at random, per grid."""
    found = [_dense_check(cell) for cell in _chosen(settings, cells, extra)]
    tell(f"covariance: {len(found)} cells by dense matrices, re-arming at the {cells[0].rearm}")
    return found


def _chosen(settings: Settings, cells: list[Cell], extra: int) -> Iterator[Cell]:
    random = np.random.default_rng(settings.seed)
    for grid in settings.grids:
        here = [cell for cell in cells if cell.grid is grid]
        slowest = [max((c for c in here if c.dead_ns == d), key=lambda c: c.sizes[1]) for d in grid.dead_ns]
        worst = max(here, key=lambda cell: abs(cell.relative_error(spectral_name())))
        first = slowest if worst in slowest else [*slowest, worst]
        rest = [cell for cell in here if cell not in first]
        yield from first
        for k in random.choice(len(rest), extra, replace=False):
            yield rest[k]


def _dense_check(cell: Cell) -> DenseCheck:
    terms = cell.terms
    dense = HoldingTimeCovariance(**{name: getattr(terms, name) for name in terms.__dataclass_fields__})
    count = SPECTRAL[1] + 1
    reference, found = dense.eigenvalues[:count], terms.eigenvalues[:count]
    apart = np.abs(reference[:, None] - found[None, :]).min(axis=1)
    apart = apart[:-1] if np.abs(reference[-1].imag) > 0 else apart  # the last may be half of a pair
    paper = dense.spectral_sum(*SPECTRAL)
    inverse = _by_inverse(cell)
    sigma2 = terms.sigma2
    return DenseCheck(
        cell,
        eigenvalues=float(apart.max()),
        spectral=2.0 * abs(paper - cell.sums[spectral_name()]) / sigma2,
        exact=2.0 * abs(_by_solve(cell) - terms.exact_sum) / sigma2,
        summed=2.0 * abs(dense.cutoff_sum(3000) - terms.exact_sum) / sigma2,
        inverse=2.0 * (inverse - paper) / sigma2,
        negative=terms.sigma_ss2 + 2.0 * inverse < 0.0,
    )


def _parts(cell: Cell) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Dense P, pi, pi Q_mu - mu pi and Q_mu 1 - mu, all from matrices, in periods (3.7)."""
    from mars_lidar.statistics import moment_matrices

    chain = cell.terms.chain
    pdf = np.asarray(cell.terms.stationary_pdf)
    q_mu = moment_matrices(chain).q_mu
    mean = q_mu.sum(axis=1)
    mu = float(pdf @ mean)
    return chain.dense("rapp"), pdf, pdf @ q_mu - mu * pdf, mean - mu


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
    kept = order[1:count]
    weight = (row @ vectors[:, kept]) * (inverse[kept] @ value)
    tail = np.sum(weight * values[kept] ** SPECTRAL[0] / (1.0 - values[kept]))
    return cell.terms.cutoff_sum(SPECTRAL[0]) + float(tail.real) * cell.grid.period_ns**2
