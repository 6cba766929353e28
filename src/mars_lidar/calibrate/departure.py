"""Whether a stream departs from an ideal pixel beyond its edge, whatever its light: `same_phase` from a safe age on."""

from __future__ import annotations

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.calibration_pass import CERTAIN
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.intervals import Stream
from mars_lidar.calibrate.same_phase import SamePhase, same_phase

SIGNIFICANT = 5.0  # standard deviations
_NARROW = 0.2  # units, of which a bin is one of a coarse clock
_BRIGHT = 0.005  # photons of a unit of a clock that runs free: the phase alone does not tell their rate


def certain_ns(found: Calibration) -> float:
    """Age, ns, from which on the rate of an ideal pixel depends on the phase alone, with any jitter seen or hidden."""
    jitter = found.jitter_ns + 2.0 * found.jitter_error_ns if found.jitter_ns else found.jitter_limit_ns
    first = found.summary.smallest_ns[0] if found.dead_time_by == "smallest interval" else found.dead_time_ns
    return float(max(found.hold_off_ns, first + CERTAIN * np.nan_to_num(jitter)) + 2.0 * found.summary.unit_ns)


def departure_of(stream: Stream, found: Calibration) -> SamePhase:
    """Registrations by age against those at the same phases, up to four dead times or two periods more."""
    begin = certain_ns(found)
    return same_phase(stream, begin, max(4.0 * begin, begin + 2.0 * stream.period_ns))


def too_coarse(stream: Stream, rate: FloatArray) -> bool:
    """Whether much light (n,) falls within one unit of a clock that does not run with the laser."""
    if stream.unit_ns == 0.0 or stream.units > 0:
        return False
    bins = stream.unit_ns / stream.period_ns * rate.size  # of a unit
    # of a bin that is hardly wider than a unit all light may be that of one unit
    return bool(rate.max(initial=0.0) * (max(bins, 1.0) if bins > _NARROW else bins) > _BRIGHT)
