"""A detector drawn photon by photon, with the faults that real ones have: for streams that the model does not fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mars_lidar.timestamps import Timestamps


@dataclass(frozen=True)
class Faults:
    """What a detector does beside its dead time.

    Parameters
    ----------
    jitter_ns
        Standard deviation of a Gaussian error of each recorded time, ns: after the dead time, so that intervals may
        be shorter than it.
    afterpulse, afterpulse_ns
        Probability that an avalanche traps a carrier, and the mean of its exponential release time, ns; released
        during the dead time it is lost (Straka et al., arXiv 2001.10036).
    electronics_ns
        The electronics record a detection only if this long has passed since the last record (Rapp et al. 2019); a
        detection that is not recorded blinds the detector all the same.
    """

    jitter_ns: float = 0.0
    afterpulse: float = 0.0
    afterpulse_ns: float = 100.0
    electronics_ns: float = 0.0


def detect(arrivals: Timestamps, dead_ns: float, faults: Faults, seed: int) -> Timestamps:
    """What a detector makes of the photons of one pixel (a stream without dead time); armed at the start."""
    random = np.random.default_rng(seed)
    photons = arrivals.times_ns.tolist()
    trapped = random.random(len(photons) + 1) < faults.afterpulse
    release = random.exponential(faults.afterpulse_ns, len(photons) + 1).tolist()
    kept: list[float] = []
    ready = recorded = 0.0  # when detector and electronics are ready
    pending = np.inf  # release of a trapped carrier
    fired = 0
    for photon in photons:
        while pending <= photon or photon >= ready:
            at = min(pending, photon)
            carrier = pending <= photon
            pending = np.inf if carrier else pending
            if at >= ready:
                ready = at + dead_ns
                if trapped[fired % len(trapped)]:
                    pending = at + release[fired % len(release)]
                fired += 1
                if at >= recorded:
                    kept.append(at)
                    recorded = at + faults.electronics_ns
            if not carrier:
                break
    times = np.array(kept)
    if faults.jitter_ns:
        times = np.sort(np.abs(times + faults.jitter_ns * random.standard_normal(times.size)))
    times = times[times < arrivals.cycles * arrivals.period_ns]
    x = times / arrivals.period_ns
    cycle = np.floor(x)
    place = np.minimum(((x - cycle) * arrivals.bins).astype(np.int32), arrivals.bins - 1)
    return replace(
        arrivals, times_ns=times, cycle=cycle.astype(np.int32), bin=place, offsets=np.array([0, times.size], np.int64)
    )
