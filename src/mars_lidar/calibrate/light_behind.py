"""What lies behind a stream: light and phases of avalanches, without the jitter of the records."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import fine_light
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.intervals import Stream
from mars_lidar.calibrate.jittered import normal_kernel, unblurred
from mars_lidar.calibrate.recovery_edge import Law
from mars_lidar.calibrate.shortest_intervals import Underlying
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.law import registration_pdf

MATTERS = 0.15  # of the recorded pulse: a narrower jitter is none
_NODES = 1.05  # ratio of the widths of an edge for which the light behind it is computed
_BINS_PER_WIDTH = 3
_LEAST_BINS, _MOST_BINS = 2**10, 2**15  # of the light behind an edge
_STEPS = 30  # of Richardson and Lucy


@dataclass(frozen=True, eq=False)
class LightBehind:
    """Light and avalanches behind a stream, for calibrations of it."""

    stream: Stream

    def bins(self, width_ns: float) -> int:
        """Bins that are narrow beside the edge."""
        bins = _MOST_BINS
        while bins > _LEAST_BINS and bins * width_ns > 2.0 * _BINS_PER_WIDTH * self.stream.period_ns:
            bins //= 2
        return bins

    def law(self, found: Calibration, about_ns: float, clock_ns: float) -> Law:
        """What lies behind edges of about that width, as a function of it."""
        bins = self.bins(about_ns)
        if not isinstance(found.pulse, GaussianPulse):
            same = self.of(found, bins)
            return lambda width_ns: same

        widest = 0.99 * found.pulse.sigma_ns**2  # variance of a jitter
        known: dict[int, Underlying] = {}

        def variance(width_ns: float) -> float:
            """Variance, ns^2, of the jitter that makes an edge of that width."""
            return min(0.5 * max(width_ns**2 - clock_ns**2, 0.0), widest)

        def at(node: int) -> Underlying:
            if node not in known:
                jitter = math.sqrt(variance(_NODES**node))
                known[node] = self.of(replace(found, jitter_ns=jitter), bins)
            return known[node]

        def behind(width_ns: float) -> Underlying:
            # between two widths by the variance of the jitter, which leaves the variance of the pulse as it is
            node = math.floor(math.log(width_ns) / math.log(_NODES))
            low, high = variance(_NODES**node), variance(_NODES ** (node + 1))
            if high == low:
                return at(node)
            part = float(np.clip((variance(width_ns) - low) / (high - low), 0.0, 1.0))
            return at(node).mixed(at(node + 1), part)

        return behind

    def any_width(self, found: Calibration) -> Law:
        """What lies behind edges of any width; jitters that are small beside the pulse are none."""
        known: dict[float, Underlying] = {}
        sigma = found.pulse.sigma_ns if isinstance(found.pulse, GaussianPulse) else math.inf
        bins = self.bins(sigma) if math.isfinite(sigma) else _MOST_BINS // 4

        def behind(width_ns: float) -> Underlying:
            jitter = width_ns / math.sqrt(2.0)
            jitter = jitter if jitter > MATTERS * sigma else 0.0
            if jitter not in known:
                known[jitter] = self.of(replace(found, jitter_ns=jitter), bins)
            return known[jitter]

        return behind

    def of(self, found: Calibration, bins: int) -> Underlying:
        """Light and phases of avalanches."""
        period, jitter = self.stream.period_ns, found.jitter_ns
        if found.pulse is None:
            rate = fine_light(self.stream, found.hold_off_ns, bins)
        else:
            rate = found.arriving_in(bins)
        if jitter == 0.0:
            phases = self.stream.histogram(bins).astype(np.float64)
        elif found.pulse is not None:
            phases = self._in_the_long_run(rate, found)
        else:
            kernel = normal_kernel(jitter, period, bins)
            rate = unblurred(rate, kernel, _STEPS)
            phases = unblurred(self.stream.histogram(bins).astype(np.float64), kernel, _STEPS)
        return Underlying.of(rate, phases, period)

    def _in_the_long_run(self, rate: FloatArray, found: Calibration) -> FloatArray:
        """Phases (n,) of avalanches in light (n,), which the jitter of the records hides."""
        system = System(
            period_ns=self.stream.period_ns,
            cycles=1,
            bins=rate.size,
            start="stationary",
            pulse=GaussianPulse(sigma_ns=0.01 * self.stream.period_ns),
            detector=Detector(dead_time_ns=found.dead_time_ns),
        )
        try:
            return registration_pdf(None, 0.0, system, "stationary", waveform=rate, threads=1)
        except (ConvergenceError, ValueError):  # locked to the laser, or far more light than the laws do
            kernel = normal_kernel(found.jitter_ns, self.stream.period_ns, rate.size)
            return unblurred(self.stream.histogram(rate.size).astype(np.float64), kernel, _STEPS)

    def uncertain(self, found: Calibration, width_ns: float, clock_ns: float) -> tuple[Law, ...]:
        """The light, a standard error away in each independent direction of its parameters but the jitter."""
        if found.pulse is None:
            return ()
        told = np.isfinite(np.diag(found.covariance)) & np.array([name != "jitter_ns" for name in found.names])
        values, vectors = np.linalg.eigh(found.covariance[np.ix_(told, told)])
        lights = []
        for value, vector in zip(values, vectors.T, strict=True):
            step: FloatArray = np.zeros(told.size)
            step[told] = math.sqrt(max(value, 0.0)) * vector
            lights.append(self.law(found.moved(step), width_ns, clock_ns))
        return tuple(lights)
