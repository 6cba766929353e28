"""What every file of photons tells beside them, and the timestamps of a measured stream."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._version import __version__
from mars_lidar.light.timestamps import Timestamps

FORMAT = "mars-lidar timestamps"
FORMAT_VERSION = 1


def attributes(times: Timestamps) -> dict[str, Any]:
    """What a file tells beside the photons, as JSON knows it."""
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
    one may be cut by the end of the period. `clock_ns` is the resolution of the clock, where it is not `unit_ns`.
    """
    pixels = int(detector.max()) + 1 if detector.size else 1
    phase = (np.asarray(fine, np.float64) + 0.5) * unit_ns  # the middle of what the clock tells apart
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
