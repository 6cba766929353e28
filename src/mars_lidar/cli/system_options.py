"""The system of a command line: a file, single options, or a file with some values replaced by options."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from mars_lidar._base import checks
from mars_lidar._base.files import read_column, read_npy, reading
from mars_lidar.cli.options import Integer, Number, Text, options
from mars_lidar.instrument.effects import FIELDS
from mars_lidar.instrument.presets import PRESETS
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.instrument.system import Detector, System

# --- Effects --------------------------------------------------------------------------------------------------------


@options
class Effects:
    """Effects of the detector; None: as in the file.

    Effects of the detector (off by default)
    ----------------------------------------
    afterpulse_probability
        Mean number of trapped carriers that an avalanche leaves, those lost in the dead time included ... [default: 0]
    afterpulse_delay_ns
        ... and their mean delay after the avalanche, ns.
    jitter_fwhm_ns
        Gaussian timing jitter: full width at half maximum, ns.
    jitter_tail_ns
        Mean of the exponential tail of the jitter, ns ...
    jitter_tail_fraction
        ... and the fraction of the events in it.
    jitter_file
        Measured jitter instead: 1-D .npy array of its density.
    jitter_bin_ns
        Sample width of --jitter-file, ns.
    code_density_file
        TDC non-linearity: 1-D .npy array of relative code widths; their number divides the bins.
    crosstalk
        Mean number of neighbours that an avalanche triggers; with --engine sequential. [default: 0]
    crosstalk_kernel
        Which neighbours: 4 or 8. [default: 8]
    """

    detection_efficiency: Number | None = None
    dark_count_hz: Number | None = None
    afterpulse_probability: Number | None = None
    afterpulse_delay_ns: Number | None = None
    twilight_ns: Number | None = None
    recovery_ns: Number | None = None
    electronics_dead_time_ns: Number | None = None
    max_events_per_period: Integer | None = None
    jitter_fwhm_ns: Number | None = None
    jitter_tail_ns: Number | None = None
    jitter_tail_fraction: Number | None = None
    jitter_file: Path | None = None
    jitter_bin_ns: Number | None = None
    code_density_file: Path | None = None
    crosstalk: Number | None = None
    crosstalk_kernel: Text | None = None
    max_events_per_exposure: Integer | None = None

    def given(self) -> dict[str, Any]:
        """Fields of `Detector`, as plain data."""
        fields: dict[str, Any] = {name: getattr(self, name) for name in FIELDS if hasattr(self, name)}
        fields["jitter"] = self._jitter()
        probability, delay_ns = self.afterpulse_probability, self.afterpulse_delay_ns
        if (probability is None) != (delay_ns is None):
            raise ValueError("--afterpulse-probability and --afterpulse-delay-ns belong together: both, or neither")
        if probability is not None:
            fields["afterpulsing"] = {"probability": probability, "delay_ns": delay_ns}
        if self.code_density_file is not None:
            fields["code_density"] = read_array("--code-density-file", self.code_density_file)
        if self.crosstalk is not None:
            fields["crosstalk"] = {"probability": self.crosstalk, "kernel": self.crosstalk_kernel or "8"}
        elif self.crosstalk_kernel is not None:
            raise ValueError("--crosstalk-kernel belongs to --crosstalk, which is not given")
        return {name: value for name, value in fields.items() if value is not None}

    def _jitter(self) -> dict[str, Any] | None:
        gaussian = {
            "fwhm_ns": self.jitter_fwhm_ns,
            "tail_ns": self.jitter_tail_ns,
            "tail_fraction": self.jitter_tail_fraction,
        }
        gaussian = {name: value for name, value in gaussian.items() if value is not None}
        if self.jitter_fwhm_ns is not None:
            checks.real("--jitter-fwhm-ns", self.jitter_fwhm_ns, low=0.0, strict_low=True)
        if self.jitter_file is not None:
            if gaussian:
                raise ValueError("give the jitter once: --jitter-file or --jitter-fwhm-ns and its tail")
            if self.jitter_bin_ns is None:
                raise ValueError(f"--jitter-file {self.jitter_file} needs --jitter-bin-ns, its samples' width in ns")
            values = read_array("--jitter-file", self.jitter_file)
            return {"kind": "sampled", "values": values.tolist(), "bin_ns": self.jitter_bin_ns}
        if self.jitter_bin_ns is not None:
            raise ValueError("--jitter-bin-ns belongs to --jitter-file, which is not given")
        if gaussian and self.jitter_fwhm_ns is None:
            raise ValueError("--jitter-tail-ns and --jitter-tail-fraction need --jitter-fwhm-ns")
        return {"kind": "gaussian", **gaussian} if gaussian else None


def read_array(option: str, file: Path) -> Any:
    """The values of a .npy, .csv or .txt file that `option` names; of text, a column, or times and values."""
    if file.suffix in (".csv", ".txt"):
        with reading(file, "a column of numbers"):
            values = read_column(file)
    elif file.suffix != ".npy":
        raise ValueError(f"{option} must be a 1-D .npy array, or a column as .csv or .txt, got {str(file)!r}")
    else:
        values = read_npy(file)
    if values.ndim != 1 or values.dtype.kind not in "fiu" or not (np.isfinite(values) & (values >= 0)).all():
        raise ValueError(f"{file}: {option} must be finite numbers >= 0, (n,), got {values.dtype} {values.shape}")
    return values


_SIGMA = "Gaussian pulse: standard deviation, ns."


@options
class PulseOptions:
    """A Gaussian pulse or a measured one; None: not given.

    System
    ------
    pulse_sigma_ns
        Gaussian pulse: standard deviation, ns. [default: 0.5]
    pulse_fwhm_ns
        Gaussian pulse: full width at half maximum, ns.
    pulse_file
        Measured impulse response: 1-D .npy array, or a column as .csv or .txt.
    pulse_bin_ns
        Sample width of --pulse-file, ns.
    pulse_origin
        What a delay refers to in --pulse-file: peak, centroid or first. [default: peak]
    """

    pulse_sigma_ns: Number | None = None
    pulse_fwhm_ns: Number | None = None
    pulse_file: Path | None = None
    pulse_bin_ns: Number | None = None
    pulse_origin: Text | None = None

    def build(self) -> Pulse | None:
        """The pulse of these options, or None if none is given."""
        one_of = (
            ("--pulse-sigma-ns", self.pulse_sigma_ns),
            ("--pulse-fwhm-ns", self.pulse_fwhm_ns),
            ("--pulse-file", self.pulse_file),
        )
        given = [name for name, value in one_of if value is not None]
        if len(given) > 1:
            raise ValueError(f"give the pulse once: one of {' and '.join(given)}")
        if self.pulse_file is None and (self.pulse_bin_ns is not None or self.pulse_origin is not None):
            raise ValueError("--pulse-bin-ns and --pulse-origin belong to --pulse-file, which is not given")
        if self.pulse_sigma_ns is not None:
            return GaussianPulse(sigma_ns=self.pulse_sigma_ns)
        if self.pulse_fwhm_ns is not None:
            return GaussianPulse.from_fwhm(fwhm_ns=self.pulse_fwhm_ns)
        if self.pulse_file is None:
            return None
        if self.pulse_bin_ns is None:
            raise ValueError(f"--pulse-file {self.pulse_file} needs --pulse-bin-ns, the width of its samples in ns")
        return _measured(self.pulse_file, self.pulse_bin_ns, self.pulse_origin or "peak")


@options
class FittedPulseOptions(PulseOptions):
    """Options of the pulse of a stream: a Gaussian is fitted if none is given.

    System
    ------
    pulse_sigma_ns
        Gaussian pulse: standard deviation, ns. [default: fitted]
    """

    pulse_sigma_ns: Number | None = None


def _measured(file: Path, bin_ns: float, origin: str) -> SampledPulse:
    values = read_array("--pulse-file", file)
    try:
        return SampledPulse(values, bin_ns, origin)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error


DEFAULT_SYSTEM = System(
    period_ns=1e3 / 7.5,
    cycles=1000,
    bins=1024,
    pulse=GaussianPulse(sigma_ns=0.5),
    detector=Detector(dead_time_ns=75.0),
    start="armed",
)
_DETECTOR = ("dead_time_ns", "mode", "gate_start_ns", "gate_width_ns", "gate_step_ns", "gate_cycles")


@options
class SystemChanges:
    """Single values of a system, in place of those of a file or of the default one; None: as there.

    System
    ------
    period_ns
        Laser period, ns. [default: 133.33, 7.5 MHz]
    detector
        Published detector, in place of the file's (docs/detectors.md): $presets.
    dead_time_ns
        Dead time after a registration, ns. [default: 75]
    mode
        When the pixel registers: nonparalyzable, paralyzable (every arrival restarts the dead time), synchronous (armed
        at each pulse, first photon only) or gated (with --gate-start-ns, --gate-width-ns). [default: nonparalyzable]
    gate_start_ns
        Mode gated: opening of the gate in each period, ns.
    gate_width_ns
        Mode gated: width of the gate, at most the period, ns.
    gate_step_ns
        Mode gated: the opening advances by this, ns ... [default: 0]
    gate_cycles
        ... every so many periods. [default: 1]
    cycles
        Laser periods per exposure. [default: 1000]
    bins
        Histogram bins per period. [default: 1024]
    start
        Pixel at the start of an exposure: armed (ready) or stationary (warmed up). [default: armed]
    """

    period_ns: Number | None = None
    detector: Annotated[Text | None, Parameter(choices=tuple(PRESETS))] = None
    dead_time_ns: Number | None = None
    mode: Text | None = None
    gate_start_ns: Number | None = None
    gate_width_ns: Number | None = None
    gate_step_ns: Number | None = None
    gate_cycles: Integer | None = None
    cycles: Integer | None = None
    bins: Integer | None = None
    pulse: PulseOptions = PulseOptions()
    start: Text | None = None

    def of(self, file: Path | None, effects: Effects | None = None) -> System:
        """The system of a file, or the default, with these changes."""
        base = DEFAULT_SYSTEM if file is None else System.load(file)
        if self.detector is not None:
            base = base.replace(detector=Detector.preset(self.detector))
        changes: dict[str, Any] = {name: getattr(self, name) for name in ("period_ns", "cycles", "bins", "start")}
        changes["pulse"] = self.pulse.build()
        single = {name: getattr(self, name) for name in _DETECTOR}
        given = {name: value for name, value in single.items() if value is not None}
        given |= {} if effects is None else effects.given()
        if given:
            changes["detector"] = with_changes(base.detector, given)
        return base.replace(**{name: value for name, value in changes.items() if value is not None})


@options
class SystemOptions:
    """A system: a file or the default one, and single options in place of its values.

    System
    ------
    system
        YAML or JSON file (see mars-lidar init); single options replace its values.
    """

    system: Path | None = None
    changes: SystemChanges = SystemChanges()

    def build(self, effects: Effects | None = None) -> System:
        """The system of these options."""
        return self.changes.of(self.system, effects)


def with_changes(base: Detector, given: dict[str, Any]) -> Detector:
    """`base` with the given values in place of its own; the gate of a file is dropped with its mode."""
    known = base.to_dict()
    if given.get("mode", base.mode) != base.mode:
        known = {name: value for name, value in known.items() if name != "mode" and not name.startswith("gate_")}
    return Detector.from_dict(known | given)
