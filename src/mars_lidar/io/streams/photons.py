"""Photons as a recorder of another program counted them: units of its clocks, before anything is known of the laser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import FileError
from mars_lidar.io.streams.attributes import measured
from mars_lidar.light.timestamps import Timestamps

_SAME = 1e-3  # relative difference within which a clock counts laser periods
_SYNCS = 100  # records of a channel that may be a laser's sync
_EVEN = 1e-2  # spread of their intervals, relative


class NoLaserError(FileError):
    """The file does not tell which laser period its photons came in."""


@dataclass(frozen=True, eq=False)
class Photons:
    """What every format of a stream is mapped onto."""

    clock: NDArray[Any]  # (n,) whole units of `clock_ns` since the start of the recording
    clock_ns: float
    detector: NDArray[Any]  # (n,) channel of each; -1 for a pulse at the recorder's input for the laser's sync
    source: str  # the file
    fine: NDArray[Any] | None = None  # (n,) whole units of `fine_ns` since the laser pulse; None without a laser
    fine_ns: float = 0.0
    period_ns: float | None = None  # of the laser, where the file tells it

    def timestamps(self, period_ns: float | None = None, bins: int | None = None) -> Timestamps:
        """A pixel for each channel, in one row; `period_ns` where the file does not tell it."""
        if self.fine is not None:
            return self._counted(self.fine, self.period_ns if period_ns is None else period_ns, bins)
        if period_ns is None:
            return self._synchronous(bins)
        photon = self.detector >= 0
        periods = (self.clock[photon].astype(np.float64) + 0.5) * self.clock_ns / period_ns
        cycle = np.floor(periods).astype(np.int64)
        unit = self.clock_ns if bins is None else period_ns / bins
        fine = (periods - cycle) * (period_ns / unit) - 0.5  # `measured` adds half a unit
        return measured(cycle, fine, unit, self.detector[photon], period_ns, bins, self.source, self.clock_ns)

    def histograms(self) -> dict[str, NDArray[np.int64]]:
        """Counts over the time since the laser pulse, of each channel that has photons."""
        if self.fine is None:
            raise ValueError(f"{self.source} holds absolute times without laser pulses: there are no histograms in it")
        channels = np.unique(self.detector)
        longest = int(self.fine.max(initial=0)) + 1
        return {f"channel {k}": np.bincount(self.fine[self.detector == k], minlength=longest) for k in channels}

    def _counted(self, fine: NDArray[Any], period_ns: float | None, bins: int | None) -> Timestamps:
        if period_ns is None:
            raise NoLaserError(
                f"{self.source} does not tell the laser period: its clock of {self.clock_ns:g} ns runs free; "
                "mars-lidar reconstruct takes its histograms, mars-lidar calibrate its dead time"
            )
        if abs(self.clock_ns / period_ns - 1.0) > _SAME:
            raise ValueError(
                f"{self.source}: timestamps must count laser periods of {period_ns:g} ns where there are nanotimes, "
                f"their unit is {self.clock_ns:g} ns"
            )
        return measured(self.clock, fine, self.fine_ns, self.detector, period_ns, bins, self.source)

    def _synchronous(self, bins: int | None) -> Timestamps:
        """Times since the last record of the channel whose records come as evenly as a laser's pulses, the sync."""
        for channel in np.unique(self.detector):
            sync = self.clock[self.detector == channel].astype(np.int64)
            apart = np.diff(sync)
            if apart.size < _SYNCS or float(apart.std()) > _EVEN * float(apart.mean()):
                continue
            kept = (self.detector != channel) & (self.detector >= 0) & (self.clock >= sync[0])
            clock = self.clock[kept].astype(np.int64)
            cycle = np.searchsorted(sync, clock, "right") - 1
            period = float(apart.mean()) * self.clock_ns
            fine = clock - sync[cycle]
            return measured(cycle, fine, self.clock_ns, self.detector[kept], period, bins, self.source)
        raise NoLaserError(
            f"{self.source} holds absolute times without laser pulses: give period_ns; without a laser, mars-lidar "
            "mars-lidar calibrate gives dead time and afterpulses"
        )
