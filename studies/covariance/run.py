"""Study "covariance", T4 of the MaRS paper (arXiv 2512.04924): covariances of holding times, and truncating their sum.

What each rule leaves out of gamma_1 + gamma_2 + ... in every cell of declared grids over (S, B, t_d), against
the sum without truncation; some cells by dense matrices and LAPACK, a check of the O(n) way. Equation numbers refer
to docs/theory.md, section 4.

The paper decomposes the dense matrix, seconds a cell at n = 1024; its rule needs five eigenpairs of them. The
implicitly restarted Arnoldi method (ARPACK) finds those from some hundred products in either direction, in
hundredths of a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Self

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import eig

from mars_lidar import Flux, System, holding_time_covariance
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from mars_lidar.statistics import ConvergenceError, HoldingTimeCovariance, PhaseChain
from mars_lidar.statistics.chain import Rearm
from mars_lidar.statistics.renewal import lag_covariances, weighted_waits
from studies import Facts, Request, Tell
from studies.common.draw import legend_below, maps, panels
from studies.common.report import Row, picked
from studies.common.sample import NEAR_NS, PERIOD_NS, WIDE_NS, Grid, log_points, paper_grids, system_of

ComplexArray = NDArray[np.complex128]

_MOST_LAGS, _MOST_MODES = 100_000, 12  # that the automatic rule considers


MODES = 14  # two more than the automatic rule looks at, so that its last pair is whole
_SUBSPACE = 80
_WORST = 1e-11  # residual |P v - lambda v| for |v| = 1 that is refused: measured 1e-13
_PAIRED = 1e-5  # eigenvalues from left and right: with edge re-arming they are worst conditioned, 8e-8
_MATTERS = 0.03  # below it lambda^7 has left the tail


@dataclass(frozen=True, eq=False)
class TruncatedSums(HoldingTimeCovariance):
    """`HoldingTimeCovariance` with its sum by several rules, from the dense transition matrix, O(n^3)."""

    @classmethod
    def of(cls, terms: HoldingTimeCovariance) -> Self:
        """The same cell."""
        return cls(**{field.name: getattr(terms, field.name) for field in fields(HoldingTimeCovariance)})

    def cutoff_sum(self, cutoff: int) -> float:
        """gamma_1 + ... + gamma_cutoff, ns^2: the sum over the first `cutoff` lags (4.1); 0 for none."""
        if cutoff <= self.gamma.size:
            return float(self.gamma[:cutoff].sum())
        return float(lag_covariances(self.chain, self.times, cutoff).sum()) * (self.mu / self.times.mu) ** 2

    @property
    def eigenvalues(self) -> ComplexArray:
        """Eigenvalues of P (bins,), by falling magnitude; the first is 1."""
        return self._modes[0]

    def spectral_sum(self, lags: int = 6, modes: int = 5) -> float:
        """gamma_1 .. gamma_lags exactly, the tail from the leading `modes` eigenvalues, 1 included (4.2).

        Where `modes` would split a conjugate pair, one more mode is taken. The paper's rule is L = 6, p = 5.
        """
        values, weights = self._modes
        count = self._whole_pairs(modes)
        leading, weight = values[1:count], weights[1:count]
        tail = np.sum(weight * leading**lags / (1.0 - leading))
        return self.cutoff_sum(lags) + float(tail.real)

    def automatic_rule(self, tolerance: float = 1e-3) -> tuple[int, int]:
        """The cheapest (lags, modes) whose neglected modes stay below `tolerance` x sigma_ss2 (4.3).

        The neglected part is bounded by the spectral gap: ``|gamma_l| <= sigma_ss2``, and modes beyond the p-th decay
        at least as ``|lambda_(p+1)|^l``. The bound is rigorous for a normal matrix. P is not normal, which affects the
        first lags; at least six of them are therefore summed exactly.
        """
        size = np.abs(self.eigenvalues)
        best: tuple[int, int] | None = None
        for modes in range(1, min(_MOST_MODES, size.size - 1) + 1):
            count = self._whole_pairs(modes)
            next_size = float(size[count]) if count < size.size else 0.0
            if next_size >= 1.0:
                continue
            lags = 6
            if next_size > 0.0:
                lags = max(6, math.ceil(math.log(tolerance * (1.0 - next_size)) / math.log(next_size)))
            if lags <= _MOST_LAGS and (best is None or lags + count < sum(best)):
                best = lags, count
        if best is None:
            raise ArithmeticError(
                f"{self.chain.describe()}: no gap in the first {_MOST_MODES} eigenvalues; use exact_sum"
            )
        return best

    def _whole_pairs(self, modes: int) -> int:
        values = self.eigenvalues
        if modes < values.size and modes > 1:
            last, following = values[modes - 1], values[modes]
            paired = abs(last.imag) > 0 and abs(following - last.conjugate()) <= 1e-9 * abs(last)
            # pairs are ordered (+, -): a count that ends on the first of a pair includes the second
            if paired and np.count_nonzero(values[1:modes].imag) % 2 == 1:
                return modes + 1
        return modes

    @cached_property
    def _modes(self) -> tuple[ComplexArray, ComplexArray]:
        """Eigenvalues and the weights (pi Q_mu v_k)(u_k Q_mu 1) in ns^2, by falling magnitude (4.2)."""
        # not the left eigenvectors of inv(V), with which variances were negative: P is far from normal (4.4)
        decomposition: Any = eig(self.chain.dense(), left=True, right=True)
        values, left_vectors, right_vectors = decomposition
        order = np.argsort(-np.round(np.abs(values), 12), kind="stable")  # keeps conjugates adjacent
        values, left_vectors, right_vectors = values[order], left_vectors[:, order], right_vectors[:, order]
        pdf, times = self.times.stationary.pdf, self.times
        row = weighted_waits(self.chain, pdf) - times.mu * pdf
        with np.errstate(divide="ignore", invalid="ignore"):  # the many modes of lambda = 0 are defective
            overlap = np.sum(left_vectors.conj() * right_vectors, axis=0)
            weights = (row @ right_vectors) * (left_vectors.conj().T @ (times.mean - times.mu)) / overlap
        return values, weights * (self.mu / self.times.mu) ** 2


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
    dense = TruncatedSums.of(terms)
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
    pdf = np.asarray(cell.terms.times.stationary.pdf)
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


_USUAL_CUTOFFS = range(21)  # among these the best fixed one is looked for
_HARD = (10.0, 1.0, 1.0)  # S, B, t_d / t_r


def mean_error(cells: Sequence[Cell], rule: str) -> float:
    """Mean absolute error of the sum by `rule`, ns^2."""
    return float(np.mean([abs(cell.error(rule)) for cell in cells]))


def best_cutoff(cells: Sequence[Cell]) -> int:
    """The fixed cut-off of least mean absolute error among those commonly used, 0 to 20."""
    return min(_USUAL_CUTOFFS, key=lambda c: mean_error(cells, cutoff_name(c)))


def run(settings: Settings, request: Request) -> Facts:
    """Both ways of re-arming on all grids, and the check by dense matrices."""
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
            "decay": decay(settings),
            "eigenvalues": eigenvalues(settings, centre),
            "truncation": truncation(settings, centre),
            "map": error_map(settings, centre),
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
