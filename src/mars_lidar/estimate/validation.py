"""The verb `validate`: does the calibrated model predict the stream? Count law, shape, joint statistics, recovery."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _validate
from mars_lidar.detector import Detector
from mars_lidar.estimate.calibration import Calibration, calibrate
from mars_lidar.estimate.detector_model import stream_detector
from mars_lidar.estimate.intervals import FloatArray, stream_of
from mars_lidar.estimate.phase_bins import free_bins
from mars_lidar.estimate.prediction import Prediction, cut, predict, system_of
from mars_lidar.estimate.recovery import Recovery, recovery_of
from mars_lidar.studies.distance import KL_FLOOR, Pmf, g_test, kl_divergence, total_variation, two_sample_g_test
from mars_lidar.system import System
from mars_lidar.timestamps import Timestamps

_BOOTSTRAPS = 400
_LEAST_REALIZATIONS = 20
_LEAST_SIMULATED = 200


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
    prediction
        What was predicted, by which law or by how many simulated realizations.
    measured
        Frequencies of the counts.
    total_variation, total_variation_floor
        Of the count law, and the mean and 99 % quantile of samples of this size from the predicted law (and of the
        simulated size from it, where the prediction is simulated).
    kl, kl_floor
        KL(measured || predicted) in nats, and the same of its floor.
    histogram
        (bins,) mean measured registrations of a realization.
    shape_variation, shape_floor
        Total variation of the normalised histograms, and what sampling alone makes of it in the mean, by the exact
        variances of the bins.
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
    prediction: Prediction
    measured: Pmf
    total_variation: float
    total_variation_floor: tuple[float, float]
    kl: float
    kl_floor: tuple[float, float]
    histogram: FloatArray
    shape_variation: float
    shape_floor: float
    checks: tuple[Check, ...]
    recovery: Recovery
    level: float

    @property
    def predicted(self) -> Pmf:
        """Law of the count: the exact finite-exposure pmf, or frequencies of a simulation."""
        return self.prediction.count

    @property
    def histogram_law(self) -> FloatArray:
        """(bins,) mean predicted registrations of a realization."""
        return self.prediction.histogram

    @property
    def window(self) -> NDArray[np.bool_]:
        """(bins,) the bins of the signal window, +-3 sigma about the strongest return (an eighth of the period about
        the largest bin, with a free shape).
        """
        return self.prediction.window

    @property
    def failed(self) -> tuple[Check, ...]:
        """Tests that the model does not pass, at `level` divided by their number."""
        return tuple(check for check in self.checks if check.p < self.level / len(self.checks))

    @property
    def consistent(self) -> bool:
        """Whether the stream could be one of the model's."""
        short = self.calibration.too_short and self.prediction.recovery is None  # a jitter makes some, as simulated
        return not self.failed and not short


def validate(
    times: Timestamps | Sequence[Timestamps],
    calibration: Calibration | None = None,
    *,
    cycles: int,
    detector: Detector | None = None,
    simulated: int = 4000,
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
    detector
        What the prediction is made for: free-running, paralyzable too, with effects. Efficiency and dark counts are
        taken as part of the calibrated light, a Gaussian jitter as part of its pulse. Default: a pixel with the
        calibrated dead time and nothing more.
    simulated
        Realizations to simulate, at least 200, for what no law predicts: the exact engine draws the model's stream,
        which is cut as the measured one. Their own sampling error is part of every floor and test.
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
    drawn = _validate.integer("simulated", simulated, low=_LEAST_SIMULATED, high=10**7)
    if detector is not None:
        detector = stream_detector(detector)
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
    size = sum(int((piece.end_ns / stream.period_ns + 1e-9) // number) for piece in stream.pieces)
    if size < _LEAST_REALIZATIONS:
        raise ValueError(
            f"cycles must leave at least {_LEAST_REALIZATIONS} realizations of a stream of {stream.cycles:,} periods, "
            f"got {number:,}: {size}"
        )
    system = system_of(calibration, detector, number, free_bins(stream.bins))
    law = predict(calibration, system, drawn)
    label = 2 * law.groups + law.window
    table, histogram = cut(stream, system, label)
    counts, inside = table.sum(1), table[:, 1::2].sum(1)
    measured = Pmf.of_counts(counts)
    floors = _floors(law, measured, size)
    # a calibration by simulation has an error of its own, which makes no difference to the spread
    fitted = 0.0 if calibration.simulated == 0.0 else 1.0 / (calibration.simulated * size)
    count, joint = 1.0 / size + law.noise("count"), 1.0 / size + law.noise("joint")
    checks = [
        Check("counts, G-test", math.nan, math.nan, math.nan, _count_test(law, measured, size)),
        _check("mean count", float(counts.mean()), law.mean, math.sqrt(max(law.variance, 1e-300) * (count + fitted))),
        _check("count variance", *_variance(counts, law.variance, count * size)),
        _check("window variance", *_variance(inside, law.window_variance, joint * size)),
    ]
    expected, shape = law.histogram, 1.0 / size + law.noise("histogram") + fitted
    # E |x| of a normal of variance v is sqrt(2 v / pi)
    shape_floor = 0.5 * float(np.sqrt(2.0 / math.pi * law.bin_variance * shape).sum() / expected.sum())
    if calibration.waveform is None:
        checks.append(_shape_check(law, histogram, shape, len(calibration.names)))
    found = recovery_of(stream, calibration.rate, calibration.dead_time_ns, calibration.hold_off_ns)
    p = found.p_value if law.recovery is None else found.p_against(law.recovery)
    checks.append(Check("recovery, chi²", math.nan, math.nan, math.nan, p))
    return Validation(
        calibration, system, size, counts, law, measured, total_variation(measured, law.count), floors[0],
        _kl(measured, law.count), floors[1], histogram,
        0.5 * float(np.abs(histogram / histogram.sum() - expected / expected.sum()).sum()), shape_floor,
        tuple(checks), found, alpha,
    )  # fmt: skip


def _count_test(law: Prediction, measured: Pmf, size: int) -> float:
    """Of the counts against their law, or against simulated ones."""
    if "count" in law.exact:
        return g_test(law.count, measured, size)
    return two_sample_g_test(measured, size, law.count, law.simulated)


def _check(name: str, measured: float, predicted: float, error: float) -> Check:
    from scipy.stats import norm

    if not error > 0:
        return Check(name, measured, predicted, 0.0, 1.0 if measured == predicted else 0.0)
    return Check(name, measured, predicted, error, float(2.0 * norm.sf(abs(measured - predicted) / error)))


def _variance(counts: NDArray[np.int64], predicted: float, more: float) -> tuple[float, float, float]:
    """Sample variance, the predicted one, and the standard error by the fourth moment of the sample.

    `more`: how much larger the error's square is than that of the sample, by the prediction's own.
    """
    x = counts - counts.mean()
    measured = float((x**2).sum() / (counts.size - 1))
    fourth = float((x**4).mean())
    square = max(fourth - measured**2, 2.0 * measured**2 / counts.size) / counts.size
    return measured, predicted, math.sqrt(square * more)


def _shape_check(law: Prediction, histogram: FloatArray, share: float, parameters: int) -> Check:
    """Chi-square of the mean histogram in groups of equal expected counts, with `share` of their covariance."""
    from scipy.stats import chi2

    starts = np.flatnonzero(np.diff(law.groups, prepend=-1))
    off = np.add.reduceat(histogram - law.histogram, starts)
    values, vectors = np.linalg.eigh(0.5 * (law.group_covariance + law.group_covariance.T))
    good = values > 1e-10 * values[-1]
    square = (((vectors.T @ off)[good]) ** 2 / values[good]).sum() / share
    if law.simulated:  # the inverse of a sample covariance is too large (Hartlap et al., A&A 464, 399, 2007)
        square *= (law.simulated - good.sum() - 2) / (law.simulated - 1)
    freedom = max(int(good.sum()) - parameters, 1)
    p = float(chi2.sf(square, freedom))
    return Check("histogram, chi²", float(square), float(freedom), math.sqrt(2.0 * freedom), p)


def _floors(law: Prediction, measured: Pmf, size: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Mean and 99 % quantile of total variation and KL of samples of `size` counts from the law itself.

    Of a simulated law, against another sample of its size: both drawn from what the two together say.
    """
    random = np.random.default_rng(size)
    p = np.append(law.count.p, max(1.0 - float(law.count.p.sum()), 0.0))
    if "count" not in law.exact:
        low, high = min(law.count.first, measured.first), max(law.count.last, measured.last)
        both = law.simulated * law.count.on(low, high) + size * measured.on(low, high)
        p = both / both.sum()
    p /= p.sum()
    drawn = random.multinomial(size, p, size=_BOOTSTRAPS) / size
    against = p if "count" in law.exact else random.multinomial(law.simulated, p, size=_BOOTSTRAPS) / law.simulated
    distance = 0.5 * np.abs(drawn - against).sum(-1)
    divergence = kl_divergence(drawn, np.maximum(against, KL_FLOOR))
    return (
        (float(distance.mean()), float(np.quantile(distance, 0.99))),
        (float(divergence.mean()), float(np.quantile(divergence, 0.99))),
    )


def _kl(measured: Pmf, predicted: Pmf) -> float:
    low, high = min(measured.first, predicted.first), max(measured.last, predicted.last)
    return float(kl_divergence(measured.on(low, high)[None], predicted.on(low, high))[0])
