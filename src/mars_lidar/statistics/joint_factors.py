"""The feedback equation of one pixel on one grid, and its solution by sparse factors, where sweeps take too many.

Equation numbers are those of docs/joint_law.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.phase_chain_operator import ConvergenceError

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


MOST_FACTORED = 2**14  # bins of an equation that is factorised: a second
GOOD = 1e-9  # relative residual with which a solution is accepted


@dataclass(eq=False)
class FeedbackEquation:
    """The equation (4.4) of one pixel on n bins; dead time K + (d + f)/n periods; `response` (6, n) is (4.1)."""

    whole: int
    shift: int
    fraction: float
    response: FloatArray

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
        """(2, n) of what registrations `x` (2, n) re-arm in each bin, its two parts weighted."""
        a, b = self.maps
        stays, goes_on = a @ np.roll(x, self.shift, -1), b @ np.roll(x, self.shift + 1, -1)
        return np.asarray(np.asarray(near) * stays + np.asarray(far) * goes_on, dtype=np.float64)

    def blind(self, x: FloatArray) -> FloatArray:
        """(n,) registrations that keep the pixel blind at the start of each bin, whole periods included (4.3)."""
        mass, n, d = x[0], self.bins, self.shift
        below = np.concatenate([[0.0], np.cumsum(np.concatenate([mass, mass]))])
        j = np.arange(n)
        last = (self.maps[1] @ np.roll(x, d + 1, -1))[0]
        return np.asarray(below[j + n] - below[j + n - d] + last + self.whole * mass.sum())

    def apply(self, x: FloatArray) -> FloatArray:
        """The left side of (4.4), without whole periods of dead time, by prefix sums: no code of the sweeps."""
        pa, p0, p1, qa, q0, q1 = self.response
        total, slope = self.rearmed(x)
        blind = self.blind(x) - self.whole * x[0].sum()
        return np.array([x[0] + pa * blind - p0 * total - p1 * slope, x[1] + qa * blind - q0 * total - q1 * slope])


def factorised(grid: FeedbackEquation) -> Callable[..., FloatArray]:
    """Sparse factors of (5.4) with the windows of worths as further unknowns: few entries in every row.

    The window that the others follow from sums many bins: that one full row would fill the factors. So it is held
    at 0 in them, and put back as a change of rank one. That is well conditioned where the pixel's state is all but
    certain: behind the brightest light. Other places are tried where a solution shows that it is not.
    """
    if grid.bins > MOST_FACTORED:
        raise ConvergenceError(
            f"sweeps do not solve the feedback equation, and it is too large to be factorised on {grid.bins} bins"
        )
    lit = grid.response[0]
    peak = int(np.argmax(lit))
    dim = np.roll(lit, -peak) <= lit.min() + 1e-3 * (lit.max() - lit.min())
    behind = (peak + int(np.argmax(dim))) % grid.bins
    best, least = None, np.inf
    for place in dict.fromkeys((behind, 0, peak, (peak + grid.bins // 2) % grid.bins)):
        solve = _factors_at(grid, place)
        source = grid.response[[0, 3]]
        x = np.zeros_like(source)
        for _ in range(2):
            rest = np.concatenate([(source - grid.apply(x)).reshape(-1), np.zeros(grid.bins)])
            x = x + solve(rest, trans="T")[: 2 * grid.bins].reshape(2, -1)
        left = left_over(source - grid.apply(x), x)
        if best is None or left < least:
            best, least = solve, left
        if least <= 0.1 * GOOD:
            break
    assert best is not None
    return best


def _factors_at(grid: FeedbackEquation, place: int) -> Callable[..., FloatArray]:
    """Factors with the window before bin `place` held, and put back."""
    from scipy.sparse.linalg import splu

    n, d = grid.bins, grid.shift
    turned = replace(grid, response=np.ascontiguousarray(np.roll(grid.response, -place, axis=1)))
    pa, qa = turned.response[0], turned.response[3]
    row, matrix = np.zeros(3 * n), _matrix(turned)
    row[:d], row[n : n + d] = -pa[:d], -qa[:d]
    order = np.arange(3 * n).reshape(3, n).T.reshape(-1)  # bin after bin: entries near the diagonal
    try:
        factors: Any = splu(matrix[order][:, order])
    except RuntimeError as error:  # SuperLU's word for an exactly singular matrix
        raise ConvergenceError(f"the feedback equation is singular: {error}") from None

    def bare(right: FloatArray, trans: str) -> FloatArray:
        out, ordered = np.empty_like(right), np.ascontiguousarray(right[order])
        out[order] = factors.solve(ordered, trans=trans)
        return out

    one = np.zeros(3 * n)
    one[2 * n] = 1.0
    change = {"N": (bare(one, "N"), row), "T": (bare(row, "T"), one)}

    def whole(right: FloatArray, trans: str = "N") -> FloatArray:
        three = right.reshape(3, n, -1)
        out = bare(np.roll(three, -place, axis=1).reshape(3 * n, -1), trans)
        step, weight = change[trans]
        out -= step[:, None] * (weight @ out / (1.0 + weight @ step))
        return np.asarray(np.roll(out.reshape(3, n, -1), place, axis=1).reshape(right.shape))

    return whole


def _matrix(grid: FeedbackEquation) -> csc_matrix:
    """The equations without the sum over a window in row 2 n, the window before the first bin."""
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


def left_over(rest: FloatArray, x: FloatArray) -> float:
    """Largest residual `rest` of a solution `x`, relative to its largest value; infinite of none where there is one."""
    size, left = float(np.abs(x).max()), float(np.abs(rest).max())
    return left / size if size > 0.0 else math.inf if left != 0.0 else 0.0
