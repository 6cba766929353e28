"""The dead time of a stream by its smallest interval, where the edge of the recovery is sharp."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from mars_lidar.calibrate.calibration_pass import CERTAIN, Watch, fitted
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.hidden_dead_time import excess, hidden
from mars_lidar.calibrate.hidden_light import SHUT, may_shut, with_hidden, with_later
from mars_lidar.calibrate.intervals import Stream, Summary
from mars_lidar.calibrate.light_behind import LightBehind
from mars_lidar.calibrate.shortest_intervals import FEW, LEAST_REACH, Ages, shortest
from mars_lidar.calibrate.unknowns import is_seen
from mars_lidar.instrument.pulse import GaussianPulse, Pulse

_BRIGHT = 1.0  # photons of a pulse of which a pixel may see the first alone
_BLURRED = 3.0  # jitters before the first photons of a bright pulse
_ROUNDED = 0.1  # standard errors of the light that the dead time's rounding may move it by
_COARSE = 2.0  # units of a clock that runs free, of a pulse below which its shape is not known
ALL = 0.98  # of the pulse that may be jitter
WIDEST = 0.1  # periods that a jitter may be wide where no pulse limits it
_OUT_OF_ORDER = 0.3  # of the intervals within the reach of a jitter that may hide


@dataclass(frozen=True, eq=False)
class SharpEdge:
    """A calibration whose dead time is the smallest interval; `jitter_ns` is None where it is not told."""

    stream: Stream
    counted: Summary
    shape: Pulse | Literal["gaussian", "free"]
    hold_off_ns: float | None
    returns: int
    jitter_ns: float | None
    _seen: dict[float, Ages] = field(default_factory=dict)

    @property
    def _light(self) -> LightBehind:
        return LightBehind(self.stream)

    def _pass(self, watch: Watch, near: Calibration | None = None) -> Calibration:
        return fitted(self.stream, self.counted, self.shape, watch, self.returns, near, divided=False)

    def by_smallest(self, first: Calibration) -> Calibration:
        """The smallest of n intervals exceeds t_d by 1 / (sum of the rates at re-arming) in the mean.

        What a dead time may be below it for want of light, or above it with a jitter that hides, is in the error.
        """
        stream, smallest = self.stream, first.dead_time_ns
        first = self._certain(first)
        told, law = self.jitter_ns is not None, self._light.any_width(first)
        sigma = min(width_of(first), WIDEST * stream.period_ns)
        mean, error = excess(law(0.0), stream.registrations, smallest)
        dead = max(smallest - mean, 0.0)
        left = hidden(self._ages(), law, stream.registrations, dead, 0.0 if told else ALL * sigma)
        # how the light begins is not known on the scale of a coarse clock, or of a jitter of a bright pulse
        coarse = stream.units == 0 and not width_of(first) > _COARSE * stream.unit_ns
        guard = 2.0 * stream.unit_ns if coarse else 0.0
        if not told and first.pulse is not None and first.signal > SHUT:
            guard = max(guard, _BLURRED * left.jitter_ns)
        shut = self._shut(first)
        if shut > 0.0:
            guard, left = max(guard, _BLURRED * shut), replace(left, jitter_ns=max(left.jitter_ns, ALL * shut))
        if guard > 0.0:
            error = max(error, excess(law(0.0), stream.registrations, smallest, guard)[1])
        error = max(error, left.below_ns, 0.0 if told else left.above_ns)
        limit = 0.0 if told else math.hypot(max(left.jitter_ns, 0.0), stream.unit_ns)
        found = replace(
            first,
            dead_time_ns=dead,
            dead_time_error_ns=math.hypot(error, stream.unit_ns, first.jitter_ns),
            jitter_limit_ns=0.0 if smallest < limit else limit,
        )
        # a jitter as large as the dead time puts records out of order: with many of them within its reach
        reach = CERTAIN * left.jitter_ns - smallest
        if not told and reach > 0.0 and self._near(reach) > _OUT_OF_ORDER * stream.registrations:
            return replace(found, edge_fits=False, dead_time_error_ns=math.nan)
        if found.pulse is None:
            return with_later(found, max(limit, ALL * shut), self._pass, bright=shut > 0.0)
        return with_hidden(found, min(limit, ALL * sigma), self._pass, known=isinstance(self.shape, Pulse))

    def _shut(self, first: Calibration) -> float:
        """Recorded width, ns, of a pulse of which only the first photons may be seen, and all of the width be jitter.

        0 where it is dimmer, or where as many intervals show the edge that a jitter as wide would have blurred it. With
        such a jitter pixels look armed within a pulse that they have already seen, which makes it dim: so its light is
        also judged from where the jitter would be over.
        """
        if self.jitter_ns is not None or isinstance(self.shape, Pulse) or not first.total > _BRIGHT:
            return 0.0
        watch = Watch(first.dead_time_ns, first.hold_off_ns, by=first.dead_time_by)
        gaussian = replace(self, shape="gaussian")
        seen = first if first.pulse is not None else gaussian._pass(watch)
        width = width_of(seen)
        if not math.isfinite(width) or not seen.signal > _BRIGHT or self._near(width) >= FEW:
            return 0.0
        later = replace(watch, hold_ns=max(watch.hold_ns, watch.dead_ns + CERTAIN * ALL * width))
        if may_shut(seen) or may_shut(gaussian._pass(later, seen)):
            return width
        return 0.0

    def _near(self, reach_ns: float) -> int:
        """Intervals within this of the smallest."""
        limit = float(self.counted.smallest_ns[0]) + reach_ns
        return sum(int((dt < limit).sum()) for dt in self.stream.intervals())

    def _certain(self, first: Calibration) -> Calibration:
        """Watched from where the pixel is armed for certain, with two roundings of the clock, where that matters."""
        unit, rate = self.stream.unit_ns, first.rate
        peak = float(rate.max(initial=0.0)) * rate.size / self.stream.period_ns
        if 2.0 * unit * peak < _ROUNDED / math.sqrt(max(self.stream.registrations, 1)):
            return first
        # whole units: to where one ends, as a record stands in the middle of its own; others are spread over theirs too
        hold = max(first.hold_off_ns, first.dead_time_ns + (1.5 if self.stream.units else 3.0) * unit)
        if not hold > first.hold_off_ns:
            return first
        later = self._pass(Watch(first.dead_time_ns, hold, first.jitter_ns, by=first.dead_time_by), first)
        return later if later.armed.used >= FEW else first

    def _ages(self, reach_ns: float = 0.0) -> Ages:
        """The shortest intervals, up to at least `reach_ns` above the smallest."""
        smallest = float(self.counted.smallest_ns[0])
        reach_ns = max(reach_ns, LEAST_REACH * self.stream.period_ns)
        if max(self._seen, default=0.0) < reach_ns:
            self._seen[reach_ns] = shortest(self.stream, smallest, reach_ns)
        return self._seen[max(self._seen)]


def width_of(found: Calibration) -> float:
    """Sigma of a Gaussian pulse that is seen, else inf."""
    return found.pulse.sigma_ns if isinstance(found.pulse, GaussianPulse) and is_seen(found) else math.inf
