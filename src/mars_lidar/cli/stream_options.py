"""Options of the commands that read a measured photon stream: where it lies, and what light is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mars_lidar.cli import options
from mars_lidar.cli.console import say
from mars_lidar.cli.effect_options import StreamEffects
from mars_lidar.cli.info import parsed_pixel
from mars_lidar.cli.options import _SYSTEM, _option
from mars_lidar.cli.pulse_options import FittedPulseOptions

if TYPE_CHECKING:
    from mars_lidar.calibrate import Calibration
    from mars_lidar.instrument.detector import Detector
    from mars_lidar.instrument.pulse import Pulse
    from mars_lidar.instrument.system import System as SystemObject
    from mars_lidar.light.timestamps import Timestamps

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
UnitNs = Annotated[float | None, _option("--unit-ns", panel=STREAM, help="Unit of the times in a .mat or .npz, ns.")]
Variable = Annotated[
    str | None, _option("--variable", panel=STREAM, help="Variable of a .mat or .npz that holds the times.")
]

DeadTimeNs = Annotated[
    float | None,
    _option(
        "--dead-time-ns",
        panel=_SYSTEM,
        help="Dead time of the pixel, ns.",
        default="of --system or a simulated stream, else by the edge of the recovery",
    ),
]
HoldOffNs = Annotated[
    float | None,
    _option(
        "--hold-off-ns",
        panel=_SYSTEM,
        default="the dead time; with dead electronics the sum of both",
        help="Leave out this long after each photon, ns: keeps out afterpulses and dead electronics.",
    ),
]
System = Annotated[
    Path | None,
    _option(
        "--system",
        panel=_SYSTEM,
        help="YAML or JSON file with pulse and detector; single options replace its values.",
        default="that of a simulated stream",
    ),
]
Mode = Annotated[
    str | None,
    _option(
        "--mode",
        panel=_SYSTEM,
        default="nonparalyzable",
        help="nonparalyzable, or paralyzable: every arrival restarts the dead time.",
    ),
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

    def arrivals(self, stream: Path, dead_time_ns: float | None) -> list[tuple[str, str]]:
        """The rows of a recording without a laser."""
        import numpy as np

        from mars_lidar.calibrate import inspect_arrivals
        from mars_lidar.cli.measured_tables import arrival_rows
        from mars_lidar.io.streams.files import recorded

        found = recorded(stream, unit_ns=self.unit_ns, variable=self.variable)
        channels, counts = np.unique(found.detector[found.detector >= 0], return_counts=True)
        if not channels.size:
            raise ValueError(f"{stream} holds no photons")
        y, x = (0, int(channels[counts.argmax()])) if self.pixel is None else parsed_pixel(self.pixel)
        if y != 0 or x not in channels:
            raise ValueError(f"--pixel must be 0,C with a channel C of {', '.join(map(str, channels))}, got ({y}, {x})")
        times = found.clock[found.detector == x].astype(np.float64) * found.clock_ns
        rows = [("file", f"{stream}: {int(counts.sum()):,} photons"), ("channel", f"{x}: {times.size:,} photons")]
        return rows + arrival_rows(inspect_arrivals(times, unit_ns=found.clock_ns, dead_time_ns=dead_time_ns))

    def load(self, stream: Path) -> tuple[Timestamps, list[tuple[str, str]]]:
        """The pixel, and the rows that say what was read."""
        import numpy as np

        from mars_lidar.light.timestamps import Timestamps as Times

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
    """What is known of pulse and detector, and what light is fitted; None: of the file, or found from the stream."""

    system: System = None
    detector: options.DetectorPreset = None
    dead_time_ns: DeadTimeNs = None
    mode: Mode = None
    hold_off_ns: HoldOffNs = None
    pulse: FittedPulseOptions = field(default_factory=FittedPulseOptions)
    free: Free = False
    returns: Returns = 1

    def _told(self, times: Timestamps, given: dict[str, Any], pulse: Pulse | None) -> SystemObject | None:
        """The system that file, stream and options tell, of the light's own pulse; None where they tell no detector.

        `given`: fields of the detector, of the options. A jitter alone tells none: the dead time is found beside it.
        """
        from mars_lidar.calibrate.detector_model import stream_detector
        from mars_lidar.cli.system_options import with_given
        from mars_lidar.instrument.detector import Detector
        from mars_lidar.instrument.pulse import GaussianPulse
        from mars_lidar.instrument.system import MAX_CYCLES
        from mars_lidar.instrument.system import System as SystemOf

        known = times.system if self.system is None else SystemOf.load(self.system)
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
        return SystemOf(
            period_ns=times.period_ns,
            cycles=min(max(times.cycles, 1), MAX_CYCLES),
            bins=times.bins,
            pulse=pulse,
            detector=detector,
            start="armed",
        )

    def calibrate(self, times: Timestamps, effects: StreamEffects) -> tuple[Calibration, Detector | None]:
        """The light of the stream by maximum likelihood, and the detector where it is more than a dead time."""
        from mars_lidar.calibrate import calibrate as fitted
        from mars_lidar.calibrate.detector_model import is_plain, jitter_sigma
        from mars_lidar.cli.system_options import with_given
        from mars_lidar.instrument.detector import Detector

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
