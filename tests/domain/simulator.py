"""A simulator of its own for the sweep: every arrival drawn and judged, in double precision, by NumPy alone.

It shares no line with the engines. Arrivals of an exposure are drawn, sorted, and walked through one after another, all
exposures side by side; small systems only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mars_lidar import GaussianPulse
from mars_lidar._base.types import FloatArray
from tests.domain.systems import PERIOD_NS, Case

ABLE = {"detection_efficiency", "dark_count_hz", "electronics_dead_time_ns", "twilight_ns"}
ABLE |= {"max_events_per_period", "max_events_per_exposure", "recovery_ns"}


def warm_up(case: Case) -> float:
    """Periods simulated before the exposure for a stationary start, so that the start-up transient decays."""
    if case.system.start == "armed" or case.system.dead_time_periods == 0.0:
        return 0.0
    return 150.0 * (case.system.dead_time_periods + 1.0) + 20.0 * case.system.detector.recovery_ns / PERIOD_NS


def arrivals(case: Case) -> float:
    """Arrivals of an exposure, those of its warm-up included."""
    return case.photons * (case.system.cycles + warm_up(case))


def able(case: Case) -> bool:
    """Whether this simulator has what the case needs."""
    return set(case.system.detector.effects) <= ABLE


def counts(case: Case, exposures: int, seed: int) -> NDArray[np.int64]:
    """Histograms (exposures, bins)."""
    owner, time = registered(case, exposures, seed)
    bins = np.minimum((time % 1.0 * case.system.bins).astype(np.int64), case.system.bins - 1)
    return np.bincount(owner * case.system.bins + bins, minlength=exposures * case.system.bins).reshape(exposures, -1)


def registered(case: Case, exposures: int, seed: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Owner and time (periods) of what is recorded, in no order."""
    random = np.random.default_rng([seed, 77])
    system, detector = case.system, case.system.detector
    early = np.ceil(warm_up(case))
    offset = early - (random.random(exposures) * (detector.dead_time_ns / PERIOD_NS + 1.0) if early else 0.0)
    length = system.cycles + early
    owner, time = _arrivals(case, exposures, length, random)
    time -= early
    keep = time >= -np.broadcast_to(offset, exposures)[owner]
    if detector.mode == "gated":
        keep &= case.since_gate(time) < case.gate_width
    owner, time = owner[keep], time[keep]
    order = np.lexsort((time, owner))
    owner, time = owner[order], time[order]
    first = np.searchsorted(owner, np.arange(exposures + 1))
    return _recorded(case, first, time, random)


def _arrivals(
    case: Case, exposures: int, length: float, random: np.random.Generator
) -> tuple[NDArray[np.int64], FloatArray]:
    """Owner and time (periods, from 0 to `length`, whole) of all arrivals."""
    share = case.system.detector.detection_efficiency
    dark = case.system.detector.dark_count_hz * PERIOD_NS * 1e-9
    parts = []
    uniform = case.background * share + dark
    number = random.poisson(uniform * length, exposures)
    parts.append((np.repeat(np.arange(exposures), number), random.random(number.sum()) * length))
    if case.waveform is not None:
        number = random.poisson(case.strongest * share * length, exposures)
        total = int(number.sum())
        if total:
            edges = np.concatenate([[0.0], np.cumsum(case.waveform)])
            phase = np.interp(random.random(total) * edges[-1], edges, np.arange(edges.size) / case.waveform.size)
            parts.append((np.repeat(np.arange(exposures), number), np.floor(random.random(total) * length) + phase))
    else:
        for signal, delay in zip(case.signal, case.delay, strict=True):
            number = random.poisson(signal * share * length, exposures)
            phase = (delay + _pulse(case, int(number.sum()), random)) % 1.0
            time = np.floor(random.random(phase.size) * length) + phase
            parts.append((np.repeat(np.arange(exposures), number), time))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _pulse(case: Case, number: int, random: np.random.Generator) -> FloatArray:
    """Times of photons round their delay, periods."""
    pulse = case.system.pulse
    if isinstance(pulse, GaussianPulse):
        return random.standard_normal(number) * (pulse.sigma_ns / PERIOD_NS)
    low, high = pulse.support_ns()
    edges = np.linspace(low, high, 1 + round((high - low) / pulse.to_dict()["bin_ns"]))
    below = pulse.cumulative(edges)
    return np.asarray(np.interp(random.random(number) * below[-1], below, edges) / PERIOD_NS)


def _recorded(
    case: Case, first: NDArray[np.int64], time: FloatArray, random: np.random.Generator
) -> tuple[NDArray[np.int64], FloatArray]:
    """Owner and time of what is recorded in the exposure, arrival by arrival, all exposures side by side."""
    detector, dead, cycles = case.system.detector, case.system.dead_time_periods, case.system.cycles
    exposures = first.size - 1
    twilight, recovery = detector.twilight_ns / PERIOD_NS, detector.recovery_ns / PERIOD_NS
    electronics = case.system.electronics_dead_time_periods
    per_period, per_exposure = (
        np.inf if most is None else most for most in (detector.max_events_per_period, detector.max_events_per_exposure)
    )
    ready, recorded = np.full(exposures, -np.inf), np.full(exposures, -np.inf)
    period, in_period, in_all = np.full(exposures, -1.0), np.zeros(exposures), np.zeros(exposures)
    owners, times = [], []
    here = np.arange(exposures)
    for step in range(int(np.max(np.diff(first), initial=0))):
        here = here[first[here] + step < first[here + 1]]
        t = time[first[here] + step]
        fires = t >= ready[here] - twilight
        if recovery:  # a photon within the twilight fires as the dead time ends
            insensitive = np.exp(-np.maximum(t - ready[here], 0.0) / recovery)
            fires &= (t < ready[here]) | (random.random(t.size) >= insensitive)
        t = np.maximum(t, np.where(fires, ready[here], t)) if twilight else t
        if detector.mode == "paralyzable":
            ready[here] = t + dead
        elif detector.mode == "synchronous":
            ready[here[fires]] = np.maximum(np.floor(t[fires]) + 1.0, np.ceil(t[fires] + dead))
        else:
            ready[here[fires]] = t[fires] + dead
        selected = fires & (t >= 0.0) & (t < cycles)
        who, t = here[selected], t[selected]
        ok = t >= recorded[who] + electronics
        recorded[who[ok]] = t[ok] if electronics > dead else -np.inf
        who, t = who[ok], t[ok]
        in_period[who] = np.where(np.floor(t) == period[who], in_period[who], 0.0) + 1.0
        period[who] = np.floor(t)
        ok = in_period[who] <= per_period
        who, t = who[ok], t[ok]
        in_all[who] += 1.0
        ok = in_all[who] <= per_exposure
        owners.append(who[ok])
        times.append(t[ok])
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *owners]), np.concatenate([np.zeros(0), *times])
