"""Building a table: entries, start-phase corrections, refinement of the axes, and the check at the end."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.memory import check_memory
from mars_lidar._base.progress import of_part, shown
from mars_lidar._base.threads import thread_count
from mars_lidar._base.types import FloatArray, Progress
from mars_lidar._version import __version__
from mars_lidar.instrument.system import System
from mars_lidar.statistics.chain import Rearm
from mars_lidar.statistics.gate import require_mode
from mars_lidar.table.axes import MAX_POINTS, PAPER_GRID, Grid, axis_values, describe, inserted, midpoints, thinned
from mars_lidar.table.entries import Entries
from mars_lidar.table.error import (
    QuantisationError,
    deviations,
    law_error,
    law_variation,
    long_error,
    quantisation_error,
)
from mars_lidar.table.lookup import evaluate
from mars_lidar.table.node_laws import NodeLaws, node_laws
from mars_lidar.table.nodes import Method, N, Nodes
from mars_lidar.table.recipe import Recipe
from mars_lidar.table.start_phase import StartPhases, start_phases
from mars_lidar.table.storage import request_key

_METHODS, _REARMS = ("exposure", "mars"), ("centre", "edge")
_ERROR_SAMPLES = 128  # pixels on which a table is checked when it is built
_ATTEMPTS = 4  # of refining, each with half the error of the one before

_LINES = 8  # values of the other axis at which one is looked at
_ROUNDS = 12

Axes = tuple[FloatArray, FloatArray]
Evaluate = Callable[[FloatArray, FloatArray], Entries]


class Built(Nodes):
    """Nodes that are evaluated."""

    @classmethod
    def build(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        *,
        method: Method = "exposure",
        rearm: Rearm = "centre",
        refine: float | None = None,
        tolerance: float = 1e-4,
        check_law: bool = False,
        threads: int | None = None,
        progress: Progress | bool | None = None,
    ) -> Self:
        """Evaluate every entry.

        Parameters
        ----------
        system
            Laser, detector and histogram. Its detection efficiency and dark counts are left out (`System.detected`).
        signal, background
            Axes, detected photons per period (`Flux.detected`): ``(low, high, points)`` for 0 and `points` log-spaced
            values, or an array of values taken as it is. Between 0 and the next value everything is interpolated
            linearly.
        method
            ``"exposure"``: exact statistics of the finite exposure. ``"mars"``: the paper's, Markov chain and
            Gaussian of the Markov-renewal law, asymptotic in the exposure.
        rearm
            ``"centre"`` or ``"edge"`` of the bin, for ``"mars"``.
        refine
            Error in total variation, in [1e-5, 0.1]: points are inserted until the table meets it between its
            nodes (`QuantisationError.largest`). None: the axes as they are.
        tolerance
            Of each entry, for ``"exposure"``: see `exposure_moments`.
        check_law
            Compare the counts drawn from the table with exact laws as well (`law_error`), and keep the result.
        threads
            Threads to run on; default: all processors that this process may use.
        progress
            Called as ``progress(done, total)``; an exception from it stops the build.

        Raises
        ------
        ValueError, TypeError
            Naming the argument, before any work; or where `refine` cannot be met.
        ConvergenceError
            Naming the cell that could not be evaluated.
        """
        if not isinstance(system, System):
            raise TypeError(f"system must be a System, got {type(system).__name__}")
        require_mode("a table", system)
        system = system.detected()  # its axes are detected photons
        axes = axis_values("signal", signal), axis_values("background", background)
        checks.choice("method", method, _METHODS)
        checks.choice("rearm", rearm, _REARMS)
        if rearm != "centre" and method != "mars":
            raise ValueError(f"rearm must be 'centre' for method {method!r}, which has no such choice, got {rearm!r}")
        goal = None if refine is None else checks.real("refine", refine, low=1e-5, high=0.1)
        tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
        if not isinstance(check_law, bool):
            raise TypeError(f"check_law must be True or False, got {check_law!r}")
        progress = shown(progress, "building a table")
        recipe = Recipe(method, rearm, tolerance, thread_count(threads))
        began = time.perf_counter()
        if goal is None:
            table = _evaluated(cls, system, axes, recipe, progress)
            error = quantisation_error(table, samples=_ERROR_SAMPLES, threads=recipe.threads)
        else:
            table, error = _refined(cls, system, axes, recipe, goal, progress)
        longest = long_error(table, _ERROR_SAMPLES, recipe.threads)
        law = law_error(table, threads=recipe.threads).to_dict() if check_law else None
        table.provenance.update(
            key=request_key(system, axes, method=method, rearm=rearm, refine=goal, tolerance=tolerance),
            refine=goal,
            error=error.to_dict(),
            error_longest=None if longest is None else longest.to_dict(),
            law=law,
            build_s=time.perf_counter() - began,
        )
        return table


def _evaluated(make: type[N], system: System, axes: Axes, recipe: Recipe, progress: Progress | None) -> N:
    signal, background = axes
    check_memory(
        2 * 4 * signal.size * background.size * system.bins,
        f"tables of {signal.size} x {background.size} x {system.bins}",
        "take fewer points or bins",
    )
    cells = signal.size * background.size
    settled = cells + max(1, cells // 10)  # the start phases take about so much of the time
    total = settled + max(1, cells // 20)  # and the laws of some entries so much
    entries = recipe.entries(
        np.repeat(signal, background.size),
        np.tile(background, signal.size),
        system,
        of_part(progress, 0, cells, total),
    )
    phases, laws = StartPhases.none(), NodeLaws.none()
    if recipe.method == "exposure":
        phases = start_phases(
            system,
            signal,
            background,
            entries.cumulants,
            entries.bins,
            threads=recipe.threads,
            progress=of_part(progress, cells, settled, total),
        )
        laws = node_laws(
            system,
            signal,
            background,
            entries,
            threads=recipe.threads,
            progress=of_part(progress, settled, total, total),
        )
    if progress is not None:
        progress(total, total)
    provenance = {"version": __version__, "signal": describe(signal), "background": describe(background)}
    return make(
        system, recipe.method, signal, background, recipe.rearm, recipe.tolerance, provenance, entries, phases, laws
    )


def _refined(
    make: type[N], system: System, axes: Axes, recipe: Recipe, goal: float, progress: Progress | None
) -> tuple[N, QuantisationError]:
    inner = goal
    for _ in range(_ATTEMPTS):
        axes = _refined_axes(*axes, lambda s, b: recipe.entries(s, b, system), inner)
        table = _evaluated(make, system, axes, recipe, progress)
        error = quantisation_error(table, samples=4 * _ERROR_SAMPLES, threads=recipe.threads)
        if error.largest <= goal:
            return table, error
        inner *= 0.5
    raise ValueError(
        f"refine must be an error that can be met, got {goal:g}: reached {error.largest:.2g} with "
        f"{axes[0].size} x {axes[1].size} points at S = {error.worst_signal:g}, B = {error.worst_background:g}"
    )


def _refined_axes(
    signal: FloatArray, background: FloatArray, evaluated: Evaluate, goal: float
) -> tuple[FloatArray, FloatArray]:
    """Axes with points inserted, where the error in the middle between two is above half of `goal`.

    The error is in total variation, of the count law (two normal laws to first order) and of the shape; half of it
    for each axis. Looked at along a few lines in the direction of each axis, in the canonical delay.
    """
    lines = _lines(background)
    signal = _refined_axis(signal, lambda s: evaluated(np.repeat(s, lines.size), np.tile(lines, s.size)), lines, goal)
    across = _lines(signal)
    background = _refined_axis(
        background, lambda b: evaluated(np.tile(across, b.size), np.repeat(b, across.size)), across, goal
    )
    return signal, background


def _lines(axis: FloatArray) -> FloatArray:
    positive = axis[axis > 0]
    span = np.log(positive[-1] / positive[0]) if positive.size else 0.0
    some = axis[thinned(axis, max(span / (_LINES - 1), 1e-9))]
    return some[some > 0] if positive.size else some


def _refined_axis(
    axis: FloatArray, along: Callable[[FloatArray], Entries], lines: FloatArray, goal: float
) -> FloatArray:
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
        law = law_variation(deviations(cumulants, exact.cumulants))
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
