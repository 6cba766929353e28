"""The system of a command line: a file, single options, or a file with some values replaced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mars_lidar.effects import FIELDS
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


@dataclass(frozen=True, kw_only=True)
class Effects:
    """The options that switch on effects of the detector; None: as in the file."""

    detection_efficiency: float | None
    dark_count_hz: float | None
    afterpulse_probability: float | None
    afterpulse_delay_ns: float | None
    twilight_ns: float | None
    crosstalk: float | None
    crosstalk_kernel: str | None
    electronics_dead_time_ns: float | None
    max_events_per_period: int | None
    max_events_per_exposure: int | None
    jitter_fwhm_ns: float | None
    jitter_tail_ns: float | None
    jitter_tail_fraction: float | None
    jitter_file: Path | None
    jitter_bin_ns: float | None
    code_density_file: Path | None

    def given(self) -> dict[str, Any]:
        """Fields of `Detector`, as plain data."""
        told: dict[str, Any] = {name: getattr(self, name) for name in FIELDS if hasattr(self, name)}
        told["jitter"] = self._jitter()
        told["afterpulsing"] = _together(
            {"probability": self.afterpulse_probability, "delay_ns": self.afterpulse_delay_ns},
            "--afterpulse-probability and --afterpulse-delay-ns",
        )
        if self.crosstalk_kernel is not None and self.crosstalk is None:
            raise ValueError("--crosstalk-kernel belongs to --crosstalk, which is not given")
        told["crosstalk"] = None
        if self.crosstalk is not None:
            told["crosstalk"] = {"probability": self.crosstalk, "kernel": self.crosstalk_kernel or "8"}
        if self.code_density_file is not None:
            told["code_density"] = _array("--code-density-file", self.code_density_file)
        return {name: value for name, value in told.items() if value is not None}

    def _jitter(self) -> dict[str, Any] | None:
        gaussian = {
            "fwhm_ns": self.jitter_fwhm_ns, "tail_ns": self.jitter_tail_ns, "tail_fraction": self.jitter_tail_fraction
        }  # fmt: skip
        gaussian = {name: value for name, value in gaussian.items() if value is not None}
        if self.jitter_file is not None:
            if gaussian:
                raise ValueError("the jitter is given once: choose --jitter-file or --jitter-fwhm-ns and its tail")
            if self.jitter_bin_ns is None:
                raise ValueError(f"--jitter-file {self.jitter_file} needs --jitter-bin-ns, its samples' width in ns")
            values = _array("--jitter-file", self.jitter_file)
            return {"kind": "sampled", "values": values.tolist(), "bin_ns": self.jitter_bin_ns}
        if self.jitter_bin_ns is not None:
            raise ValueError("--jitter-bin-ns belongs to --jitter-file, which is not given")
        if gaussian and self.jitter_fwhm_ns is None:
            raise ValueError("--jitter-tail-ns and --jitter-tail-fraction need --jitter-fwhm-ns")
        return {"kind": "gaussian", **gaussian} if gaussian else None


def _together(values: dict[str, Any], names: str) -> dict[str, Any] | None:
    given = [value is not None for value in values.values()]
    if any(given) and not all(given):
        raise ValueError(f"{names} belong together: both, or neither")
    return values if all(given) else None


def build_system(
    file: Path | None,
    *,
    period_ns: float | None,
    cycles: int | None,
    bins: int | None,
    preset: str | None = None,
    dead_time_ns: float | None,
    mode: str | None = None,
    gate_start_ns: float | None = None,
    gate_width_ns: float | None = None,
    gate_step_ns: float | None = None,
    gate_cycles: int | None = None,
    dark_count_hz: float | None = None,
    effects: Effects | None = None,
    start: str | None,
    pulse_sigma_ns: float | None,
    pulse_fwhm_ns: float | None,
    pulse_file: Path | None,
    pulse_bin_ns: float | None,
    pulse_origin: str | None,
) -> System:
    """The system of `file` (or the default one) with the options that are not None in place of its values."""
    base = DEFAULT_SYSTEM if file is None else System.load(file)
    if preset is not None:
        base = base.replace(detector=Detector.preset(preset))
    changes: dict[str, Any] = {
        "period_ns": period_ns,
        "cycles": cycles,
        "bins": bins,
        "start": start,
        "pulse": _pulse(pulse_sigma_ns, pulse_fwhm_ns, pulse_file, pulse_bin_ns, pulse_origin),
    }
    detector = {
        "dead_time_ns": dead_time_ns,
        "mode": mode,
        "gate_start_ns": gate_start_ns,
        "gate_width_ns": gate_width_ns,
        "gate_step_ns": gate_step_ns,
        "gate_cycles": gate_cycles,
        "dark_count_hz": dark_count_hz,
    }
    given = {name: value for name, value in detector.items() if value is not None}
    given |= {} if effects is None else effects.given()
    if given:
        changes["detector"] = _detector(base.detector, given)
    return base.replace(**{name: value for name, value in changes.items() if value is not None})


def _detector(base: Detector, given: dict[str, Any]) -> Detector:
    """`base` with what is given in place of its values; a gate of the file goes with its mode."""
    known = base.to_dict()
    if given.get("mode", base.mode) != base.mode:
        known = {name: value for name, value in known.items() if name != "mode" and not name.startswith("gate_")}
    return Detector.from_dict(known | given)


def _pulse(
    sigma_ns: float | None, fwhm_ns: float | None, file: Path | None, bin_ns: float | None, origin: str | None
) -> Pulse | None:
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
    values = _array("--pulse-file", file)
    try:
        return SampledPulse(values, bin_ns, origin)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error


def _array(option: str, file: Path) -> Any:
    import numpy as np

    if file.suffix != ".npy":
        raise ValueError(f"{option} must be a 1-D .npy array, got {str(file)!r}")
    try:
        return np.load(file, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{file}: {error}") from error
