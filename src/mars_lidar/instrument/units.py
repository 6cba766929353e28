"""Warnings for times that are likely given in ps or s instead of ns."""

import math
import warnings

from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.pulse import FWHM_PER_SIGMA, GaussianPulse, Pulse
from mars_lidar.instrument.tolerances import TOL


class UnitWarning(UserWarning):
    """A value that is possible but was probably given in another unit.

    See Also
    --------
    System

    Examples
    --------
    >>> import warnings
    >>> import mars_lidar as ml
    >>> pulse, detector = ml.GaussianPulse(sigma_ns=500.0), ml.Detector(dead_time_ns=75.0)  # sigma was meant in ps
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     system = ml.System(period_ns=1000.0, cycles=10, bins=64, pulse=pulse, detector=detector)
    >>> {warning.category.__name__ for warning in caught}
    {'UnitWarning'}
    """


# time from which a value is unusual, in ns and in laser periods; and from which it is meant as it is, in ns
_PULSE, _DEAD, _GATE = (41.0, 0.31, 2e4), (25_000.0, 25.0, 1e6), (0.0, 25.0, 1e6)


def period_hint(period_ns: float) -> str:
    """Hint at the period that was probably meant, or an empty text."""
    if period_ns < 1e-3:  # 1 ps
        return f"period_ns={period_ns:g} is {period_ns:g} ns: {1e9 * period_ns:.4g} ns, if it was given in seconds"
    return ""


def check_units(period: float, pulse: Pulse, detector: Detector) -> None:
    """Warn of times that are 1000 or 1e9 times the usual values."""
    if hint := period_hint(period):
        _warn(hint)
    times = [
        ("dead_time_ns", detector.dead_time_ns, _DEAD),
        ("electronics_dead_time_ns", detector.electronics_dead_time_ns, _DEAD),
    ]
    if isinstance(pulse, GaussianPulse):
        times.append(("sigma_ns", pulse.sigma_ns, _PULSE))
    times += [(name, abs(getattr(detector, name) or 0.0), _GATE) for name in ("gate_start_ns", "gate_step_ns")]
    if any(value >= meant for _, value, (_, _, meant) in times):
        return  # nobody's laboratory: the far end of the domain, in units of its own
    for name, value, (odd_ns, odd_periods, _) in times:
        limit = value > 0.0 and math.log10(value).is_integer()
        if 0.0 < value < TOL.seconds_as_ns and value < 1e-6 * period and not limit:
            likely, unit = 1e9 * value, "seconds"
        elif odd_ns <= value and odd_periods * period <= value != period and _typed(name, value):
            likely, unit = 1e-3 * value, "picoseconds"
        else:
            continue
        what = f"{name}={value:g} is {value / period:.3g} laser periods of {period:.4g} ns"
        _warn(f"{what}: if it was meant in {unit}, give {likely:g}, in ns")


def check_delays(median_ns: float, period_ns: float) -> None:
    """Warn of returns that come many periods after their pulse."""
    if TOL.unusual_periods * period_ns <= abs(median_ns) < 1e7:
        what = f"delay_ns has a median of {median_ns:g}, {median_ns / period_ns:.3g} laser periods, and wraps into one"
        _warn(
            f"{what}: if it was meant in picoseconds, divide it by 1000; if it comes from depths of a file in "
            "millimetres or centimetres, give depth_unit_m (--depth-unit-m) 0.001 or 0.01"
        )


def _typed(name: str, value: float) -> bool:
    """Whether somebody may have typed it, perhaps as the width at half maximum."""
    values = [value, FWHM_PER_SIGMA * value] if name == "sigma_ns" else [value]
    return any(abs(float(f"{candidate:.{TOL.typed_digits}g}") - candidate) < 1e-9 * candidate for candidate in values)


def _warn(text: str) -> None:
    warnings.warn(text, UnitWarning, stacklevel=5)  # who made the system, or called simulate
