"""The dead time of a stream, and its jitter: by the smallest interval, or by the middle of a blurred edge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mars_lidar.estimate.calibration_once import CERTAIN, Watch, fitted
from mars_lidar.estimate.calibration_result import Calibration, nearest
from mars_lidar.estimate.edge import ORDINARY, Edge, edge_of
from mars_lidar.estimate.intervals import Stream
from mars_lidar.estimate.shortest import FEW, Ages, Underlying, extrapolated, is_sharp, shortest
from mars_lidar.estimate.stream_summary import Summary
from mars_lidar.pulse import GaussianPulse, Pulse
from mars_lidar.statistics import ConvergenceError

SHARP = 0.01  # false-alarm probability of a blurred edge
HIDDEN = 14.0  # of a jitter this many mean excesses of the smallest interval wide nine in ten are seen
_ROUNDS = 4
_BINS_PER_WIDTH = 8
_STARTS = (0.15, 0.06, 0.4)  # widths tried, in parts of the reach over which the edge is not sharp
_SAME = 0.05  # standard errors by which a last round may move the edge
_AGREE = 4.0  # standard errors between the jitter by the edge and that by the shape of the pulse


@dataclass(frozen=True, eq=False)
class Unknown:
    """A calibration whose dead time is estimated too, and the jitter where `jitter_ns` is None."""

    stream: Stream
    counted: Summary
    shape: Pulse | Literal["gaussian", "free"]
    hold_off_ns: float | None
    returns: int
    jitter_ns: float | None

    def calibrated(self) -> Calibration:
        """By the smallest interval where the edge is sharp, else with edge and light fitted in turn."""
        if self.counted.smallest_ns.size == 0:
            raise ValueError("dead_time_ns must be given where no recording in times holds two registrations")
        smallest, hold, told = float(self.counted.smallest_ns[0]), self.hold_off_ns, self.jitter_ns or 0.0
        if hold is not None and hold < smallest:
            raise ValueError(f"hold_off_ns must be at least the dead time of {smallest:g} ns, got {hold:g}")
        least = smallest + CERTAIN * told
        first = self._pass(Watch(smallest, max(least, hold or 0.0), told, by="smallest interval"))
        if smallest == 0.0 or self.jitter_ns == 0.0:
            return self._sharp(first)
        sharp, found = self._blurred(first)
        if found is not None:
            return found
        return self._sharp(first) if sharp else replace(self._sharp(first), edge_fits=False, jitter_limit_ns=0.0)

    def _pass(self, watch: Watch, near: Calibration | None = None) -> Calibration:
        return fitted(self.stream, self.counted, self.shape, watch, self.returns, near)

    def _sharp(self, first: Calibration) -> Calibration:
        """The smallest of n intervals exceeds t_d by 1 / (sum of the rates at re-arming) in the mean."""
        stream, smallest = self.stream, first.dead_time_ns
        excess = stream.period_ns / max(stream.registrations * _rate_after(stream, first), 1e-300)
        # a dead time as short as that would have let one interval more pass: far less where no light fell before
        error = max(excess, smallest - _shortest_likely(stream, first))
        limit = math.hypot(HIDDEN * excess, stream.unit_ns)
        told = self.jitter_ns is not None or smallest < limit  # no edge, no jitter to be seen by it
        return replace(
            first,
            dead_time_ns=max(smallest - excess, 0.0),
            dead_time_error_ns=math.hypot(error, stream.unit_ns, first.jitter_ns),
            jitter_limit_ns=0.0 if told else limit,
        )

    def _blurred(self, first: Calibration) -> tuple[bool, Calibration | None]:
        """Whether the edge is sharp; and by the edge, None where that is sharp or no Gaussian jitter makes it."""
        ages = shortest(self.stream, first.dead_time_ns)
        if ages.interval_ns.size < FEW:
            return True, None
        try:
            return self._started(first, ages)
        except (ConvergenceError, ValueError):  # light beyond what the laws do: far more than one photon per period
            return True, None

    def _started(self, first: Calibration, ages: Ages) -> tuple[bool, Calibration | None]:
        """From several rough edges, if the edge is not sharp."""
        sharp = _behind(first, first.dead_time_ns, 0.0)
        if self.jitter_ns is None:
            chance, reach = is_sharp(ages, sharp)
            if chance > SHARP:
                return True, None
            widths = [reach * part for part in _STARTS]
        else:
            widths = [math.sqrt(2.0) * self.jitter_ns]
        found = (self._from(first, ages, extrapolated(ages, sharp, width), width) for width in widths)
        return False, next((one for one in found if one is not None), None)

    def _from(self, first: Calibration, ages: Ages, dead: float, width: float) -> Calibration | None:
        """The edge and the light in turn, from a rough edge."""
        found = first
        if dead <= 0.0:
            return None
        for _ in range(_ROUNDS):
            edge = self._edge(ages, found, dead, width)
            if edge is None or not _is_jitter(edge, ages, found):
                return None
            shift = abs(edge.dead_time_ns - dead) / edge.dead_time_error_ns
            found = self._pass(self._watch(edge), None if found is first else found)
            dead, width = edge.dead_time_ns, math.hypot(math.sqrt(2.0) * edge.jitter_ns, ages.clock_ns)
            if shift < _SAME:
                break
        edge = self._edge(ages, found, dead, width, _uncertain(found, dead, width))
        if edge is None or not edge.fits > ORDINARY:
            return None
        if abs(found.jitter_ns - edge.jitter_ns) > _AGREE * edge.jitter_error_ns > 0.0:  # the pulse is no Gaussian
            found = self._pass(replace(self._watch(edge), jitter_error_ns=0.0), found)
            found = replace(found, jitter_error_ns=edge.jitter_error_ns)
        elif "jitter_ns" in found.names:
            edge = edge.known(found.jitter_ns, found.jitter_error_ns)
        elif found.pulse is not None and edge.jitter_error_ns > 0.0:  # a measured pulse: the light with another jitter
            watch = replace(self._watch(edge), jitter_ns=edge.jitter_ns + edge.jitter_error_ns)
            moved = nearest(found, self._pass(watch, found).parameters - found.parameters)
            found = replace(found, covariance=found.covariance + np.outer(moved, moved))
        return replace(found, dead_time_ns=edge.dead_time_ns, dead_time_error_ns=edge.dead_time_error_ns)

    def _edge(
        self, ages: Ages, found: Calibration, dead: float, width: float, off: tuple[Underlying, ...] = ()
    ) -> Edge | None:
        edge = edge_of(ages, _behind(found, dead, width), dead, width, off)
        return edge if edge is None or self.jitter_ns is None else edge.known(self.jitter_ns, 0.0)

    def _watch(self, edge: Edge) -> Watch:
        hold = max(edge.dead_time_ns + CERTAIN * edge.jitter_ns, self.hold_off_ns or 0.0)
        return Watch(edge.dead_time_ns, hold, edge.jitter_ns, edge.jitter_error_ns, edge.dead_time_error_ns, "edge")


def _is_jitter(edge: Edge, ages: Ages, found: Calibration) -> bool:
    """Whether the edge is wider than the clock alone makes it, and no wider than the pulse, which holds the jitter."""
    if ages.clock_ns > 0.0 and edge.jitter_ns < max(ages.clock_ns, 2.0 * edge.jitter_error_ns):
        return False
    sigma = found.pulse.sigma_ns if isinstance(found.pulse, GaussianPulse) else math.inf
    return edge.jitter_ns - 3.0 * edge.jitter_error_ns < sigma


def _behind(found: Calibration, dead_ns: float, width_ns: float) -> Underlying:
    """The light, in bins that are narrow beside the edge."""
    rate, period = found.arriving, found.summary.period_ns
    while rate.size % 2 == 0 and _BINS_PER_WIDTH * 2.0 * period < rate.size * width_ns:
        rate = rate.reshape(-1, 2).sum(1)
    return Underlying.of(rate, period, dead_ns)


def _uncertain(found: Calibration, dead_ns: float, width_ns: float) -> tuple[Underlying, ...]:
    """The light, a standard error away in each independent direction of its parameters."""
    if found.pulse is None:
        return ()
    told = np.isfinite(np.diag(found.covariance))
    values, vectors = np.linalg.eigh(found.covariance[np.ix_(told, told)])
    lights = []
    for value, vector in zip(values, vectors.T, strict=True):
        step = np.zeros(told.size)
        step[told] = math.sqrt(max(value, 0.0)) * vector
        lights.append(_behind(found.moved(step), dead_ns, width_ns))
    return tuple(lights)


def _rate_after(stream: Stream, found: Calibration) -> float:
    """Mean photons per period that fall on the pixel at the moment it re-arms."""
    rate, bins = found.rate, found.armed.passes.size
    shift = found.dead_time_ns / stream.period_ns
    total = 0.0
    for phase in stream.phases():
        again = phase + shift
        again -= np.floor(again)
        total += float(rate[np.minimum((again * bins).astype(np.int64), bins - 1)].sum()) * bins
    return total / max(stream.registrations, 1)


def _shortest_likely(stream: Stream, found: Calibration) -> float:
    """The dead time, ns, with which one interval is expected that is shorter than the smallest; at least 0."""
    smallest, rate = found.dead_time_ns, found.rate
    behind = Underlying(rate, stream.histogram(rate.size).astype(np.float64), stream.period_ns)
    before = np.append(np.geomspace(1e-9 * stream.period_ns, smallest, 60), smallest) if smallest > 0.0 else np.zeros(1)
    number = np.array([behind.count(smallest - gap, np.array([gap]))[0] for gap in before])
    return smallest - float(np.interp(1.0, np.maximum.accumulate(number), before))
