"""Configuration of the study "detectors": the light, the detectors, and what is computed of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, System
from mars_lidar._base.types import FloatArray

SIGNAL, BACKGROUND, DELAY_NS, DEAD_NS = 1.0, 1.0, 37.0, 45.0
LIGHT = {"signal S": SIGNAL, "background B": BACKGROUND, "delay_ns": DELAY_NS, "dead_time_ns": DEAD_NS}
SEED = 20
REACH = 3.0  # periods of inter-registration times that are drawn


@dataclass(frozen=True)
class Example:
    """A detector, its name in figures and tables, and the figure it belongs to."""

    name: str
    figure: str
    detector: Detector


def example_of(name: str, figure: str, **changes: Any) -> Example:
    """A detector of the common dead time but for `changes`."""
    return Example(name, figure, Detector(**{"dead_time_ns": DEAD_NS, **changes}))


EXAMPLES = (
    example_of("non-paralyzable", ""),
    example_of("paralyzable", "paralyzable", mode="paralyzable"),
    example_of("synchronous, no dead time", "synchronous", dead_time_ns=0.0, mode="synchronous"),
    example_of("synchronous", "synchronous", mode="synchronous"),
    example_of("gated", "gated", mode="gated", gate_start_ns=20.0, gate_width_ns=40.0),
    example_of(
        "moving gate", "gated", mode="gated", gate_start_ns=0.0, gate_width_ns=30.0, gate_step_ns=1.0, gate_cycles=5
    ),
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One detector: simulated, and predicted where there is a prediction.

    `histogram` and `intervals` are means per exposure; `counts` (exposures,). `law` (n,) is P(N = n), or None.
    """

    example: Example
    system: System
    counts: NDArray[np.int64]
    histogram: FloatArray
    histogram_error: FloatArray
    intervals: FloatArray
    expected: FloatArray | None
    moments: tuple[float, float] | None
    law: FloatArray | None
