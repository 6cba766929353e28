"""`mars-lidar inspect`, `calibrate` and `validate`: measured photon streams."""

from __future__ import annotations

import math
from pathlib import Path

import typer

from mars_lidar._base import checks
from mars_lidar.calibrate import inspect as look
from mars_lidar.calibrate import validate as compared
from mars_lidar.calibrate.prediction import system_of
from mars_lidar.cli.console import FAILED, check_picture, refuse_existing, reported, save_picture, table
from mars_lidar.cli.effect_options import StreamEffects
from mars_lidar.cli.groups import argument, examples
from mars_lidar.cli.measured_tables import clock_rows, interval_rows, light_rows
from mars_lidar.cli.options import of_output
from mars_lidar.cli.options import out as out_option
from mars_lidar.cli.stream_options import DEAD_TIME_NS, FitOptions, StreamOptions, of_stream
from mars_lidar.instrument.system import MAX_CYCLES

_RECIPE = "docs/calibration.md has the whole recipe."
INSPECT_EPILOG = examples(
    "mars-lidar inspect lab.ptu -o lab.png",
    "mars-lidar inspect photons.mat --variable tPhoton --unit-ns 0.064 --period-ns 50.048",
    _RECIPE,
)
CALIBRATE_EPILOG = examples(
    "mars-lidar calibrate lab.ptu --dead-time-ns 85 -o lab.yaml",
    "mars-lidar calibrate lab.ptu --pixel 0,2 --pulse-file irf.npy --pulse-bin-ns 0.008",
    "mars-lidar calibrate lab.ptu --returns 2 --hold-off-ns 120",
    "mars-lidar calibrate lab.ptu --dead-time-ns 85 --pulse-sigma-ns 0.5 --jitter-fwhm-ns 0.1",
    _RECIPE,
)
VALIDATE_EPILOG = examples(
    "mars-lidar validate lab.ptu --cycles 9975 --dead-time-ns 85 -o validation.png",
    "mars-lidar validate decay.ptu --cycles 1000 --free",
    "mars-lidar validate lab.ptu --cycles 9975 --system lab.yaml --afterpulse-probability 0.01 "
    "--afterpulse-delay-ns 50",
    "Exit code 1 where the model does not fit the stream. " + _RECIPE,
)
_STREAM = argument("Photon stream: .ptu, .pt2, .pt3, .ht2, .ht3, .t3r, .spc, Photon-HDF5, .mat or .npz.")
_PICTURE = out_option("A picture: .png, .pdf or .svg.", None)
_OVERWRITE = of_output("Replace an existing file.", default=False)


def inspect(
    stream: Path = _STREAM,
    *,
    source: StreamOptions,
    dead_time_ns: float | None = DEAD_TIME_NS,
    out: Path | None = _PICTURE,
    overwrite: bool = _OVERWRITE,
) -> None:
    """Look at a photon stream: rates, intervals, dead time, recovery after a photon, and what does not fit.

    Nothing is assumed of the light but that it repeats with the laser; of a simulated stream only the photons are
    looked at, not the system in its header. Without a laser: dead time and afterpulses in constant light.
    """
    with reported():
        check_picture(out, overwrite)
        from mars_lidar.io.streams.photons import NoLaserError

        try:
            times, rows = source.load(stream)
        except NoLaserError as error:
            if out is not None:
                raise ValueError(f"{error}; a picture (-o) needs a laser period") from error
            table(source.arrivals(stream, dead_time_ns))
            return
        found = look(times, dead_time_ns=dead_time_ns)
        rows += clock_rows(found.calibration) + interval_rows(found.calibration, dead_time_ns is None)
        light = found.calibration
        told = f"{light.total:.5g} ± {light.total_error:.2g} photons per period reach the pixel, armed or not"
        rows.append(("light", told))
        recovered = found.recovery.findings()
        if not recovered:
            ages = found.recovery.edges_ns[-1]
            how = "behind an edge that jitter blurs" if light.jitter_ns else "at once"
            told = f"{how}: the rate is that of the light from {found.recovery.dead_time_ns:.5g} to {ages:.4g} ns"
            rows.append(("recovery", told))
        rows += [("not known", text) for text in found.unknown]
        rows += [("does not fit", text) for text in found.problems or ("nothing",)]
        if out is not None:
            from mars_lidar.plot.stream import stream_figure

            save_picture(stream_figure(found, f"{stream.name}"), out)
            rows.append(("picture", str(out)))
        table(rows)


def calibrate(
    stream: Path = _STREAM,
    *,
    source: StreamOptions,
    light: FitOptions,
    effects: StreamEffects,
    out: Path | None = out_option("The calibrated system, .yaml or .json, to simulate with.", None),
    cycles: int | None = of_output(
        "Laser periods of an exposure of the calibrated system.", "those of the stream, at most 1e8"
    ),
    overwrite: bool = _OVERWRITE,
) -> None:
    """Signal, background and delay of a photon stream, by maximum likelihood, with standard errors."""
    with reported():
        from mars_lidar.io.streams.photons import NoLaserError

        _check_system_out(out, light.free, overwrite)
        if cycles is not None:
            checks.integer("--cycles", cycles, low=1, high=MAX_CYCLES)
        try:
            times, rows = source.load(stream)
        except NoLaserError as error:
            if out is not None or light.system is not None:
                raise ValueError(f"{error}; a system (-o, --system) needs a laser period") from error
            table(source.arrivals(stream, light.dead_time_ns))
            return
        found, detector = light.calibrate(times, effects)
        table(rows + clock_rows(found) + light_rows(found, detector))
        if out is not None:
            bins = times.bins if times.bins <= 2**20 else 1024
            exposure = min(max(times.cycles, 1), MAX_CYCLES) if cycles is None else cycles
            system_of(found, detector, exposure, bins).replace(start="armed").save(out)
            table([("wrote", f"{out}, exposures of {exposure:,} laser periods")])


def validate(
    stream: Path = _STREAM,
    *,
    cycles: int = of_stream("Laser periods of a realization: the stream is cut into such pieces.", default=...),
    source: StreamOptions,
    light: FitOptions,
    effects: StreamEffects,
    simulated: int = of_stream("Realizations to simulate for what no law predicts of a detector.", default=4000),
    out: Path | None = _PICTURE,
    overwrite: bool = _OVERWRITE,
) -> None:
    """Does the model predict the stream? Calibrates, cuts into realizations, compares counts, shape, joint statistics.

    Distances stand beside their sampling floor: what samples of the predicted law itself would have.
    """
    with reported():
        check_picture(out, overwrite)
        times, rows = source.load(stream)
        calibrated, detector = light.calibrate(times, effects)
        found = compared(times, calibrated, cycles=cycles, detector=detector, simulated=simulated)
        rows += clock_rows(calibrated) + light_rows(calibrated, detector)
        mean, high = found.total_variation_floor
        rows += [
            ("prediction", found.prediction.words),
            ("realizations", f"{found.realizations:,} of {cycles:,} cycles, {found.counts.mean():,.6g} counts each"),
            ("count law", f"total variation {found.total_variation:.4g}, sampling floor {mean:.4g} (99 %: {high:.4g})"),
            ("", f"KL {found.kl:.4g} nats, sampling floor {found.kl_floor[0]:.4g} (99 %: {found.kl_floor[1]:.4g})"),
            (
                "histogram",
                f"total variation {found.shape_variation:.4g}, sampling floor {found.shape_floor:.4g}"
                + (" (fitted bin by bin: tells nothing)" if calibrated.waveform is not None else ""),
            ),
        ]
        for check in found.checks:
            figures = f"{check.measured:.6g}, predicted {check.predicted:.6g} ± {check.error:.2g}; "
            figures = "" if math.isnan(check.error) else figures
            mark = "  ✗" if check in found.failed else ""
            rows.append((check.name, f"{figures}p = {check.p:.2g}{mark}"))
        if found.prediction.recovery is None:  # else what it finds is what was told
            rows += [("recovery", text) for text in found.recovery.findings()]
        if found.consistent:
            verdict = f"the model fits (a stream of the model's fails at {found.level:.0%})"
        else:
            failed = [check.name for check in found.failed]
            failed += ["intervals shorter than the dead time"] * found.too_short
            verdict = f"the model does NOT fit: {'; '.join(failed)}"
        rows.append(("verdict", verdict))
        if out is not None:
            from mars_lidar.plot.stream import validation_figure

            save_picture(validation_figure(found, stream.name), out)
            rows.append(("picture", str(out)))
        table(rows)
        if not found.consistent:
            raise typer.Exit(FAILED)


def _check_system_out(out: Path | None, free: bool, overwrite: bool) -> None:
    if out is None:
        return
    if free:
        raise ValueError("a free shape is no system: leave out --out or --free")
    if out.suffix not in (".yaml", ".yml", ".json"):
        raise ValueError(f"--out must end in .yaml, .yml or .json, got {str(out)!r}")
    refuse_existing(out, overwrite)
