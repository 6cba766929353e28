"""What methods of `count_law` and `registration_pdf` share: where the chain re-arms, one cell's light."""

from __future__ import annotations

from typing import Literal

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells


def rearm_of(rearm: str | None, used: bool, by: str) -> Literal["centre", "edge"]:
    """Where the chain re-arms; a choice only where the chain is `used`."""
    if rearm is None:
        return "centre"
    if not used:
        raise ValueError(f"rearm must be None for {by}, which has no such choice, got {rearm!r}")
    return "edge" if checks.choice("rearm", rearm, ("centre", "edge")) == "edge" else "centre"


def pixel_of(cells: Cells, k: int) -> tuple[float | None, FloatArray | None, float | None]:
    """Signal, waveform and delay of one cell as the chain takes them."""
    if cells.waveform is not None:
        return None, cells.signal[k] * cells.waveform[cells.row[k]], None
    return float(cells.signal[k]), None, float(cells.delay[k]) * cells.system.period_ns
