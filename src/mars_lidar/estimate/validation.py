"""The verb `validate`: does the calibrated model predict the stream? Count law, shape, joint statistics, recovery."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _validate
from mars_lidar.estimate.calibration import Calibration, _free_bins, calibrate
from mars_lidar.estimate.intervals import FloatArray, Stream, stream_of
from mars_lidar.estimate.recovery import Recovery, recovery_of
from mars_lidar.statistics import JointLaw, count_law, joint_law
from mars_lidar.studies.distance import KL_FLOOR, Pmf, g_test, kl_divergence, total_variation
from mars_lidar.system import System
from mars_lidar.timestamps import Timestamps

_BOOTSTRAPS = 400
_WINDOWS = 64  # of the period, in which the mean histogram is tested with its exact covariance
_WINDOW_SIGMAS = 3.0
_LEAST_REALIZATIONS = 20
_BATCH = 64  # realizations whose scatter gives the errors of variances


@dataclass(frozen=True)
class Check:
    """One comparison of the stream with the model.

    Attributes
    ----------
    name
        What is compared.
    measured, predicted, error
        The figures, and the standard error of their difference by sampling; NaN where there is none.
    p
        Probability of a difference at least as large if the model holds.
    """

    name: str
    measured: float
    predicted: float
    error: float
    p: float

    @property
    def score(self) -> float:
        """Difference in standard errors."""
        return (self.measured - self.predicted) / self.error if self.error > 0 else math.nan


@dataclass(frozen=True, eq=False)
class Validation:
    """A stream cut into realizations, beside what the calibrated model predicts of them; made by `validate`.

    Attributes
    ----------
    calibration, system
        What the prediction is made of; the system's start is ``stationary``.
    realizations
        Number of stretches of ``system.cycles`` periods.
    counts
        (realizations,) registrations of each.
    measured, predicted
        Law of the count: frequencies, and the exact finite-exposure pmf.
    total_variation, total_variation_floor
        Of the count law, and the mean and 99 % quantile of samples of this size from the predicted law.
    kl, kl_floor
        KL(measured || predicted) in nats, and the same of its floor.
    histogram, histogram_law
        (bins,) mean measured and predicted registrations of a realization.
    shape_variation, shape_floor
        Total variation of the normalised histograms, and what sampling alone makes of it in the mean, by the exact
        variances of the bins.
    window
        (bins,) weights of the signal window, +-3 sigma about the strongest return (an eighth of the period about
        the largest bin, with a free shape).
    checks
        All tests; `consistent` is their verdict.
    recovery
        Registrations by time since the last one.
    level
        False-alarm probability of the verdict, all tests together.
    """

    calibration: Calibration
    system: System
    realizations: int
    counts: NDArray[np.int64]
    measured: Pmf
    predicted: Pmf
    total_variation: float
    total_variation_floor: tuple[float, float]
    kl: float
    kl_floor: tuple[float, float]
    histogram: FloatArray
    histogram_law: FloatArray
    shape_variation: float
    shape_floor: float
    window: NDArray[np.bool_]
    checks: tuple[Check, ...]
    recovery: Recovery
    level: float

    @property
    def failed(self) -> tuple[Check, ...]:
        """Tests that the model does not pass, at `level` divided by their number."""
        return tuple(check for check in self.checks if check.p < self.level / len(self.checks))

    @property
    def consistent(self) -> bool:
        """Whether the stream could be one of the model's."""
        return not self.failed and self.calibration.too_short == 0


def validate(
    times: Timestamps | Sequence[Timestamps],
    calibration: Calibration | None = None,
    *,
    cycles: int,
    level: float = 0.01,
    pooled: bool = False,
) -> Validation:
    """Cut a stream into realizations of `cycles` laser periods and compare them with the calibrated model.

    Parameters
    ----------
    times, pooled
        As for `calibrate`.
    calibration
        What `calibrate` found, from this stream or another; default: from this one, with its defaults.
    cycles
        Laser periods of a realization; at least 20 must fit in the stream. What is left at its end is not used.
    level
        False-alarm probability of the verdict: a stream of the model's fails this often.

    Returns
    -------
    Validation

    Notes
    -----
    A stretch of a running stream begins with a warmed-up pixel: the law is that of ``start="stationary"``.
    Neighbouring stretches share a dead time, which correlates their counts at the order of one count; the floors
    take them for independent. Parameters that were fitted to the same stream make the fit slightly better than
    the floor; a free shape makes the mean histogram agree by construction, and then it is not tested.
    """
    number = _validate.integer("cycles", cycles, low=1, high=10**8)
    alpha = _validate.real("level", level, low=0.0, high=0.5, strict_low=True)
    if calibration is None:
        calibration = calibrate(times, pooled=pooled)
    elif not isinstance(calibration, Calibration):
        raise TypeError(f"calibration must be a Calibration, got {type(calibration).__name__}")
    stream = stream_of(times, pooled=pooled)
    if abs(stream.period_ns / calibration.summary.period_ns - 1.0) > 1e-9:
        raise ValueError(
            f"times must have the period that was calibrated, {calibration.summary.period_ns:g} ns, "
            f"got {stream.period_ns:g}"
        )
    bins = _free_bins(stream.bins)
    system = calibration.system(number, bins)
    law = joint_law(**calibration.light_arguments(), system=system)
    window = _window(calibration, system, law)
    counts, inside, histogram = _cut(stream, system, window)
    size = counts.size
    if size < _LEAST_REALIZATIONS:
        raise ValueError(
            f"cycles must leave at least {_LEAST_REALIZATIONS} realizations of a stream of {stream.cycles:,} periods, "
            f"got {number:,}: {size}"
        )
    exact = count_law(**calibration.light_arguments(), system=system)
    predicted = Pmf(int(exact.support[0]), exact.pmf)
    measured = Pmf.of_counts(counts)
    floors = _floors(predicted, size)
    mean_error = math.sqrt(max(float(exact.variance), 1e-300) / size)
    checks = [
        Check("counts, G-test", math.nan, math.nan, math.nan, g_test(predicted, measured, size)),
        _check("mean count", float(counts.mean()), float(exact.mean), mean_error),
        _check("count variance", *_variance(counts, float(exact.variance))),
        _check("window variance", *_variance(inside, float(law.window(window)[1]))),
    ]
    shape_floor = math.nan
    variance = law.variance
    # E |x| of a normal of variance v is sqrt(2 v / pi)
    shape_floor = 0.5 * float(np.sqrt(2.0 / math.pi * variance / size).sum() / law.mean.sum())
    if calibration.waveform is None:
        checks.append(_shape_check(law, histogram, size, len(calibration.names)))
    found = recovery_of(stream, calibration.rate, calibration.dead_time_ns, calibration.hold_off_ns)
    checks.append(Check("recovery, chi²", math.nan, math.nan, math.nan, found.p_value))
    expected = law.mean
    return Validation(
        calibration, system, size, counts, measured, predicted, total_variation(measured, predicted), floors[0],
        _kl(measured, predicted), floors[1], histogram, expected,
        0.5 * float(np.abs(histogram / histogram.sum() - expected / expected.sum()).sum()), shape_floor, window,
        tuple(checks), found, alpha,
    )  # fmt: skip


def _cut(
    stream: Stream, system: System, window: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Counts (r,) of all bins and of those in the window, and the mean histogram (bins,)."""
    counts: list[NDArray[np.int64]] = []
    inside: list[NDArray[np.int64]] = []
    total = np.zeros(system.bins)
    for piece in stream.pieces:
        number = int((piece.end_ns / stream.period_ns + 1e-9) // system.cycles)
        both = np.zeros((2, number), np.int64)
        for start in range(0, piece.times_ns.size, 2**20):
            x = piece.times_ns[start : start + 2**20] / stream.period_ns
            cycle = np.floor(x)
            place = np.minimum(((x - cycle) * system.bins).astype(np.int64), system.bins - 1)
            item = (cycle / system.cycles).astype(np.int64)
            kept = item < number
            item, place = item[kept], place[kept]
            if item.size:
                first = int(item[0])
                length = int(item[-1]) - first + 1
                both[0, first : first + length] += np.bincount(item - first, minlength=length)
                marked = window[place]
                both[1, first : first + length] += np.bincount(item[marked] - first, minlength=length)
                total += np.bincount(place, minlength=system.bins)
        counts.append(both[0])
        inside.append(both[1])
    all_counts = np.concatenate(counts)
    return all_counts, np.concatenate(inside), total / max(all_counts.size, 1)


def _window(calibration: Calibration, system: System, law: JointLaw) -> NDArray[np.bool_]:
    """The bins of the signal window."""
    if calibration.pulse is None:
        centre, half = float(np.argmax(law.mean)) + 0.5, system.bins / 16
    else:
        low, high = calibration.pulse.support_ns()
        sigma = getattr(calibration.pulse, "sigma_ns", (high - low) / (2.0 * _WINDOW_SIGMAS))
        centre = calibration.delay_ns / system.bin_ns
        half = _WINDOW_SIGMAS * sigma / system.bin_ns
    away = (np.arange(system.bins) + 0.5 - centre + 0.5 * system.bins) % system.bins - 0.5 * system.bins
    return np.asarray(np.abs(away) <= max(half, 0.5))


def _check(name: str, measured: float, predicted: float, error: float) -> Check:
    from scipy.stats import norm

    if not error > 0:
        return Check(name, measured, predicted, 0.0, 1.0 if measured == predicted else 0.0)
    return Check(name, measured, predicted, error, float(2.0 * norm.sf(abs(measured - predicted) / error)))


def _variance(counts: NDArray[np.int64], predicted: float) -> tuple[float, float, float]:
    """Sample variance, the predicted one, and the standard error by the fourth moment of the sample."""
    x = counts - counts.mean()
    measured = float((x**2).sum() / (counts.size - 1))
    fourth = float((x**4).mean())
    return measured, predicted, math.sqrt(max(fourth - measured**2, 2.0 * measured**2 / counts.size) / counts.size)


def _shape_check(law: JointLaw, histogram: FloatArray, size: int, parameters: int) -> Check:
    """Chi-square of the mean histogram in windows of equal expected counts, with the exact covariance of them."""
    from scipy.stats import chi2

    windows = min(_WINDOWS, law.mean.size)
    share = np.cumsum(law.mean) / law.mean.sum()
    group = np.minimum((share * windows - 1e-9).astype(np.int64), windows - 1)
    used = np.unique(group)
    weights = (group == used[:, None]).astype(np.float64)
    off = weights @ (histogram - law.mean)
    matrix = law.covariance_of(weights[:, None], weights[None]) / size
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    good = values > 1e-10 * values[-1]
    statistic = float((((vectors.T @ off)[good]) ** 2 / values[good]).sum())
    freedom = max(int(good.sum()) - parameters, 1)
    p = float(chi2.sf(statistic, freedom))
    return Check("histogram, chi²", statistic, float(freedom), math.sqrt(2.0 * freedom), p)


def _floors(law: Pmf, size: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Mean and 99 % quantile of total variation and KL of samples of `size` counts from the law itself."""
    random = np.random.default_rng(size)
    p = np.append(law.p, max(1.0 - float(law.p.sum()), 0.0))
    p /= p.sum()
    drawn = random.multinomial(size, p, size=_BOOTSTRAPS) / size
    distance = 0.5 * np.abs(drawn - p).sum(-1)
    divergence = kl_divergence(drawn, np.maximum(p, KL_FLOOR))
    return (
        (float(distance.mean()), float(np.quantile(distance, 0.99))),
        (float(divergence.mean()), float(np.quantile(divergence, 0.99))),
    )


def _kl(measured: Pmf, predicted: Pmf) -> float:
    low, high = min(measured.first, predicted.first), max(measured.last, predicted.last)
    return float(kl_divergence(measured.on(low, high)[None], predicted.on(low, high))[0])
