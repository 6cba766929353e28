"""Options that say where a measured photon stream lies, and what is known of its instrument."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.calibration import GIVEN
from mars_lidar.cli.console import two_integers
from mars_lidar.cli.groups import group, panel
from mars_lidar.cli.options import of_system
from mars_lidar.cli.pulse_options import FittedPulseOptions
from mars_lidar.instrument.pulse import Pulse
from mars_lidar.instrument.system import System
from mars_lidar.light.timestamps import Timestamps

of_stream = panel("Stream")


@group
class StreamOptions:
    """One pixel of a photon stream; None: as the file has it."""

    pixel: str | None = of_stream("Pixel (channel c is 0,c).", "the brightest", metavar="Y,X")
    period_ns: float | None = of_stream("Laser period, ns, where the file does not have it.")
    bins: int | None = of_stream("Histogram bins of the period.", "the file's clock")
    unit_ns: float | None = of_stream("Unit of the times in a .mat or .npz, ns.")
    variable: str | None = of_stream("Variable of a .mat or .npz that holds the times.")

    def arrivals(self, stream: Path) -> tuple[FloatArray, float, list[tuple[str, str]]]:
        """Times (n,) and clock unit, ns, of a recording without a laser, and rows that describe the file."""
        from mars_lidar.io.streams.files import recorded

        found = recorded(stream, unit_ns=self.unit_ns, variable=self.variable)
        channels, counts = np.unique(found.detector[found.detector >= 0], return_counts=True)
        if not channels.size:
            raise ValueError(f"{stream} holds no photons")
        y, x = (0, int(channels[counts.argmax()])) if self.pixel is None else two_integers("--pixel", self.pixel)
        if y != 0 or x not in channels:
            raise ValueError(f"--pixel must be 0,C with a channel C of {', '.join(map(str, channels))}, got ({y}, {x})")
        times = found.clock[found.detector == x].astype(np.float64) * found.clock_ns
        rows = [("file", f"{stream}: {int(counts.sum()):,} photons"), ("channel", f"{x}: {times.size:,} photons")]
        return times, found.clock_ns, rows

    def load(self, stream: Path) -> tuple[Timestamps, list[tuple[str, str]]]:
        """The stream of one pixel, and rows that describe file and pixel."""
        asked = None if self.pixel is None else two_integers("--pixel", self.pixel)
        times = Timestamps.load(
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
        pixel = times.pixel(y, x)
        if height * width > 1:
            how = ", the brightest" if asked is None else ""
            rows.append(("pixel", f"({y}, {x}){how}: {len(pixel):,} photons"))
        return pixel, rows


@group
class KnownOptions:
    """What is known of pulse and detector, and the shape of the light."""

    given: list[str] | None = of_system(
        f"What is known and not fitted: NAME=VALUE, once for each; {', '.join(GIVEN)}.", metavar="NAME=VALUE"
    )
    system: Path | None = of_system("YAML or JSON file with a known pulse and detector, in place of --given.")
    pulse: FittedPulseOptions = FittedPulseOptions()
    free: bool = of_system("Any shape of light, bin by bin: fluorescence, haze, many surfaces.", default=False)
    returns: int = of_system("Returns (surfaces) in the pixel.", default=1)

    def known(self) -> System | dict[str, Any] | None:
        """The argument `given` of `calibrate`."""
        if self.system is not None:
            if self.given:
                raise ValueError("the detector is given once: choose --system or --given")
            return System.load(self.system)
        values: dict[str, Any] = {}
        for text in self.given or ():
            name, equals, value = text.partition("=")
            name = name.strip().replace("-", "_")
            if not equals or name not in GIVEN:
                raise ValueError(f"--given must be NAME=VALUE with a NAME of {', '.join(GIVEN)}, got {text!r}")
            if name == "mode":
                values[name] = value.strip()
                continue
            try:
                values[name] = float(value)
            except ValueError:
                raise ValueError(f"--given {name} must be a number, got {value!r}") from None
        return values or None

    def shape(self) -> Pulse | Literal["gaussian", "free"]:
        """The argument `pulse` of `calibrate`."""
        pulse = self.pulse.build()
        if self.free and pulse is not None:
            raise ValueError("the light has one shape: choose --free or a pulse")
        return "free" if self.free else pulse or "gaussian"
