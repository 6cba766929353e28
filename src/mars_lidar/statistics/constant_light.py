"""Mean registration rate under constant light, with dead time, recovery, afterpulses and twilight pulses.

Straka, Grygar, Hloušek, Ježek, "Counting statistics of actively quenched SPADs under continuous illumination",
J. Lightwave Technol. 38, 4765 (2020), arXiv 2001.10036; Krause, Walenta, "Exponential-recovery model for free-running
SPADs with capacity-induced dead-time imperfections", arXiv 2507.10361 (2025). Equations (15), (16) and (22) of
docs/theory_detectors.md.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.detector import Detector, require_effects
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.instrument.tolerances import TOL as INSTRUMENT
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.tolerances import TOL

_EFFECTS = (*LIGHT_EFFECTS, "afterpulsing", "twilight_ns", "recovery_ns", *TIMING_EFFECTS)


@checked
def constant_light_rate(rate_hz: float, detector: Detector) -> float:
    """Mean rate of registrations of a free-running pixel under constant light, counts/s.

    Without afterpulsing the rate is exactly 1 / (t_d + e^(-lambda alpha) w), alpha the duration of twilight. The mean
    wait w of an armed pixel is 1 / lambda, or 1F1(1, 1 + a, a) / lambda with a = lambda r if the sensitivity recovers
    with the time constant r. With afterpulsing the rate is exact to first order in the afterpulse probability p: the
    number of trapped carriers is replaced by its mean over all histories, with an error of the order p^2.

    Parameters
    ----------
    rate_hz
        Photons per second at the pixel, before its detection efficiency; dark counts are added.
    detector
        A detector of mode ``"nonparalyzable"`` without crosstalk, limits of events or a longer dead time of the
        electronics. It may have `recovery_ns` or afterpulses of all generations, but not both.

    Returns
    -------
    float
        Registrations per second.

    Raises
    ------
    TypeError
        A rate that is not a number; not a `Detector`.
    ValueError
        A negative rate, or a detector whose mean rate is not known (see `detector`).

    See Also
    --------
    Detector, count_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> round(ml.statistics.constant_light_rate(1e7, ml.Detector(dead_time_ns=50.0)))  # 1e7 / (1 + 0.5)
    6666667
    """
    light = checks.real("rate_hz", rate_hz, low=0.0, high=INSTRUMENT.rate_hz)
    require_effects("constant_light_rate", detector, _EFFECTS, lambda _: "; simulate it with engine 'sequential'")
    if detector.mode != "nonparalyzable":
        raise ValueError(f"constant_light_rate treats mode 'nonparalyzable' only, got {detector.mode!r}")
    rate = (light * detector.detection_efficiency + detector.dark_count_hz) * 1e-9  # per ns
    dead, twilight, traps = detector.dead_time_ns, detector.twilight_ns, detector.afterpulsing
    if rate == 0.0:
        return 0.0
    if traps is None:
        return 1e9 / (dead + math.exp(-rate * twilight) * _wait(rate, detector.recovery_ns))
    if detector.recovery_ns > 0.0:
        raise ValueError(
            "constant_light_rate treats recovery_ns or afterpulsing, not both, "
            f"got {detector.recovery_ns:g} and {traps!r}"
        )
    if traps.generations is not None:
        raise ValueError(
            f"constant_light_rate treats afterpulses of all generations, generations=None, got {traps.generations}"
        )
    if traps.delay_ns is not None:
        return 1e9 / _exponential(rate, dead, twilight, traps.probability, traps.delay_ns)
    parts = max(1, min(math.ceil(40 * rate * (traps.bin_ns or 0.0)), TOL.sampled_delays // len(traps.delays or (0,))))
    density = np.repeat(np.diff(traps.edges_below) / parts, parts) * traps.probability
    return 1e9 / _sampled(rate, dead, twilight, density, (traps.bin_ns or 0.0) / parts)


def renewal_moments(photons: FloatArray, system: System) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of a count under constant light in a long exposure, (6.2) of docs/theory.md.

    `photons` (...) are those detected in a period.
    """
    x = photons * system.dead_time_periods
    return system.cycles * photons / (1.0 + x), system.cycles * photons / (1.0 + x) ** 3


def _wait(rate: float, recovery: float) -> float:
    """Mean waiting time of an armed pixel, ns, with the hazard rate `rate` (1 - e^(-u / recovery))."""
    from scipy.special import hyp1f1

    a = rate * recovery
    longer = hyp1f1(1.0, 1.0 + a, a) if a < 1e10 else math.sqrt(0.5 * math.pi * a) + 1.0 / 3.0  # to 1e-11
    return float(longer) / rate


def _exponential(rate: float, dead: float, twilight: float, p: float, delay: float) -> float:
    """Mean interval, ns, for the release rate level / delay e^(-u / delay) of carriers after every avalanche."""
    from scipy.integrate import quad

    scale = min(delay, 1.0 / rate)  # ns: width of the integrands
    level, interval = p, math.inf
    for _ in range(TOL.constant_light_rounds):
        released = level * math.exp(-dead / delay)
        again = -math.expm1(-rate * twilight - released * math.expm1(twilight / delay))

        def survival(s: float, released: float = released) -> float:  # P(no avalanche until s after re-arming)
            return math.exp(-rate * s + released * math.expm1(-s / delay))

        def by_release(x: float, released: float = released) -> float:  # part of `survival` that depends on releases
            return scale * math.exp(-rate * x * scale - released) * math.expm1(released * math.exp(-x * scale / delay))

        # E e^(-s / delay) for the time s of the next avalanche, integrated by parts
        mean = math.exp(-released) / rate + quad(by_release, 0.0, 60.0, epsabs=0.0, limit=400)[0]
        part = quad(lambda x: survival(x * scale) * math.exp(-x * scale / delay) * scale, 0.0, 60.0, limit=400)[0]
        decay = again + (1.0 - again) * (1.0 - part / delay)
        level, last, interval = p / (1.0 - math.exp(-dead / delay) * decay), interval, dead + (1.0 - again) * mean
        if abs(interval - last) <= TOL.rounding * interval:
            return interval
    raise ConvergenceError(f"constant_light_rate of {1e9 * rate:g} photons/s does not converge; simulate it")


def _sampled(rate: float, dead: float, twilight: float, density: NDArray[np.float64], cell: float) -> float:
    """Mean interval, ns; `density` (n,): carriers trapped by one avalanche, by release time in cells of `cell` ns."""
    from scipy.signal import fftconvolve

    n, edges = density.size, np.arange(density.size + 1, dtype=np.float64) * cell
    carriers, interval = density, math.inf
    for _ in range(TOL.constant_light_rounds):
        below = np.concatenate([[0.0], np.cumsum(carriers)])

        def between(at: Any, below: NDArray[np.float64] = below) -> NDArray[np.float64]:
            """Carriers (n,) in the cells with edges `at` (n + 1,)."""
            return np.asarray(np.diff(np.interp(at, edges, below)))

        free = between(edges + dead)
        last_part = np.interp([dead - twilight, dead], edges, below)
        again = -math.expm1(-rate * twilight - float(last_part[1] - last_part[0]))
        hazard = rate * cell + free
        armed = np.exp(-np.concatenate([[0.0], np.cumsum(hazard)]))
        fires = -np.diff(armed)
        mean = float(np.sum(fires / hazard) * cell + armed[-1] / rate)
        # release at dead + s + u is u after an avalanche at s after re-arming; s is at the centre of its cell
        later = between(edges + (dead + 0.5 * cell))
        trapped = fftconvolve(later, fires[::-1])[n - 1 :]
        carriers = density + (1.0 - again) * np.maximum(trapped, 0.0) + again * free
        last, interval = interval, dead + (1.0 - again) * mean
        if abs(interval - last) <= TOL.rounding * interval:
            return interval
    raise ConvergenceError(f"constant_light_rate of {1e9 * rate:g} photons/s does not converge; simulate it")
