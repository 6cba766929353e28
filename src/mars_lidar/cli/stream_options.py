"""Options of the commands that read a measured photon stream: where it lies, and what light is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from mars_lidar.cli import options
from mars_lidar.cli.console import say
from mars_lidar.cli.inspect import parsed_pixel
from mars_lidar.cli.options import _SYSTEM, _option

if TYPE_CHECKING:
    from mars_lidar.detector import Detector
    from mars_lidar.estimate import Calibration
    from mars_lidar.pulse import Pulse
    from mars_lidar.system import System as SystemObject
    from mars_lidar.timestamps import Timestamps

STREAM = "Stream"

Pixel = Annotated[
    str | None,
    _option("--pixel", panel=STREAM, metavar="Y,X", help="Pixel (channel c is 0,c).", default="the brightest"),
]
PeriodNs = Annotated[
    float | None, _option("--period-ns", panel=STREAM, help="Laser period, ns, where the file does not tell it.")
]
Bins = Annotated[
    int | None, _option("--bins", panel=STREAM, help="Histogram bins of the period.", default="the file's clock")
]
UnitNs = Annotated[
    float | None, _option("--unit-ns", panel=STREAM, help="Unit of the times in a .mat or .npz, ns.")
]
Variable = Annotated[
    str | None, _option("--variable", panel=STREAM, help="Variable of a .mat or .npz that holds the times.")
]

DeadTimeNs = Annotated[
    float | None,
    _option(
        "--dead-time-ns", panel=_SYSTEM, help="Dead time, ns.",
        default="of --system or a simulated stream, else by the edge of the recovery",
    ),
]
JitterNs = Annotated[
    float | None,
    _option(
        "--jitter-ns", panel=_SYSTEM, help="Sigma of the Gaussian jitter of each photon's time, ns.",
        default="of --system, else fitted with the dead time",
    ),
]
HoldOffNs = Annotated[
    float | None,
    _option(
        "--hold-off-ns", panel=_SYSTEM, default="the dead time",
        help="Leave out this long after each photon, ns: keeps out afterpulses and dead electronics.",
    ),
]
System = Annotated[
    Path | None, _option("--system", panel=_SYSTEM, help="YAML or JSON file with pulse and detector, effects too.")
]
PulseSigmaNs = Annotated[
    float | None,
    _option("--pulse-sigma-ns", panel=_SYSTEM, help="Gaussian pulse, sigma in ns.", default="fitted"),
]
Free = Annotated[
    bool,
    _option("--free", panel=_SYSTEM, help="Any shape of light, bin by bin: fluorescence, haze, many surfaces."),
]
Returns = Annotated[int, _option("--returns", panel=_SYSTEM, help="Returns (surfaces) in the pixel.", default="1")]


@dataclass(frozen=True, kw_only=True)
class StreamOptions:
    """One pixel of a photon stream; None: as the file tells it."""

    pixel: Pixel = None
    period_ns: PeriodNs = None
    bins: Bins = None
    unit_ns: UnitNs = None
    variable: Variable = None

    def load(self, stream: Path) -> tuple[Timestamps, list[tuple[str, str]]]:
        """The pixel, and the rows that say what was read."""
        import numpy as np

        from mars_lidar.timestamps import Timestamps as Times

        asked = None if self.pixel is None else parsed_pixel(self.pixel)
        times = Times.load(
            stream, period_ns=self.period_ns, bins=self.bins, unit_ns=self.unit_ns, variable=self.variable
        )
        height, width = times.shape
        rows = [("file", f"{stream}: {len(times):,} photons of {height} × {width} pixels")]
        if asked is None:
            y, x = (int(k) for k in np.unravel_index(int(times.counts.argmax()), times.shape))
        else:
            y, x = asked
            if not (0 <= y < height and 0 <= x < width):
                raise ValueError(f"--pixel must lie in y 0 to {height - 1}, x 0 to {width - 1}, got ({y}, {x})")
        one = times.pixel(y, x)
        if height * width > 1:
            how = ", the brightest" if asked is None else ""
            rows.append(("pixel", f"({y}, {x}){how}: {len(one):,} photons"))
        return one, rows


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """What is known of pulse and detector, and what light is fitted; None: found from the stream."""

    system: System = None
    dead_time_ns: DeadTimeNs = None
    jitter_ns: JitterNs = None
    hold_off_ns: HoldOffNs = None
    pulse_sigma_ns: PulseSigmaNs = None
    pulse_fwhm_ns: options.PulseFwhmNs = None
    pulse_file: options.PulseFile = None
    pulse_bin_ns: options.PulseBinNs = None
    pulse_origin: options.PulseOrigin = None
    free: Free = False
    returns: Returns = 1

    @cached_property
    def known(self) -> SystemObject | None:
        """The system of the file."""
        from mars_lidar.system import System as SystemOf

        return None if self.system is None else SystemOf.load(self.system)

    def calibrate(self, times: Timestamps) -> Calibration:
        """The light of the stream by maximum likelihood."""
        from mars_lidar.cli.system_options import pulse_of
        from mars_lidar.estimate import calibrate as fitted

        shape: Pulse | Literal["free"] | None = pulse_of(
            self.pulse_sigma_ns, self.pulse_fwhm_ns, self.pulse_file, self.pulse_bin_ns, self.pulse_origin
        )
        if self.free:
            if shape is not None:
                raise ValueError("the light has one shape: choose --free or a pulse")
            shape = "free"
        found = fitted(
            times, self.known, pulse=shape, dead_time_ns=self.dead_time_ns, hold_off_ns=self.hold_off_ns,
            returns=self.returns, jitter_ns=self.jitter_ns,
        )  # fmt: skip
        if not found.converged:
            say("warning: the likelihood was not maximised; what is printed is where it stopped")
        return found

    def detector(self) -> Detector | None:
        """That of the system file, where it is more than a dead time."""
        if self.known is None:
            return None
        from mars_lidar.estimate.detector_model import is_plain

        return None if is_plain(self.known.detector) else self.known.detector
