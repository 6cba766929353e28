"""The options of a pulse, for every command that takes one."""

from __future__ import annotations

from pathlib import Path

from mars_lidar.cli.effect_options import read_array
from mars_lidar.cli.groups import group
from mars_lidar.cli.options import of_system
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse

_SIGMA = "Gaussian pulse: standard deviation, ns."


@group
class PulseOptions:
    """A Gaussian pulse or a measured one; None: not given."""

    pulse_sigma_ns: float | None = of_system(_SIGMA, "0.5")
    pulse_fwhm_ns: float | None = of_system("Gaussian pulse: full width at half maximum, ns.")
    pulse_file: Path | None = of_system("Measured impulse response: 1-D .npy array, or a column as .csv or .txt.")
    pulse_bin_ns: float | None = of_system("Sample width of --pulse-file, ns.")
    pulse_origin: str | None = of_system("What a delay refers to in --pulse-file: peak, centroid or first.", "peak")

    def build(self) -> Pulse | None:
        """The pulse that is meant, or None where none is given."""
        one_of = (
            ("--pulse-sigma-ns", self.pulse_sigma_ns),
            ("--pulse-fwhm-ns", self.pulse_fwhm_ns),
            ("--pulse-file", self.pulse_file),
        )
        given = [name for name, value in one_of if value is not None]
        if len(given) > 1:
            raise ValueError(f"the pulse is given once: choose one of {' and '.join(given)}")
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


@group
class FittedPulseOptions(PulseOptions):
    """Options of the pulse of a stream: a Gaussian is fitted if none is given."""

    pulse_sigma_ns: float | None = of_system(_SIGMA, "fitted")


def _measured(file: Path, bin_ns: float, origin: str) -> SampledPulse:
    values = read_array("--pulse-file", file)
    try:
        return SampledPulse(values, bin_ns, origin)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error
