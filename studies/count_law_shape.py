"""Shapes over the dead time, against the exact mean histogram: no simulation, no noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mars_lidar.statistics import registration_pdf
from studies import Tell
from studies.count_law import WIDE_PERIOD_NS, Settings
from studies.simulators import arrival_shape

FloatArray = NDArray[np.float64]

SHAPES = {
    "poisson": "Poisson",
    "renewal": "renewal and MaRS, paper's, centre",
    "mars_edge": "MaRS, paper's, edge",
}


def shape_sweep(settings: Settings, tell: Tell) -> dict[str, FloatArray]:
    """Total variation (dead times, cells) of each of `SHAPES` to the exposure's exact mean histogram."""
    signal, background = (g.ravel() for g in np.meshgrid(settings.sweep_flux, settings.sweep_flux, indexing="ij"))
    found: dict[str, list[FloatArray]] = {name: [] for name in SHAPES}
    for dead in settings.dead_sweep:
        system = settings.system(WIDE_PERIOD_NS, dead * WIDE_PERIOD_NS)
        truth = registration_pdf(signal, background, system, "exposure")
        shapes = {
            "poisson": arrival_shape(signal, background, system),
            "renewal": registration_pdf(signal, background, system, "chain"),
            "mars_edge": registration_pdf(signal, background, system, "chain", rearm="edge"),
        }
        for name, shape in shapes.items():
            found[name].append(0.5 * np.abs(shape - truth).sum(-1))
    tell(f"count-law: shapes at {len(settings.dead_sweep)} dead times, {signal.size} cells each")
    return {name: np.array(rows) for name, rows in found.items()}
