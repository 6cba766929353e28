"""Options of the commands that read a measured photon stream: where it lies, and what light is fitted to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from mars_lidar.calibrate import Calibration, inspect_arrivals
from mars_lidar.calibrate import calibrate as fitted
from mars_lidar.calibrate.detector_model import is_plain, jitter_sigma, stream_detector
from mars_lidar.cli.console import say, two_integers
from mars_lidar.cli.effect_options import StreamEffects
from mars_lidar.cli.groups import group, panel
from mars_lidar.cli.measured_tables import arrival_rows
from mars_lidar.cli.options import DETECTOR, of_system
from mars_lidar.cli.pulse_options import FittedPulseOptions
from mars_lidar.cli.system_options import with_given
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import MAX_CYCLES, System
from mars_lidar.light.timestamps import Timestamps

of_stream = panel("Stream")
DEAD_TIME_NS = of_system(
    "Dead time of the pixel, ns.", "of --system or a simulated stream, else by the edge of the recovery"
)


@group
class StreamOptions:
    """One pixel of a photon stream; None: as the file tells it."""

    pixel: str | None = of_stream("Pixel (channel c is 0,c).", "the brightest", metavar="Y,X")
    period_ns: float | None = of_stream("Laser period, ns, where the file does not tell it.")
    bins: int | None = of_stream("Histogram bins of the period.", "the file's clock")
    unit_ns: float | None = of_stream("Unit of the times in a .mat or .npz, ns.")
    variable: str | None = of_stream("Variable of a .mat or .npz that holds the times.")

    def arrivals(self, stream: Path, dead_time_ns: float | None) -> list[tuple[str, str]]:
        """The rows of a recording without a laser."""
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
        return rows + arrival_rows(inspect_arrivals(times, unit_ns=found.clock_ns, dead_time_ns=dead_time_ns))

    def load(self, stream: Path) -> tuple[Timestamps, list[tuple[str, str]]]:
        """The pixel, and the rows that say what was read."""
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
        one = times.pixel(y, x)
        if height * width > 1:
            how = ", the brightest" if asked is None else ""
            rows.append(("pixel", f"({y}, {x}){how}: {len(one):,} photons"))
        return one, rows


@group
class FitOptions:
    """What is known of pulse and detector, and what light is fitted; None: of the file, or found from the stream."""

    system: Path | None = of_system(
        "YAML or JSON file with pulse and detector; single options replace its values.", "that of a simulated stream"
    )
    detector: str | None = DETECTOR
    dead_time_ns: float | None = DEAD_TIME_NS
    mode: str | None = of_system(
        "nonparalyzable, or paralyzable: every arrival restarts the dead time.", "nonparalyzable"
    )
    hold_off_ns: float | None = of_system(
        "Leave out this long after each photon, ns: keeps out afterpulses and dead electronics.",
        "the dead time; with dead electronics the sum of both",
    )
    pulse: FittedPulseOptions = FittedPulseOptions()
    free: bool = of_system("Any shape of light, bin by bin: fluorescence, haze, many surfaces.", default=False)
    returns: int = of_system("Returns (surfaces) in the pixel.", default=1)

    def _told(self, times: Timestamps, given: dict[str, Any], pulse: Pulse | None) -> System | None:
        """The system that file, stream and options tell, of the light's own pulse; None where they tell no detector.

        `given`: fields of the detector, of the options. A jitter alone tells none: the dead time is found beside it.
        """
        known = times.system if self.system is None else System.load(self.system)
        dead = self.dead_time_ns
        if known is None and self.detector is None and (not given or (dead is None and set(given) == {"jitter"})):
            return None
        if self.detector is not None:
            base = Detector.preset(self.detector)
        elif known is not None:
            base = known.detector
        elif dead is None:
            raise ValueError("a detector with effects needs its dead time: give --dead-time-ns or --system")
        else:
            base = Detector(dead_time_ns=dead)
        detector = stream_detector(with_given(base, given | ({} if dead is None else {"dead_time_ns": dead})))
        pulse = pulse or (GaussianPulse(sigma_ns=0.01 * times.period_ns) if known is None else known.pulse)
        if known is not None:
            return known.replace(detector=detector, pulse=pulse)
        return System(
            period_ns=times.period_ns,
            cycles=min(max(times.cycles, 1), MAX_CYCLES),
            bins=times.bins,
            pulse=pulse,
            detector=detector,
            start="armed",
        )

    def calibrate(self, times: Timestamps, effects: StreamEffects) -> tuple[Calibration, Detector | None]:
        """The light of the stream by maximum likelihood, and the detector where it is more than a dead time."""
        if self.mode not in (None, "nonparalyzable", "paralyzable"):
            raise ValueError(f"--mode must be nonparalyzable or paralyzable for a running stream, got {self.mode!r}")
        given = effects.given() | ({} if self.mode is None else {"mode": self.mode})
        pulse = self.pulse.build()
        told = self._told(times, given, pulse)
        shape: Pulse | Literal["free", "gaussian"] | None = pulse if told is None else None
        if told is not None and pulse is None and self.system is None and times.system is None:
            shape = "gaussian"
        if self.free:
            if pulse is not None:
                raise ValueError("the light has one shape: choose --free or a pulse")
            shape = "free"
        dead = self.dead_time_ns if told is None else None
        jitter = jitter_sigma(with_given(Detector(dead_time_ns=0.0), given)) if told is None and given else None
        found = fitted(
            times,
            told,
            pulse=shape,
            dead_time_ns=dead,
            hold_off_ns=self.hold_off_ns,
            returns=self.returns,
            jitter_ns=jitter,
        )
        if not found.converged:
            say("warning: the likelihood was not maximised; what is printed is where it stopped")
        return found, None if told is None or is_plain(told.detector) else told.detector
