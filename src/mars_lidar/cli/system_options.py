"""The system of a command line: a file, single options, or a file with some values replaced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mars_lidar.cli import options
from mars_lidar.cli.effect_options import Effects, read_array
from mars_lidar.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.system import Detector, System

DEFAULT_SYSTEM = System(
    period_ns=1e3 / 7.5,
    cycles=1000,
    bins=1024,
    pulse=GaussianPulse(sigma_ns=0.5),
    detector=Detector(dead_time_ns=75.0),
    start="armed",
)
_DETECTOR = ("dead_time_ns", "mode", "gate_start_ns", "gate_width_ns", "gate_step_ns", "gate_cycles")


@dataclass(frozen=True, kw_only=True)
class SystemOptions:
    """A system: a file or the default one, and single options in place of its values; None: as there."""

    system: options.System = None
    period_ns: options.PeriodNs = None
    detector: options.DetectorPreset = None
    dead_time_ns: options.DeadTimeNs = None
    mode: options.Mode = None
    gate_start_ns: options.GateStartNs = None
    gate_width_ns: options.GateWidthNs = None
    gate_step_ns: options.GateStepNs = None
    gate_cycles: options.GateCycles = None
    cycles: options.Cycles = None
    bins: options.Bins = None
    pulse_sigma_ns: options.PulseSigmaNs = None
    pulse_fwhm_ns: options.PulseFwhmNs = None
    pulse_file: options.PulseFile = None
    pulse_bin_ns: options.PulseBinNs = None
    pulse_origin: options.PulseOrigin = None
    start: options.Start = None

    def build(self, effects: Effects | None = None) -> System:
        """The system that is meant."""
        base = DEFAULT_SYSTEM if self.system is None else System.load(self.system)
        if self.detector is not None:
            base = base.replace(detector=Detector.preset(self.detector))
        changes: dict[str, Any] = {name: getattr(self, name) for name in ("period_ns", "cycles", "bins", "start")}
        changes["pulse"] = pulse_of(
            self.pulse_sigma_ns, self.pulse_fwhm_ns, self.pulse_file, self.pulse_bin_ns, self.pulse_origin
        )
        single = {name: getattr(self, name) for name in _DETECTOR}
        given = {name: value for name, value in single.items() if value is not None}
        given |= {} if effects is None else effects.given()
        if given:
            changes["detector"] = with_given(base.detector, given)
        return base.replace(**{name: value for name, value in changes.items() if value is not None})


def with_given(base: Detector, given: dict[str, Any]) -> Detector:
    """`base` with what is given in place of its values; a gate of the file goes with its mode."""
    known = base.to_dict()
    if given.get("mode", base.mode) != base.mode:
        known = {name: value for name, value in known.items() if name != "mode" and not name.startswith("gate_")}
    return Detector.from_dict(known | given)


def pulse_of(
    sigma_ns: float | None, fwhm_ns: float | None, file: Path | None, bin_ns: float | None, origin: str | None
) -> Pulse | None:
    """The pulse that the options give, or None where they give none."""
    given = [
        name
        for name, value in (
            ("--pulse-sigma-ns", sigma_ns),
            ("--pulse-fwhm-ns", fwhm_ns),
            ("--pulse-file", file),
        )
        if value is not None
    ]
    if len(given) > 1:
        raise ValueError(f"the pulse is given once: choose one of {' and '.join(given)}")
    if file is None and (bin_ns is not None or origin is not None):
        raise ValueError("--pulse-bin-ns and --pulse-origin belong to --pulse-file, which is not given")
    if sigma_ns is not None:
        return GaussianPulse(sigma_ns=sigma_ns)
    if fwhm_ns is not None:
        return GaussianPulse.from_fwhm(fwhm_ns=fwhm_ns)
    if file is None:
        return None
    if bin_ns is None:
        raise ValueError(f"--pulse-file {file} needs --pulse-bin-ns, the width of its samples in ns")
    return _measured(file, bin_ns, origin or "peak")


def _measured(file: Path, bin_ns: float, origin: str) -> SampledPulse:
    values = read_array("--pulse-file", file)
    try:
        return SampledPulse(values, bin_ns, origin)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error
