"""Selection of one of several returns as the depth of a pixel, and detection of an internal reflection."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.method import Flags
from mars_lidar.reconstruction.reconstruction import Reconstruction

KEEP = ("strongest", "nearest", "farthest")
_SAME_BINS = 3  # bins within which delays count as equal
_MOSTLY = 0.5  # share of the pixels with equal delay, above which it is a common one
_EXCESS = 5.0  # standard deviations of the median bin by which a bin must exceed it to show a later return


def keep_return(
    result: Reconstruction, keep: str = "strongest", from_ns: float = 0.0, attenuation: str = "none"
) -> Reconstruction:
    """The maps (...) of one return of each pixel, among the returns at least `from_ns` after the laser pulse.

    `result` is a reconstruction with ``returns=2`` or more: an internal reflection is then a separate return, whose
    counts and dead time the likelihood includes, and is omitted here. Pixels without a return after `from_ns` are
    flagged ``NO_SIGNAL``. `attenuation` is that of the reconstruction; its level is unchanged. Only the strongest
    return of a pixel has a 90 % interval: the half width of any other is NaN.
    """
    checks.choice("keep", keep, KEEP)
    first = checks.real("from_ns", from_ns, low=0.0, high=result.system.period_ns)
    every = result.returns
    if every is None:
        raise ValueError("keep and from_ns choose among several returns: reconstruct with returns=2 or more")
    allowed = np.isfinite(every.delay_ns) & (every.delay_ns >= first)
    order = {"strongest": every.signal, "nearest": -every.delay_ns, "farthest": every.delay_ns}[keep]
    place = np.argmax(np.where(allowed, order, -np.inf), axis=-1)[..., None]
    lacking = ~allowed.any(-1)

    def chosen(values: NDArray[Any], without: float = math.nan) -> NDArray[Any]:
        return np.where(lacking, without, np.take_along_axis(values, place, -1)[..., 0])

    strongest = np.argmax(np.nan_to_num(every.signal, nan=-1.0), axis=-1)
    with_interval = ~lacking & (place[..., 0] == strongest)

    def interval(half_width: FloatArray | None) -> FloatArray | None:
        return None if half_width is None else np.where(with_interval, half_width, np.nan)

    signal, depth = chosen(every.signal, 0.0), chosen(every.depth_m)
    returned = signal * depth**2 if attenuation == "inverse_square" else signal
    return replace(
        result,
        delay_ns=chosen(every.delay_ns),
        depth_m=depth,
        signal=signal,
        reflectivity=np.nan_to_num(returned) / result.level,
        delay_error_ns=chosen(every.delay_error_ns),
        depth_error_m=chosen(every.depth_error_m),
        signal_error=chosen(every.signal_error),
        delay_half_width_ns=interval(result.delay_half_width_ns),
        depth_half_width_m=interval(result.depth_half_width_m),
        outlier=None if result.outlier is None else chosen(every.false_alarm),
        flags=np.where(lacking, result.flags | np.uint8(Flags.NO_SIGNAL), result.flags).astype(np.uint8),
    )


def common_delay(result: Reconstruction) -> tuple[float, float] | None:
    """(share of the pixels, median delay in ns) if more than half of the first returns lie within three bins."""
    every = result.returns
    first = result.delay_ns if every is None else np.where(every.count > 0, every.delay_ns[..., 0], np.nan)
    delays = first[result.detected & np.isfinite(first)]
    if delays.size < 2:
        return None
    bins, width = result.system.bins, result.system.bin_ns
    counts = np.bincount((delays / width).astype(np.int64) % bins, minlength=bins)
    together = np.sum([np.roll(counts, -k) for k in range(_SAME_BINS)], axis=0)
    place = int(np.argmax(together))
    share = float(together[place]) / delays.size
    inside = (delays / width - place) % bins < _SAME_BINS
    return (share, float(np.median(delays[inside]))) if share > _MOSTLY else None


def has_later_light(counts: NDArray[Any], result: Reconstruction, delay_ns: float) -> bool:
    """Whether `counts` (bins,), summed over the pixels, show light beside the pulse at `delay_ns`."""
    system = result.system
    low, high = system.pulse.support_ns()
    since = (system.time_ns - delay_ns) % system.period_ns
    near = (since < high + 2 * system.bin_ns) | (since > system.period_ns + low - 2 * system.bin_ns)
    rest = counts[~near & (counts > 0)].astype(np.float64)
    if rest.size < 2:
        return False
    floor = float(np.median(rest))
    return float(rest.max()) > floor + _EXCESS * math.sqrt(max(floor, 1.0)) * math.sqrt(1.0 + math.log(rest.size))
