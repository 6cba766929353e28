"""The options that switch on effects of the detector, for every command that takes a system or a stream."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.files import read_npy, reading
from mars_lidar._base.text import read_column
from mars_lidar.cli.groups import group, panel
from mars_lidar.instrument.effects import FIELDS

_effect = panel("Effects of the detector (off by default)")


def _declared(name: str, *names: str) -> Any:
    """The option of an effect that is one number, as `mars_lidar.instrument.effects.FIELDS` declares it."""
    effect = FIELDS[name]
    assert effect.help is not None
    return _effect(effect.help, effect.default, *names)


@group
class LightEffects:
    """What changes the light that a pixel counts; None: as in the file."""

    detection_efficiency: float | None = _declared("detection_efficiency")
    dark_count_hz: float | None = _declared("dark_count_hz")


@group
class StreamEffects:
    """Effects of the detector that the stream of one pixel shows; None: as in the file."""

    afterpulse_probability: float | None = _effect(
        "Mean number of trapped carriers that an avalanche leaves, those lost in the dead time included ...", "0"
    )
    afterpulse_delay_ns: float | None = _effect("... and their mean delay after the avalanche, ns.")
    twilight_ns: float | None = _declared("twilight_ns")
    recovery_ns: float | None = _declared("recovery_ns")
    electronics_dead_time_ns: float | None = _declared("electronics_dead_time_ns")
    max_events_per_period: int | None = _declared("max_events_per_period")
    jitter_fwhm_ns: float | None = _effect("Gaussian timing jitter: full width at half maximum, ns.")
    jitter_tail_ns: float | None = _effect("Mean of the exponential tail of the jitter, ns ...")
    jitter_tail_fraction: float | None = _effect("... and share of the events that are in it.")
    jitter_file: Path | None = _effect("Measured jitter instead: 1-D .npy array of its density.")
    jitter_bin_ns: float | None = _effect("Sample width of --jitter-file, ns.")
    code_density_file: Path | None = _effect(
        "TDC non-linearity: 1-D .npy array of relative code widths; their number divides the bins."
    )

    def given(self) -> dict[str, Any]:
        """Fields of `Detector`, as plain data."""
        told: dict[str, Any] = {name: getattr(self, name) for name in FIELDS if hasattr(self, name)}
        told["jitter"] = self._jitter()
        probability, delay_ns = self.afterpulse_probability, self.afterpulse_delay_ns
        if (probability is None) != (delay_ns is None):
            raise ValueError("--afterpulse-probability and --afterpulse-delay-ns belong together: both, or neither")
        if probability is not None:
            told["afterpulsing"] = {"probability": probability, "delay_ns": delay_ns}
        if self.code_density_file is not None:
            told["code_density"] = read_array("--code-density-file", self.code_density_file)
        return {name: value for name, value in told.items() if value is not None}

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
                raise ValueError("the jitter is given once: choose --jitter-file or --jitter-fwhm-ns and its tail")
            if self.jitter_bin_ns is None:
                raise ValueError(f"--jitter-file {self.jitter_file} needs --jitter-bin-ns, its samples' width in ns")
            values = read_array("--jitter-file", self.jitter_file)
            return {"kind": "sampled", "values": values.tolist(), "bin_ns": self.jitter_bin_ns}
        if self.jitter_bin_ns is not None:
            raise ValueError("--jitter-bin-ns belongs to --jitter-file, which is not given")
        if gaussian and self.jitter_fwhm_ns is None:
            raise ValueError("--jitter-tail-ns and --jitter-tail-fraction need --jitter-fwhm-ns")
        return {"kind": "gaussian", **gaussian} if gaussian else None


@group
class Effects(StreamEffects, LightEffects):
    """Effects of the detector; None: as in the file."""

    crosstalk: float | None = _effect(
        "Mean number of neighbours that an avalanche triggers; with --engine sequential.", "0"
    )
    crosstalk_kernel: str | None = _effect("Which neighbours: 4 or 8.", "8")
    max_events_per_exposure: int | None = _declared("max_events_per_exposure")

    def given(self) -> dict[str, Any]:
        """Fields of `Detector`, as plain data."""
        told = super().given()
        if self.crosstalk is None:
            told.pop("crosstalk", None)
            if self.crosstalk_kernel is not None:
                raise ValueError("--crosstalk-kernel belongs to --crosstalk, which is not given")
        else:
            told["crosstalk"] = {"probability": self.crosstalk, "kernel": self.crosstalk_kernel or "8"}
        return told


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
