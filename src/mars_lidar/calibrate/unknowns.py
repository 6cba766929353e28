"""What a stream cannot tell of what was calibrated from it: an error of NaN, and a sentence that says why.

And what a jitter too small to be seen changes of a calibrated light: part of its error, or a reason to state none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.calibration_fit import log_likelihood
from mars_lidar.calibrate.calibration_pass import CERTAIN, Watch
from mars_lidar.calibrate.calibration_result import Calibration, nearest
from mars_lidar.calibrate.light_behind import MATTERS
from mars_lidar.calibrate.shortest_intervals import FEW
from mars_lidar.instrument.pulse import GaussianPulse

_MISFIT = 1e-5  # false-alarm probability of light that is told not to be that of the pulse
_GROUPS, _EXPECTED = 128, 10.0  # of the bins at most, registrations in each at least
_SEEN = 15.0  # gain of log likelihood by which returns of unknown width are seen: chance peaks gain less
_HIDDEN = 5.0  # standard errors of a constant light that a pulse which is not seen may have
_UNIT = 1.0  # units of the clock that a pulse must be wide
_UNSEEN = 0.5  # passes below which the light of a bin is not known
_BIASED = 0.5  # standard errors


def told(found: Calibration, *, edge: bool) -> Calibration:
    """`found` with errors of NaN where the stream cannot tell, and why in `Calibration.unknown`.

    `edge`: dead time and jitter were estimated too, so that light which does not fit may be theirs.
    """
    reasons = list(found.unknown)
    lost: set[str] = set()
    if not found.converged:
        reasons.append("the likelihood was not maximised: the light is not known")
        lost.update(found.names)
    if not found.edge_fits:
        reasons.append(
            "dead time, jitter and light are not known: the rate after a registration rises neither at once, for good, "
            "nor as Gaussian jitter makes it rise, of up to an eighth of the dead time and a tenth of the period; give "
            "a dead time and a hold-off"
        )
        lost.update(found.names)
    if found.pulse is None:
        reasons += _free(found, lost)
    else:
        if "sigma_ns" in found.names and not is_seen(found):
            reasons.append("no pulse is seen: signal, delay and width are not known")
            lost.update(name for name in found.names if name != "background" and name != "jitter_ns")
            found = _dark(found)
        reasons += _pulse(found, lost, edge and found.edge_fits and found.converged)
    if not reasons:
        return found
    covariance = found.covariance.copy()
    for k, name in enumerate(found.names):
        if name in lost:
            covariance[k, :] = covariance[:, k] = math.nan
    jitter = math.nan if "jitter_ns" in lost and found.jitter_error_ns else found.jitter_error_ns
    return replace(found, covariance=covariance, jitter_error_ns=jitter, unknown=tuple(reasons))


def _free(found: Calibration, lost: set[str]) -> list[str]:
    passes = found.armed.passes
    if (passes >= _UNSEEN).all() and not _crowded(found, found.armed.rate):
        return []
    lost.update(found.names)
    dark = int((passes < _UNSEEN).sum())
    if dark:
        return [f"all of the light is not known: {dark:,} of {passes.size:,} bins of the period were never watched"]
    return [_CROWDED]


_CROWDED = "the light is not known: several photons fall within one unit of the clock or one bin"


def _pulse(found: Calibration, lost: set[str], edge: bool) -> list[str]:
    reasons = []
    places = [name for name in found.names if name.startswith(("delay", "sigma", "jitter"))]
    fitted = "sigma_ns" in found.names
    if isinstance(found.pulse, GaussianPulse) and found.pulse.sigma_ns < _UNIT * found.summary.unit_ns:
        unit = found.summary.unit_ns
        reasons.append(f"delay and width are not known: the pulse is no wider than the clock's unit of {unit:.4g} ns")
        lost.update(places)
    if _crowded(found, found.rate):
        reasons.append(_CROWDED)
        lost.update(found.names)
    elif edge and fitted and misfit(found) < _MISFIT:
        reasons.append(
            "the light is not known: registrations over the period are not those of a Gaussian pulse on a background, "
            "or jitter or clock distort them"
        )
        lost.update(found.names)
    return reasons


def _dark(found: Calibration) -> Calibration:
    """Constant light, where no pulse is seen: what one may hide, too faint or too wide, is in the error."""
    seen = found.armed
    passes = float(seen.passes.mean())
    total = float(seen.registrations.sum()) / max(passes, 1e-300)
    error = math.sqrt(max(float(seen.registrations.sum()), 1.0)) / max(passes, 1e-300)
    covariance = found.covariance.copy()
    covariance[0, :] = covariance[:, 0] = 0.0
    covariance[0, 0] = error**2 + min(found.signal, _HIDDEN * error) ** 2
    return replace(found, background=total, returns_signal=np.zeros_like(found.returns_signal), covariance=covariance)


def is_seen(found: Calibration) -> bool:
    """Whether the returns are seen, beside a constant light."""
    seen = found.armed
    flat = np.full(seen.passes.size, seen.registrations.sum() / max(float(seen.passes.sum()), 1e-300))
    return log_likelihood(seen, np.maximum(found.rate, 1e-300)) - log_likelihood(seen, flat) > _SEEN


def _crowded(found: Calibration, rate: FloatArray) -> bool:
    """Whether photons share a unit of the clock, of which one at most is recorded, by more than the errors."""
    bins = round(found.summary.unit_ns * rate.size / found.summary.period_ns)  # of a unit
    if bins < 1:
        return False
    light = np.add.reduceat(rate, np.arange(0, rate.size, bins))
    # a registration in the middle of a unit stands for one anywhere: light l is taken for l (1 - l^2 / 12)
    bias = float((light**3).sum()) / 12.0
    error = found.total_error
    return bool(bias > _BIASED * error)


def misfit(found: Calibration) -> float:
    """Probability of registrations as far from the fitted light over the period, or farther, by chi-square."""
    from scipy.stats import chi2

    seen = found.armed
    expected = found.rate * seen.passes
    share = np.cumsum(expected)
    groups = int(min(_GROUPS, share[-1] / _EXPECTED))
    if groups <= len(found.names) + 1:
        return 1.0
    group = np.minimum((share / share[-1] * groups).astype(np.int64), groups - 1)
    wanted = np.bincount(group, expected, minlength=groups)
    got = np.bincount(group, seen.registrations, minlength=groups)
    judged = wanted > 0.5 * _EXPECTED
    square = float(((got - wanted)[judged] ** 2 / wanted[judged]).sum())
    return float(chi2.sf(square, max(int(judged.sum()) - len(found.names), 1)))


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
    if other.armed.used < FEW or (bright and (other.armed.passes < _UNSEEN).any()):
        return replace(found, covariance=np.full_like(found.covariance, math.nan), unknown=(*found.unknown, _LATER))
    return replace(found, covariance=found.covariance + (other.total - found.total) ** 2)


def without_pulse(found: Calibration) -> Calibration:
    """Without errors of signal, delay and width, and a sentence that says why."""
    lost = np.array([name.startswith(("signal", "delay", "sigma")) for name in found.names])
    covariance = np.where(lost | lost[:, None], math.nan, found.covariance)
    return replace(found, covariance=covariance, unknown=(*found.unknown, _HIDES))
