"""Calibration of detectors whose likelihood is not known: by simulation of the same detector (indirect inference).

Gourieroux, Monfort, Renault, J. Appl. Econometrics 8, S85 (1993): the light is right with which streams of the exact
engine, calibrated in the same way, give the same estimates as the measured stream, whatever their bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mars_lidar.estimate.calibration import Calibration
from mars_lidar.flux import Flux
from mars_lidar.system import System
from mars_lidar.timestamps import Timestamps

TIMES = 4.0  # the simulated stream is so much longer than the measured one
_MOST = 8_000_000  # registrations of it, about
_STEPS = 12
_NEAR = 0.3  # standard errors that a last step may have
_PIXELS = 16
_SEED = 20_252


def indirect(
    found: Calibration, system: System, calibrated: Callable[[Timestamps], Calibration]
) -> Calibration:
    """`found` with the light of `system` that `calibrated` sees as it sees the measured stream.

    One return of a known pulse. The covariance is that of the fit, enlarged by that of the simulation.
    """
    from mars_lidar.simulate import simulate_timestamps

    counted = found.summary
    times = min(TIMES, _MOST / max(counted.registrations, 1))
    cycles = int(max(1, np.ceil(times * counted.cycles / _PIXELS)))
    made_by = system.replace(cycles=cycles, bins=counted.bins if counted.bins <= 2**16 else 1024, start="armed")
    seen = np.array([found.background, found.signal, found.delay_ns])
    errors = np.sqrt(np.diag(found.covariance))
    light, converged, row = seen.copy(), False, np.ones((1, _PIXELS))
    for _ in range(_STEPS):
        flux = Flux(max(light[1], 0.0) * row, max(light[0], 0.0), light[2])
        stream = simulate_timestamps(flux, made_by, seed=_SEED)
        again = calibrated(stream)
        step = seen - np.array([again.background, again.signal, again.delay_ns])
        step[2] = (step[2] + 0.5 * counted.period_ns) % counted.period_ns - 0.5 * counted.period_ns
        light += step
        if (np.abs(step) < _NEAR * errors).all():
            converged = True
            break
    return replace(
        found,
        background=float(max(light[0], 0.0)),
        returns_signal=np.array([max(light[1], 0.0)]),
        returns_delay_ns=np.array([light[2] % counted.period_ns]),
        covariance=found.covariance * (1.0 + 1.0 / times),
        simulated=times,
        converged=found.converged and converged,
    )
