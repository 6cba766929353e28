"""The light of cells as the native recursion takes it (docs/theory_exposure.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.paralyzable_rate import registration_rates

if TYPE_CHECKING:
    from mars_lidar._base.native import _core


def native_light(cells: Cells, bins: int, history: FloatArray | None = None) -> _core.ExposureLight:
    """Photons of the parts of bins, or of paralyzable pixels the rates of registrations.

    `history` (cells, 2 bins + 2) is the warm state where it is known: `warm_history`.
    """
    from mars_lidar._base.native import _core

    if cells.system.detector.mode == "paralyzable":
        return _core.ExposureLight.paralyzable(cells.grid(bins, 1), cells.total, registration_rates(cells, bins))
    energy, row = cells.energies(bins)
    signal, background = cells.native_flux
    return _core.ExposureLight(signal=signal, background=background, shape=row, shapes=energy, history=history)
