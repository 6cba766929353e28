"""`mars-lidar convert` and `mars-lidar timestamps`: other file formats, and photons instead of counts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mars_lidar.cli.console import progress_bar, table
from mars_lidar.cli.foreign import ForeignOptions
from mars_lidar.cli.options import Integer, Number, OutPath, command
from mars_lidar.cli.simulate import say_time

if TYPE_CHECKING:
    from mars_lidar.io import Converted


_LARGE_IMAGE = 5e8


def convert(
    source: Path,
    target: Path,
    /,
    *,
    realization: Integer | None = None,
    foreign: ForeignOptions = ForeignOptions(),
    bins: Integer | None = None,
    clock_ps: Number | None = None,
    overwrite: bool = False,
) -> None:
    """Write a cube or a photon stream in another format.

    Data that the other format cannot hold are listed.

    Arguments
    ---------
    source
        A cube, a photon stream (also of a lab: .ptu, Photon-HDF5), or histograms of another program.
    target
        The new file; its suffix names the format.

    Options
    -------
    realization
        Convert only this exposure of a cube, from 0; a .mat holds one.
    bins
        Histogram bins of a recorded stream. [default: its finest clock]
    clock_ps
        For a .ptu stream: unit of the times, ps; programs that make an image of it use one bin per unit.
        [default: the finest, 32768 to a period]
    overwrite
        Replace an existing file.

    Examples
    --------
    mars-lidar convert room.zarr room.h5
    mars-lidar convert set.zarr first.mat --realization 0
    mars-lidar convert lab.ptu lab.h5 --bins 1024
    mars-lidar convert face.mat face.zarr --variable counts --system camera.yaml

    Notes
    -----
    Cubes: .zarr .h5 .npz .mat .ptu. Photon streams: .npz .ptu .h5 (Photon-HDF5). .ptu and Photon-HDF5 need pip install
    'mars-lidar[io]'. docs/formats.md describes each.
    """
    from mars_lidar.dataset.store import is_dataset
    from mars_lidar.io.conversion import convert as converted

    if is_dataset(source):
        raise ValueError(f"{source} is a dataset: mars-lidar export writes it as the files that networks load")
    if foreign.of_histograms(source):
        done = _imported(foreign, source, target, overwrite)
    else:
        done = converted(
            source,
            target,
            realization=realization,
            period_ns=foreign.period_ns,
            bins=bins,
            clock_ps=clock_ps,
            overwrite=overwrite,
        )
    rows = [("wrote", str(done.path)), ("content", done.content)]
    table(rows + [("lost", text) for text in done.lost or ("nothing",)])


def _imported(foreign: ForeignOptions, source: Path, target: Path, overwrite: bool) -> Converted:
    from mars_lidar.io import save
    from mars_lidar.io.conversion import Converted

    with foreign.opened(source) as cube:
        save(target, cube, overwrite=overwrite)
        sizes = " × ".join(map(str, cube.shape))
        return Converted(target, f"measured cube {sizes} (realization, y, x, time)", ())


def timestamps(
    cube: Path,
    /,
    *,
    out: OutPath,
    realization: Integer = 0,
    threads: Integer | None = None,
    clock_ps: Number | None = None,
    overwrite: bool = False,
) -> None:
    """Write the photons of a cube one by one, with their times.

    The exposure is simulated again, and the histogram of its photons is compared with the cube's counts.

    Arguments
    ---------
    cube
        A cube written by mars-lidar.

    Options
    -------
    out
        The stream: .npz, .ptu or .h5 (Photon-HDF5).
    realization
        Which exposure, from 0 in the file. [default: 0]
    threads
        Threads. [default: all cores]
    clock_ps
        For a .ptu stream: unit of the times, ps; programs that make an image of it use one bin per unit.
        [default: the finest, 32768 to a period]
    overwrite
        Replace an existing file.

    Examples
    --------
    mars-lidar simulate --scene room -o room.zarr
    mars-lidar timestamps room.zarr -o room.ptu
    mars-lidar timestamps set.zarr --realization 3 -o photons.h5
    """
    from mars_lidar.io.conversion import photons, resolution_ns
    from mars_lidar.io.cube import load
    from mars_lidar.io.streams.formats import check_output

    check_output(out, overwrite=overwrite, clock_ps=clock_ps)
    with load(cube) as stored, progress_bar("simulating") as progress:
        say_time(stored.flux, stored.system, stored.engine, 1, threads, {})
        times = photons(stored, realization=realization, threads=threads, progress=progress)
    times.save(out, overwrite=overwrite, clock_ps=clock_ps)
    unit = resolution_ns(out, times, clock_ps)
    height, width = times.shape
    resolution = "as simulated" if unit == 0.0 else f"in units of {1e3 * unit:.4g} ps; cycles and bins are exact"
    image = 2 * height * width * times.period_ns / unit if out.suffix == ".ptu" else 0.0
    if image > _LARGE_IMAGE:
        resolution += f"; other programs make an image of {image / 1e9:.2g} GB of it, --clock-ps a smaller one"
    content = f"{len(times):,} photons of {height} × {width} pixels"
    table({"wrote": str(out), "content": content, "times": resolution})


convert_command = command(convert)
timestamps_command = command(timestamps)
