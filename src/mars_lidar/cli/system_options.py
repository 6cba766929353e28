"""The system of a command line: a file, single options, or a file with some values replaced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mars_lidar.cli.effect_options import Effects
from mars_lidar.cli.groups import group
from mars_lidar.cli.options import DETECTOR, SYSTEM, of_system
from mars_lidar.cli.pulse_options import PulseOptions
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System

DEFAULT_SYSTEM = System(
    period_ns=1e3 / 7.5,
    cycles=1000,
    bins=1024,
    pulse=GaussianPulse(sigma_ns=0.5),
    detector=Detector(dead_time_ns=75.0),
    start="armed",
)
_DETECTOR = ("dead_time_ns", "mode", "gate_start_ns", "gate_width_ns", "gate_step_ns", "gate_cycles")


@group
class SystemChanges:
    """Single values of a system, in place of those of a file or of the default one; None: as there."""

    period_ns: float | None = of_system("Laser period, ns.", "133.33, 7.5 MHz")
    detector: str | None = DETECTOR
    dead_time_ns: float | None = of_system("Dead time after a registration, ns.", "75")
    mode: str | None = of_system(
        "When the pixel registers: nonparalyzable, paralyzable (every arrival restarts the dead time), synchronous "
        "(armed at each pulse, first photon only) or gated (with --gate-start-ns, --gate-width-ns).",
        "nonparalyzable",
    )
    gate_start_ns: float | None = of_system("Mode gated: opening of the gate in each period, ns.")
    gate_width_ns: float | None = of_system("Mode gated: width of the gate, at most the period, ns.")
    gate_step_ns: float | None = of_system("Mode gated: the opening advances by this, ns ...", "0")
    gate_cycles: int | None = of_system("... every so many periods.", "1")
    cycles: int | None = of_system("Laser periods per exposure.", "1000")
    bins: int | None = of_system("Histogram bins per period.", "1024")
    pulse: PulseOptions = PulseOptions()
    start: str | None = of_system(
        "Pixel at the start of an exposure: armed (ready) or stationary (warmed up).", "armed"
    )

    def of(self, file: Path | None, effects: Effects | None = None) -> System:
        """The system of a file, or the default one, so changed."""
        base = DEFAULT_SYSTEM if file is None else System.load(file)
        if self.detector is not None:
            base = base.replace(detector=Detector.preset(self.detector))
        changes: dict[str, Any] = {name: getattr(self, name) for name in ("period_ns", "cycles", "bins", "start")}
        changes["pulse"] = self.pulse.build()
        single = {name: getattr(self, name) for name in _DETECTOR}
        given = {name: value for name, value in single.items() if value is not None}
        given |= {} if effects is None else effects.given()
        if given:
            changes["detector"] = with_given(base.detector, given)
        return base.replace(**{name: value for name, value in changes.items() if value is not None})


@group
class SystemOptions:
    """A system: a file or the default one, and single options in place of its values."""

    system: Path | None = SYSTEM
    changes: SystemChanges = SystemChanges()

    def build(self, effects: Effects | None = None) -> System:
        """The system that is meant."""
        return self.changes.of(self.system, effects)


def with_given(base: Detector, given: dict[str, Any]) -> Detector:
    """`base` with what is given in place of its values; a gate of the file goes with its mode."""
    known = base.to_dict()
    if given.get("mode", base.mode) != base.mode:
        known = {name: value for name, value in known.items() if name != "mode" and not name.startswith("gate_")}
    return Detector.from_dict(known | given)
