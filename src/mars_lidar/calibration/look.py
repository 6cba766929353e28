"""Description of a recording before any model: clock, period, rate, intervals, and anomalies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base.display import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.periodicity import other_period
from mars_lidar.calibration.recording import Recording


@dataclass(frozen=True, eq=False)
class Look:
    """A recording in numbers, without any model.

    Attributes
    ----------
    registrations, cycles, period_ns, seconds
        Sizes; the period is NaN without a laser.
    unit_ns, locked
        Clock unit, 0 for real numbers, and whether the clock restarts with each laser pulse.
    rate_per_s, per_period
        Registrations per second and per laser period.
    smallest_ns, quantiles_ns
        Smallest intervals (up to 20), and those at 1, 50 and 99 %.
    same_time
        Number of records with exactly the time of the preceding record.
    own_period_ns
        Period of the photons if it differs from that of the laser, else None.
    """

    registrations: int
    cycles: float
    period_ns: float
    seconds: float
    unit_ns: float
    locked: bool
    rate_per_s: float
    smallest_ns: FloatArray
    quantiles_ns: FloatArray
    same_time: int
    own_period_ns: float | None

    __repr__ = brief

    @property
    def per_period(self) -> float:
        """Registrations per laser period."""
        return self.registrations / self.cycles

    @property
    def problems(self) -> tuple[str, ...]:
        """Anomalies that no photon stream of this laser shows, one sentence each."""
        out = []
        if self.own_period_ns is not None:
            given = "no laser was recorded" if np.isnan(self.period_ns) else f"not every {self.period_ns:.7g} ns"
            out.append(f"the photons repeat every {self.own_period_ns:.6g} ns, {given}: give that period")
        if self.same_time:
            out.append(
                f"{self.same_time:,} records at exactly the time of the preceding one: several detectors in one "
                "channel, records that are not photons, or a clock coarser than the dead time"
            )
        return tuple(out)


def look_at(recording: Recording) -> Look:
    """`Look` of a recording."""
    gaps = np.concatenate([np.diff(piece) for piece in recording.pieces])
    count = min(20, gaps.size)
    seconds = 1e-9 * recording.exposure * recording.period_ns
    clock, n, cycles = recording.clock, recording.photons, recording.exposure
    period = recording.period_ns if recording.laser else float("nan")
    smallest, quantiles = np.sort(np.partition(gaps, count - 1)[:count]), np.quantile(gaps, (0.01, 0.5, 0.99))
    same, own, unit, locked = int((gaps == 0.0).sum()), other_period(recording), clock.unit_ns, clock.locked
    return Look(n, cycles, period, seconds, unit, locked, n / seconds, smallest, quantiles, same, own)
