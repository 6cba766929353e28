"""Count laws matched to four given cumulants, for tables that store only these cumulants of the exact law.

The law is defined in native/laws/matched_law.h, from which the engines draw. This module gives its probabilities and a
criterion for its accuracy.
"""

from __future__ import annotations

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.resources import thread_count
from mars_lidar._base.types import ArrayLike, FloatArray, IndexArray, NDArray
from mars_lidar.statistics.pmf import Pmf
from mars_lidar.statistics.tolerances import TOL


def matched_pmf(cumulants: ArrayLike, *, threads: int | None = None) -> list[Pmf]:
    """Probabilities of the laws on the integers n >= 0 that have four given cumulants.

    Parameters
    ----------
    cumulants
        (cells, 4) mean in [0, 1e15], variance >= 0, third and fourth cumulant. Cumulants that no integer variable
        can have (such as a smaller variance than its mean permits) give a law with similar ones.
    threads
        Threads to run on; default: all processors that this process may use.

    Returns
    -------
    list of Pmf
        One for each cell.

    Raises
    ------
    ValueError
        For cumulants out of range, or a law too wide to be listed (a variance above 1e12).

    Notes
    -----
    There are three forms. (1) For a variance of 9 or more, or a smooth law, quantiles are those of E. A. Cornish and
    R. A. Fisher (1938) to the fourth cumulant, rounded, with Sheppard's corrections. (2) For few photons, mode locking
    and saturation the law is that of an integer plus a Panjer variable minus a Poisson variable (or the mirror image),
    times a polynomial. (3) For the smallest variance that an integer can have it consists of two integers. `trusted`
    states where the result is close to the exact law.
    """
    given, team = _checked(cumulants), thread_count(threads)
    first, last, _ = _support(given, team)
    size = last - first + 1
    if (size > TOL.most_counts).any():
        k = int(size.argmax())
        raise ValueError(
            f"cumulants[{k}] must have a variance for which {TOL.most_counts} counts suffice, got {given[k, 1]:g}"
        )
    start = np.concatenate([[0], np.cumsum(size)])
    flat = np.empty(int(start[-1]))
    _core.matched_pmf(cumulants=given, first=first, start=start, out=flat, threads=team)
    return [Pmf(int(first[k]), flat[start[k] : start[k + 1]].copy(), TOL.matched_outside) for k in range(first.size)]


def trusted(cumulants: ArrayLike, *, threads: int | None = None) -> NDArray[np.bool_]:
    """Whether the law of `matched_pmf` is within a total variation of 0.002 of the exact law: (cells,).

    The criterion uses the cumulants (cells, 4) alone; docs/studies/law.md gives its error rate.
    """
    return _support(_checked(cumulants), thread_count(threads))[2]


def _checked(cumulants: ArrayLike) -> FloatArray:
    given: FloatArray = np.ascontiguousarray(cumulants, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] != 4:
        raise ValueError(f"cumulants must be of shape (cells, 4), got {given.shape}")
    bad = ~np.isfinite(given).all(-1) | (given[:, 0] < 0) | (given[:, 0] > TOL.most_mean) | (given[:, 1] < 0)
    if bad.any():
        k = int(bad.argmax())
        raise ValueError(
            f"cumulants[{k}] must be finite with a mean in [0, {TOL.most_mean:g}] and a variance >= 0, "
            f"got {given[k].tolist()}"
        )
    return given


def _support(given: FloatArray, team: int) -> tuple[IndexArray, IndexArray, NDArray[np.bool_]]:
    """First and last listed count of each law, and whether it is trusted: (cells,) each."""
    cells = len(given)
    first, last, close = np.empty(cells, np.int64), np.empty(cells, np.int64), np.empty(cells, np.bool_)
    _core.matched_support(cumulants=given, first=first, last=last, trusted=close, threads=team)
    return first, last, close
