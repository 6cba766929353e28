"""Timestamps of a case: what must hold for every registration, and the lattice of their phases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mars_lidar import simulate, simulate_timestamps
from studies.domain.case import PERIOD_NS, Case
from studies.domain.checks import Check

_MOST = 3e5  # registrations that are looked at one by one
_LATTICE = 17  # bits of a period behind which phases are still to be even
_CELLS = 16


def recorded(case: Case, seed: int, budget: float) -> list[Check]:
    """Checks of `simulate_timestamps` with the exact engine: order, dead time, exposure, histogram, fine phases."""
    if case.registrations() > _MOST or (case.mode == "paralyzable" and case.photons * case.system.cycles > 5 * _MOST):
        return []
    pixels = int(np.clip(min(budget / max(case.registrations(), 1e-6), 2**22 / case.system.bins), 1, 64))
    flux, system = case.flux(pixels), case.system
    if case.mode in ("gated", "moving gate") and system.cycles * min(1.0, case.photons) * pixels > 10 * _MOST:
        return []
    times = simulate_timestamps(flux, system, seed=seed, threads=1)
    cube = simulate(flux, system, seed=seed, threads=1).reshape(pixels, system.bins)
    owner = np.repeat(np.arange(pixels), np.diff(times.offsets))
    binned = np.bincount(owner * system.bins + times.bin, minlength=cube.size).reshape(cube.shape)
    t = times.times_ns / PERIOD_NS
    blurred = bool({"jitter", "code_density"} & set(system.detector.effects))
    least = max(system.dead_time_periods, system.electronics_dead_time_periods)
    facts = {
        "histogram of the timestamps": bool((binned == cube).all()),
        "times inside of the exposure": bool((t >= 0.0).all() and (t < system.cycles).all()),
        "times in order": bool((np.diff(t)[np.diff(owner) == 0] >= 0.0).all()),
        "dead time kept": blurred or bool((np.diff(t)[np.diff(owner) == 0] >= least * (1.0 - 1e-12) - 2.5e-7).all()),
        "no bin above the most that fits": bool(cube.max(initial=0) <= system.max_bin_count),
        "registrations in the gate": blurred
        or system.detector.mode != "gated"
        or bool((case.since_gate(t, early=2.5e-7) <= case.gate_width + 5e-7).all()),
    }
    results = [Check("timestamps", "timestamps", name, 1.0 if fine else 0.0, 0.0) for name, fine in facts.items()]
    return results + _lattice(case, t, owner)


def _lattice(case: Case, t: NDArray[np.float64], owner: NDArray[np.int64]) -> list[Check]:
    """Phases of smooth light are even on the scale of 2^-17 period: first registrations, and all of them."""
    spoiled = {"jitter", "code_density", "max_events_per_exposure"} & set(case.system.detector.effects)
    narrow = case.strongest > 0.0 and getattr(case.system.pulse, "sigma_ns", 0.0) < 1e-3 * PERIOD_NS
    if case.waveform is not None or spoiled or narrow or case.mode in ("gated", "moving gate", "synchronous"):
        return []
    fine = (t * 2.0**_LATTICE) % 1.0
    first = np.diff(owner, prepend=-1) != 0
    results = []
    for name, x in (("fine phases", fine), ("fine phases of the first", fine[first])):
        # a registration at the end of a dead time keeps its distance to the one before: the first only, or dim light
        if x.size < 40 * _CELLS or (name == "fine phases" and case.photons * case.system.dead_time_periods > 0.1):
            continue
        observed = np.bincount((x * _CELLS).astype(int), minlength=_CELLS)
        expected = x.size / _CELLS
        p = float(stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), _CELLS - 1))
        results.append(Check("timestamps", "closed form", name, p, float(np.abs(observed / expected - 1.0).max())))
    return results
