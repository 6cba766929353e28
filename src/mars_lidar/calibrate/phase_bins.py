"""How finely the period is divided: for a likelihood, and for a free shape."""

from __future__ import annotations

from mars_lidar.calibrate.intervals import Stream
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse

SHAPE_BINS = 1024  # of a free shape, and of the histogram whose shape Rapp's method fits
_MOST_BINS = 2**15  # of the fine grid, unless the stream has more itself
_BINS_PER_SIGMA = 20  # at which the bins of the fine grid are narrow beside the pulse


def fine_bins(stream: Stream, pulse: Pulse | None) -> int:
    """The stream's bins times a power of two: narrow beside the pulse, but no more than is useful."""
    wanted = 2048.0
    if isinstance(pulse, GaussianPulse):
        wanted = _BINS_PER_SIGMA * stream.period_ns / pulse.sigma_ns
    elif isinstance(pulse, SampledPulse):
        wanted = 4.0 * stream.period_ns / pulse.bin_ns
    bins = stream.bins if stream.units or stream.bins <= _MOST_BINS else SHAPE_BINS
    while bins < wanted and 2 * bins <= max(_MOST_BINS, stream.bins if stream.units else 0):
        if stream.units % (2 * bins) != 0:  # bins would hold different numbers of units
            break
        bins *= 2
    return bins


def free_bins(bins: int) -> int:
    """Bins of a free shape: the stream's, or a divisor of them near 1024."""
    if bins <= 2 * SHAPE_BINS:
        return bins
    divisors = [n for n in range(2 * SHAPE_BINS, SHAPE_BINS // 4, -1) if bins % n == 0]
    return divisors[0] if divisors else SHAPE_BINS
