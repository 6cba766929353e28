"""`mars-lidar simulate`: from a scene to a cube on disk and a picture of it, in one command."""

from __future__ import annotations

import contextlib
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from mars_lidar._base.progress import span
from mars_lidar.cli import options
from mars_lidar.cli.console import progress_bar, refuse_existing, save_picture, say
from mars_lidar.cli.console import table as print_table
from mars_lidar.cli.system_options import Effects, SystemOptions
from mars_lidar.engines import ENGINES, EngineOptions
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux, StoredFlux
from mars_lidar.table import Table

if TYPE_CHECKING:
    from mars_lidar.io import Written
    from mars_lidar.io.capture import Capture


def simulate(
    *,
    scene: options.SceneOptions = options.SceneOptions(),
    instrument: SystemOptions = SystemOptions(),
    effects: Effects = Effects(),
    light: options.LightOptions = options.LightOptions(),
    engine: Annotated[options.Text, Parameter(choices=tuple(ENGINES))] = "exact",
    table: Path | None = None,
    count: options.Text | None = None,
    interpolation: options.Text | None = None,
    table_outside: options.Text | None = None,
    realizations: options.Integer = 1,
    seed: options.Integer = 0,
    threads: options.Integer | None = None,
    device: options.Text = "cpu",
    out: options.OutPath,
    overwrite: bool = False,
    resume: bool = False,
    like: Path | None = None,
    picture: options.Switch = True,
) -> None:
    """Simulate the histograms of a scene: a cube and a picture of it.

    The file contains everything needed to simulate the cube again. xarray.open_zarr(OUT) opens a .zarr with named
    dimensions and units; mars_lidar.io.load(OUT) opens any of the formats.

    Simulation
    ----------
    engine
        exact; feedback (its cost does not grow with the exposure); auto (the faster of these, pixel by pixel); mars
        (count law x mean histogram); sequential (slow, an independent reference); renewal, poisson (baselines).
        [default: exact]
    table
        For --engine mars and renewal: a table of this system (mars-lidar table build), or none: every distinct pixel is
        evaluated by itself, some ms each. [default: one over the image's range, built once and stored in the cache]
    count : {exact, matched, gaussian}
        For --engine mars: the law of the count: exact, matched (to four cumulants, faster with --table) or gaussian
        (the paper's). [default: exact]
    interpolation : {bilinear, nearest}
        Between the entries of --table: bilinear or nearest. [default: bilinear]
    table_outside : {error, exact}
        For pixels beyond the range of --table: error, or exact (each is evaluated by itself, some ms). [default: error]
    realizations
        Independent exposures of the image. [default: 1]
    seed
        Seed: the same command gives the same counts. [default: 0]
    threads
        Threads; the counts do not depend on it. [default: all cores]
    device : {cpu, cuda}
        cpu, or cuda: the current GPU, with the same counts. [default: cpu]

    Output
    ------
    out
        The cube: .zarr (any size, written as it is simulated), .h5, .hdf5, .npz, .mat or .ptu.
    overwrite
        Replace an existing cube and picture.
    resume
        Continue an interrupted .zarr, with the same command.
    picture
        A PNG overview beside the cube. [default: yes]

    Scene (one of --scene, --depth and --transient)
    -----------------------------------------------
    like
        Simulate the light of a capture (tal, mitransient, Zaragoza's HDF5) in its bins; with --out .hdf5 or .h5 the
        result is a capture of the same layout.

    Examples
    --------
    mars-lidar simulate --scene room -o room.zarr
    mars-lidar simulate --scene room --signal 0.1 --sbr 0.2 --dead-time-ns 30 --cycles 5000 -o dim.zarr
    mars-lidar simulate --depth depth.png --image colour.png --realizations 10 --seed 7 -o set.zarr
    mars-lidar simulate --depth art/ --system spad.yaml --attenuation inverse_square -o art.h5
    mars-lidar simulate --scene room --mode gated --gate-start-ns 30 --gate-width-ns 20 -o gated.zarr
    mars-lidar simulate --scene room --engine mars --table room.h5 --cycles 100000 -o long.zarr
    mars-lidar simulate --transient render.hdf5 --signal 0.5 --sbr 5 -o transient.zarr
    mars-lidar simulate --like render.hdf5 --signal 0.5 --sbr 5 -o capture.hdf5
    mars-lidar simulate --scene room --pulse-file irf.npy --pulse-bin-ns 0.008 -o measured.npz
    mars-lidar simulate --scene room --jitter-fwhm-ns 0.1 --electronics-dead-time-ns 100 -o real.zarr
    mars-lidar simulate --scene room --detector excelitas-spcm-aqrh -o module.zarr

    Notes
    -----
    S and B are expected detectable photons per laser period; with --detection-efficiency, photons on the pixel. Dead
    time distorts histograms where S + B is not small.
    """
    from mars_lidar.io import load, save_capture, simulate_to
    from mars_lidar.io.capture import CAPTURE_SUFFIXES

    with contextlib.ExitStack() as after:
        began = time.perf_counter()
        png = out.with_suffix(".png")
        may_exist = overwrite or resume
        refuse_existing(png, may_exist or not picture, "--overwrite, --no-picture or another --out")
        refuse_existing(out, may_exist)
        system, capture = instrument.build(effects), None
        if like is not None:
            capture, system, scene = capture_scene(like, instrument, system, scene)
            if realizations != 1:
                raise ValueError(f"--like writes a capture, which holds one exposure, not {realizations}")
        target = out
        if capture is not None and out.suffix.lower() in CAPTURE_SUFFIXES:
            if resume or out.suffix != out.suffix.lower():
                raise ValueError("a capture is written after the whole simulation: omit --resume")
            folder = after.enter_context(tempfile.TemporaryDirectory(prefix=".mars-lidar-", dir=out.parent))
            target = Path(folder) / "cube.zarr"
        view = options.read_scene(scene, light, system, in_parts=True)
        lookup, table_outside = _table(table, system, engine, view.flux, table_outside, threads)
        chosen: EngineOptions = {
            "table": lookup,
            "count": count,  # type: ignore[typeddict-item]  # checked there
            "interpolation": interpolation,  # type: ignore[typeddict-item]
            "outside": table_outside,  # type: ignore[typeddict-item]
        }
        if device == "cpu":
            say_time(view.flux, system, engine, realizations, threads, chosen)
        with progress_bar("simulating") as progress:
            written = simulate_to(
                target,
                view.flux,
                system,
                engine=engine,
                realizations=realizations,
                seed=seed,
                threads=threads,
                device=device,  # type: ignore[arg-type]  # checked there
                depth_m=view.depth_m,
                reflectivity=view.reflectivity,
                source=view.source,
                overwrite=overwrite,
                resume=resume,
                progress=progress,
                **chosen,
            )
        if capture is not None and target != out:
            with load(target) as cube:
                save_capture(out, cube, capture.file.path, overwrite=overwrite)
        if picture:
            _draw(target, png)
        _summary(written, png if picture else None, began, out)


def capture_scene(
    like: Path, instrument: SystemOptions, system: System, scene: options.SceneOptions
) -> tuple[Capture, System, options.SceneOptions]:
    """A capture, `system` with its time bins, and its light from time 0 on as the scene.

    The period is that of the capture's bins, or --period-ns, of a whole number of them; bin 0 is the capture's bin 0.
    """
    from mars_lidar.io.capture import read_capture

    changes = instrument.changes
    names = (*options.SCENE_KINDS, "transient_bin_ns", "transient_start_ns")
    conflicts = [name for name in names if getattr(scene, name) is not None] + ["bins"] * (changes.bins is not None)
    if conflicts:
        conflict = conflicts[0].replace("_", "-")
        raise ValueError(f"--like takes light and time bins from {like}: omit --{conflict}")
    capture = read_capture(like)
    width, bins = float(capture.bin_ns or 0.0), capture.image[2]
    if changes.period_ns is not None:
        bins = round(changes.period_ns / width)
        if bins < capture.image[2] or abs(changes.period_ns / width - bins) > 1e-6 * bins:
            raise ValueError(
                f"--period-ns must be a whole number of bins of {width:.7g} ns, {capture.image[2]} at least "
                f"({capture.image[2] * width:.7g} ns), got {changes.period_ns:g}"
            )
    light = replace(scene, transient=like, transient_start_ns=0.0)
    return capture, system.replace(period_ns=bins * width, bins=bins), light


def say_time(
    flux: Flux, system: System, engine: str, realizations: int, threads: int | None, chosen: EngineOptions
) -> None:
    """Print the expected time of a long run and a faster alternative."""
    from mars_lidar.io.simulated_file import advice

    text = str(advice(flux, system, engine, realizations=realizations, threads=threads, options=chosen))
    if text:
        say(text)


def _table(
    file: Path | None, system: System, engine: str, flux: Flux, outside: str | None, threads: int | None
) -> tuple[Table | None, str | None]:
    """The table that is given; or for an engine that would evaluate each pixel, one of the image's range."""
    from mars_lidar.engines.table_reader import image_table

    if file is not None and str(file) != "none":
        return Table.load(file, system), outside
    takes = "table" in ENGINES[engine].options if engine in ENGINES else False
    if file is not None or not takes or isinstance(flux, StoredFlux):
        return None, outside
    began = time.perf_counter()
    with progress_bar("building a table") as progress:
        table = image_table(flux, system, threads, progress)
    if table is None:
        return None, outside
    size = f"{table.signal.size} × {table.background.size}"
    say(
        f"{engine}: a table {size} over the image's range, found or built in {span(time.perf_counter() - began)} and "
        "kept in the cache (mars-lidar table info); --table none evaluates every pixel by itself"
    )
    return table, outside or "exact"


def _draw(cube: Path, png: Path) -> None:
    """The overview of a finished cube; the cube is good whatever happens here."""
    from mars_lidar.io import load
    from mars_lidar.plot import overview

    try:
        with load(cube) as stored:
            save_picture(overview(stored), png)
    except BaseException:
        say(f"{cube} is complete; its picture was not made (mars-lidar view {cube} -o {png} does it)")
        raise


def _summary(written: Written, png: Path | None, began: float, out: Path) -> None:
    from mars_lidar.io import load

    with load(written.path) as cube:
        count, height, width, bins = cube.shape
        each = f", {each_ns(written.ns_per_registration)} per registration" if written.registrations else ""
        rows = {
            "simulated": f"{count} × {height} × {width} × {bins} (realization, y, x, time) {cube.recipe.dtype}, "
            f"{written.registrations:,} registrations, engine {cube.engine}, seed {cube.seed}",
            "time": f"{span(written.simulate_s)} simulating{each}; {span(written.write_s)} writing; "
            f"{span(time.perf_counter() - began)} in all",
        }
    if written.report:
        rows["engine"] = ", ".join(reported_words(*entry) for entry in written.report.items())
    rows["cube" if written.path == out else "capture"] = str(out)
    if png is not None:
        rows["picture"] = str(png)
    print_table(rows)


def reported_words(name: str, value: float) -> str:
    """An entry of an engine's report: seconds of a stage, or a number of pixels, the reason in brackets."""
    if name.endswith("_s"):
        return f"{name[:-2]} {value:.3g} s"
    what, _, reason = name.replace("_", " ").partition(", ")
    return f"{what} ({reason}) {value:,.0f}" if reason else f"{what} {value:,.0f}"


def each_ns(number: float) -> str:
    """Nanoseconds, or microseconds, in words."""
    return f"{number:.3g} ns" if number < 999.5 else f"{number / 1e3:.3g} µs"


simulate_command = options.command(simulate)
