"""A system as the explorer's page sets it: its sliders, or why they cannot tell it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.io import Cube
from mars_lidar.reconstruction import reconstruct

_SUPPORTED = (*LIGHT_EFFECTS, "afterpulsing", "twilight_ns", "electronics_dead_time_ns", "jitter")


def settings_of(system: System) -> tuple[dict[str, Any], str]:
    """What the page's sliders are set to for a system, and why it has no exact law there, or nothing."""
    detector = system.detector
    settings: dict[str, Any] = {
        "period": system.period_ns,
        "cycles": system.cycles,
        "bins": system.bins,
        "start": system.start,
        "dead": detector.dead_time_ns,
        "mode": detector.mode,
        "efficiency": detector.detection_efficiency,
        "dark": detector.dark_count_hz,
        "twilight": detector.twilight_ns,
        "electronics": detector.electronics_dead_time_ns,
    }
    unsupported = [name for name in detector.effects if name not in _SUPPORTED]
    if isinstance(system.pulse, GaussianPulse):
        settings["sigma"] = system.pulse.sigma_ns
    else:
        unsupported.append("a measured pulse")
    if detector.mode == "gated":
        settings |= {"gateStart": detector.gate_start_ns, "gateWidth": detector.gate_width_ns}
    if detector.gate_moves:
        unsupported.append("a gate that moves")
    after, jitter = detector.afterpulsing, detector.jitter
    if after is not None and (after.delay_ns is None or after.generations is not None):
        unsupported.append("sampled or limited afterpulses")
    elif after is not None:
        settings |= {"afterpulses": after.probability, "trapDelay": after.delay_ns}
    if jitter is not None and getattr(jitter, "tail_fraction", 1.0) > 0.0:
        unsupported.append("a jitter that is not Gaussian")
    elif jitter is not None:
        settings["jitter"] = getattr(jitter, "sigma_ns", 0.0)
    return settings, f"This page draws no law for {' and '.join(unsupported)}." if unsupported else ""


def truth_of(cube: Cube) -> str:
    """Why the light of a cube cannot be told by one return over uniform background, or nothing."""
    if cube.measured:
        return ""
    if cube.flux.waveform is not None or len(cube.flux.returns_signal) > 1:
        return "This page draws no law for light that is not one return over uniform background."
    return ""


def light_of(cube: Cube, image: int, row: int, column: int, counts: NDArray[Any]) -> dict[str, float] | None:
    """S, B and delay (ns) of a pixel: of the file, of a measured one by maximum likelihood, or None."""
    system = cube.system
    if not cube.measured:
        if truth_of(cube):
            return None
        flux = cube.flux
        signal, background = float(flux.signal[row, column]), float(flux.background[row, column])
        delay = float(flux.returns_delay_ns.reshape(1, *flux.shape)[0, row, column])
    else:
        try:
            estimate = reconstruct(counts, system)
        except ValueError:  # a mode or a pulse that it does not hold for
            return None
        share = system.detector.detection_efficiency
        dark = system.detector.dark_count_hz * system.period_ns * 1e-9
        signal, delay = float(estimate.signal) / share, float(estimate.delay_ns)
        background = max(float(estimate.background) - dark, 0.0) / share
    delay = delay % system.period_ns if np.isfinite(delay) else 0.0
    return {"signal": signal, "background": background, "delay": delay}
