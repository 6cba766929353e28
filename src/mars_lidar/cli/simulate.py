"""`mars-lidar simulate`: from a scene to a cube on disk and a picture of it, in one command."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mars_lidar.cli import options
from mars_lidar.cli.console import progress_bar, reported, say
from mars_lidar.cli.console import table as print_table
from mars_lidar.cli.system_options import Effects, build_system

if TYPE_CHECKING:
    from mars_lidar.flux import Flux
    from mars_lidar.io import Written
    from mars_lidar.scene import Scene
    from mars_lidar.system import System
    from mars_lidar.table import Table

EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar simulate --scene room -o room.zarr",
        "mars-lidar simulate --scene room --signal 0.1 --sbr 0.2 --dead-time-ns 30 --cycles 5000 -o dim.zarr",
        "mars-lidar simulate --depth depth.png --image colour.png --realizations 10 --seed 7 -o set.zarr",
        "mars-lidar simulate --depth art/ --system spad.yaml --attenuation inverse_square -o art.h5",
        "mars-lidar simulate --scene room --mode gated --gate-start-ns 30 --gate-width-ns 20 -o gated.zarr",
        "mars-lidar simulate --scene room --engine mars --table room.h5 --cycles 100000 -o long.zarr",
        "mars-lidar simulate --transient render.hdf5 --signal 0.5 --sbr 5 -o transient.zarr",
        "mars-lidar simulate --scene room --pulse-file irf.npy --pulse-bin-ns 0.008 -o measured.npz",
        "mars-lidar simulate --scene room --jitter-fwhm-ns 0.1 --electronics-dead-time-ns 100 -o real.zarr",
        "mars-lidar simulate --scene room --detector excelitas-spcm-aqrh -o module.zarr",
        "S and B are expected detectable photons per laser period, after detection efficiency. Dead time "
        "bends histograms where S + B is not small.",
    )
)


def simulate(
    *,
    scene: options.Scene = None,
    size: options.Size = None,
    scene_seed: options.SceneSeed = 0,
    depth: options.Depth = None,
    image: options.Image = None,
    depth_unit_m: options.DepthUnitM = None,
    focal_px: options.FocalPx = None,
    index: options.Index = None,
    transient: options.Transient = None,
    transient_bin_ns: options.TransientBinNs = None,
    transient_start_ns: options.TransientStartNs = None,
    transient_name: options.TransientName = None,
    transient_channel: options.TransientChannel = None,
    transient_pulse: options.TransientPulse = None,
    photons_per_unit: options.PhotonsPerUnit = None,
    system: options.System = None,
    period_ns: options.PeriodNs = None,
    detector: options.DetectorPreset = None,
    dead_time_ns: options.DeadTimeNs = None,
    mode: options.Mode = None,
    gate_start_ns: options.GateStartNs = None,
    gate_width_ns: options.GateWidthNs = None,
    gate_step_ns: options.GateStepNs = None,
    gate_cycles: options.GateCycles = None,
    cycles: options.Cycles = None,
    bins: options.Bins = None,
    pulse_sigma_ns: options.PulseSigmaNs = None,
    pulse_fwhm_ns: options.PulseFwhmNs = None,
    pulse_file: options.PulseFile = None,
    pulse_bin_ns: options.PulseBinNs = None,
    pulse_origin: options.PulseOrigin = None,
    start: options.Start = None,
    detection_efficiency: options.DetectionEfficiency = None,
    dark_count_hz: options.DarkCountHz = None,
    afterpulse_probability: options.AfterpulseProbability = None,
    afterpulse_delay_ns: options.AfterpulseDelayNs = None,
    twilight_ns: options.TwilightNs = None,
    crosstalk: options.Crosstalk = None,
    crosstalk_kernel: options.CrosstalkKernel = None,
    electronics_dead_time_ns: options.ElectronicsDeadTimeNs = None,
    max_events_per_period: options.MaxEventsPerPeriod = None,
    max_events_per_exposure: options.MaxEventsPerExposure = None,
    jitter_fwhm_ns: options.JitterFwhmNs = None,
    jitter_tail_ns: options.JitterTailNs = None,
    jitter_tail_fraction: options.JitterTailFraction = None,
    jitter_file: options.JitterFile = None,
    jitter_bin_ns: options.JitterBinNs = None,
    code_density_file: options.CodeDensityFile = None,
    signal: options.SignalLevel = None,
    sbr: options.Sbr = 1.0,
    attenuation: options.Attenuation = "none",
    ambient: options.Ambient = None,
    engine: options.Engine = "exact",
    table: options.Table = None,
    model: options.Model = None,
    count: options.Count = None,
    interpolation: options.Interpolation = None,
    table_outside: options.TableOutside = None,
    realizations: options.Realizations = 1,
    seed: options.Seed = 0,
    threads: options.Threads = None,
    device: options.Device = "cpu",
    out: options.Out,
    overwrite: options.Overwrite = False,
    picture: options.Picture = True,
) -> None:
    """Simulate histograms of a scene under dead time, and write the cube with a picture of it.

    The file holds all that is needed to make the cube again. xarray.open_zarr(OUT) opens a .zarr with named
    dimensions and units; mars_lidar.io.load(OUT) opens any of the formats.
    """
    with reported():
        began = time.perf_counter()
        png = out.with_suffix(".png")
        if picture and png.exists() and not overwrite:
            raise FileExistsError(f"{png} exists already; give --overwrite, --no-picture or another --out")
        if out.exists() and not overwrite:
            raise FileExistsError(f"{out} exists already; give --overwrite or another --out")
        instrument = build_system(
            system,
            period_ns=period_ns,
            cycles=cycles,
            bins=bins,
            preset=detector,
            dead_time_ns=dead_time_ns,
            mode=mode,
            gate_start_ns=gate_start_ns,
            gate_width_ns=gate_width_ns,
            gate_step_ns=gate_step_ns,
            gate_cycles=gate_cycles,
            effects=Effects(
                detection_efficiency=detection_efficiency,
                dark_count_hz=dark_count_hz,
                afterpulse_probability=afterpulse_probability,
                afterpulse_delay_ns=afterpulse_delay_ns,
                twilight_ns=twilight_ns,
                crosstalk=crosstalk,
                crosstalk_kernel=crosstalk_kernel,
                electronics_dead_time_ns=electronics_dead_time_ns,
                max_events_per_period=max_events_per_period,
                max_events_per_exposure=max_events_per_exposure,
                jitter_fwhm_ns=jitter_fwhm_ns,
                jitter_tail_ns=jitter_tail_ns,
                jitter_tail_fraction=jitter_tail_fraction,
                jitter_file=jitter_file,
                jitter_bin_ns=jitter_bin_ns,
                code_density_file=code_density_file,
            ),
            start=start,
            pulse_sigma_ns=pulse_sigma_ns,
            pulse_fwhm_ns=pulse_fwhm_ns,
            pulse_file=pulse_file,
            pulse_bin_ns=pulse_bin_ns,
            pulse_origin=pulse_origin,
        )
        given = {
            "--transient-bin-ns": transient_bin_ns,
            "--transient-start-ns": transient_start_ns,
            "--transient-name": transient_name,
            "--transient-channel": transient_channel,
            "--transient-pulse": transient_pulse,
            "--photons-per-unit": photons_per_unit,
        }
        flux: Flux
        if transient is None:
            _refuse(given, "--transient")
            view, source = chosen_scene(scene, size, scene_seed, depth, image, depth_unit_m, focal_px, index)
            flux = view.flux(
                instrument,
                signal=1.0 if signal is None else signal,
                sbr=sbr,
                attenuation=attenuation,  # type: ignore[arg-type]  # checked there
                ambient=ambient,  # type: ignore[arg-type]
            )
            depth_m, reflectivity = view.depth_m, view.reflectivity
        else:
            if scene is not None or depth is not None:
                raise ValueError("the scene is one of --scene, --depth and --transient, got two of them")
            _refuse({"--size": size, "--image": image, "--index": index, "--ambient": ambient}, "a scene")
            if attenuation != "none":
                raise ValueError(f"--attenuation is for scenes; a transient has it in it, got {attenuation!r}")
            from mars_lidar.io import read_transient

            light = read_transient(
                transient, bin_ns=transient_bin_ns, start_ns=transient_start_ns, name=transient_name,
                channel=transient_channel,
            )  # fmt: skip
            if signal is None and photons_per_unit is None:
                signal = 1.0
            flux = light.stored_flux(
                instrument, signal=signal, photons_per_unit=photons_per_unit, sbr=sbr,
                pulse=transient_pulse is not False,
            )  # fmt: skip
            source, depth_m, reflectivity = f"transient {transient}", None, None
        from mars_lidar.io import simulate_to

        with progress_bar("simulating") as progress:
            written = simulate_to(
                out,
                flux,
                instrument,
                engine=engine,
                realizations=realizations,
                seed=seed,
                threads=threads,
                device=device,  # type: ignore[arg-type]  # checked there
                depth_m=depth_m,
                reflectivity=reflectivity,
                source=source,
                overwrite=overwrite,
                progress=progress,
                table=_table(table, instrument),
                model=model,
                count=count,  # type: ignore[arg-type]  # checked there
                interpolation=interpolation,  # type: ignore[arg-type]
                outside=table_outside,  # type: ignore[arg-type]
            )
        if picture:
            _draw(out, png)
        _summary(written, png if picture else None, began)


def _refuse(given: Mapping[str, object], what: str) -> None:
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"{name} belongs to {what}, which is not given")


def chosen_scene(
    name: str | None,
    size: int | None,
    seed: int,
    depth: Path | None,
    image: Path | None,
    unit: float | None,
    focal: float | None,
    index: int | None = None,
) -> tuple[Scene, str]:
    """The scene of a command line, and what it is in words."""
    from mars_lidar.scene import Scene

    if (name is None) == (depth is None):
        told = "neither" if name is None else "both"
        raise ValueError(f"the scene is one of --scene and --depth, got {told}")
    if depth is None:
        for option, value in (("--image", image), ("--depth-unit-m", unit), ("--focal-px", focal), ("--index", index)):
            if value is not None:
                raise ValueError(f"{option} belongs to --depth, which is not given")
        size = 128 if size is None else size
        return Scene.example(name or "", size=size, seed=seed), f"example {name}, size {size}, seed {seed}"
    source = f"depth {depth}" + ("" if index is None else f", frame {index}")
    source += "" if image is None else f", image {image}"
    return Scene.from_rgbd(depth, image, size=size, depth_unit_m=unit, focal_px=focal, index=index), source


def _table(file: Path | None, system: System) -> Table | None:
    if file is None:
        return None
    from mars_lidar.table import Table

    return Table.load(file, system)


def _draw(cube: Path, png: Path) -> None:
    """The overview of a finished cube; the cube is good whatever happens here."""
    from mars_lidar.io import load
    from mars_lidar.plot import overview

    unfinished = png.with_name(png.name + ".incomplete")
    try:
        with load(cube) as stored:
            overview(stored).savefig(unfinished, format="png", pil_kwargs={"compress_level": 4})
        os.replace(unfinished, png)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        say(f"{cube} is complete; its picture was not made (mars-lidar view {cube} -o {png} does it)")
        raise


def _summary(written: Written, png: Path | None, began: float) -> None:
    from mars_lidar.io import load

    with load(written.path) as cube:
        count, height, width, bins = cube.shape
        each = f", {written.ns_per_registration:.3g} ns per registration" if written.registrations else ""
        rows = [
            (
                "simulated",
                f"{count} × {height} × {width} × {bins} (realization, y, x, time) {cube.recipe.dtype}, "
                f"{written.registrations:,} registrations, engine {cube.engine}, seed {cube.seed}",
            ),
            (
                "time",
                f"{written.simulate_s:.3g} s simulating{each}; {written.write_s:.3g} s writing; "
                f"{time.perf_counter() - began:.3g} s in all",
            ),
            ("cube", str(written.path)),
        ]
        if written.report:
            rows.insert(2, ("engine", _told(written.report)))
    if png is not None:
        rows.append(("picture", str(png)))
    print_table(rows)


def _told(report: dict[str, float]) -> str:
    """An engine's report in words: seconds by stage, numbers of pixels."""
    return ", ".join(
        f"{name[:-2]} {value:.3g} s" if name.endswith("_s") else f"{name.replace('_', ' ')} {value:,.0f}"
        for name, value in report.items()
    )
