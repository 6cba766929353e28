"""What the realizations of a stream should be like: by the exact laws where there are any, else by simulation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import places
from mars_lidar.calibrate.calibration import Calibration
from mars_lidar.calibrate.detector_model import is_plain, pulse_of_the_light
from mars_lidar.calibrate.interval_table import AgeTable, age_table
from mars_lidar.calibrate.intervals import Piece, Stream, stream_of
from mars_lidar.calibrate.light_error import Fitted
from mars_lidar.calibrate.recovery import Recovery, recovery_of
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.pulse import SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.statistics import ConvergenceError, count_law, joint_law, mean_histogram
from mars_lidar.statistics.distance import Pmf

WINDOW_SIGMAS = 3.0
_GROUPS = 64  # of the period, in which the mean histogram is tested with its covariance
_PIXELS = 16  # simulated side by side
_REGISTRATIONS = 2_000_000  # simulated at a time, about
_SEED = 20_251


@dataclass(frozen=True, eq=False)
class Prediction:
    """Count law, mean histogram and joint statistics of realizations, and how well they are known.

    Attributes
    ----------
    count, mean, variance
        Law of the count, and its moments.
    histogram, bin_variance
        (bins,) mean and variance of the registrations of each bin.
    window_variance
        Variance of the registrations in the signal window.
    window, groups, group_covariance
        (bins,) that window, (bins,) groups of bins of about equal counts, the covariance (g, g) of their registrations.
    simulated
        Realizations that were simulated for what no law gives; 0 where all is exact.
    exact
        What of it is exact: names of ``("count", "histogram", "joint")``.
    recovery, ages
        Of the simulated stream; None where none was.
    """

    count: Pmf
    mean: float
    variance: float
    histogram: FloatArray
    bin_variance: FloatArray
    window_variance: float
    window: NDArray[np.bool_]
    groups: NDArray[np.int64]
    group_covariance: FloatArray
    simulated: int = 0
    exact: tuple[str, ...] = ("count", "histogram", "joint")
    recovery: Recovery | None = None
    ages: AgeTable | None = None

    __repr__ = brief

    def noise(self, what: str) -> float:
        """1 / (realizations that a part was simulated with), 0 of an exact one: what sampling adds to variances."""
        return 0.0 if what in self.exact else 1.0 / self.simulated

    @property
    def words(self) -> str:
        """How it came about, in words."""
        names = {"count": "count law", "histogram": "mean histogram", "joint": "joint statistics"}
        exact = [name for key, name in names.items() if key in self.exact]
        if not self.simulated:
            return "exact laws" + ("" if self.recovery is None else "; recovery simulated")
        drawn = [name for key, name in names.items() if key not in self.exact] + ["recovery"]
        told = f"{', '.join(drawn)} by {self.simulated:,} simulated realizations"
        return f"{', '.join(exact)} exact; {told}" if exact else told


def system_of(calibration: Calibration, detector: Detector | None, cycles: int, bins: int) -> System:
    """The system whose realizations are predicted."""
    plain = calibration.system(cycles, bins)
    if detector is None:
        return plain
    if calibration.pulse is None:
        if detector.jitter is not None and calibration.jitter_ns == 0.0:
            raise ValueError("a free shape holds the detector's jitter already: leave detector.jitter out")
        return plain.replace(detector=detector)
    if isinstance(calibration.pulse, SampledPulse) and calibration.jitter_ns > 0.0:  # its jitter is off already
        return plain.replace(detector=detector)
    return plain.replace(detector=detector, pulse=pulse_of_the_light(calibration.pulse, detector))


def predict(calibration: Calibration, system: System, realizations: int, light: Fitted) -> Prediction:
    """What realizations of `system` in the calibrated light are like; `realizations` to simulate where no law is.

    `light` is the same light, for the ages of the simulated stream.
    """
    arguments = calibration.light_arguments()
    try:
        exact = count_law(**arguments, system=system)
        law = joint_law(**arguments, system=system)
    except (ValueError, ConvergenceError):
        if is_plain(system.detector):
            raise  # not for want of a law
        return _simulated(calibration, system, realizations, light)
    window, groups = window_of(calibration, system, law.mean), _groups_of(law.mean)
    recovery, ages = None, None
    if not is_plain(system.detector):
        recovery, ages = _intervals(calibration, next(_streams(calibration, system, 1000)), light)
    return Prediction(
        Pmf(int(exact.support[0]), exact.pmf),
        float(exact.mean),
        float(exact.variance),
        law.mean,
        law.variance,
        float(law.window(window)[1]),
        window,
        groups,
        np.asarray(law.covariance_of(group_weights(groups)[:, None], group_weights(groups)[None])),
        recovery=recovery,
        ages=ages,
    )


def window_of(calibration: Calibration, system: System, mean: FloatArray) -> NDArray[np.bool_]:
    """The bins of the signal window, of a mean histogram (bins,)."""
    if calibration.pulse is None:
        centre, half = float(np.argmax(mean)) + 0.5, system.bins / 16
    else:
        low, high = calibration.pulse.support_ns()
        sigma = getattr(calibration.pulse, "sigma_ns", (high - low) / (2.0 * WINDOW_SIGMAS))
        centre = calibration.delay_ns / system.bin_ns
        half = WINDOW_SIGMAS * sigma / system.bin_ns
    away = (np.arange(system.bins) + 0.5 - centre + 0.5 * system.bins) % system.bins - 0.5 * system.bins
    return np.asarray(np.abs(away) <= max(half, 0.5))


def cut(stream: Stream, system: System, labels: NDArray[np.integer]) -> tuple[NDArray[np.int64], FloatArray]:
    """Registrations (realizations, labels) in the bins of each label, and the mean histogram (bins,)."""
    found: list[NDArray[np.int64]] = []
    total = np.zeros(system.bins)
    kinds = int(labels.max()) + 1
    for piece in stream.pieces:
        number = int((piece.end_ns / stream.period_ns + 1e-9) // system.cycles)
        table = np.zeros((number, kinds), np.int64)
        for start in range(0, piece.times_ns.size, 2**20):
            cycle, place, _ = places(piece.times_ns[start : start + 2**20], stream.period_ns, system.bins)
            item = (cycle / system.cycles).astype(np.int64)
            kept = (item >= 0) & (item < number)
            item, place = item[kept], place[kept]
            if item.size:
                first, last = int(item.min()), int(item.max())
                length = last - first + 1
                number_of = np.bincount((item - first) * kinds + labels[place], minlength=length * kinds)
                table[first : last + 1] += number_of.reshape(length, kinds)
                total += np.bincount(place, minlength=system.bins)
        found.append(table)
    every = np.concatenate(found)
    return every, total / max(len(every), 1)


def _simulated(calibration: Calibration, system: System, realizations: int, light: Fitted) -> Prediction:
    """From streams of the exact engine, warmed up for a realization and cut as the measured one is."""
    parts: list[tuple[NDArray[np.int64], ...]] = []  # of each part: groups, window
    total, squares = np.zeros(system.bins), np.zeros(system.bins)
    window, groups = np.zeros(system.bins, bool), np.zeros(system.bins, np.int64)
    recovery, ages = None, None
    for stream in _streams(calibration, system, -(-realizations // _PIXELS)):
        table, histogram = cut(stream, system, np.arange(system.bins))
        if recovery is None:
            window, groups = window_of(calibration, system, histogram), _groups_of(histogram)
            recovery, ages = _intervals(calibration, stream, light)
        total += table.sum(0)
        squares += (table**2).sum(0)
        starts = np.flatnonzero(np.diff(groups, prepend=-1))
        parts.append((np.add.reduceat(table, starts, axis=1), table[:, window].sum(1)))
    grouped, inside = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    number = grouped.sum(1)
    mean = total / number.size
    spread = np.maximum(squares / number.size - mean**2, 0.0)
    arguments = calibration.light_arguments()
    exact: list[str] = []
    count, moments = Pmf.of_counts(number), (float(number.mean()), float(number.var(ddof=1)))
    with suppress(ValueError, ConvergenceError):
        law = count_law(**arguments, system=system)
        count, moments = Pmf(int(law.support[0]), law.pmf), (float(law.mean), float(law.variance))
        exact.append("count")
    with suppress(ValueError, ConvergenceError):
        mean = np.asarray(mean_histogram(**arguments, system=system), dtype=np.float64)
        exact.append("histogram")
    return Prediction(
        count,
        *moments,
        mean,
        spread,
        float(inside.var(ddof=1)),
        window,
        groups,
        np.atleast_2d(np.cov(grouped.T)),
        number.size,
        tuple(exact),
        recovery,
        ages,
    )


def _streams(calibration: Calibration, system: System, per_pixel: int) -> Iterator[Stream]:
    """Streams of so many realizations in each of the pixels, in bounded parts."""
    from mars_lidar.simulate import simulate_timestamps

    light = calibration.flux(_PIXELS)
    each = max(calibration.summary.per_period, 1e-6) * system.cycles * _PIXELS
    part = int(max(1, min(per_pixel, _REGISTRATIONS // max(each, 1.0))))
    for number, begin in enumerate(range(0, per_pixel, part)):
        wanted = min(part, per_pixel - begin)
        warm = system.replace(cycles=system.cycles * (wanted + 1), start="armed")
        stream = stream_of(simulate_timestamps(light, warm, seed=_SEED, realization=number), pooled=True)
        begun = system.cycles * system.period_ns
        pieces = tuple(
            Piece(piece.times_ns[piece.times_ns >= begun] - begun, piece.end_ns - begun, False)
            for piece in stream.pieces
        )
        yield replace(stream, pieces=pieces, cycles=_PIXELS * wanted * system.cycles)


def _intervals(calibration: Calibration, stream: Stream, light: Fitted) -> tuple[Recovery, AgeTable]:
    dead, hold = calibration.dead_time_ns, calibration.hold_off_ns
    return recovery_of(stream, calibration.rate, dead, hold), age_table(stream, light, dead, hold)


def _groups_of(mean: FloatArray) -> NDArray[np.int64]:
    """Groups (bins,) of neighbouring bins, 0, 1, ..., of about equal expected registrations."""
    number = min(_GROUPS, mean.size)
    share = np.cumsum(mean) / mean.sum()
    group = np.minimum((share * number - 1e-9).astype(np.int64), number - 1)
    return np.asarray(np.unique(group, return_inverse=True)[1], dtype=np.int64)


def group_weights(groups: NDArray[np.int64]) -> FloatArray:
    """(groups, bins) 1 where a bin is of the group."""
    return np.asarray(groups == np.arange(int(groups.max()) + 1)[:, None], dtype=np.float64)
