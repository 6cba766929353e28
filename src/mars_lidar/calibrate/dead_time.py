"""The dead time of a stream, and its jitter: by the smallest interval, or by the middle of a blurred edge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mars_lidar.calibrate.calibration_pass import CERTAIN, Watch
from mars_lidar.calibrate.calibration_result import Calibration, nearest
from mars_lidar.calibrate.hidden_dead_time import EDGE
from mars_lidar.calibrate.hidden_light import SHUT, with_hidden, without_pulse
from mars_lidar.calibrate.recovery_edge import ORDINARY, REACH, Edge, Law, edge_of
from mars_lidar.calibrate.same_phase import SIGNIFICANT, departure_of, too_coarse
from mars_lidar.calibrate.sharp_edge import ALL, WIDEST, SharpEdge, width_of
from mars_lidar.calibrate.shortest_intervals import FEW, Ages, extrapolated, is_sharp
from mars_lidar.instrument.pulse import GaussianPulse, Pulse

SHARP = 0.01  # false-alarm probability of a blurred edge
HIDDEN = 14.0  # of a jitter this many mean excesses of the smallest interval wide nine in ten are seen
_ROUNDS = 12
_STARTS = (0.15, 0.06, 0.4, 1.0)  # widths tried, in parts of the reach over which the edge is not sharp
_SAME = 0.05  # standard errors by which a last round may move the edge
_AGREE = 4.0  # standard errors between the jitter by the edge and that by the shape of the pulse
_STEP = 0.2  # of the light behind an edge that falls before it, where the dead time keeps it away
_MOSTLY = 0.7  # of the recorded width of a bright pulse that is jitter: then pulse and signal hide in it
_HOPELESS = 1e-12  # fit of an edge in some round below which no other light makes it one: jitters had 6e-7 and more
_FOLLOWED = 0.5  # of a change of a bright pulse's jitter that the edge follows: then it is not the edge that tells it


@dataclass(frozen=True, eq=False)
class Unknown(SharpEdge):
    """A calibration whose dead time is estimated too, and the jitter where `jitter_ns` is None."""

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
            return self.by_smallest(first)
        sharp, blurred = self._blurred(first)
        if blurred is not None:
            return self._checked(blurred)
        found = self.by_smallest(first)
        return self._checked(found) if sharp else replace(found, edge_fits=False, dead_time_error_ns=math.nan)

    def _checked(self, found: Calibration) -> Calibration:
        """Without an edge where the rate beyond it is not that of the light: it was none, or is not all there is."""
        if self.jitter_ns is not None or too_coarse(self.stream, found.armed.rate):
            return found
        scores, _ = departure_of(self.stream, found).first()
        if np.abs(scores).max(initial=0.0) <= SIGNIFICANT:
            return found
        return replace(found, edge_fits=False, dead_time_error_ns=math.nan)

    def _blurred(self, first: Calibration) -> tuple[bool, Calibration | None]:
        """Whether the edge is sharp; and by the edge, None where that is sharp or no Gaussian jitter makes it."""
        ages = self._ages()
        if ages.interval_ns.size < FEW:
            return True, None
        sharp = self._light.any_width(first)(0.0)
        if self.jitter_ns is None:
            chance, reach = is_sharp(ages, sharp, self.stream.registrations)
            if chance > SHARP:
                return True, None
            if self.shape == "free" and (by_a_pulse := self._by_a_pulse()) is not None:
                return False, by_a_pulse
            widths = [reach * part for part in _STARTS]
        else:
            widths = [math.sqrt(2.0) * self.jitter_ns]
        found = (self._from(first, extrapolated(self._ages(8.0 * width), sharp, width), width) for width in widths)
        return False, next((one for one in found if one is not None), None)

    def _by_a_pulse(self) -> Calibration | None:
        """The edge as the model of a Gaussian pulse has it, which tells pulse and jitter apart; None without one."""
        model = replace(self, shape="gaussian", _seen=dict(self._seen))
        found = model.calibrated()
        if found.dead_time_by != "edge" or not found.converged:
            return None
        hold = max(found.hold_off_ns, self.hold_off_ns or 0.0)
        watch = Watch(
            found.dead_time_ns, hold, found.jitter_ns, found.jitter_error_ns, found.dead_time_error_ns, "edge"
        )
        return replace(self._pass(watch), jitter_limit_ns=found.jitter_limit_ns)

    def _from(self, first: Calibration, dead: float, width: float) -> Calibration | None:
        """The edge and the light, from a rough edge: the light of a jitter leads to an edge of that jitter."""
        period, ages = self.stream.period_ns, self._ages()
        jitter = width / math.sqrt(2.0) if self.jitter_ns is None else self.jitter_ns
        tried: list[tuple[float, float]] = []
        found, failed = first, 0
        for _ in range(_ROUNDS):
            sigma = width_of(found)
            jitter = min(jitter, ALL * sigma)
            if not (dead > 0.0 and jitter < 1.5 * WIDEST * period):
                return None
            hold = max(dead + CERTAIN * jitter, self.hold_off_ns or 0.0)
            found = self._pass(Watch(dead, hold, jitter), None if found is first else found)
            failed += not found.converged
            if found.armed.used < FEW or failed > 1:
                return None
            edge = self._edge(ages, found, dead, width)
            if edge is None or edge.fits < _HOPELESS or not self._is_step(found, edge, self._light.bins(width)):
                return None
            if ages.clock_ns > 0.0 and edge.jitter_ns < max(ages.clock_ns, 2.0 * edge.jitter_error_ns):
                return self._clocked(first, edge, ages)
            shift = abs(edge.dead_time_ns - dead) / edge.dead_time_error_ns
            tried.append((jitter, edge.jitter_ns))
            dead, width = edge.dead_time_ns, math.hypot(math.sqrt(2.0) * edge.jitter_ns, ages.clock_ns)
            off = abs(edge.jitter_ns - jitter)
            if shift < _SAME and off <= _SAME * edge.jitter_error_ns:
                break
            jitter = _nearer(tried)
        if edge is None or not edge.jitter_ns - 3.0 * edge.jitter_error_ns < width_of(found):  # the pulse holds it
            return None
        if self.jitter_ns is None and edge.jitter_error_ns > 0.0:
            follows = self._follows(ages, found, edge, width)
            off = edge.jitter_ns - found.jitter_ns
            found = self._pass(self._watch(edge.followed(follows, off)), found)
        else:
            follows, off = (0.0, 0.0), 0.0
            found = self._pass(self._watch(edge), found)
        if found.too_short:
            return None
        edge = self._edge(ages, found, dead, width, self._light.uncertain(found, width, ages.clock_ns))
        if edge is None or not edge.fits > ORDINARY:
            return None
        edge = edge.followed(follows, off)
        if abs(found.jitter_ns - edge.jitter_ns) > _AGREE * edge.jitter_error_ns > 0.0:  # the pulse is no Gaussian
            found = self._pass(replace(self._watch(edge), jitter_error_ns=0.0), found)
            found = replace(found, jitter_error_ns=edge.jitter_error_ns)
        elif "jitter_ns" in found.names:
            edge = edge.known(found.jitter_ns, found.jitter_error_ns)
        elif found.pulse is not None and edge.jitter_error_ns > 0.0:  # a measured pulse: the light with another jitter
            watch = replace(self._watch(edge), jitter_ns=edge.jitter_ns + edge.jitter_error_ns)
            moved = nearest(found, self._pass(watch, found).parameters - found.parameters)
            found = replace(found, covariance=found.covariance + np.outer(moved, moved))
        found = replace(found, dead_time_ns=edge.dead_time_ns, dead_time_error_ns=edge.dead_time_error_ns)
        hides = found.jitter_ns > _MOSTLY * width_of(found) or follows[1] > _FOLLOWED
        if self.jitter_ns is None and found.signal > SHUT and hides:
            return without_pulse(found)
        return found

    def _follows(self, ages: Ages, found: Calibration, edge: Edge, width: float) -> tuple[float, float]:
        """By how much of a change of the jitter that the light is fitted with dead time and jitter of the edge follow.

        Little where the light falls evenly on the edge. Where it is that of a bright pulse a repetition later, the
        light that goes with a jitter makes an edge of nearly that jitter.
        """
        step = max(edge.jitter_error_ns, _SAME * edge.jitter_ns)
        jitter = found.jitter_ns + step
        if not jitter < ALL * width_of(found):
            jitter = found.jitter_ns - step
        if not jitter > 0.0:
            return 0.0, 0.0
        light = self._pass(Watch(found.dead_time_ns, found.hold_off_ns, jitter), found)
        moved = self._edge(ages, light, edge.dead_time_ns, width)
        same = self._edge(ages, found, edge.dead_time_ns, width)
        if moved is None or same is None or not light.converged:
            return 0.0, 0.0
        change = jitter - found.jitter_ns
        return (moved.dead_time_ns - same.dead_time_ns) / change, (moved.jitter_ns - same.jitter_ns) / change

    def _clocked(self, first: Calibration, edge: Edge, ages: Ages) -> Calibration | None:
        """The middle of an edge that the clock alone blurs; a jitter less than its unit may hide."""
        unit = self.stream.unit_ns
        if not edge.fits > ORDINARY:
            return None
        found = self._pass(Watch(edge.dead_time_ns, max(edge.dead_time_ns + 2.0 * unit, self.hold_off_ns or 0.0)))
        if found.too_short:
            return None
        found = replace(
            found,
            dead_time_error_ns=math.hypot(edge.dead_time_error_ns, unit),
            dead_time_by="edge",
            jitter_limit_ns=max(edge.jitter_ns + 2.0 * edge.jitter_error_ns, ages.clock_ns),
        )
        sigma = found.pulse.sigma_ns if isinstance(found.pulse, GaussianPulse) else 0.0
        return with_hidden(
            found, min(found.jitter_limit_ns, ALL * sigma), self._pass, known=isinstance(self.shape, Pulse)
        )

    def _edge(
        self, ages: Ages, found: Calibration, dead: float, width: float, off: tuple[Law, ...] = ()
    ) -> Edge | None:
        ages = self._ages(dead + REACH * width - ages.smallest_ns)
        edge = edge_of(ages, self._light.law(found, width, ages.clock_ns), dead, width, off)
        return edge if edge is None or self.jitter_ns is None else edge.known(self.jitter_ns, 0.0)

    def _is_step(self, found: Calibration, edge: Edge, bins: int) -> bool:
        """Whether the dead time makes the edge: not the light, which is no less before it than behind it."""
        width = math.hypot(math.sqrt(2.0) * edge.jitter_ns, self.stream.unit_ns)
        ages = np.maximum(edge.dead_time_ns + width * np.array([-3.0, -1.0, 0.0, 2.0]), 0.0)
        fallen = self._light.of(found, bins).fallen(ages)
        kept, seen = float(fallen[1] - fallen[0]), float(fallen[3] - fallen[2])
        return self.stream.registrations * kept >= EDGE and kept >= _STEP * seen

    def _watch(self, edge: Edge) -> Watch:
        hold = max(edge.dead_time_ns + CERTAIN * edge.jitter_ns, self.hold_off_ns or 0.0)
        return Watch(edge.dead_time_ns, hold, edge.jitter_ns, edge.jitter_error_ns, edge.dead_time_error_ns, "edge")


def _nearer(tried: list[tuple[float, float]]) -> float:
    """Where what comes out is what was put in, by the last two tries."""
    jitter, got = tried[-1]
    if len(tried) > 1:
        before, gave = tried[-2]
        slope = (got - gave) / (jitter - before) if jitter != before else 1.0
        if slope < 0.9:
            got = float(np.clip(jitter + (got - jitter) / (1.0 - slope), 0.5 * jitter, 2.0 * jitter))
    return got
