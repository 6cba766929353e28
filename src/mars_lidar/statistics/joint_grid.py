"""The feedback equation of one pixel on one grid: factors of its matrix, and the folded exposure that solves it.

Equation numbers are those of docs/joint_law.md. Arrays of the two numbers of a bin (mass and first moment, 4.1) are
(..., 2, n). The equation is solved by sweeps, and by sparse factors where sweeps take too many steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.native import _core
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.statistics.cells import Cells, whole_bins
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.tolerances import TOL

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


# --- The feedback equation by sparse factors -----------------------------------------------------------------------


def factorised(grid: FoldedGrid) -> Callable[..., FloatArray]:
    """Solver of (5.4) by sparse factors, with the sliding sums of alpha as further unknowns: few entries in every row.

    The first sliding sum extends over many bins; its full row would make the factors dense. The factors are computed
    with this sum set to 0, and a rank-one update restores it. The update is well conditioned where the state of the
    pixel is nearly certain, which is after the brightest light; if the residual is too large, the sum begins elsewhere.
    """
    if grid.bins > TOL.folded_factored:
        raise ConvergenceError(
            f"sweeps do not solve the feedback equation, and it is too large to be factorised on {grid.bins} bins"
        )
    lit = grid.response[0]
    peak = int(np.argmax(lit))
    dim = np.roll(lit, -peak) <= lit.min() + 1e-3 * (lit.max() - lit.min())
    after_peak = (peak + int(np.argmax(dim))) % grid.bins
    best, least = None, np.inf
    for place in dict.fromkeys((after_peak, 0, peak, (peak + grid.bins // 2) % grid.bins)):
        source = grid.response[[0, 3]]
        x = np.zeros_like(source)
        with np.errstate(all="ignore"):  # factors of a nearly singular matrix are judged by the residual
            solve = _factors_at(grid, place)
            for _ in range(2):
                rest = np.concatenate([(source - grid.apply(x)).reshape(-1), np.zeros(grid.bins)])
                x = x + solve(rest, trans="T")[: 2 * grid.bins].reshape(2, -1)
            error = relative_residual(source - grid.apply(x), x)
        error = math.inf if math.isnan(error) else error
        if best is None or error < least:
            best, least = solve, error
        if least <= 0.1 * TOL.folded_residual:
            break
    assert best is not None
    return best


def _factors_at(grid: FoldedGrid, place: int) -> Callable[..., FloatArray]:
    """Solver whose factors have the sliding sum before bin `place` set to 0, which a rank-one update restores."""
    from scipy.sparse.linalg import splu

    n, d = grid.bins, grid.shift
    turned = replace(grid, response=np.ascontiguousarray(np.roll(grid.response, -place, axis=1)))
    pa, qa = turned.response[0], turned.response[3]
    row, matrix = np.zeros(3 * n), _matrix(turned)
    row[:d], row[n : n + d] = -pa[:d], -qa[:d]
    order = np.arange(3 * n).reshape(3, n).T.reshape(-1)  # bin after bin: entries near the diagonal
    try:
        factors: Any = splu(matrix[order][:, order])
    except RuntimeError as error:  # SuperLU raises it for an exactly singular matrix
        raise ConvergenceError(f"the feedback equation is singular: {error}") from None

    def solve_factors(right: FloatArray, trans: str) -> FloatArray:
        out, ordered = np.empty_like(right), np.ascontiguousarray(right[order])
        out[order] = factors.solve(ordered, trans=trans)
        return out

    unit = np.zeros(3 * n)
    unit[2 * n] = 1.0
    update = {"N": (solve_factors(unit, "N"), row), "T": (solve_factors(row, "T"), unit)}

    def solve(right: FloatArray, trans: str = "N") -> FloatArray:
        by_unknown = right.reshape(3, n, -1)
        out = solve_factors(np.roll(by_unknown, -place, axis=1).reshape(3 * n, -1), trans)
        step, weight = update[trans]
        out -= step[:, None] * (weight @ out / (1.0 + weight @ step))
        return np.asarray(np.roll(out.reshape(3, n, -1), place, axis=1).reshape(right.shape))

    return solve


def _matrix(grid: FoldedGrid) -> csc_matrix:
    """Matrix (3 n, 3 n) of the equations without row 2 n, that of the sliding sum before the first bin."""
    from scipy.sparse import csc_matrix

    pa, p0, p1, qa, q0, q1 = grid.response
    n, d = grid.bins, grid.shift
    near, far = grid.maps
    i = np.arange(n)
    rows: list[NDArray[np.int64]] = []
    columns: list[NDArray[np.int64]] = []
    values: list[FloatArray] = []

    def add(row: NDArray[np.int64], column: NDArray[np.int64], value: FloatArray) -> None:
        rows.append(row)
        columns.append(column)
        values.append(value)

    for k in (0, 1):
        add(i + k * n, i + k * n, np.ones(n))
        for part, away, armed in ((near, d, 0.0), (far, d + 1, far[0, k])):
            j = (i + away) % n
            add(i + k * n, j, armed * pa[j] - part[0, k] * p0[j] - part[1, k] * p1[j])
            add(i + k * n, j + n, armed * qa[j] - part[0, k] * q0[j] - part[1, k] * q1[j])
    add(i, i + 2 * n, np.ones(n))
    rest = i[1:]
    add(i + 2 * n, (i - 1) % n + 2 * n, np.ones(n))  # row i: window after bin i - 1
    add(rest + 2 * n, rest + 2 * n, -np.ones(n - 1))
    for away, sign in ((0, -1.0), (d, 1.0)):
        j = (rest + away) % n
        add(rest + 2 * n, j, sign * pa[j])
        add(rest + 2 * n, j + n, sign * qa[j])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return csc_matrix(entries, shape=(3 * n, 3 * n))


def relative_residual(rest: FloatArray, x: FloatArray) -> float:
    """Ratio of the largest residual `rest` to the largest value of the solution `x`; infinite if only x is 0."""
    size, largest = float(np.abs(x).max()), float(np.abs(rest).max())
    return largest / size if size > 0.0 else math.inf if largest != 0.0 else 0.0


# --- The folded exposure -------------------------------------------------------------------------------------------


@dataclass(eq=False)
class FoldedGrid:
    """The exposure of one pixel on a grid of n bins, and its feedback equation (4.4). Made by `FoldedGrid.of`.

    Attributes
    ----------
    whole, shift, fraction
        The dead time is K + (d + f) / n periods: K, d and f.
    response
        (6, n) responses of the bins to being armed and to re-arming (4.1).
    cycles, warm
        Periods of the exposure; whether it starts in the stationary state.
    sweeps
        Sweeps that the slowest solution so far took.
    residual
        Largest relative residual among the solutions that were checked.
    direct
        Whether sparse factors solve the equation, because the sweeps did not converge.
    unchecked
        Number of further transposed solutions whose residuals are checked; later ones converge in the same way.
    """

    whole: int
    shift: int
    fraction: float
    response: FloatArray
    cycles: int = 1
    warm: bool = False
    sweeps: int = 0
    residual: float = 0.0
    direct: bool = False
    unchecked: int = 2

    @classmethod
    def of(cls, cells: Cells, bins: int) -> FoldedGrid:
        """The grid of the only cell of `cells`, on `bins` bins."""
        system = cells.system
        whole, shift, fraction = whole_bins(system.dead_time_periods, bins)
        if system.start == "armed":  # a dead time beyond the end of the exposure has no further effect
            whole = min(whole, system.cycles)
        energy, row = cells.energies(bins)
        signal, background = cells.native_flux
        photons = signal[0] * energy[row[0]] + background[0] / energy.shape[-1]
        response = np.empty((6, bins))
        _core.joint_response(photons, response)
        return cls(whole, shift, fraction, response, system.cycles, system.start == "stationary")

    @property
    def bins(self) -> int:
        """Bins of the grid n."""
        return int(self.response.shape[1])

    @cached_property
    def maps(self) -> tuple[FloatArray, FloatArray]:
        """The 2 x 2 maps `near` and `far` of a shift by f bins."""
        f = self.fraction
        g, c = f * (1.0 - f), 1.0 - 2.0 * f
        near = [[1.0 - f, -3.0 * g], [g, 0.5 * (1.0 + c**3) - 6.0 * f * g]]
        far = [[f, 3.0 * g], [-g, 0.5 * (1.0 - c**3) - 6.0 * (1.0 - f) * g]]
        return np.array(near), np.array(far)

    def rearmed(self, x: FloatArray, near: ArrayLike = 1.0, far: ArrayLike = 1.0) -> FloatArray:
        """Re-arming (2, n) after registrations `x` (2, n), with weights of the `near` and the `far` of its two bins."""
        a, b = self.maps
        in_near, in_far = a @ np.roll(x, self.shift, -1), b @ np.roll(x, self.shift + 1, -1)
        return np.asarray(np.asarray(near) * in_near + np.asarray(far) * in_far, dtype=np.float64)

    def blind(self, x: FloatArray) -> FloatArray:
        """(n,) registrations within the dead time before the start of each bin, whole periods included (4.3)."""
        mass, n, d = x[0], self.bins, self.shift
        below = np.concatenate([[0.0], np.cumsum(np.concatenate([mass, mass]))])
        j = np.arange(n)
        last = (self.maps[1] @ np.roll(x, d + 1, -1))[0]
        return np.asarray(below[j + n] - below[j + n - d] + last + self.whole * mass.sum())

    def apply(self, x: FloatArray) -> FloatArray:
        """The left side of (4.4), without whole periods of dead time, by prefix sums, independent of the sweeps."""
        pa, p0, p1, qa, q0, q1 = self.response
        total, slope = self.rearmed(x)
        blind = self.blind(x) - self.whole * x[0].sum()
        return np.array([x[0] + pa * blind - p0 * total - p1 * slope, x[1] + qa * blind - q0 * total - q1 * slope])

    def noise(self, x: FloatArray, armed: FloatArray, again: FloatArray) -> FloatArray:
        """(3, n) covariance of the noise of (mass, moment) in a bin: (5.2)."""
        pa, p0, p1, qa, q0, q1 = self.response
        mass, moment = x
        total, slope = again
        return np.array(
            [
                mass - pa**2 * armed - p0**2 * total - 2 * p0 * p1 * slope - p1**2 * total / 3,
                moment - pa * qa * armed - p0 * q0 * total - (p0 * q1 + p1 * q0) * slope - p1 * q1 * total / 3,
                mass / 3 - qa**2 * armed - q0**2 * total - 2 * q0 * q1 * slope - q1**2 * total / 3,
            ]
        )

    @cached_property
    def _unit(self) -> FloatArray:
        """Registrations (2, n) of one armed pixel per bin, whole periods left out: w of (4.5)."""
        return self._forward(self.response[[0, 3]])

    @cached_property
    def state(self) -> FloatArray:
        """Stationary registrations of one period (2, n)."""
        return np.asarray(self._unit / (1.0 + self.whole * self._unit[0].sum()))

    def solve(self, source: FloatArray) -> FloatArray:
        """Registrations (2, n) that follow from `source` (2, n): (4.5)."""
        x = self._forward(source)
        share = self.whole * x[0].sum() / (1.0 + self.whole * self._unit[0].sum())
        return np.asarray(x - share * self._unit)

    @cached_property
    def _flat(self) -> tuple[FloatArray, float]:
        """The transposed solution (2, n) for a window of ones, and its total worth."""
        y = self._adjoint(np.ones((1, self.bins)), None, TOL.folded_change)[0]
        return y, float(self.worth(y).sum())

    def worth(self, y: FloatArray) -> FloatArray:
        """Effect (..., n) of being armed at the start of each bin: alpha of (5.3)."""
        return np.asarray(self.response[0] * y[..., 0, :] + self.response[3] * y[..., 1, :])

    def adjoint(
        self, mass: FloatArray, moment: FloatArray | None = None, tolerance: float = TOL.folded_change
    ) -> FloatArray:
        """(m, 2, n) solution of the transposed equations (5.4) for sources (m, n)."""
        y = self._adjoint(mass, moment, tolerance)
        if self.whole:
            flat, total = self._flat
            share = self.whole * self.worth(y).sum(-1) / (1.0 + self.whole * total)
            y -= share[:, None, None] * flat
        return y

    def _forward(self, source: FloatArray) -> FloatArray:
        source = np.ascontiguousarray(source)
        if not self.direct:
            out = np.empty((self.bins, 2))
            done, error = _core.joint_forward(
                response=self.response,
                shift=self.shift,
                fraction=self.fraction,
                mass_in=source[0],
                moment_in=source[1],
                out=out,
                sweeps=TOL.folded_sweeps,
                tolerance=TOL.folded_change,
            )
            x = np.ascontiguousarray(out.T)
            rest = relative_residual(source - self.apply(x), x)
            self.direct = not (error <= TOL.folded_change and rest <= TOL.folded_residual)
            self.sweeps = max(self.sweeps, int(done))
        if self.direct:
            x = np.zeros((2, self.bins))
            for _ in range(2):  # iterative refinement: the second round removes the rounding error of the first
                right = np.concatenate([(source - self.apply(x)).reshape(-1), np.zeros(self.bins)])
                x = x + self._factors(right, trans="T")[: 2 * self.bins].reshape(2, -1)
        self._check_residual(source - self.apply(x), x)
        return x

    def _adjoint(self, mass: FloatArray, moment: FloatArray | None, tolerance: float) -> FloatArray:
        m, n = mass.shape
        y = np.zeros((m, 2, n))
        mass = np.ascontiguousarray(mass)
        moment = None if moment is None else np.ascontiguousarray(moment)
        if not self.direct:
            first, second = np.empty((m, n)), np.empty((m, n))
            done, error = np.empty(m, np.int64), np.empty(m)
            _core.joint_adjoint(
                response=self.response,
                shift=self.shift,
                fraction=self.fraction,
                mass_in=mass,
                moment_in=moment,
                mass=first,
                moment=second,
                sweeps=TOL.folded_sweeps,
                tolerance=tolerance,
                done=done,
                error=error,
            )
            y[:, 0], y[:, 1] = first, second
            self.direct = not (error <= tolerance).all()
            self.sweeps = max(self.sweeps, int(done.max()))
            if self.unchecked > 0 and moment is None and not self.direct:
                some = np.linspace(0, m - 1, min(m, TOL.folded_checked)).astype(np.int64)
                rest = -self._apply_transposed(y[some])
                rest[:, 0] += mass[some]
                self.unchecked -= 1
                self.direct = not relative_residual(rest, y[some]) <= TOL.folded_residual
                if not self.direct:
                    self._check_residual(rest, y[some])
        if self.direct:
            source = np.zeros((m, 2, n))
            source[:, 0] = mass
            if moment is not None:
                source[:, 1] = moment
            y = np.zeros((m, 2, n))
            for _ in range(2):
                rest = source - self._apply_transposed(y)
                step = self._factors(np.concatenate([rest.reshape(m, -1), np.zeros((m, n))], -1).T)
                y = y + step[: 2 * n].T.reshape(m, 2, n)
            self._check_residual(source - self._apply_transposed(y), y)
        return y

    def _check_residual(self, rest: FloatArray, x: FloatArray) -> None:
        error = relative_residual(rest, x)
        self.residual = max(self.residual, error)
        if not error <= TOL.folded_residual:
            raise ConvergenceError(f"the feedback equation has a relative residual of {error:.1e}")

    def _apply_transposed(self, y: FloatArray) -> FloatArray:
        """The left side of (5.4) for `y` (m, 2, n), without whole periods of dead time."""
        _, p0, p1, _, q0, q1 = self.response
        d, n = self.shift, self.bins
        near, far = self.maps
        armed = self.worth(y)
        again = np.stack([p0 * y[:, 0] + q0 * y[:, 1], p1 * y[:, 0] + q1 * y[:, 1]], 1)
        below = np.concatenate([np.zeros((len(y), 1)), np.cumsum(np.concatenate([armed, armed], -1), -1)], -1)
        i = np.arange(n)
        out = y - near.T @ np.roll(again, -d, -1) - far.T @ np.roll(again, -d - 1, -1)
        out += far[0][:, None] * np.roll(armed, -d - 1, -1)[:, None]
        out[:, 0] += below[:, i + d + 1] - below[:, i + 1]
        return np.asarray(out)

    @cached_property
    def _factors(self) -> Callable[..., FloatArray]:
        """Solver for right sides (3 n, m), by factors that are computed once."""
        return factorised(self)
