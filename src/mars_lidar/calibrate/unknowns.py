"""What a stream cannot tell of what was calibrated from it: an error of NaN, and a sentence that says why."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.calibration_fit import log_likelihood
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.instrument.pulse import GaussianPulse

_MISFIT = 1e-5  # false-alarm probability of light that is told not to be that of the pulse
_GROUPS, _EXPECTED = 128, 10.0  # of the bins at most, registrations in each at least
_SEEN = 15.0  # gain of log likelihood by which returns of unknown width are seen: chance peaks gain less
_HIDDEN = 5.0  # standard errors of a constant light that a pulse which is not seen may have
_UNIT = 1.0  # units of the clock that a pulse must be wide
UNSEEN = 0.5  # passes below which the light of a bin is not known
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
    if (passes >= UNSEEN).all() and not _crowded(found, found.armed.rate):
        return []
    lost.update(found.names)
    dark = int((passes < UNSEEN).sum())
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
