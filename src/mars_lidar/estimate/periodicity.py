"""Which period a stream has by itself: a wrong laser period smears the light and invents a recovery."""

from __future__ import annotations

import numpy as np

from mars_lidar.estimate.intervals import Stream

_CELLS = 2**20  # of the time axis: all of it where the stream is shorter
_PER_PERIOD = 32  # cells of the given period: lines up to 16 times its frequency
_SLOWEST = 0.3  # of the laser's frequency
_STRONG = 40.0  # times the power of light without a period: one of 2^20 lines by chance at e^-40
_CLEAR = 4.0  # times as strong as the line at the given period


def other_period(stream: Stream) -> float | None:
    """The period, ns, that the photons repeat with where it is not that of the stream; None where it is, or none is.

    Periodogram of the first times: photons of a constant light have a power of their number in each line, those of a
    pulsed one of their number squared at the laser's frequency and its multiples. The lowest strong line is taken.
    """
    piece = max(stream.pieces, key=lambda one: one.times_ns.size)
    cell = stream.period_ns / _PER_PERIOD
    times = piece.times_ns[: np.searchsorted(piece.times_ns, _CELLS * cell)]
    if times.size < 100:
        return None
    place = np.floor(times / cell).astype(np.int64)
    length = int(2 ** np.ceil(np.log2(place[-1] + 1)))
    power = np.abs(np.fft.rfft(np.bincount(place, minlength=length))) ** 2 / times.size
    given = length / _PER_PERIOD  # the line of the given period
    low = int(np.ceil(_SLOWEST * given))
    if low < 3 or power.size < low + 2:
        return None
    at_given = _strongest(power, given)
    strong = np.flatnonzero(power[low:] > max(_STRONG, _CLEAR * at_given, 0.25 * float(power[low:].max()))) + low
    if strong.size == 0:
        return None
    first = int(strong[0])
    first += int(np.argmax(power[first : first + 3]))
    if abs(first - given) < 1.5:
        return None
    around = power[first - 1 : first + 2]
    return float(length * cell / (first + (around[2] - around[0]) / around.sum()))


def _strongest(power: np.ndarray[tuple[int, ...], np.dtype[np.float64]], line: float) -> float:
    near = round(line)
    return float(power[max(near - 1, 0) : near + 2].max())
