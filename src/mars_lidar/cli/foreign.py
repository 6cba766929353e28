"""Cubes of the command line: files of mars-lidar, and histograms of other programs with options for what they lack."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter

from mars_lidar.cli.console import say
from mars_lidar.cli.options import Integer, Number, Text, options, two
from mars_lidar.cli.system_options import PulseOptions
from mars_lidar.instrument.presets import PRESETS
from mars_lidar.instrument.system import Detector, System

if TYPE_CHECKING:
    from mars_lidar.io import Cube
    from mars_lidar.io.streams.recorders import Recorded


_NEEDED = "--system, or --bin-ps (or --period-ns), --cycles, --dead-time-ns (or --detector) and --pulse-sigma-ns"


@options
class ForeignOptions:
    """Properties of histograms that files of other programs do not contain; not needed for files of mars-lidar.

    System
    ------
    system
        YAML or JSON file (see mars-lidar init); single options replace its values.
    detector
        Published detector, in place of the file's (docs/detectors.md): $presets.

    A file of another program
    -------------------------
    bin_ps
        Width of a histogram bin, ps.
    period_ns
        Laser period, ns. [default: the histogram's length]
    cycles
        Laser periods that each histogram was accumulated over.
    dead_time_ns
        Dead time after a registration, ns.
    start_ns
        Time from the laser pulse to the first bin (a gate), ns. [default: 0.0]
    variable
        Name of the array, of a file with several; NAME[3] of a MATLAB cell of arrays.
    axes : NYXT
        Its dimensions, e.g. tyx; n exposures, (yx) or (xy) pixels row by row or column by column. [default: time last,
        or where the system's bins fit]
    image : H,W
        Height and width of (yx) or (xy).
    unit_ns
        Unit of photon times, ns.
    window_ns : START,STOP
        Use only the photon times since the laser pulse that lie in this window, ns.
    """

    system: Path | None = None
    bin_ps: Number | None = None
    period_ns: Number | None = None
    cycles: Integer | None = None
    detector: Annotated[Text | None, Parameter(choices=tuple(PRESETS))] = None
    dead_time_ns: Number | None = None
    pulse: PulseOptions = PulseOptions()
    start_ns: Number = 0.0
    variable: Text | None = None
    axes: Text | None = None
    image: Text | None = None
    unit_ns: Number | None = None
    window_ns: Text | None = None

    @property
    def _given(self) -> list[str]:
        return [f.name for f in fields(self) if getattr(self, f.name) not in (None, 0.0, PulseOptions())]

    def of_histograms(self, path: Path) -> bool:
        """Whether `path` is read as histograms: by its suffix, or by options that apply to histograms only."""
        if path.suffix.lower() in (".npy", ".csv", ".txt", ".tif", ".tiff", ".sdt"):
            return True
        names = ("system", "cycles", "bin_ps", "dead_time_ns", "axes", "image")
        return any(getattr(self, name) is not None for name in names)

    def opened(self, path: Path) -> Cube:
        """The cube in a file of mars-lidar, or of another program."""
        from mars_lidar.io import SUFFIXES, load
        from mars_lidar.io.foreign import FOREIGN_SUFFIXES, read_counts

        if not self._given and (path.suffix in SUFFIXES or path.suffix not in FOREIGN_SUFFIXES):
            try:
                return load(path)
            except ValueError as error:
                if not is_foreign(path, error):
                    raise
                raise ValueError(
                    f"{path} is not a cube written by mars-lidar; for a file of another program give {_NEEDED}"
                ) from error
        if path.suffix in SUFFIXES and path.suffix not in FOREIGN_SUFFIXES:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in self._given)
            raise ValueError(f"{path} describes its histograms completely: omit {options}")
        base = self._file()
        contents = read_counts(
            path,
            variable=self.variable,
            axes=self.axes,
            image=None if self.image is None else two("--image", self.image, "integers H,W"),
            bins=None if base is None else base.bins,
        )
        length = None if contents.counts is None else contents.counts.shape[-1]
        whole = self if contents.recorder is None or base is not None else self._completed(contents.recorder, length)
        between, form = self.window_ns, "numbers START,STOP in ns"
        window = None if between is None else two("--window-ns", between, form, float)
        system = base or whole._system(path, length)
        cube = contents.cube(system, start_ns=self.start_ns, unit_ns=self.unit_ns, window_ns=window)
        if cube.system.detector.mode == "gated" and system.detector.mode != "gated":
            gate = cube.system.detector.gate_width_ns
            say(
                f"warning: {path}: {gate:.6g} of the {system.period_ns:.6g} ns of a period are taken for the gate of a "
                "detector that is off outside; a free-running detector is also blind after light there, which makes S "
                "and B too low: give its whole period"
            )
        return cube

    def _completed(self, recorder: Recorded, length: int | None) -> ForeignOptions:
        """With the recorder's values where no option is given; the period is rounded to a whole number of its bins."""
        width = recorder.bin_ns if self.bin_ps is None else None
        if width is None:
            return self if self.cycles is not None else replace(self, cycles=recorder.cycles)
        period = self.period_ns or recorder.period_ns or (width * length if length else None)
        whole = None if period is None else max(round(period / width), length or 1) * width
        cycles = recorder.cycles if self.cycles is None else self.cycles
        return replace(self, bin_ps=1e3 * width, period_ns=whole, cycles=cycles)

    def _file(self) -> System | None:
        if self.system is None:
            return None
        single = ("bin_ps", "period_ns", "cycles", "detector", "dead_time_ns")
        given = [name for name in single if getattr(self, name) is not None]
        if given or self.pulse != PulseOptions():
            excluded = ", ".join(f"--{name.replace('_', '-')}" for name in given) or "a pulse"
            raise ValueError(f"--system describes the whole system: it and {excluded} exclude each other")
        return System.load(self.system)

    def _system(self, path: Path, length: int | None) -> System:
        pulse = self.pulse.build()
        missing = [
            name
            for name, given in (
                ("--cycles", self.cycles is not None),
                ("--dead-time-ns", self.dead_time_ns is not None or self.detector is not None),
                ("--pulse-sigma-ns", pulse is not None),
                ("--bin-ps", (self.bin_ps, self.period_ns) != (None, None)),
            )
            if not given
        ]
        if missing or pulse is None or self.cycles is None:
            raise ValueError(f"{path} does not state how it was recorded: give {', '.join(missing)}, or --system")
        period, bins = self._clock(path, length)
        detector = Detector(dead_time_ns=0.0) if self.detector is None else Detector.preset(self.detector)
        if self.dead_time_ns is not None:
            detector = Detector.from_dict(detector.to_dict() | {"dead_time_ns": self.dead_time_ns})
        return System(period_ns=period, cycles=self.cycles, bins=bins, pulse=pulse, detector=detector)

    def _clock(self, path: Path, length: int | None) -> tuple[float, int]:
        """Laser period, ns, and bins in it."""
        width = None if self.bin_ps is None else 1e-3 * self.bin_ps
        if width is not None and not width > 0.0:
            raise ValueError(f"--bin-ps must be positive, got {self.bin_ps:g}")
        if width is None or self.period_ns is None:
            if length is None:
                raise ValueError(f"{path} holds photon times: give --period-ns and --bin-ps")
            return (length * width, length) if width is not None else (float(self.period_ns or 0.0), length)
        bins = self.period_ns / width
        if abs(bins - round(bins)) > 1e-6 * bins:  # the digits that a period is stated with
            below, above = int(bins) * width, (int(bins) + 1) * width
            raise ValueError(
                f"--period-ns must be a whole number of bins of {width:g} ns, got {self.period_ns:g}; "
                f"{below:.7g} and {above:.7g} would be"
            )
        return self.period_ns, round(bins)


def is_foreign(path: Path, error: ValueError) -> bool:
    """Whether `mars_lidar.io.load` refused a file because another program wrote it, of a kind that can be read."""
    from mars_lidar.io import SUFFIXES
    from mars_lidar.io.foreign import FOREIGN_SUFFIXES

    known = path.suffix.lower() in FOREIGN_SUFFIXES
    return known and (path.suffix not in SUFFIXES or "not a cube written by mars-lidar" in str(error))


def foreign_rows(path: Path) -> list[tuple[str, str]]:
    """Rows that `mars-lidar info` prints for a file of another program."""
    from mars_lidar.io.foreign import listed
    from mars_lidar.io.streams.formats import RECORDER_SUFFIXES

    if path.suffix.lower() in RECORDER_SUFFIXES:
        return _recorder_rows(path)
    rows = [("file", f"{path} (not written by mars-lidar)")]
    rows += [("array", f"{name} {content}".strip()) for name, content in listed(path).items()]
    return [*rows, ("reconstruct with", _NEEDED)]


def _recorder_rows(path: Path) -> list[tuple[str, str]]:
    """What a photon counter recorded: its clocks, the photons of each channel, and the images of a scan."""
    from mars_lidar.io.streams.formats import recorded as photons_of
    from mars_lidar.io.streams.recorders import recorded

    rows = [("file", f"{path} (not written by mars-lidar)")]
    scan, streams = None, []
    if path.suffix == ".sdt":
        scan = recorded(path)
    else:
        recording = photons_of(path)
        streams = [("a channel's stream", "mars-lidar calibrate --pixel 0,C")]
        clock = f"{1e3 * recording.clock_ns:.7g} ps"
        if recording.fine is None:
            rows.append(("clock", f"absolute times in units of {clock} (T2)"))
        else:
            laser = "laser periods" if recording.period_ns else "its own, not the laser's"
            fine = f"{1e3 * recording.fine_ns:.5g} ps"
            rows.append(("clock", f"{laser}, {clock}; photons in units of {fine} after the pulse"))
            scan = recorded(path)
        for channel, number in zip(*np.unique(recording.detector, return_counts=True), strict=True):
            events = "photons" if channel >= 0 else "pulses"
            rows.append(("channel", f"{channel if channel >= 0 else 'sync'}: {number:,} {events}"))
    if scan is not None:
        for name, array in scan.arrays.items():
            rows.append(("histograms", f"{name}: {' × '.join(map(str, array.shape))}, {int(array.sum()):,} photons"))
        rows += [("left out", text) for text in scan.notes]
        rows.append(("reconstruct with", _NEEDED + "; bins and cycles as far as the file tells them"))
    return rows + streams
