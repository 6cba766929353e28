"""Figure of the study "returns"."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mars_lidar.plot.style import COLOURS, INK, style
from studies.common.draw import legend_below, panels
from studies.common.report import Row, save_figure


def returns_figure(path: Path, curves: Sequence[Row], rows: Sequence[Row]) -> Path:
    """How often two returns are seen as two, over their separation; and how often their intervals hold the truth."""
    with style():
        figure, axes = panels(2.9, 1, 2)
        left, right = axes[0]
        for colour, cycles in zip(COLOURS, dict.fromkeys(row["cycles"] for row in curves), strict=False):
            mine = [row for row in curves if row["cycles"] == cycles]
            label = f"{0.5 * cycles:g} photons each"
            left.plot(*_line(mine, "both seen %"), "o-", ms=2.5, lw=1.0, color=colour, label=label)
        left.set(xscale="log", xlabel="separation (sigma of the pulse)", ylabel="both seen (%)")
        left.legend(frameon=False, loc="lower right")
        for what, colour in (("depth", COLOURS[0]), ("S", COLOURS[1])):
            for words, marker in (("95 %", "o"), ("68 %", "s")):
                sure = [row for row in rows if row["both seen %"] >= 90.0]
                label = f"{what}, intervals of {words}"
                right.plot(*_line(sure, f"{what} in {words}"), marker, ms=3, mfc="none", color=colour, label=label)
        for share in (95.0, 68.27):
            right.axhline(share, color=INK, lw=0.7, ls="--")
        right.set(xscale="log", xlabel="separation (sigma of the pulse)", ylabel="intervals that hold the truth (%)")
        for ax in (left, right):
            ax.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
            ax.minorticks_off()
        left.set_xlim(0.28, 6.5)
        legend_below(figure, [right], 4, handlelength=1.2, columnspacing=1.0)
        return save_figure(path, figure)


def _line(rows: Sequence[Row], name: str) -> tuple[list[float], list[float]]:
    return [row["separation"] for row in rows], [row[name] for row in rows]
