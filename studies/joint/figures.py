"""The figure of the classifier study: AUC of every case, classifier and engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mars_lidar.plot.style import COLOURS, DPI, INK, MISSING
from studies.common.draw import WIDTH, legend_below
from studies.joint.classifiers import chance
from studies.joint.outcomes import ENGINES, TESTS, Outcome, Settings

_LINEAR = 0.02  # from chance, where the axis turns from linear to logarithmic
_TICKS = (-0.02, 0.0, 0.02, 0.1, 0.5)
_COLOUR = dict(zip(ENGINES, (INK, COLOURS[0], COLOURS[1], COLOURS[2]), strict=True))
_MARK = dict(zip(ENGINES, "|osD", strict=True))


def figure(settings: Settings, outcomes: Sequence[Outcome]) -> Figure:
    """Cases above, one panel a classifier; the random systems below, in the order of each engine's AUCs."""
    named, drawn = ([o for o in outcomes if o.random is kind and o.aucs] for kind in (False, True))
    page = Figure(figsize=(WIDTH, 5.2), dpi=DPI, layout="constrained")
    halves: Any = page.subfigures(2, 1, height_ratios=(1.5, 1.0))
    upper, lower = halves
    above = upper.subplots(1, len(TESTS), sharey=True)
    for ax, test in zip(above, TESTS, strict=True):
        _cases(ax, test, [c.name for c in settings.cases], named, 2.0 * chance(settings.exposures))
    for ax, test in zip(lower.subplots(1, 2, sharey=True), TESTS[:2], strict=True):
        _random(ax, test, drawn, 2.0 * chance(settings.random_exposures))
    lower.axes[0].set_ylabel("share of systems below")
    legend_below(lower, above[:1], len(ENGINES))
    return page


def _axis(ax: Any, band: float, lowest: float) -> None:
    ax.axvspan(-band, band, color=MISSING, alpha=0.6, lw=0)
    ax.set_xscale("symlog", linthresh=_LINEAR)
    ax.set(xlim=(min(-0.03, 1.1 * lowest), 0.7), xlabel="AUC")
    ax.set_xticks(_TICKS, [f"{0.5 + t:g}" for t in _TICKS])
    ax.minorticks_off()


def _cases(ax: Any, test: str, cases: Sequence[str], outcomes: Sequence[Outcome], band: float) -> None:
    _axis(ax, band, min((o.aucs[t][0] - 0.5 for o in outcomes for t in TESTS), default=0.0))
    for row in range(1, len(cases)):
        ax.axhline(row - 0.5, color=MISSING, lw=0.4)
    for k, engine in enumerate(ENGINES):
        here = [o for o in outcomes if o.engine == engine]
        value = np.array([o.aucs[test][0] - 0.5 for o in here])
        place = np.array([cases.index(o.case.name) for o in here]) + 0.2 * (k - 1.5)
        ax.plot(value, place, _MARK[engine], color=_COLOUR[engine], ms=3.0, mew=0.9, mfc="none", label=engine)
    ax.set_yticks(range(len(cases)), cases)
    ax.set(ylim=(len(cases) - 0.5, -0.5), title=test)
    ax.tick_params(axis="y", length=0)


def _random(ax: Any, test: str, outcomes: Sequence[Outcome], band: float) -> None:
    _axis(ax, band, min((o.aucs[test][0] - 0.5 for o in outcomes), default=0.0))
    for engine in ENGINES:
        value = np.sort([o.aucs[test][0] - 0.5 for o in outcomes if o.engine == engine])
        share = (np.arange(value.size) + 0.5) / max(value.size, 1)
        ax.plot(value, share, _MARK[engine], color=_COLOUR[engine], ms=2.5, mew=0.8, mfc="none")
    ax.set(ylim=(0, 1), title=f"random systems, {test}")
