"""A stream in numbers, without any model of the light: rates and intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.intervals import Stream, stream_of
from mars_lidar.light.timestamps import Timestamps


@dataclass(frozen=True, eq=False)
class Summary:
    """A stream in numbers, without any model of the light.

    Attributes
    ----------
    registrations, cycles, period_ns, unit_ns, bins
        Sizes and clock; `unit_ns` is 0 where the file does not tell its resolution.
    smallest_ns
        The smallest intervals (up to 20) in ascending order, ns.
    quantiles_ns
        Intervals at 1, 50 and 99 %.
    same_time
        Intervals of 0: two records at one time, which no detector makes.
    """

    registrations: int
    cycles: int
    period_ns: float
    unit_ns: float
    bins: int
    smallest_ns: FloatArray
    quantiles_ns: FloatArray
    same_time: int

    __repr__ = brief

    @property
    def rate_per_s(self) -> float:
        """Registrations per second."""
        return self.registrations / (1e-9 * self.period_ns * self.cycles)

    @property
    def per_period(self) -> float:
        """Registrations per laser period."""
        return self.registrations / self.cycles


def summary(times: Timestamps | Sequence[Timestamps], *, pooled: bool = False) -> Summary:
    """Rates and intervals of a stream of one pixel (see `calibrate` for the arguments)."""
    return summary_of(stream_of(times, pooled=pooled))


def summary_of(stream: Stream) -> Summary:
    """`summary` of a stream that is at hand."""
    smallest = np.empty(0)
    sample = []
    for dt in stream.intervals():
        head = np.partition(dt, 19)[:20] if dt.size > 20 else dt
        smallest = np.sort(np.concatenate([smallest, head]))[:20]
        sample.append(dt[:: max(1, stream.registrations // 10**6)])
    kept = np.concatenate(sample) if sample else np.empty(0)
    quantiles = np.quantile(kept, (0.01, 0.5, 0.99)) if kept.size else np.full(3, math.nan)
    return Summary(
        stream.registrations,
        stream.cycles,
        stream.period_ns,
        stream.unit_ns,
        stream.bins,
        smallest,
        quantiles,
        stream.same_time,
    )
