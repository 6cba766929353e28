"""Calibration of detectors whose likelihood is not known: by simulation of the same detector (indirect inference).

Gourieroux, Monfort, Renault, J. Appl. Econometrics 8, S85 (1993): the light is right with which streams of the exact
engine, calibrated in the same way, give the same estimates as the measured stream, whatever their bias. There are as
many estimates as there are parameters, for returns of a known or fitted width as for a free shape, bin by bin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.calibration_result import Calibration, nearest
from mars_lidar.calibrate.intervals import Stream, stream_of
from mars_lidar.instrument.system import System

TIMES = 4.0  # the simulated stream is so much longer than the measured one
_MOST = 8_000_000  # registrations of it, about
_STEPS = 12
_NEAR = 0.3  # standard errors that a last step may have
_PIXELS = 16
_SEED = 20_252


def indirect(found: Calibration, system: System, once: Callable[[Stream], Calibration]) -> Calibration:
    """`found` with the light of `system` that `once` calibrates as it does the measured stream.

    The covariance is that of the fit, enlarged by that of the simulation. The pulse of `system` is not used.
    """
    from mars_lidar.simulate import simulate_timestamps

    if found.waveform is not None and system.detector.jitter is not None:
        # a free shape is the light as it is recorded, which a pixel without jitter records as it is
        plain = system.replace(detector=system.detector.without("jitter"))
        return replace(indirect(replace(found, jitter_ns=0.0), plain, once), jitter_ns=found.jitter_ns)
    counted = found.summary
    times = min(TIMES, _MOST / max(counted.registrations, 1))
    cycles = int(max(1, np.ceil(times * counted.cycles / _PIXELS)))
    bins = counted.bins if counted.bins <= 2**16 else 1024
    light, converged = found, False
    for _ in range(_STEPS):
        made_by = system.replace(cycles=cycles, bins=bins, pulse=light.system(1, bins).pulse, start="armed")
        # of its own for each stream, or the error of the simulation would be shared by all that are calibrated
        stream = simulate_timestamps(light.flux(_PIXELS), made_by, seed=_SEED + counted.registrations)
        step = nearest(found, found.parameters - once(stream_of(stream, pooled=True)).parameters)
        light = light.moved(step)
        if _small(found, step):
            converged = True
            break
    return replace(
        light,
        covariance=found.covariance * (1.0 + 1.0 / times),
        simulated=times,
        converged=found.converged and converged,
    )


def _small(found: Calibration, step: FloatArray) -> bool:
    """Whether a step is small beside the standard errors: of each parameter, or of all light of a free shape."""
    errors = np.sqrt(np.diag(found.covariance))
    if found.waveform is not None:
        return bool(abs(step.sum()) < _NEAR * errors[0])
    told = np.isfinite(errors)
    return bool((np.abs(step[told]) < _NEAR * errors[told]).all())
