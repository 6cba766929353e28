"""What methods of `count_law` and `registration_pdf` share: where the chain re-arms, the network, one cell's light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from mars_lidar._base import checks
from mars_lidar.statistics.cells import Cells, FloatArray

if TYPE_CHECKING:
    from pathlib import Path

    from mars_lidar.learn.neural import NeuralMap


def rearm_of(rearm: str | None, used: bool, by: str) -> Literal["centre", "edge"]:
    """Where the chain re-arms; a choice only where the chain is `used`."""
    if rearm is None:
        return "centre"
    if not used:
        raise ValueError(f"rearm must be None for {by}, which has no such choice, got {rearm!r}")
    return "edge" if checks.choice("rearm", rearm, ("centre", "edge")) == "edge" else "centre"


def check_model(model: object, method: str) -> None:
    """Raise ValueError for a model that the method has no use for."""
    if model is not None and method != "neural":
        raise ValueError(f"model must be None for method {method!r}, which has no network, got {model!r}")


def neural_moments(cells: Cells, model: NeuralMap | str | Path | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """PDFs (cells, bins), means and variances (cells,) by the network."""
    from mars_lidar.engines import ENGINES, NeuralEngine

    default = ENGINES["neural"]
    engine = default if model is None and isinstance(default, NeuralEngine) else NeuralEngine(model)
    return engine.of_cells(cells)


def pixel_of(cells: Cells, k: int) -> tuple[float | None, FloatArray | None, float | None]:
    """Signal, waveform and delay of one cell as the chain takes them."""
    if cells.waveform is not None:
        return None, cells.signal[k] * cells.waveform[cells.row[k]], None
    return float(cells.signal[k]), None, float(cells.delay[k]) * cells.system.period_ns
