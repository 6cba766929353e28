"""`mars-lidar info`, `view` and `explore`: describe a file, draw it, and explore it in a browser."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mars_lidar._base import checks, manifest
from mars_lidar._base.files import size_on_disk
from mars_lidar._version import other_version
from mars_lidar.cli.console import Exit, check_picture, progress_bar, save_picture, say, table
from mars_lidar.cli.dataset import dataset_rows
from mars_lidar.cli.foreign import ForeignOptions, foreign_rows, is_foreign
from mars_lidar.cli.options import Integer, OutPath, Switch, Text, command, two
from mars_lidar.instrument.detector import Detector
from mars_lidar.light.flux import Flux

if TYPE_CHECKING:
    from mars_lidar.io import Cube


def info(file: Path, /, *, verify: bool = False) -> int | None:
    """Describe a cube, a dataset or a file of another program.

    System, light, engine and size; whether the file is complete, and how to open it.

    Arguments
    ---------
    file
        A cube: .zarr (also a URL), .h5, .hdf5, .npz, .mat or .ptu; a dataset; a file of another program.

    Options
    -------
    verify
        Simulate again and compare every count; exit code 1 if they differ.
    """
    from mars_lidar.io import IncompleteFileError, load
    from mars_lidar.io import verify as same_again

    rows = dataset_rows(file)
    if rows is not None:
        if verify:
            raise ValueError(f"{file} is a dataset: mars-lidar verify {file} makes its chunks again")
        table(rows)
        return None
    try:
        cube = load(file, allow_incomplete=True)
    except IncompleteFileError as error:  # nothing in it can be read
        table([("file", str(file)), ("complete", f"NO: {error}")])
        return None
    except ValueError as error:
        if not is_foreign(file, error):
            raise
        table(foreign_rows(file))
        return None
    with cube:
        table(_rows(cube))
        if not verify:
            return None
        if not cube.complete:
            raise ValueError(f"{file} is incomplete: there is nothing to verify")
        with progress_bar("verifying") as progress:
            same = same_again(cube, progress=progress)
        damaged = (manifest.damage(file) if file.suffix == ".zarr" else []) or ["counts differ"]
        different = f"NO: {damaged[0]}{other_version(cube.version)}"
        table([("verified", "simulated again, every count is the same" if same else different)])
        return None if same else Exit.FAILED


def view(
    file: Path,
    /,
    *,
    foreign: ForeignOptions = ForeignOptions(),
    out: OutPath,
    pixel: list[Text] | None = None,
    realization: Integer = 0,
    sample: Integer | None = None,
    overwrite: bool = False,
) -> None:
    """Draw depth, reflectivity, counts and a few histograms.

    Beside the true depth stands that of the fullest bin. Each histogram stands beside the incident rate, scaled to
    the same total: the difference is pile-up. A measured cube is shown with its maximum-likelihood light.

    Arguments
    ---------
    file
        A cube: .zarr, .h5, .hdf5, .npz, .mat, .ptu; a dataset; histograms of another program: also .npy, .tif, .csv.

    Options
    -------
    out
        The picture: .png, .pdf or .svg.
    pixel : Y,X
        Pixel whose histogram is drawn; up to 6 times. [default: a bright, a dim and an edge pixel]
    realization
        Which exposure, counted from 0 in this file. [default: 0]
    sample
        Of a dataset: which sample. [default: 0]
    overwrite
        Replace an existing picture.
    """
    check_picture(out, overwrite)
    pixels = None if not pixel else [two("--pixel", text) for text in pixel]
    with opened(file, sample, foreign) as cube:
        from mars_lidar.plot import overview

        figure = overview(cube, realization=realization, pixels=pixels)
    save_picture(figure, out)
    table([("picture", str(out))])


def opened(file: Path, sample: int | None, foreign: ForeignOptions) -> Cube:
    """A cube, histograms of another program, or a sample of a dataset."""
    from mars_lidar.dataset.store import is_dataset, open_dataset

    if is_dataset(file):
        return open_dataset(file).cube(0 if sample is None else sample)
    if sample is not None:
        raise ValueError(f"--sample is for datasets, and {file} is none")
    return foreign.opened(file)


def _rows(cube: Cube) -> dict[str, str]:
    system, recipe = cube.system, cube.recipe
    count, height, width, bins = cube.shape
    complete = "yes" if cube.complete else "NO: the simulation did not finish"
    if cube.complete and cube.path is not None and cube.path.suffix == ".zarr":
        complete += f"; {manifest.description(cube.path)}"
    if cube.progress:
        complete += f"; {cube.progress}"
    stored = "elsewhere" if cube.path is None else f"{size_on_disk(cube.path) / 1e6:,.4g} MB on disk"
    rows = {
        "file": f"{cube.url or cube.path} (mars-lidar {cube.version})",
        "complete": complete,
        "counts": f"{count} × {height} × {width} × {bins} (realization, y, x, time) {recipe.dtype}, "
        f"{recipe.nbytes / 1e6:,.4g} MB in memory, {stored}",
    }
    if cube.registrations is not None:
        pixels = count * height * width
        each = cube.registrations / pixels
        rows["registrations"] = f"{cube.registrations:,}, {each:,.4g} per pixel and exposure"
    first = recipe.first_realization
    numbers = f"{first}" if count == 1 else f"{first} to {first + count - 1}"
    dead = system.detector.dead_time_ns
    effects = [f"{name} {_short(getattr(system.detector, name))}" for name in system.detector.effects]
    made = "".join(f", {name} {_short(value)}" for name, value in cube.settings.items() if name != "table")
    engine = "none: measured" if cube.measured else f"{cube.engine}{made}, seed {cube.seed}, realization {numbers}"
    rows |= {
        "engine": engine,
        "laser": f"period {system.period_ns:.6g} ns ({1e3 / system.period_ns:.4g} MHz, unambiguous to "
        f"{system.unambiguous_range_m:.4g} m), {system.cycles:,} cycles",
        "pulse": repr(system.pulse),
        "detector": f"dead time {dead:.6g} ns ({system.dead_time_periods:.4g} periods), {system.detector.mode}, "
        f"start {system.start}",
        **_gate(system.detector),
        **({"effects": ", ".join(effects)} if effects else {}),
        "bins": f"{1e3 * system.bin_ns:.5g} ps, {system.depth_m(system.bin_ns):.3g} m of depth each",
        **({} if cube.measured else _light(cube.flux)),
    }
    if "table" in cube.settings:
        rows["table"] = ", ".join(f"{name} {value}" for name, value in cube.settings["table"].items())
    if recipe.source:
        rows["source" if cube.measured else "scene"] = recipe.source
    place = cube.url or str(cube.path)
    call = f"mars_lidar.io.load({place!r})"
    if not cube.complete:
        call = f"{call[:-1]}, allow_incomplete=True)"
    elif place.endswith(".zarr"):
        call += f"  or  xarray.open_zarr({place!r})"
    rows["open with"] = call
    return rows


def _light(flux: Flux) -> dict[str, str]:
    photons = f"mean S {flux.signal.mean():.4g}, B {flux.background.mean():.4g} photons per laser period"
    if flux.waveform is not None:
        photons += f"; waveform of {flux.waveform.shape[-1]} parts"
    elif len(flux.returns_signal) > 1:
        photons += f"; {len(flux.returns_signal)} returns"
    made_of = [f"{k} {_short(v)}" for k, v in flux.info.items() if not k.endswith("_definition")]
    return {"flux": photons} | ({"flux made of": ", ".join(made_of)} if made_of else {})


def _gate(detector: Detector) -> dict[str, str]:
    if detector.gate_start_ns is None:
        return {}
    text = f"{detector.gate_width_ns:.6g} ns from {detector.gate_start_ns:.6g} ns of each period"
    if detector.gate_moves:
        every = "every period" if detector.gate_cycles == 1 else f"every {detector.gate_cycles} periods"
        text += f", moved by {detector.gate_step_ns:.6g} ns {every}"
    return {"gate": text}


def _short(value: Any) -> str:
    if isinstance(value, tuple):
        return f"of {len(value)} values"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def explore(
    file: Path | None = None,
    /,
    *,
    foreign: ForeignOptions = ForeignOptions(),
    sample: Integer | None = None,
    port: Integer = 0,
    browser: Switch = True,
) -> None:
    """Show pixels and their exact laws in a browser.

    Sliders show the effects of dead time; any pixel of a cube can be selected. The page is served on 127.0.0.1 only,
    until Ctrl-C; the cube is read in the parts that are displayed.

    Arguments
    ---------
    file
        A cube, a sample of a dataset, or histograms of another program, as mars-lidar view takes them. [default: the
        page's own picture]

    Options
    -------
    sample
        Of a dataset: which sample. [default: 0]
    port
        Port on the loopback address. [default: 0, one that is free]
    browser
        Open the page in the browser of this machine. [default: yes]

    Examples
    --------
    mars-lidar explore
    mars-lidar explore room.zarr
    mars-lidar explore room.zarr --no-browser --port 8000
    """
    from mars_lidar.explore import CubeServer

    with contextlib.ExitStack() as stack:
        cube = None if file is None else stack.enter_context(opened(file, sample, foreign))
        checks.integer("--port", port, low=0, high=65535)
        server = CubeServer(cube, "" if file is None else str(file), port=port)
        stack.callback(server.close)
        table([("page", server.url), ("end", "Ctrl-C")])
        if browser:
            import webbrowser

            if not webbrowser.open(server.url):
                say("no browser was found: open the page in one")
        with contextlib.suppress(KeyboardInterrupt):
            server.serve()


info_command = command(info)
view_command = command(view)
explore_command = command(explore)
