"""What a jitter too small to be seen changes of a calibrated light: part of its error, or a reason to state none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mars_lidar.calibrate.calibration_pass import CERTAIN, Watch
from mars_lidar.calibrate.calibration_result import Calibration, nearest
from mars_lidar.calibrate.light_behind import MATTERS
from mars_lidar.calibrate.shortest_intervals import FEW
from mars_lidar.calibrate.unknowns import UNSEEN
from mars_lidar.instrument.pulse import GaussianPulse

Again = Callable[[Watch, Calibration | None], Calibration]
"""The light of the same stream for another detector, begun with that of another calibration."""

_BRIGHT = 0.02  # photons of signal from which on a jitter moves the light by more than its error
SHUT = 4.0  # photons of signal of which the pixel sees the first alone
_PARTS = (0.6, 1.0)  # of a hidden jitter that are tried
_HIDES = (
    "signal, delay and width are not known: the pulse is bright, only its first photons are seen, and how much of its "
    "width is jitter is not"
)
_LATER = (
    "all of the light is not known: a jitter may hide after which, to be safe, hardly a registration is left: give the "
    "dead time and the jitter"
)


def with_hidden(found: Calibration, jitter: float, again: Again, *, known: bool) -> Calibration:
    """`found` with what jitters of sigma up to `jitter`, ns, would change of its light added to the covariance.

    `again` fits the light for another detector; `known`: the shape of the pulse was given. No error is stated of
    signal, delay and width of a pulse so bright that only its first photons are seen.
    """
    if not isinstance(found.pulse, GaussianPulse) or jitter < MATTERS * found.pulse.sigma_ns:
        return found
    if found.signal < _BRIGHT or known:
        return found
    if found.signal > SHUT:
        return without_pulse(found)
    covariance = found.covariance
    for part in _PARTS:
        # armed for certain later than without it
        hold = max(found.armed.hold_off_ns, found.dead_time_ns + CERTAIN * part * jitter)
        other = again(Watch(found.armed.hold_off_ns, hold, part * jitter, by=found.dead_time_by), found)
        if other.armed.used < FEW or not other.converged:
            return without_pulse(found)
        moved = nearest(found, other.parameters - found.parameters)
        covariance = covariance + np.outer(moved, moved)
    found = replace(found, covariance=covariance)
    return without_pulse(found) if may_shut(found) else found


def may_shut(found: Calibration) -> bool:
    """Whether the pulse may be so bright that the pixel sees its first photons alone: by three standard errors."""
    lights = [k for k, name in enumerate(found.names) if name.startswith("signal")]
    error = math.sqrt(max(float(found.covariance[np.ix_(lights, lights)].sum()), 0.0))
    return not found.signal + 3.0 * error <= SHUT


def with_later(found: Calibration, jitter: float, again: Again, *, bright: bool) -> Calibration:
    """`with_hidden` for a free shape: watched only from where the pixel is armed for certain with such a jitter.

    Of a `bright` pulse what is not watched then is light too.
    """
    hold = found.dead_time_ns + CERTAIN * jitter
    if not hold > found.armed.hold_off_ns:
        return found
    other = again(Watch(hold, hold, by=found.dead_time_by), None)
    if other.armed.used < FEW or (bright and (other.armed.passes < UNSEEN).any()):
        return replace(found, covariance=np.full_like(found.covariance, math.nan), unknown=(*found.unknown, _LATER))
    return replace(found, covariance=found.covariance + (other.total - found.total) ** 2)


def without_pulse(found: Calibration) -> Calibration:
    """Without errors of signal, delay and width, and a sentence that says why."""
    lost = np.array([name.startswith(("signal", "delay", "sigma")) for name in found.names])
    covariance = np.where(lost | lost[:, None], math.nan, found.covariance)
    return replace(found, covariance=covariance, unknown=(*found.unknown, _HIDES))
