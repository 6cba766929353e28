"""Mean, variance and mean histogram of a paralyzable pixel by integration over the exposure: an oracle for its laws.

An arrival is registered if and only if there is no other arrival within the dead time before it. The rate of
registrations is therefore r(t) = lambda(t) exp(-(C(t) - C(t - t_d))), with the integrated light C, and registrations
further apart than the dead time are independent. The variance is the mean less twice the integral of
r(t) [R(t) - R(t - t_d)], the pairs that do not occur, with R the integral of r from the begin of the exposure on.
"""

from typing import NamedTuple

import numpy as np

import mars_lidar as ml
from harness.laws import Floats


class Moments(NamedTuple):
    """Of one pixel; `histogram` (bins,)."""

    mean: float
    variance: float
    histogram: Floats


def paralyzable_moments(flux: ml.Flux, system: ml.System, parts: int = 4096) -> Moments:
    """Integrals over `parts` of the period and as many of the pulse; beyond the transient they grow linearly."""
    dead, bins, armed = system.dead_time_periods, system.bins, system.start == "armed"
    whole = int(dead)
    rest = dead - whole
    steps, light = _light(flux, system, parts)
    edges = np.arange(bins + 1) / bins
    phase = np.unique(np.concatenate([edges, np.linspace(0.0, 1.0, parts + 1), steps, (steps + rest) % 1.0, [rest]]))
    early = (phase < rest).astype(int)  # the dead time before began a period earlier
    past = phase - rest + early
    total, now, then = float(light(np.ones(1))[0]), light(phase), light(past)
    periods = min(system.cycles, 2 * whole + 4)
    rates, below, pairs = [], [np.zeros(phase.size)], [0.0]
    for k in range(periods):
        before = k - whole - early  # the period in which the dead time began
        lit = (then + total * before) if not armed else np.where(before < 0, 0.0, then + total * before)
        within = now + total * k - lit
        rise = np.diff(within)  # exp(-within) over a part where it is linear in the exponent
        mean_keep = np.divide(np.expm1(-rise), -rise, out=np.ones_like(rise), where=rise != 0.0)
        rates.append(np.diff(now) * np.exp(-within[:-1]) * mean_keep)
        below.append(below[-1][-1] + np.concatenate([[0.0], np.cumsum(rates[-1])]))
        first, last = (np.interp(past, phase, below[max(k - whole - j, -1) + 1]) for j in (1, 0))
        apart = below[-1] - np.where(early, first, last)
        pairs.append(pairs[-1] + float(0.5 * (apart[1:] + apart[:-1]) @ rates[-1]))
    mean = np.array([each[-1] for each in below])
    more = system.cycles - periods
    histograms = [np.add.reduceat(rate, np.searchsorted(phase, edges[:-1])) for rate in rates]
    variance = np.maximum(mean - 2.0 * np.array(pairs), 0.0)  # rounding of a pixel that counts 1
    return Moments(
        *(float(x[-1] + more * (x[-1] - x[-2])) for x in (mean, variance)), sum(histograms) + more * histograms[-1]
    )


def _light(flux: ml.Flux, system: ml.System, parts: int):
    """Phases between which the light is smooth, and photons before phases (n,) of a period."""
    background = float(flux.background.item())
    if flux.waveform is not None:
        wave = flux.waveform.reshape(-1)
        steps = np.arange(wave.size + 1) / wave.size
        below = np.concatenate([[0.0], np.cumsum(wave)])
        return steps, lambda x: background * x + np.interp(x, steps, below)
    pulse, period = system.pulse, system.period_ns
    signal, delay = (each.reshape(-1) for each in (flux.returns_signal, np.nan_to_num(flux.returns_delay_ns)))
    steps = (delay[:, None] + np.linspace(*pulse.support_ns(), parts)).ravel() / period % 1.0

    def light(x: Floats) -> Floats:
        return background * x + sum(
            s * (pulse.wrapped_cumulative(x * period - d, period) - pulse.wrapped_cumulative(-d, period))
            for s, d in zip(signal, delay, strict=True)
        )

    return steps, light
