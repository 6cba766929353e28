"""The folded exposure of one pixel on one grid: registrations, their noise, and what a window feels of it.

Equation numbers are those of docs/joint_law.md. Arrays of the two numbers of a bin (mass and first moment, 4.1)
are (..., 2, n).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.grid import whole_bins
from mars_lidar.statistics.joint_factors import GOOD, FeedbackEquation, factorised, left_over
from mars_lidar.statistics.phase_chain_operator import ConvergenceError

_CHECKED = 3  # windows of those that are solved together, by a residual: first, last and between
_SWEEPS = 200  # beyond, a factorisation is cheaper
_TOLERANCE = 1e-10  # of a solution, relative to its largest value


@dataclass(eq=False)
class FoldedGrid(FeedbackEquation):
    """The exposure of one pixel on n bins. Made by `FoldedGrid.of`.

    `sweeps` tells what the slowest solution so far took, `residual` what the worst of those that were checked left.
    """

    cycles: int = 1
    warm: bool = False
    sweeps: int = 0
    residual: float = 0.0
    direct: bool = False
    unproven: int = 2  # transposed solutions by sweeps that are still to be checked by `residual`; later ones are alike

    @classmethod
    def of(cls, cells: Cells, bins: int) -> FoldedGrid:
        """The only cell of `cells` on `bins` bins."""
        from mars_lidar._base.native import _core

        system = cells.system
        whole, shift, fraction = whole_bins(system.dead_time_periods, bins)
        if system.start == "armed":  # a dead time beyond the end of the exposure is as good as one up to it
            whole = min(whole, system.cycles)
        energy, row = cells.energies(bins)
        signal, background = cells.native_flux
        photons = signal[0] * energy[row[0]] + background[0] / energy.shape[-1]
        response = np.empty((6, bins))
        _core.joint_response(photons, response)
        return cls(whole, shift, fraction, response, system.cycles, system.start == "stationary")

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
        """(2, n) and its total worth: the transposed solution for a window of ones."""
        y = self._adjoint(np.ones((1, self.bins)), None, _TOLERANCE)[0]
        return y, float(self.worth(y).sum())

    def worth(self, y: FloatArray) -> FloatArray:
        """(..., n) what being armed at the start of a bin is worth: alpha of (5.3)."""
        return np.asarray(self.response[0] * y[..., 0, :] + self.response[3] * y[..., 1, :])

    def adjoint(self, mass: FloatArray, moment: FloatArray | None = None, tolerance: float = _TOLERANCE) -> FloatArray:
        """(m, 2, n) solution of the transposed equations (5.4) for sources (m, n)."""
        y = self._adjoint(mass, moment, tolerance)
        if self.whole:
            flat, total = self._flat
            share = self.whole * self.worth(y).sum(-1) / (1.0 + self.whole * total)
            y -= share[:, None, None] * flat
        return y

    def _forward(self, source: FloatArray) -> FloatArray:
        from mars_lidar._base.native import _core

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
                sweeps=_SWEEPS,
                tolerance=_TOLERANCE,
            )
            x = np.ascontiguousarray(out.T)
            self.direct = not (error <= _TOLERANCE and left_over(source - self.apply(x), x) <= GOOD)
            self.sweeps = max(self.sweeps, int(done))
        if self.direct:
            x = np.zeros((2, self.bins))
            for _ in range(2):  # the second round takes away the rounding of the first
                rest = np.concatenate([(source - self.apply(x)).reshape(-1), np.zeros(self.bins)])
                x = x + self._factors(rest, trans="T")[: 2 * self.bins].reshape(2, -1)
        self._judge(source - self.apply(x), x)
        return x

    def _adjoint(self, mass: FloatArray, moment: FloatArray | None, tolerance: float) -> FloatArray:
        from mars_lidar._base.native import _core

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
                sweeps=_SWEEPS,
                tolerance=tolerance,
                done=done,
                error=error,
            )
            y[:, 0], y[:, 1] = first, second
            self.direct = not (error <= tolerance).all()
            self.sweeps = max(self.sweeps, int(done.max()))
            if self.unproven > 0 and moment is None and not self.direct:
                some = np.linspace(0, m - 1, min(m, _CHECKED)).astype(np.int64)
                rest = -self._apply_transposed(y[some])
                rest[:, 0] += mass[some]
                self.unproven -= 1
                self.direct = not left_over(rest, y[some]) <= GOOD
                if not self.direct:
                    self._judge(rest, y[some])
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
            self._judge(source - self._apply_transposed(y), y)
        return y

    def _judge(self, rest: FloatArray, x: FloatArray) -> None:
        left = left_over(rest, x)
        self.residual = max(self.residual, left)
        if not left <= GOOD:
            raise ConvergenceError(f"the feedback equation is left with a relative residual of {left:.1e}")

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
        """Solves the equations for right sides (3 n, m), by factors that are made once."""
        return factorised(self)
