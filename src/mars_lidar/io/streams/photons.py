"""Photons in the clock units of a recorder, before the laser period is known.

Also the attributes common to files of photons, and the timestamps of a measured stream.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.files import FileError
from mars_lidar._version import __version__
from mars_lidar.light.timestamps import Timestamps

BEFORE_PTU = (".pt2", ".pt3", ".ht2", ".ht3")  # PicoQuant's formats before PTU
FORMAT = "mars-lidar timestamps"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class _SyncTolerances:
    """What is taken for the pulses of a laser in a file that does not name them."""

    period: float = 1e-3  # relative difference of a clock's unit from the period, where the clock counts periods
    records: int = 100  # of a channel, at least
    jitter: float = 1e-2  # standard deviation of their intervals, relative


_SYNC = _SyncTolerances()


class NoLaserError(FileError):
    """The file does not state the laser periods of its photons."""


@dataclass(frozen=True, eq=False)
class Photons:
    """The common representation of all stream formats."""

    clock: NDArray[Any]  # (n,) whole units of `clock_ns` since the start of the recording
    clock_ns: float
    detector: NDArray[Any]  # (n,) channel of each; -1 for a pulse at the recorder's input for the laser's sync
    source: str  # the file
    fine: NDArray[Any] | None = None  # (n,) whole units of `fine_ns` since the laser pulse; None without a laser
    fine_ns: float = 0.0
    period_ns: float | None = None  # of the laser, if stated in the file

    def timestamps(self, period_ns: float | None = None, bins: int | None = None) -> Timestamps:
        """A pixel for each channel, in one row; `period_ns` if the file does not state it."""
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
                f"{self.source} does not state the laser period: its clock of {self.clock_ns:g} ns runs free; "
                "mars-lidar reconstruct takes its histograms, mars-lidar calibrate its dead time"
            )
        if abs(self.clock_ns / period_ns - 1.0) > _SYNC.period:
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
            if apart.size < _SYNC.records or float(apart.std()) > _SYNC.jitter * float(apart.mean()):
                continue
            photon = (self.detector != channel) & (self.detector >= 0) & (self.clock >= sync[0])
            clock = self.clock[photon].astype(np.int64)
            cycle = np.searchsorted(sync, clock, "right") - 1
            period = float(apart.mean()) * self.clock_ns
            fine = clock - sync[cycle]
            return measured(cycle, fine, self.clock_ns, self.detector[photon], period, bins, self.source)
        raise NoLaserError(
            f"{self.source} holds absolute times without laser pulses: give period_ns; without a laser, "
            "mars-lidar calibrate gives dead time and afterpulses"
        )


def attributes(times: Timestamps) -> dict[str, Any]:
    """Attributes of a file besides the photons, as JSON data."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "shape": list(times.shape),
        "bins": times.bins,
        "dtype": np.dtype(times.dtype).name,
        "period_ns": times.period_ns,
        "cycles": times.cycles,
        "info": times.info,
    }


def from_attributes(
    attrs: Mapping[str, Any],
    times_ns: NDArray[np.float64],
    cycle: NDArray[Any],
    bin_: NDArray[Any],
    counts: NDArray[Any],
) -> Timestamps:
    """Timestamps of the photons of all pixels, row-major, with `counts` (H * W,) of them each."""
    version = attrs.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise ValueError(f"these timestamps have layout version {version}; version {FORMAT_VERSION} can be read")
    height, width = (checks.integer("shape", n, low=1, high=2**32) for n in attrs["shape"])
    if counts.size != height * width or int(counts.sum()) != times_ns.size:
        raise ValueError(f"{times_ns.size} photons do not make an image of {height} x {width}")
    if attrs["dtype"] not in ("uint16", "uint32") or not isinstance(attrs["info"], dict):
        raise ValueError(f"dtype must be uint16 or uint32 and info a dictionary, got {attrs['dtype']!r}")
    offsets = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    stream = Timestamps(
        np.ascontiguousarray(times_ns, np.float64),
        np.ascontiguousarray(cycle, np.int32),
        np.ascontiguousarray(bin_, np.int32),
        offsets.astype(np.int64),
        (height, width),
        checks.integer("bins", attrs["bins"], low=1, high=2**31 - 1),
        np.dtype(str(attrs["dtype"])),
        checks.real("period_ns", attrs["period_ns"], low=0.0, strict_low=True),
        checks.integer("cycles", attrs["cycles"], low=1, high=2**31),
        dict(attrs["info"]),
    )
    system = stream.system
    if system is not None and (system.period_ns, system.bins) != (stream.period_ns, stream.bins):
        raise ValueError(f"period_ns and bins must be those of its system {system}, got {stream}")
    return stream


def fine_times(times: Timestamps, fine: int, part: slice = slice(None)) -> NDArray[np.int64]:
    """Time since the laser pulse, in units of a histogram bin / `fine`, of some photons: the bin is kept exactly."""
    bin_ = times.bin[part].astype(np.int64)
    within = (times.times_ns[part] / times.period_ns - times.cycle[part]) * times.bins - bin_  # of a bin: 0 to 1
    return bin_ * fine + np.clip(within * fine, 0, fine - 1).astype(np.int64)


def of_fine_times(
    attrs: Mapping[str, Any], cycle: NDArray[Any], since: NDArray[Any], fine: int, pixel: NDArray[Any]
) -> Timestamps:
    """Timestamps of photons in the order of their pixels, with the laser period and `fine_times` of each."""
    times_ns = (cycle + (since + 0.5) / (int(attrs["bins"]) * fine)) * float(attrs["period_ns"])
    height, width = attrs["shape"]
    counts = np.bincount(pixel, minlength=int(height) * int(width))
    return from_attributes(attrs, times_ns, cycle, since // fine, counts)


def measured(
    cycle: NDArray[Any],
    fine: NDArray[Any],
    unit_ns: float,
    detector: NDArray[Any],
    period_ns: float,
    bins: int | None,
    source: str,
    clock_ns: float | None = None,
) -> Timestamps:
    """Timestamps of a recorded stream: laser period and fine time of each photon, and its detector.

    `fine` counts units of `unit_ns` since the laser pulse. Without `bins`, a bin is one unit, and the last
    one may be cut by the end of the period. `clock_ns` is the resolution of the clock, if it differs from `unit_ns`.
    """
    pixels = int(detector.max()) + 1 if detector.size else 1
    phase = (np.asarray(fine, np.float64) + 0.5) * unit_ns  # the middle of a unit of the clock
    late = np.floor(phase / period_ns).astype(np.int64)  # a stop after the next laser pulse
    cycle = np.asarray(cycle, np.int64) + late
    phase = phase - late * period_ns
    number = max(1, math.ceil(period_ns / unit_ns - 1e-6)) if bins is None else bins
    width = unit_ns if bins is None else period_ns / bins
    bin_ = np.minimum((phase / width).astype(np.int64), number - 1)
    info = {"source": source, "unit_ns": unit_ns if clock_ns is None else clock_ns}
    return of_pixels(cycle * period_ns + phase, cycle, bin_, detector, (1, pixels), number, period_ns, info)


def of_pixels(
    times_ns: NDArray[np.float64],
    cycle: NDArray[Any],
    bin_: NDArray[Any],
    pixel: NDArray[Any],
    shape: tuple[int, int],
    bins: int,
    period_ns: float,
    info: dict[str, Any],
) -> Timestamps:
    """Timestamps of photons in any order, whose `pixel` counts through the rows of an image of `shape`."""
    order = np.lexsort((times_ns, pixel))
    counts = np.bincount(pixel, minlength=math.prod(shape))
    cycles = int(cycle.max()) + 1 if cycle.size else 1
    if cycles >= 2**31:
        raise ValueError(f"{info['source']}: a stream may span 2^31 laser periods at most, got {cycles:.4g}")
    attrs = {
        "shape": shape,
        "bins": bins,
        "dtype": "uint16" if counts.max(initial=0) < 2**16 else "uint32",
        "period_ns": period_ns,
        "cycles": cycles,
        "info": info,
    }
    return from_attributes(attrs, times_ns[order], cycle[order], bin_[order], counts)
