"""Description of a recording before any model: clock, period, rate, intervals, and anomalies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base.display import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.recording import FALSE_ALARM, Recording

_PER_PERIOD = 32  # cells of the given period: lines up to 16 times its frequency
_STRONG = 40.0  # power of a line over that of Poisson noise: by chance with probability e^-40 in each line


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
    dark_s
        Beginning and length, s, of the longest time without a photon, if constant light has one as long with a
        probability below 0.2 %; else None.
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
    dark_s: tuple[float, float] | None

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
        if self.dark_s is not None:
            out.append(
                f"no photon for {self.dark_s[1]:.3g} s from {self.dark_s[0]:.3g} s on: interrupted, or dark; give the "
                "stretches of constant light, in a list"
            )
        if self.same_time:
            out.append(
                f"{self.same_time:,} records at exactly the time of the preceding one: several detectors in one "
                "channel, records that are not photons, or a clock coarser than the dead time"
            )
        return tuple(out)


def look_at(recording: Recording) -> Look:
    """`Look` of a recording."""
    gaps = recording.intervals
    seconds = 1e-9 * recording.exposure * recording.period_ns
    clock, n, cycles = recording.clock, recording.photons, recording.exposure
    period = recording.period_ns if recording.laser else float("nan")
    smallest, quantiles = gaps[:20], np.quantile(gaps, (0.01, 0.5, 0.99))
    same, own, unit, locked = int((gaps == 0.0).sum()), other_period(recording), clock.unit_ns, clock.locked
    dark = longest_dark(recording)
    return Look(n, cycles, period, seconds, unit, locked, n / seconds, smallest, quantiles, same, own, dark)


def longest_dark(recording: Recording) -> tuple[float, float] | None:
    """Beginning and length, s, of the longest time without a photon, if it is improbable in constant light; else None.

    The n times of constant light divide a recording of length T into intervals, of which one exceeds x with a
    probability of at most (n + 1) (1 - x / T)^n. The power is n - 2 here, since a recording may begin and end at a
    photon. Dead time makes such intervals rarer still.
    """
    start, longest = 0.0, (0.0, 0.0)
    for piece, cycles in zip(recording.pieces, recording.cycles, strict=True):
        end = cycles * recording.period_ns
        times = np.r_[0.0, piece, max(end, piece[-1])]
        k = int(np.diff(times).argmax())
        longest = max(longest, (float(times[k + 1] - times[k]), start + float(times[k])))
        start += end
    length, begin = longest
    dark = length / (recording.exposure * recording.period_ns)
    chance = (recording.photons + 1) * max(1.0 - dark, 0.0) ** (recording.photons - 2)
    return (1e-9 * begin, 1e-9 * length) if chance < FALSE_ALARM else None


def other_period(recording: Recording, cells: int = 2**20, slowest: float = 0.3) -> float | None:
    """The period of the photons, ns, if they have one other than that of the recording; else None.

    Periodogram of the first `cells` of time: in constant light the power of a line is the number of photons, in pulsed
    light the square of that number at the laser's frequency and its multiples. The lowest strong line is taken, from
    `slowest` laser frequencies on, if it is four times as strong as that of the laser. A dead time in bright light
    makes broad lines, so that a line must exceed its neighbours. Times are spread over the unit of the clock, which
    would be a period as well.
    """
    from scipy.ndimage import maximum_filter1d

    times = max(recording.pieces, key=lambda piece: piece.size)
    cell = recording.period_ns / _PER_PERIOD
    times = times[: np.searchsorted(times, times[0] + cells * cell)] - times[0]
    if times.size < 100:
        return None
    if unit := recording.clock.unit_ns:
        spread = np.random.default_rng(0).random(times.size) - 0.5
        times = np.maximum(times + unit * spread, 0.0)
    place = np.floor(times / cell).astype(np.int64)
    length = int(2 ** np.ceil(np.log2(place.max() + 1)))
    power = np.abs(np.fft.rfft(np.bincount(place, minlength=length))) ** 2 / times.size
    given = length / _PER_PERIOD  # the line of the given period
    low = int(np.ceil(slowest * given))
    if low < 3:
        return None
    near = maximum_filter1d(power, 3)  # the strongest of three lines
    strong = np.flatnonzero(power[low:] > max(_STRONG, 4.0 * near[round(given)], 0.25 * power[low:].max())) + low
    first = next((int(line) for line in strong if power[line] > _STRONG * _neighbours(power, int(line))), None)
    if first is None:
        return None
    first += int(np.argmax(power[first : first + 3]))
    if abs(first - max(round(first / given), 1) * given) < 1.5:  # in pulses that also repeat with the given period
        return None
    around = np.pad(power, (0, 1), "reflect")[first - 1 : first + 2]
    period = float(length * cell / (first + (around[2] - around[0]) / around.sum()))
    return period if _in_phase(times / period) else None


def _in_phase(periods: FloatArray, parts: int = 16) -> bool:
    """Whether times (n,), in periods, keep their phase: its mean in parts scatters less than the times in each do.

    The intervals of a saturated detector are nearly equal, and the phase of such times is a random walk.
    """
    means = np.array([np.exp(2j * np.pi * part).mean() for part in np.array_split(periods, parts)])
    phase, place = np.unwrap(np.angle(means)), np.arange(parts)
    off = phase - np.polyval(np.polyfit(place, phase, 1), place)  # the period is known to part of a line
    return bool((off**2).mean() < 0.25 * -2.0 * np.log(np.abs(means).mean()))


def _neighbours(power: FloatArray, line: int) -> float:
    """Mean power of a line without a period, from the median of the lines around it except the nearest."""
    reach = 2 * _PER_PERIOD
    around = np.concatenate([power[max(line - reach, 1) : line - 3], power[line + 4 : line + reach + 1]])
    return max(float(np.median(around) / np.log(2.0)), 1.0)
