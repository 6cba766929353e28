"""The sequential simulator in NumPy, as the MaRS paper describes its baseline.

The paper's (arXiv 2512.04924, 40.8 s for the canonical cube) has no public code. What it describes is
written here without handicap: the arrivals of a pixel are drawn and sorted in one NumPy call each, and the
photons are visited as Python floats, several times faster than by indexing an array. Two vectorised forms
gave the same histograms but were no faster on the canonical cube: searching each photon's successor with
`searchsorted` and visiting registrations only (1.2 times the CPU time), and a step of all pixels at once (0.9
to 1.1 times).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.workload import SIGMA_NS, Workload


def photon_by_photon(workload: Workload, pixels: NDArray[np.intp]) -> NDArray[np.uint16]:
    """Histograms (n, bins) of some pixels: draw all arrivals, sort, reject one by one in the dead time."""
    random = np.random.default_rng(1)
    flux, system = workload.flux, workload.system
    dead = system.dead_time_periods
    maps = (m.reshape(-1)[pixels] for m in (flux.signal, flux.background, flux.delay_ns))
    cube = np.empty((pixels.size, system.bins), np.uint16)
    for row, signal, background, delay in zip(cube, *maps, strict=True):
        kept = []
        armed = 0.0
        for time in _arrivals(random, signal, background, delay, workload).tolist():
            if time >= armed:
                kept.append(time)
                armed = time + dead
        row[:] = _histogram(np.array(kept), system.bins)
    return cube


def _arrivals(
    random: np.random.Generator, signal: float, background: float, delay_ns: float, workload: Workload
) -> NDArray[np.float64]:
    """Sorted arrival times of one pixel in one exposure, in periods."""
    system = workload.system
    cycles = system.cycles
    echoes = random.poisson(signal * cycles)
    phase = random.normal(delay_ns / system.period_ns, SIGMA_NS / system.period_ns, echoes)
    echo = random.integers(cycles, size=echoes) + (phase - np.floor(phase))  # the pulse wraps
    ambient = random.uniform(0.0, cycles, random.poisson(background * cycles))
    times = np.concatenate([echo, ambient])
    times.sort()
    return times


def _histogram(times: NDArray[np.float64], bins: int) -> NDArray[np.intp]:
    phase = times - np.floor(times)
    return np.bincount(np.minimum(phase * bins, bins - 1).astype(np.intp), minlength=bins)
