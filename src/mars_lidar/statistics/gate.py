"""Check of the modes and effects of the detector that a statistic treats, and the open parts of a gate.

A gate that repeats every period makes a gated pixel a free-running one that sees the flux inside of the gate, so that
the exposure recursion holds for it with that flux: docs/theory_detectors.md.
"""

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
    """Raise ValueError, with an alternative, where `what` does not treat the mode or an effect of the detector."""
    require_effects(what, system.detector, effects, _simulated)
    mode = system.detector.mode
    if mode not in modes:
        allowed = " and ".join(map(repr, modes))
        raise ValueError(
            f"{what} is for detectors of mode {allowed}, got {mode!r}{_INSTEAD[mode]}; any mode can be simulated"
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
    """Parts [low, high) of the period [0, 1), in order, in which a fixed gate is open."""
    start, _, width = system.detector.gate_periods(system.period_ns)
    end = start + width
    return ((start, end),) if end <= 1.0 else ((0.0, end - 1.0), (start, 1.0))
