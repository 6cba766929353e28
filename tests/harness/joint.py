"""The closed-form mean and covariance of the histogram (`mars_lidar.joint_law`) as an oracle for every engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import mars_lidar as ml
from harness.cases import Case
from harness.pvalues import merge

_SAMPLES = 2**14  # of a waveform that stands for several returns


@dataclass(frozen=True, eq=False)
class JointLaw:
    """Mean and covariance of cells (neighbouring bins that are joined until they hold enough) and windows."""

    law: ml.JointLaw

    @classmethod
    def of(cls, case: Case, tolerance: float = 3e-4) -> JointLaw:
        """The law of the case's pixel; None of its engines is asked."""
        flux, system = case.flux, case.system
        background = float(flux.background[0, 0])
        if flux.waveform is not None:
            return cls(
                ml.joint_law(ml.Flux(waveform=flux.waveform[0, 0], background=background), system, tolerance=tolerance)
            )
        signals, delays = flux.returns_signal[:, 0, 0], flux.returns_delay_ns[:, 0, 0]
        if len(signals) == 1:
            return cls(
                ml.joint_law(ml.Flux(float(signals[0]), background, float(delays[0])), system, tolerance=tolerance)
            )
        wave = sum(
            s * np.maximum(system.pulse.bin_energy(tau, system.period_ns, _SAMPLES), 0.0)
            for s, tau in zip(signals, delays, strict=True)
        )
        return cls(ml.joint_law(ml.Flux(waveform=wave, background=background), system, tolerance=tolerance))

    def cells(self, items: int, most: int) -> NDArray[np.float64]:
        """(cells, bins) weights of at most `most` cells, each with 500 registrations in `items` exposures."""
        expected = self.law.mean * items
        cell = merge(expected, max(500.0, expected.sum() / most))
        return (cell == np.arange(cell[-1] + 1)[:, None]).astype(float)

    def windows(self, items: int) -> NDArray[np.float64]:
        """(windows, bins) weights: half of the registrations in the fewest bins, and single bins, six or fewer."""
        mean = self.law.mean
        order = np.argsort(-mean, kind="stable")
        brightest = np.zeros(mean.size)
        brightest[order[: int(np.searchsorted(np.cumsum(mean[order]), 0.5 * mean.sum())) + 1]] = 1.0
        often = order[mean[order] * items >= 500][:200]
        single = np.eye(mean.size)[often[:: max(1, often.size // 6)][:6]]
        return np.vstack([brightest, single])
