"""The verb `validate`: does the calibrated model predict the stream? Count law, shape, joint statistics, intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import armed_time
from mars_lidar.calibrate.calibration import Calibration, _system_of, calibrate
from mars_lidar.calibrate.detector_model import is_plain, moves_records, stream_detector
from mars_lidar.calibrate.fit_tests import Check, Compared
from mars_lidar.calibrate.interval_table import age_table
from mars_lidar.calibrate.intervals import free_bins, stream_of
from mars_lidar.calibrate.light_error import Fitted
from mars_lidar.calibrate.prediction import Prediction, cut, predict, system_of
from mars_lidar.calibrate.recovery import Recovery, recovery_of
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.system import System
from mars_lidar.light.timestamps import Timestamps
from mars_lidar.statistics.distance import Pmf, kl_divergence, total_variation

_LEAST_REALIZATIONS = 20
_LEAST_SIMULATED = 200
_LEAST_PHOTONS = 10


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

    __repr__ = brief

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
    def too_short(self) -> bool:
        """Whether there are intervals shorter than the dead time that the detector cannot make."""
        return bool(self.calibration.too_short) and not moves_records(self.system.detector)

    @property
    def consistent(self) -> bool:
        """Whether the stream could be one of the model's."""
        return not self.failed and not self.too_short


@checked
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
        taken as part of the calibrated light, a Gaussian jitter as part of its pulse. Default: that of the system that
        the stream tells (a simulated one), where the calibration is by default too; else a pixel with the calibrated
        dead time and nothing more.
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
    take them for independent. The error of the calibrated light is part of every test and floor: less is left to a
    statistic of the photons that were fitted, more than sampling where others were (a hold-off, another stream). A free
    shape makes the mean histogram agree by construction, and then it is not tested.
    """
    number = checks.integer("cycles", cycles, low=1, high=10**8)
    alpha = checks.real("level", level, low=0.0, high=0.5, strict_low=True)
    drawn = checks.integer("simulated", simulated, low=_LEAST_SIMULATED, high=10**7)
    if detector is not None:
        detector = stream_detector(detector)
    if calibration is None:
        calibration = calibrate(times, pooled=pooled)
        told = None if detector is not None else _system_of(times)
        if told is not None and not is_plain(told.detector):
            detector = stream_detector(told.detector)
    elif not isinstance(calibration, Calibration):
        raise TypeError(f"calibration must be a Calibration, got {type(calibration).__name__}")
    if calibration.armed.used < _LEAST_PHOTONS:
        raise ValueError(
            f"calibration must be made of at least {_LEAST_PHOTONS} photons, got {calibration.armed.used}: all others "
            f"came within its hold-off of {calibration.hold_off_ns:.5g} ns"
        )
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
    light, dead = Fitted.of(calibration, stream), calibration.dead_time_ns
    law = predict(calibration, system, drawn, light)
    label = 2 * law.groups + law.window
    table, histogram = cut(stream, system, label)
    counts, measured = table.sum(1), Pmf.of_counts(table.sum(1))
    blind = dead
    if (slow := calibration.armed.sensitivity) is not None:  # what a registration costs with its recovery, in the mean
        watched = float(armed_time(stream, dead, 1, slow).passes[0])
        blind = max(dead, (stream.cycles - watched) * stream.period_ns / max(stream.registrations, 1))
    compared = Compared(law, counts, table[:, 1::2].sum(1), histogram, light, blind, number)
    tests = compared.checks(shape=calibration.waveform is None)
    ages = age_table(stream, light, dead, calibration.hold_off_ns, like=law.ages)
    tests += [Check(name, math.nan, math.nan, math.nan, p) for name, p in ages.p_values(light, law.ages).items()]
    floors, expected = compared.floors(), law.histogram
    low, high = min(measured.first, law.count.first), max(measured.last, law.count.last)
    return Validation(
        calibration,
        system,
        size,
        counts,
        law,
        measured,
        total_variation(measured, law.count),
        floors[0],
        float(kl_divergence(measured.on(low, high)[None], law.count.on(low, high))[0]),
        floors[1],
        histogram,
        0.5 * float(np.abs(histogram / histogram.sum() - expected / expected.sum()).sum()),
        compared.shape_floor,
        tuple(tests),
        recovery_of(stream, calibration.rate, dead, calibration.hold_off_ns),
        alpha,
    )
