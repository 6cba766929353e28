"""Which statistics treat which mode and effects of the detector, and when a gate is open."""

from __future__ import annotations

from mars_lidar.instrument.detector import Mode, require_effects
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System

PLAIN: tuple[Mode, ...] = ("nonparalyzable",)
_INSTEAD = {
    "nonparalyzable": "",
    "paralyzable": "; count_law, exposure_moments, mean_histogram and registration_pdf have its exact statistics",
    "synchronous": "; count_law, mean_histogram and registration_pdf have its exact statistics",
    "gated": "; count_law, exposure_moments, mean_histogram and registration_pdf have its exact statistics",
}


def require_mode(
    what: str, system: System, modes: tuple[Mode, ...] = PLAIN, effects: tuple[str, ...] = LIGHT_EFFECTS
) -> None:
    """Raise ValueError, naming what to use, where `what` does not treat the detector's mode, or one of its effects."""
    require_effects(what, system.detector, effects, _simulated)
    mode = system.detector.mode
    if mode not in modes:
        told = " and ".join(map(repr, modes))
        raise ValueError(
            f"{what} is for detectors of mode {told}, got {mode!r}{_INSTEAD[mode]}; any mode can be simulated"
        )
    if system.detector.gate_moves:
        raise ValueError(
            f"{what} needs a gate that repeats every period, got gate_step_ns={system.detector.gate_step_ns:g}; "
            "a moving gate can be simulated"
        )


def _simulated(effect: str) -> str:
    able = "'sequential'" if effect == "crosstalk" else "'exact' or 'sequential'"
    return f"; simulate it with engine {able}"


def open_parts(system: System) -> tuple[tuple[float, float], ...]:
    """The parts [low, high) of the period [0, 1), in order, in which a gate that does not move is open."""
    start, _, width = system.detector.gate_periods(system.period_ns)
    end = start + width
    return ((start, end),) if end <= 1.0 else ((0.0, end - 1.0), (start, 1.0))
