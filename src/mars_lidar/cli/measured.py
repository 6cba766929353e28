"""`mars-lidar inspect`, `calibrate` and `validate`: measured photon streams."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mars_lidar.cli import options
from mars_lidar.cli.console import FAILED, check_picture, reported, save_picture, say, table
from mars_lidar.cli.inspect import parsed_pixel
from mars_lidar.cli.measured_tables import clock_rows, interval_rows, light_rows
from mars_lidar.cli.options import _OUTPUT, _SYSTEM, _option

if TYPE_CHECKING:
    from mars_lidar.detector import Detector
    from mars_lidar.estimate import Calibration
    from mars_lidar.pulse import Pulse
    from mars_lidar.system import System as SystemObject
    from mars_lidar.timestamps import Timestamps

_STREAM = "Stream"
_RECIPE = "docs/calibration.md has the whole recipe."
INSPECT_EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar inspect lab.ptu -o lab.png",
        "mars-lidar inspect photons.mat --variable tPhoton --unit-ns 0.064 --period-ns 50.048",
        _RECIPE,
    )
)
CALIBRATE_EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar calibrate lab.ptu --dead-time-ns 85 -o lab.yaml",
        "mars-lidar calibrate lab.ptu --pixel 0,2 --pulse-file irf.npy --pulse-bin-ns 0.008",
        "mars-lidar calibrate lab.ptu --returns 2 --hold-off-ns 120",
        _RECIPE,
    )
)
VALIDATE_EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar validate lab.ptu --cycles 9975 --dead-time-ns 85 -o validation.png",
        "mars-lidar validate decay.ptu --cycles 1000 --free",
        "Exit code 1 where the model does not fit the stream. " + _RECIPE,
    )
)

Stream = Annotated[
    Path,
    typer.Argument(help="Photon stream: .ptu (T2, T3), Photon-HDF5, .mat or .npz.", show_default=False),
]
Pixel = Annotated[
    str | None,
    _option("--pixel", panel=_STREAM, metavar="Y,X", help="Pixel (channel c is 0,c).", default="the brightest"),
]
PeriodNs = Annotated[
    float | None, _option("--period-ns", panel=_STREAM, help="Laser period, ns, where the file does not tell it.")
]
Bins = Annotated[
    int | None, _option("--bins", panel=_STREAM, help="Histogram bins of the period.", default="the file's clock")
]
UnitNs = Annotated[
    float | None, _option("--unit-ns", panel=_STREAM, help="Unit of the times in a .mat or .npz, ns.")
]
Variable = Annotated[
    str | None, _option("--variable", panel=_STREAM, help="Variable of a .mat or .npz that holds the times.")
]
DeadTimeNs = Annotated[
    float | None,
    _option(
        "--dead-time-ns", panel=_SYSTEM, help="Dead time, ns.",
        default="of --system or a simulated stream, else by the smallest interval",
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
Cycles = Annotated[
    int,
    _option("--cycles", panel=_STREAM, help="Laser periods of a realization: the stream is cut into such pieces."),
]
Simulated = Annotated[
    int,
    _option(
        "--simulated", panel=_STREAM, help="Realizations to simulate for what no law predicts (effects of --system)."
    ),
]
Picture = Annotated[Path | None, _option("-o", "--out", panel=_OUTPUT, help="A picture: .png, .pdf or .svg.")]
SystemOut = Annotated[
    Path | None,
    _option("-o", "--out", panel=_OUTPUT, help="The calibrated system, .yaml or .json, to simulate with."),
]
Overwrite = Annotated[bool, _option("--overwrite", panel=_OUTPUT, help="Replace an existing file.")]


def inspect(
    stream: Stream,
    *,
    pixel: Pixel = None,
    period_ns: PeriodNs = None,
    bins: Bins = None,
    unit_ns: UnitNs = None,
    variable: Variable = None,
    dead_time_ns: DeadTimeNs = None,
    out: Picture = None,
    overwrite: Overwrite = False,
) -> None:
    """Look at a photon stream: rates, intervals, dead time, recovery after a photon, and what does not fit.

    Nothing is assumed of the light but that it repeats with the laser; of a simulated stream only the photons are
    looked at, not the system in its header.
    """
    with reported():
        check_picture(out, overwrite)
        from mars_lidar.estimate import inspect as look

        times, rows = _loaded(stream, pixel, period_ns, bins, unit_ns, variable)
        found = look(times, dead_time_ns=dead_time_ns)
        rows += clock_rows(found.calibration) + interval_rows(found.calibration, dead_time_ns is None)
        light = found.calibration
        told = f"{light.total:.5g} ± {light.total_error:.2g} photons per period reach the pixel, armed or not"
        rows.append(("light", told))
        recovered = found.recovery.findings()
        if not recovered:
            ages = found.recovery.edges_ns[-1]
            told = f"at once: the rate is that of the light from {light.dead_time_ns:.5g} to {ages:.4g} ns"
            rows.append(("recovery", told))
        rows += [("does not fit", text) for text in found.problems or ("nothing",)]
        if out is not None:
            from mars_lidar.plot.stream import stream_figure

            save_picture(stream_figure(found, f"{stream.name}"), out)
            rows.append(("picture", str(out)))
        table(rows)


def calibrate(
    stream: Stream,
    *,
    pixel: Pixel = None,
    period_ns: PeriodNs = None,
    bins: Bins = None,
    unit_ns: UnitNs = None,
    variable: Variable = None,
    system: System = None,
    dead_time_ns: DeadTimeNs = None,
    hold_off_ns: HoldOffNs = None,
    pulse_sigma_ns: PulseSigmaNs = None,
    pulse_fwhm_ns: options.PulseFwhmNs = None,
    pulse_file: options.PulseFile = None,
    pulse_bin_ns: options.PulseBinNs = None,
    pulse_origin: options.PulseOrigin = None,
    free: Free = False,
    returns: Returns = 1,
    out: SystemOut = None,
    overwrite: Overwrite = False,
) -> None:
    """Signal, background and delay of a photon stream, by maximum likelihood, with standard errors."""
    with reported():
        _check_system_out(out, free, overwrite)
        times, rows = _loaded(stream, pixel, period_ns, bins, unit_ns, variable)
        found = _calibrated(
            times, system, dead_time_ns, hold_off_ns, free, returns,
            (pulse_sigma_ns, pulse_fwhm_ns, pulse_file, pulse_bin_ns, pulse_origin),
        )  # fmt: skip
        rows += clock_rows(found) + light_rows(found)
        if out is not None:
            found.system(max(times.cycles, 1), times.bins if times.bins <= 2**20 else 1024, "armed").save(out)
            rows.append(("wrote", str(out)))
        table(rows)


def validate(
    stream: Stream,
    *,
    cycles: Cycles,
    pixel: Pixel = None,
    period_ns: PeriodNs = None,
    bins: Bins = None,
    unit_ns: UnitNs = None,
    variable: Variable = None,
    system: System = None,
    dead_time_ns: DeadTimeNs = None,
    hold_off_ns: HoldOffNs = None,
    pulse_sigma_ns: PulseSigmaNs = None,
    pulse_fwhm_ns: options.PulseFwhmNs = None,
    pulse_file: options.PulseFile = None,
    pulse_bin_ns: options.PulseBinNs = None,
    pulse_origin: options.PulseOrigin = None,
    free: Free = False,
    returns: Returns = 1,
    simulated: Simulated = 4000,
    out: Picture = None,
    overwrite: Overwrite = False,
) -> None:
    """Does the model predict the stream? Calibrates, cuts into realizations, compares counts, shape, joint statistics.

    Distances stand beside their sampling floor: what samples of the predicted law itself would have.
    """
    with reported():
        check_picture(out, overwrite)
        from mars_lidar.estimate import validate as compared

        times, rows = _loaded(stream, pixel, period_ns, bins, unit_ns, variable)
        light = _calibrated(
            times, system, dead_time_ns, hold_off_ns, free, returns,
            (pulse_sigma_ns, pulse_fwhm_ns, pulse_file, pulse_bin_ns, pulse_origin),
        )  # fmt: skip
        found = compared(times, light, cycles=cycles, detector=_with_effects(system), simulated=simulated)
        rows += clock_rows(light) + light_rows(light)
        mean, high = found.total_variation_floor
        rows += [
            ("prediction", found.prediction.words),
            ("realizations", f"{found.realizations:,} of {cycles:,} cycles, {found.counts.mean():,.6g} counts each"),
            ("count law", f"total variation {found.total_variation:.4g}, sampling floor {mean:.4g} (99 %: {high:.4g})"),
            ("", f"KL {found.kl:.4g} nats, sampling floor {found.kl_floor[0]:.4g} (99 %: {found.kl_floor[1]:.4g})"),
            ("histogram", f"total variation {found.shape_variation:.4g}, sampling floor {found.shape_floor:.4g}"
             + (" (fitted bin by bin: tells nothing)" if light.waveform is not None else "")),
        ]  # fmt: skip
        for check in found.checks:
            figures = "" if check.error != check.error else (
                f"{check.measured:.6g}, predicted {check.predicted:.6g} ± {check.error:.2g}; "
            )
            mark = "  ✗" if check in found.failed else ""
            rows.append((check.name, f"{figures}p = {check.p:.2g}{mark}"))
        if found.prediction.recovery is None:  # else what it finds is what was told
            rows += [("recovery", text) for text in found.recovery.findings()]
        if found.consistent:
            verdict = f"the model fits (a stream of the model's fails at {found.level:.0%})"
        else:
            failed = [check.name for check in found.failed]
            failed += ["intervals shorter than the dead time"] * bool(light.too_short)
            verdict = f"the model does NOT fit: {', '.join(failed)}"
        rows.append(("verdict", verdict))
        if out is not None:
            from mars_lidar.plot.stream import validation_figure

            save_picture(validation_figure(found, stream.name), out)
            rows.append(("picture", str(out)))
        table(rows)
        if not found.consistent:
            raise typer.Exit(FAILED)


def _loaded(
    stream: Path,
    pixel: str | None,
    period_ns: float | None,
    bins: int | None,
    unit_ns: float | None,
    variable: str | None,
) -> tuple[Timestamps, list[tuple[str, str]]]:
    """One pixel of the stream, and the rows that say what was read."""
    import numpy as np

    from mars_lidar.timestamps import Timestamps as Times

    asked = None if pixel is None else parsed_pixel(pixel)
    times = Times.load(stream, period_ns=period_ns, bins=bins, unit_ns=unit_ns, variable=variable)
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


def _calibrated(
    times: Timestamps,
    system: Path | None,
    dead_time_ns: float | None,
    hold_off_ns: float | None,
    free: bool,
    returns: int,
    pulse: tuple[float | None, float | None, Path | None, float | None, str | None],
) -> Calibration:
    from mars_lidar.cli.system_options import _pulse
    from mars_lidar.estimate import calibrate as fitted
    from mars_lidar.system import System as SystemOf

    shape: Pulse | Literal["free"] | None = _pulse(*pulse)
    if free:
        if shape is not None:
            raise ValueError("the light has one shape: choose --free or a pulse")
        shape = "free"
    known: SystemObject | None = None if system is None else SystemOf.load(system)
    found = fitted(
        times, known, pulse=shape, dead_time_ns=dead_time_ns, hold_off_ns=hold_off_ns, returns=returns
    )
    if not found.converged:
        say("warning: the likelihood was not maximised; what is printed is where it stopped")
    return found


def _with_effects(system: Path | None) -> Detector | None:
    """The detector of the system file, where it is more than a dead time."""
    if system is None:
        return None
    from mars_lidar.estimate.detector_model import is_plain
    from mars_lidar.system import System as SystemOf

    detector = SystemOf.load(system).detector
    return None if is_plain(detector) else detector


def _check_system_out(out: Path | None, free: bool, overwrite: bool) -> None:
    if out is None:
        return
    if free:
        raise ValueError("a free shape is no system: leave out --out or --free")
    if out.suffix not in (".yaml", ".yml", ".json"):
        raise ValueError(f"--out must end in .yaml, .yml or .json, got {str(out)!r}")
    if out.exists() and not overwrite:
        raise FileExistsError(f"{out} exists already; choose another name or give --overwrite")
