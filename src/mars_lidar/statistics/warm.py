"""The state that a warmed-up exposure begins with, where sweeps do not find it: by the feedback equation.

Many background photons in a dead time make the pixel a clock that forgets its phase in thousands of periods. The
recursion of docs/theory_exposure.md, section 6, then takes as long to reach its fixed point; that is also the solution
of one well conditioned sparse equation (docs/joint_law.md, 4), on the same grid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.statistics.phase_chain_operator import ConvergenceError

if TYPE_CHECKING:
    from mars_lidar.statistics.cells import Cells

NOT_WARM = -3  # the native core's code: the warm state was not found


def warm_history(cells: Cells, which: IndexArray, bins: int) -> FloatArray:
    """Warm states (n, 2 bins + 2) of some cells as the native core takes them.

    Mass and moment of the registrations of one period in each bin, the probability of being armed at its start, and the
    registrations of the last d + f bins.
    """
    from mars_lidar.statistics.joint_grid import FoldedGrid

    out = np.empty((which.size, 2 * bins + 2))
    for row, k in zip(out, which, strict=True):
        try:
            grid = FoldedGrid.of(cells.part(np.array([k])), bins)
            state = grid.state
        except ConvergenceError as error:
            raise ConvergenceError(f"stationary state of {cells.name(int(k))}: {error}; {cells.instead}") from None
        tail = float(grid.blind(state)[0]) - grid.whole * float(state[0].sum())
        row[:-2] = state.T.reshape(-1)
        row[-2:] = max(1.0 - tail - grid.whole * float(state[0].sum()), 0.0), tail
    return out
