"""Axes refined until the error between their points is below a stated one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.table.axes import MAX_POINTS, inserted, midpoints, thinned
from mars_lidar.table.entries import Entries
from mars_lidar.table.error import _LEAST_SPREAD, _TV_MEAN, _TV_VARIANCE
from mars_lidar.table.lookup import evaluate
from mars_lidar.table.start_phase import StartPhases

Evaluate = Callable[[FloatArray, FloatArray], Entries]

_LINES = 8  # values of the other axis at which one is looked at
_ROUNDS = 12


def refined_axes(
    signal: FloatArray, background: FloatArray, evaluated: Evaluate, goal: float
) -> tuple[FloatArray, FloatArray]:
    """Axes with points inserted, where the error in the middle between two is above half of `goal`.

    The error is in total variation, of the count law (two normal laws to first order) and of the shape; half of it
    for each axis. Looked at along a few lines in the direction of each axis, in the canonical delay.
    """
    lines = _lines(background)
    signal = _refined(signal, lambda s: evaluated(np.repeat(s, lines.size), np.tile(lines, s.size)), lines, goal)
    across = _lines(signal)
    background = _refined(
        background, lambda b: evaluated(np.tile(across, b.size), np.repeat(b, across.size)), across, goal
    )
    return signal, background


def _lines(axis: FloatArray) -> FloatArray:
    positive = axis[axis > 0]
    span = np.log(positive[-1] / positive[0]) if positive.size else 0.0
    some = axis[thinned(axis, max(span / (_LINES - 1), 1e-9))]
    return some[some > 0] if positive.size else some


def _refined(axis: FloatArray, along: Callable[[FloatArray], Entries], lines: FloatArray, goal: float) -> FloatArray:
    """One axis. `along` evaluates points x lines; lines are the exact nodes of a table's second axis here."""
    for _ in range(_ROUNDS):
        if axis.size < 2:
            return axis
        between = midpoints(axis)
        nodes, exact = along(axis), along(between)
        rows, weights, cumulants = evaluate(
            (axis, lines),
            nodes.cumulants,
            StartPhases.none(),
            True,
            np.repeat(between, lines.size),
            np.tile(lines, between.size),
            np.zeros(between.size * lines.size),
            False,
            1,
        )
        scale = np.maximum(np.sqrt(exact.cumulants[:, 1]), _LEAST_SPREAD)
        off = np.abs(cumulants - exact.cumulants)
        law = _TV_MEAN * off[:, 0] / scale + _TV_VARIANCE * off[:, 1] / scale**2
        mixed = np.stack([w @ nodes.shape[r] for r, w in zip(rows, weights, strict=True)])
        shape = 0.5 * np.abs(mixed - exact.shape).sum(-1)
        bad = np.maximum(law, shape).reshape(between.size, lines.size).max(1) > 0.5 * goal
        if not bad.any():
            return axis
        if axis.size + int(bad.sum()) > MAX_POINTS:
            break
        axis = inserted(axis, between[bad])
    raise ValueError(
        f"refine must be an error that {MAX_POINTS} points of an axis and {_ROUNDS} rounds can meet, got {goal:g}: "
        f"{axis.size} points in [{axis[0]:g}, {axis[-1]:g}] do not meet it; choose a larger error or a smaller range"
    )
