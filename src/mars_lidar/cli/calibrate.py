"""`mars-lidar calibrate`: light and detector from a measured photon stream, with a test of fit."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.files import read_npy
from mars_lidar._base.types import FloatArray
from mars_lidar.calibration import Calibration, CubeCalibration, calibrate_cube
from mars_lidar.calibration import calibrate as calibrated
from mars_lidar.calibration.calibration import GIVEN
from mars_lidar.cli.console import Exit, check_picture, refuse_existing, save_picture, table
from mars_lidar.cli.options import Integer, Number, OutPath, Text, command, options, two
from mars_lidar.cli.system_options import FittedPulseOptions
from mars_lidar.instrument.pulse import Pulse, SampledPulse
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS, System
from mars_lidar.instrument.tolerances import TOL
from mars_lidar.light.timestamps import Timestamps


@options
class StreamOptions:
    """One pixel of a photon stream; None: as the file has it.

    Stream
    ------
    pixel : Y,X
        Pixel (channel c is 0,c). [default: the brightest]
    period_ns
        Laser period, ns, where the file does not have it.
    bins
        Histogram bins of the period. [default: the file's clock]
    unit_ns
        Unit of the times in a .mat or .npz, ns.
    variable
        Variable of a .mat or .npz that holds the times.
    """

    pixel: Text | None = None
    period_ns: Number | None = None
    bins: Integer | None = None
    unit_ns: Number | None = None
    variable: Text | None = None

    def arrivals(self, stream: Path) -> tuple[FloatArray, float, list[tuple[str, str]]]:
        """Times (n,) and clock unit, ns, of a recording without a laser, and rows that describe the file."""
        from mars_lidar.io.streams.formats import recorded

        recording = recorded(stream, unit_ns=self.unit_ns, variable=self.variable)
        channels, counts = np.unique(recording.detector[recording.detector >= 0], return_counts=True)
        if not channels.size:
            raise ValueError(f"{stream} holds no photons")
        y, x = (0, int(channels[counts.argmax()])) if self.pixel is None else two("--pixel", self.pixel)
        if y != 0 or x not in channels:
            raise ValueError(f"--pixel must be 0,C with a channel C of {', '.join(map(str, channels))}, got ({y}, {x})")
        times = recording.clock[recording.detector == x].astype(np.float64) * recording.clock_ns
        rows = [("file", f"{stream}: {int(counts.sum()):,} photons"), ("channel", f"{x}: {times.size:,} photons")]
        return times, recording.clock_ns, rows

    def load(self, stream: Path) -> tuple[Timestamps, list[tuple[str, str]]]:
        """The stream of one pixel, and rows that describe file and pixel."""
        asked = None if self.pixel is None else two("--pixel", self.pixel)
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


@options
class KnownOptions:
    """Known properties of pulse and detector, and the shape of the light.

    System
    ------
    given : NAME=VALUE
        A known value, which is not fitted, NAME=VALUE, once for each; dead_time_ns, jitter_ns, pulse_sigma_ns, mode,
        afterpulse_probability, afterpulse_delay_ns, twilight_ns, recovery_ns, electronics_dead_time_ns.
    system
        YAML or JSON file with a known pulse and detector, in place of --given.
    free
        Any shape of light, bin by bin: fluorescence, haze, many surfaces.
    returns
        Returns (surfaces) in the pixel. [default: 1]
    """

    given: list[Text] | None = None
    system: Path | None = None
    pulse: FittedPulseOptions = FittedPulseOptions()
    free: bool = False
    returns: Integer = 1

    def known(self) -> System | dict[str, Any] | None:
        """The argument `given` of `calibrate`."""
        if self.system is not None:
            if self.given:
                raise ValueError("give the detector once: --system or --given")
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
            raise ValueError("give the shape of the light once: --free or a pulse")
        return "free" if self.free else pulse or "gaussian"


_UNITS = dict.fromkeys(("signal", "background", "light"), " photons per period")


def calibrate(
    stream: Path,
    /,
    *,
    source: StreamOptions = StreamOptions(),
    known: KnownOptions = KnownOptions(),
    look: bool = False,
    seed: Integer = 0,
    out: OutPath | None = None,
    picture: Path | None = None,
    cycles: Integer | None = None,
    overwrite: bool = False,
) -> int | None:
    """Fit light and detector to a measured photon stream.

    Each estimate has a standard error; a verdict states whether the model fits and, if not, what may be wrong. Only
    values passed with --given are assumed; from a simulated stream only the photons are used. Without a laser, dead
    time, jitter and afterpulses are estimated in constant light; from a cube, the dead time and pulse width that its
    pixels share.

    Arguments
    ---------
    stream
        Photon stream: .ptu, .pt2, .pt3, .ht2, .ht3, .t3r, .spc, Photon-HDF5, .mat, .npz; or a cube: .zarr, .npy.

    Output
    ------
    look
        Describe the file and stop before the fit.
    seed
        Seed of the simulated streams. [default: 0]
    out
        The calibrated system, .yaml or .json, to simulate with.
    picture
        A picture: .png, .pdf or .svg.
    cycles
        Laser periods of a realization: compare the law of their counts too.
    overwrite
        Replace existing files.

    Examples
    --------
    mars-lidar calibrate lab.ptu --look
    mars-lidar calibrate lab.ptu -o lab.yaml --picture lab.png
    mars-lidar calibrate lab.ptu --given dead_time_ns=50 --given jitter_ns=0.1
    mars-lidar calibrate photons.mat --variable tPhoton --unit-ns 0.064 --period-ns 50.048 --free
    mars-lidar calibrate lab.ptu --pixel 0,2 --pulse-file irf.npy --pulse-bin-ns 0.008 --cycles 9975
    mars-lidar calibrate face.npy --system lab.yaml -o face.yaml

    Notes
    -----
    Exit code 3: the model does not fit the stream. docs/calibration.md has the whole recipe.
    """
    from mars_lidar.io.streams.photons import NoLaserError

    check_picture(picture, overwrite)
    cube = stream.suffix in (".npy", ".zarr")
    if out is not None:
        checks.suffix("--out", out, (".yaml", ".yml", ".json"))
        if look or (known.free and not cube):
            raise ValueError("--out needs a fitted pulse: omit --free and --look, or --out")
        refuse_existing(out, overwrite)
    if cycles is not None:
        checks.integer("--cycles", cycles, low=1, high=TOL.cycles)
    if cube:
        if look or cycles is not None or known.given or known.pulse.build() is not None or known.returns != 1:
            raise ValueError("a cube takes --system, --free, --out and --picture: its options are not a stream's")
        return None if _cube(stream, known, out, picture).fits else Exit.MISFIT
    given, shape = known.known(), known.shape()
    try:
        times, rows = source.load(stream)
        result = calibrated(times, given, pulse=shape, returns=known.returns, look=look, seed=seed)
    except NoLaserError as error:
        if out is not None or cycles is not None:
            raise ValueError(f"{error}; --out and --cycles need a laser period") from error
        arrivals, unit, rows = source.arrivals(stream)
        result = calibrated(arrivals, given, look=look, unit_ns=unit, seed=seed)
    table(rows + look_rows(result) + ([] if look else fit_rows(result)))
    written = []
    if cycles is not None and not look:
        table([("counts", str(result.realizations(cycles)))])
    if out is not None and result.system is not None:
        result.system.save(out)
        written.append(("wrote", str(out)))
    if picture is not None:
        from mars_lidar.plot.stream import calibration

        save_picture(calibration(result, stream.name), picture)
        written.append(("picture", str(picture)))
    if written:
        table(written)
    return None if look or result.fits else Exit.MISFIT


def _cube(path: Path, known: KnownOptions, out: Path | None, picture: Path | None) -> CubeCalibration:
    """What the pixels of a cube share: printed, written as a system, and drawn as the brightest pixel with its law."""
    if path.suffix == ".zarr":
        from mars_lidar.io import load

        with load(path) as cube:
            system = cube.system if known.system is None else System.load(known.system)
            counts = np.asarray(cube.histogram)
    else:
        if known.system is None:
            raise ValueError(
                f"{path} needs --system: laser period, cycles and bins of its histograms, and where to begin"
            )
        system, counts = System.load(known.system), read_npy(path)
    result = calibrate_cube(counts, system, pulse="free" if known.free else "gaussian")
    rows = [("file", f"{path}: {counts.size // counts.shape[-1]:,} histograms of {counts.shape[-1]:,} bins")]
    units = {"background_floor": " photons per period, of the darkest of them"}
    units |= {name: _UNITS[name] for name in ("signal", "background")}
    rows += [(name, _with_unit(str(estimate), units.get(name, ""))) for name, estimate in result.estimates.items()]
    if isinstance(result.system.pulse, SampledPulse) and result.response_error is not None:
        pulse = result.system.pulse
        worst = 100.0 * float(result.response_error.max() / pulse.values.max())
        samples = f"{pulse.values.size} samples of {pulse.bin_ns:.5g} ns"
        rows.append(("response", f"{samples}, errors up to {worst:.2g} % of its peak"))
    verdict = "their histograms fit" if result.fits else "their histograms do NOT fit: another return, or an effect"
    verdict = f"{100 * result.misfits:.3g} % of {result.p_values.size} pixels have p < 1 %: {verdict}"
    rows.append(("verdict", verdict if result.p_values.size else "not known: none of the histograms could be tested"))
    table(rows)
    if out is not None:
        result.system.save(out)
        table([("wrote", str(out))])
    if picture is not None:
        from mars_lidar.plot.figures import pixel_histogram

        save_picture(pixel_histogram(result.counts[None], 0, 0, system=result.system), picture)
        table([("picture", str(picture))])
    return result


def look_rows(result: Calibration) -> list[tuple[str, str]]:
    """Clock, laser, rate, intervals, and anomalies."""
    look = result.look
    clock = f", clock unit {1e3 * look.unit_ns:.5g} ps" if look.unit_ns else ""
    if look.unit_ns and look.locked:
        clock += " from each laser pulse"
    laser = f"none recorded; {look.seconds:.4g} s{clock}"
    if result.recording.laser:
        laser = f"period {look.period_ns:.7g} ns ({1e3 / look.period_ns:.5g} MHz), {look.cycles:,.0f} periods, "
        laser += f"{look.seconds:.4g} s{clock}"
    per = f", {look.per_period:.5g} a period" if result.recording.laser else ""
    low, middle, high = look.quantiles_ns
    rows = [
        ("laser", laser),
        ("rate", f"{look.rate_per_s:,.6g} counts/s{per}"),
        ("intervals", f"smallest {look.smallest_ns[0]:.6g} ns; 1, 50, 99 %: {low:.5g}, {middle:.5g}, {high:.5g} ns"),
    ]
    return rows + [("problem", text) for text in look.problems]


def _with_unit(text: str, unit: str) -> str:
    """An estimate with its unit, before any note."""
    value, comma, note = text.partition(", ")
    return value + unit + comma + note


def fit_rows(result: Calibration) -> list[tuple[str, str]]:
    """Estimates, limits, drift, suspects, and the verdict."""
    rows = []
    interval = f" photons in {result.recording.period_ns:.5g} ns, the mean interval"
    units = _UNITS if result.recording.laser else dict.fromkeys(_UNITS, interval)
    for name, estimate in result.estimates.items():
        text, *ranges = str(estimate).split("; ")
        text = _with_unit(text, units.get(name.split("_")[0], ""))
        if name.startswith("delay") and estimate.error:
            text += f", {0.5 * SPEED_OF_LIGHT_M_PER_NS * estimate.value:.6g} m"
        rows.append((name, "; ".join([text, *ranges])))
    if result.waveform is not None:
        rows.append(("light", f"free shape of {result.waveform.size} bins, {result.waveform.sum():.6g} a period"))
    for limit in result.limits:  # with the ranges of which it sets an end
        sets = {k: r for k, r in limit.ranges.items() if {*r} & {result.estimates[k].least, result.estimates[k].most}}
        rows.append(("not in result", str(replace(limit, ranges=sets))))
    if result.drift is not None:
        drift = result.drift
        for k, name in enumerate(drift.names):
            if drift.drifts[k]:
                rows.append(("drift", f"{name}: errors grown {drift.growth[k]:.2f} times by the scatter of parts"))
        if not drift.drifts.any() and not drift.flickers:
            rows.append(("drift", f"none in {drift.times_s.size} parts of the recording (p = {drift.probability:.2g})"))
    rows += [("suspect", str(suspect)) for suspect in result.suspects]
    return [*rows, ("verdict", result.verdict)]


calibrate_command = command(calibrate)
