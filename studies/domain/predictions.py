"""Predictions of one case, each asked for by itself and held against the others and against closed forms."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mars_lidar import CountLaw, JointLaw, count_law, cramer_rao, joint_law, registration_pdf
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import mean_histogram, photons_per_bin
from studies.domain.case import Case
from studies.domain.checks import Check
from studies.domain.closed_forms import known
from studies.domain.samples import Windows

TOLERANCE = 1e-4  # of `count_law` and `mean_histogram`: their default
AGREE = 2e-3  # standard deviations, relative variance, total variation that two predictions may differ by
_QUICK_JOINT = 8.0  # photons in a dead time up to which `joint_law` takes milliseconds
_QUICK_SECONDS = 0.1  # of `joint_law`, up to which it is asked for very many windows too
_WIDEST = 2_000_000  # counts of a pmf that is kept


class Predictions:
    """What the predictions say of one case: filled step by step, None where they refused or were not asked."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.known = known(case)
        self.law: CountLaw | None = None
        self.pmf: tuple[int, FloatArray] | None = None
        self.histogram: FloatArray | None = None
        self.joint: JointLaw | None = None
        self.windows: Windows | None = None
        self.window_mean: FloatArray | None = None
        self.window_variance: FloatArray | None = None
        self.cell_variance: FloatArray | None = None
        self.echo_covariance = 0.0

    def steps(self) -> list[tuple[str, Callable[[], list[Check]]]]:
        """Names and calls, in order; each returns its comparisons with what is known so far."""
        if not self.case.predictable:
            return []
        steps = [
            ("count_law", self._count_law),
            ("pmf", self._pmf),
            ("mean_histogram", self._histogram),
            ("stationary shape", self._stationary),
        ]
        if self._joint_asked:
            steps.append(("joint_law", self._joint))
        if self.case.waveform is None and self.case.number % 6 == 0:  # a mean histogram and some algebra
            steps.append(("cramer_rao", self._bound))
        return steps

    @property
    def _joint_asked(self) -> bool:
        """Everywhere it is quick, and every fourth system elsewhere, to see whether it is."""
        case = self.case
        quick = case.photons * case.system.dead_time_periods <= _QUICK_JOINT and case.system.bins <= 4096
        return quick or case.number % 4 == 0

    def mean(self) -> FloatArray | None:
        """Mean histogram (bins,), whichever prediction has it."""
        return self.histogram if self.histogram is not None else None if self.joint is None else self.joint.mean

    def _count_law(self) -> list[Check]:
        law = count_law(self.case.flux()[0, 0], self.case.system, threads=1)
        self.law = law
        results = [_sane("count_law", bool(np.isfinite(law.cumulants).all() and law.mean >= 0 and law.variance >= 0))]
        if self.known is not None:
            sd = np.sqrt(self.known.variance or 0.0) or 1.0
            size = max(sd, 1e-4 * self.known.mean, 1e-12)
            results.append(_agree("count_law", "closed form", "mean of the count", (law.mean - self.known.mean) / size))
            if self.known.variance is not None and self.known.variance > 1e-9 * max(self.known.mean, 1e-9):
                off = law.variance / self.known.variance - 1.0
                results.append(_agree("count_law", "closed form", "variance of the count", off))
        return results

    def _pmf(self) -> list[Check]:
        if self.law is None:
            return []
        pmf = np.asarray(self.law.pmf)
        support = self.law.support
        sd = max(float(np.sqrt(self.law.variance)), 1e-6)
        off = support - float(self.law.mean)  # of the mean, which may be 1e8, to parts of a count
        mean = float(pmf @ off)
        variance = float(pmf @ (off - mean) ** 2)
        results = [
            _sane("pmf", bool(np.isfinite(pmf).all() and pmf.min() > -1e-9)),
            _agree("pmf", "count_law", "total", pmf.sum() - 1.0),
            _agree("pmf", "count_law", "mean of the count", mean / max(sd, 1e-3)),
        ]
        if self.law.variance > 1e-6:
            results.append(
                _agree("pmf", "count_law", "variance of the count", variance / float(self.law.variance) - 1.0)
            )
        if self.known is not None and self.known.pmf is not None:
            wide = max(int(support[-1]) + 1, self.known.pmf.size)
            mine, theirs = np.zeros(wide), np.zeros(wide)
            mine[support], theirs[: self.known.pmf.size] = pmf, self.known.pmf
            results.append(_agree("pmf", "closed form", "law of the count", 0.5 * float(np.abs(mine - theirs).sum())))
        if pmf.size <= _WIDEST:
            self.pmf = int(support[0]), np.maximum(pmf, 0.0)
        return results

    def _histogram(self) -> list[Check]:
        mean = np.asarray(mean_histogram(self.case.flux()[0, 0], self.case.system, threads=1))
        self.histogram = mean
        self.windows = Windows.of(self.case, mean)
        least = float(mean.min(initial=0.0))
        results = [
            _sane("mean_histogram", bool(np.isfinite(mean).all() and least >= -1e-9 * max(1.0, float(mean.max()))))
        ]
        if self.law is not None:
            results.append(_agree("mean_histogram", "count_law", "mean of the count", self._in_sd(float(mean.sum()))))
        return results

    def _stationary(self) -> list[Check]:
        case = self.case
        shape = np.asarray(registration_pdf(case.flux()[0, 0], case.system, "stationary", threads=1))
        results = [_sane("stationary shape", bool(np.isfinite(shape).all() and abs(shape.sum() - 1.0) < 1e-6))]
        dead = case.system.dead_time_periods
        plain = case.mode == "nonparalyzable" and not case.system.detector.effects
        if plain and dead == round(dead) and case.photons > 0.0:
            flat = photons_per_bin(case.flux()[0, 0], case.system, bins=case.system.bins)
            off = 0.5 * float(np.abs(shape - flat / flat.sum()).sum())
            results.append(_agree("stationary shape", "closed form", "shape", off))
        if case.system.start == "stationary" and self.histogram is not None and self.histogram.sum() > 0.0:
            observed = self.histogram / self.histogram.sum()
            off = 0.5 * float(np.abs(shape - observed).sum())
            results.append(_agree("stationary shape", "mean_histogram", "shape", off))
        return results

    def _joint(self) -> list[Check]:
        began = time.process_time()
        joint = joint_law(self.case.flux()[0, 0], self.case.system)
        took = time.process_time() - began
        self.joint = joint
        if self.windows is None:
            self.windows = Windows.of(self.case, joint.mean)
        weights = self.windows.weights.astype(np.float64)
        self.window_mean, self.window_variance = joint.window(weights)
        # a window of many cells takes as long as the law where the exposure is run through: that is not the law's time
        if took < _QUICK_SECONDS and max(joint.grid_bins, joint.mean.size) * self.windows.edges.size <= 4_000_000:
            self.cell_variance = joint.window(self.windows.cells().astype(np.float64))[1]
        self.echo_covariance = float(joint.covariance_of(weights[1], weights[2]))
        results = [_sane("joint_law", bool(np.isfinite(joint.mean).all() and np.isfinite(self.window_variance).all()))]
        if self.law is not None:
            results.append(_agree("joint_law", "count_law", "mean of the count", self._in_sd(joint.count_mean)))
            variance = float(self.law.variance)
            if variance > 1e-6 * max(1.0, float(self.law.mean)):
                off = self.window_variance[0] / variance - 1.0
                results.append(_agree("joint_law", "count_law", "variance of the count", off))
        if self.histogram is not None and self.histogram.sum() > 0.0:
            off = 0.5 * float(np.abs(self.histogram - joint.mean).sum() / self.histogram.sum())
            results.append(_agree("joint_law", "mean_histogram", "mean histogram", off))
        return results

    def _bound(self) -> list[Check]:
        bound = cramer_rao(self.case.flux()[0, 0], self.case.system, threads=1)
        errors = np.array([bound.signal, bound.background, bound.delay_ns], dtype=np.float64)
        return [_sane("cramer_rao", bool((errors > 0.0).all() and np.isfinite(bound.information).all()))]

    def _in_sd(self, mean: float) -> float:
        assert self.law is not None
        sd = float(np.sqrt(max(float(self.law.variance), 0.0)))
        return (mean - float(self.law.mean)) / max(sd, 1e-3 * float(self.law.mean), 1e-9)


def _agree(a: str, b: str, what: str, off: Any) -> Check:
    """Agreement of two numbers whose scaled difference is `off`."""
    return Check(a, b, what, 1.0 if abs(float(off)) <= AGREE else 0.0, float(off))


def _sane(name: str, fine: bool) -> Check:
    """Numbers that are numbers: finite, not negative."""
    return Check(name, name, "finite and not negative", 1.0 if fine else 0.0, 0.0)
