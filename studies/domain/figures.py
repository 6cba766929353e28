"""Maps of the domain: where each engine and prediction was verified, refused, too slow, wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from studies.common.draw import WIDTH, panels
from studies.domain.judge import ENGINES, FAILED, HANDED, LAWS, REFUSED, SLOW, UNJUDGED, VERIFIED

_INK = {
    VERIFIED: "#3b78b5",
    HANDED: "#8fc1e3",
    REFUSED: "#c9c9c9",
    SLOW: "#f0a03c",
    UNJUDGED: "#7a7a7a",
    FAILED: "#c4161c",
}
_DOTS = 6  # in a decade, at most: those of one state that would lie on each other are drawn once
_LEAST = {"S": 1e-7, "B": 1e-7, "dead": 1e-4}  # where zeros are drawn
_TITLE = {
    "S": "S (0 at the edge)",
    "B": "B (0 at the edge)",
    "dead": "dead time / period",
    "cycles": "cycles",
    "bins": "bins",
}


def maps(rows: Sequence[dict[str, Any]]) -> dict[str, Figure]:
    """`rows`: a case each, with a state by subject. The figures by name."""
    return {
        "engines": _map(rows, ENGINES, "S", "dead"),
        "engines_exposure": _map(rows, ENGINES, "B", "cycles"),
        "laws": _map(rows, LAWS[:5], "S", "dead"),
        "laws_exposure": _map(rows, LAWS[:5], "cycles", "bins"),
        "modes": _modes(rows),
    }


def _map(rows: Sequence[dict[str, Any]], subjects: Sequence[str], x: str, y: str) -> Figure:
    """A scatter plot for each subject, over two quantities."""
    figure, axes = panels(2.3, 1, len(subjects))
    for ax, subject in zip(axes[0], subjects, strict=True):
        for state, ink in _INK.items():
            some = [row for row in rows if row.get(subject) == state]
            at = np.array([[max(float(row[key]), _LEAST.get(key, 1.0)) for key in (x, y)] for row in some])
            if state == FAILED:
                ax.scatter(*at.reshape(-1, 2).T, s=14, marker="x", c=ink, lw=0.9, zorder=3)
            else:
                dots = np.unique(np.round(np.log10(at.reshape(-1, 2)) * _DOTS, 0), axis=0)
                ax.scatter(*10.0 ** (dots.T / _DOTS), s=2.5, marker="o", c=ink, lw=0, zorder=1 + (state == SLOW))
        ax.set(xscale="log", yscale="log")
        ax.set_xlabel(_TITLE[x], fontsize=7)
        ax.set_title(subject, fontsize=8)
        ax.tick_params(labelsize=6, which="both")
    axes[0, 0].set_ylabel(_TITLE[y], fontsize=7)
    _legend(figure)
    return figure


def _modes(rows: Sequence[dict[str, Any]]) -> Figure:
    """Shares of the states, by mode and start, a bar for each subject."""
    kinds = [
        (mode, start)
        for mode in ("nonparalyzable", "paralyzable", "synchronous", "gated", "moving gate")
        for start in ("armed", "stationary")
    ]
    kinds = [kind for kind in kinds if any((row["mode"], row["start"]) == kind for row in rows)]
    subjects = (*ENGINES, "timestamps", *LAWS)
    figure, axes = panels(3.4, 3, 4, sharex=True, sharey=True)
    for ax in axes.flat[len(subjects) :]:
        ax.set_visible(False)
    for ax, subject in zip(axes.flat, subjects, strict=False):
        for at, kind in enumerate(kinds):
            states = [row[subject] for row in rows if (row["mode"], row["start"]) == kind and row.get(subject)]
            start_of_bar = 0.0
            for state, ink in _INK.items():
                share = states.count(state) / max(len(states), 1)
                ax.barh(at, share, left=start_of_bar, color=ink, height=0.8)
                start_of_bar += share
        ax.set_title(subject, fontsize=7)
        ax.set_yticks(range(len(kinds)), [f"{mode}, {start}" for mode, start in kinds], fontsize=4.5)
        ax.set_xticks([0, 0.5, 1], ["0", "50 %", "100 %"], fontsize=5)
    _legend(figure)
    figure.set_size_inches(WIDTH, 4.4)
    return figure


def _legend(figure: Any) -> None:
    handles = [
        Line2D([], [], marker="x" if state == FAILED else "o", ls="", ms=4, color=ink, label=state)
        for state, ink in _INK.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=6, frameon=False)


def decades(values: Sequence[float]) -> str:
    """The range of positive values, in words; and whether 0 is among them."""
    positive = np.array([v for v in values if v > 0.0])
    if not positive.size:
        return "0"
    zero = "0, " if len(positive) < len(values) else ""
    return f"{zero}{positive.min():.2g} to {positive.max():.3g}"
