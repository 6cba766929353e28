"""The options that switch on effects of the detector, for every command that takes a system or a stream."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from mars_lidar._base import checks
from mars_lidar.cli.options import _option
from mars_lidar.instrument.effects import FIELDS

_EFFECTS = "Effects of the detector (off by default)"


def _declared(name: str, *also: str) -> Any:
    """The option of an effect that is one number, as `mars_lidar.instrument.effects.FIELDS` declares it."""
    effect = FIELDS[name]
    assert effect.help is not None
    return _option(f"--{name.replace('_', '-')}", *also, panel=_EFFECTS, help=effect.help, default=effect.default)


@dataclass(frozen=True, kw_only=True)
class LightEffects:
    """What changes the light that a pixel counts; None: as in the file."""

    detection_efficiency: Annotated[float | None, _declared("detection_efficiency")] = None
    dark_count_hz: Annotated[float | None, _declared("dark_count_hz", "--dark-counts")] = None


@dataclass(frozen=True, kw_only=True)
class StreamEffects:
    """Effects of the detector that the stream of one pixel shows; None: as in the file."""

    afterpulse_probability: Annotated[
        float | None,
        _option(
            "--afterpulse-probability",
            panel=_EFFECTS,
            help="Mean number of trapped carriers that an avalanche leaves, those lost in the dead time included ...",
            default="0",
        ),
    ] = None
    afterpulse_delay_ns: Annotated[
        float | None,
        _option("--afterpulse-delay-ns", panel=_EFFECTS, help="... and their mean delay after the avalanche, ns."),
    ] = None
    twilight_ns: Annotated[float | None, _declared("twilight_ns")] = None
    recovery_ns: Annotated[float | None, _declared("recovery_ns")] = None
    electronics_dead_time_ns: Annotated[float | None, _declared("electronics_dead_time_ns")] = None
    max_events_per_period: Annotated[int | None, _declared("max_events_per_period")] = None
    jitter_fwhm_ns: Annotated[
        float | None,
        _option("--jitter-fwhm-ns", panel=_EFFECTS, help="Gaussian timing jitter: full width at half maximum, ns."),
    ] = None
    jitter_tail_ns: Annotated[
        float | None,
        _option("--jitter-tail-ns", panel=_EFFECTS, help="Mean of the exponential tail of the jitter, ns ..."),
    ] = None
    jitter_tail_fraction: Annotated[
        float | None,
        _option("--jitter-tail-fraction", panel=_EFFECTS, help="... and share of the events that are in it."),
    ] = None
    jitter_file: Annotated[
        Path | None,
        _option("--jitter-file", panel=_EFFECTS, help="Measured jitter instead: 1-D .npy array of its density."),
    ] = None
    jitter_bin_ns: Annotated[
        float | None,
        _option("--jitter-bin-ns", panel=_EFFECTS, help="Sample width of --jitter-file, ns."),
    ] = None
    code_density_file: Annotated[
        Path | None,
        _option(
            "--code-density-file",
            panel=_EFFECTS,
            help="TDC non-linearity: 1-D .npy array of relative code widths; their number divides the bins.",
        ),
    ] = None

    def given(self) -> dict[str, Any]:
        """Fields of `Detector`, as plain data."""
        told: dict[str, Any] = {name: getattr(self, name) for name in FIELDS if hasattr(self, name)}
        told["jitter"] = self._jitter()
        told["afterpulsing"] = _together(
            {"probability": self.afterpulse_probability, "delay_ns": self.afterpulse_delay_ns},
            "--afterpulse-probability and --afterpulse-delay-ns",
        )
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


@dataclass(frozen=True, kw_only=True)
class Effects(StreamEffects, LightEffects):
    """Effects of the detector; None: as in the file."""

    crosstalk: Annotated[
        float | None,
        _option(
            "--crosstalk",
            panel=_EFFECTS,
            default="0",
            help="Mean number of neighbours that an avalanche triggers; with --engine sequential.",
        ),
    ] = None
    crosstalk_kernel: Annotated[
        str | None,
        _option("--crosstalk-kernel", panel=_EFFECTS, help="Which neighbours: 4 or 8.", default="8"),
    ] = None
    max_events_per_exposure: Annotated[int | None, _declared("max_events_per_exposure")] = None

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


def _together(values: dict[str, Any], names: str) -> dict[str, Any] | None:
    given = [value is not None for value in values.values()]
    if any(given) and not all(given):
        raise ValueError(f"{names} belong together: both, or neither")
    return values if all(given) else None


def read_array(option: str, file: Path) -> Any:
    """The array of a .npy file that `option` names."""
    import numpy as np

    from mars_lidar._base.files import read_npy

    if file.suffix != ".npy":
        raise ValueError(f"{option} must be a 1-D .npy array, got {str(file)!r}")
    values = read_npy(file)
    if values.ndim != 1 or values.dtype.kind not in "fiu" or not (np.isfinite(values) & (values >= 0)).all():
        raise ValueError(f"{file}: {option} must be finite numbers >= 0, (n,), got {values.dtype} {values.shape}")
    return values
