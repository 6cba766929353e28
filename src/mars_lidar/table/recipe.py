"""How the entries of a table are evaluated."""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar._base.types import FloatArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.statistics.chain import Rearm
from mars_lidar.table.entries import Entries, exposure_entries
from mars_lidar.table.nodes import Method
from mars_lidar.table.renewal_entries import renewal_entries


@dataclass(frozen=True, eq=False)
class Recipe:
    """How entries are evaluated."""

    method: Method
    rearm: Rearm
    tolerance: float
    threads: int

    def entries(
        self, signal: FloatArray, background: FloatArray, system: System, progress: Progress | None = None
    ) -> Entries:
        """Entries of cells (n,)."""
        if self.method == "mars":
            return renewal_entries(
                signal, background, system, rearm=self.rearm, threads=self.threads, progress=progress
            )
        return exposure_entries(
            signal, background, system, tolerance=self.tolerance, threads=self.threads, progress=progress
        )
