"""`mars-lidar reconstruct`: histogram cube to maps of depth and reflectivity, with errors where the truth is known."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.display import measured
from mars_lidar._base.files import check_target
from mars_lidar._base.progress import span
from mars_lidar.cli.console import grid, progress_bar, refuse_existing, save_picture, say, screen, table
from mars_lidar.cli.foreign import ForeignOptions
from mars_lidar.cli.options import Integer, Number, OutPath, Switch, Text, command
from mars_lidar.reconstruction import METHODS, Flags, MaximumLikelihood, Method, Reconstruction
from mars_lidar.reconstruction.keep import KEEP, common_delay, has_later_light, keep_return
from mars_lidar.scene.radiometry import ATTENUATIONS

if TYPE_CHECKING:
    from mars_lidar._base.types import FloatArray
    from mars_lidar.io import Cube
    from mars_lidar.reconstruction import Returns
    from mars_lidar.reconstruction.stored import Timed


def reconstruct(
    cube: Path,
    /,
    *,
    foreign: ForeignOptions = ForeignOptions(),
    out: OutPath,
    method: Text = "maximum_likelihood",
    level: Number | None = None,
    attenuation: Text | None = None,
    returns: Integer = 1,
    keep: Text | None = None,
    from_ns: Number | None = None,
    false_alarm: Number | None = None,
    threads: Integer | None = None,
    cloud: Path | None = None,
    focal_px: Number | None = None,
    picture: Switch = True,
    overwrite: bool = False,
) -> None:
    """Reconstruct depth and reflectivity from a cube.

    If the cube contains the true scene, the maps are compared with it. Counts are read in parts: a .zarr or .h5 may
    have any size.

    Arguments
    ---------
    cube
        A cube: .zarr, .h5, .hdf5, .npz, .mat or .ptu; or histograms of another program: also .npy, .tif, .csv.

    Options
    -------
    out
        The maps: .zarr, .h5, .hdf5 or .npz.
    method
        Methods, separated by commas, or all that suit the detector; image for 1 to 10 photons a pixel. [default:
        maximum_likelihood]
    level
        Signal photons per period of a surface of reflectivity 1. [default: that of the cube's scene, or mean
        reflectivity 1]
    attenuation
        none or inverse_square: reflectivity is signal times depth squared. [default: as the cube was simulated]
    returns
        Largest number of returns in a pixel (glass, foliage), each tested for significance; for maximum_likelihood and
        image. [default: 1]
    keep
        With --returns: the return whose depth is taken, strongest, nearest or farthest. [default: strongest]
    from_ns
        Returns nearer than this, ns after the pulse, such as an internal reflection, are modelled but not reported.
        [default: all]
    false_alarm
        Largest fraction of the pixels without signal in which noise passes as a return; for maximum_likelihood.
        [default: 0.01]
    threads
        Threads. [default: all cores]
    cloud
        Write the points of the first method and exposure, .ply, with reflectivity and standard error of depth; with
        --returns, every return is a point, with its signal.
    focal_px
        Focal length of the image in pixels, for --cloud.
    picture
        Draw the maps beside OUT, as .png. [default: yes]
    overwrite
        Replace existing files.

    Examples
    --------
    mars-lidar reconstruct room.zarr -o maps.zarr
    mars-lidar reconstruct room.zarr --method all -o maps.h5
    mars-lidar reconstruct dim.zarr --method image -o maps.zarr
    mars-lidar reconstruct room.zarr -o maps.npz --cloud room.ply --focal-px 110
    mars-lidar reconstruct face.npy --bin-ps 80 --cycles 20000 --dead-time-ns 50 --pulse-fwhm-ns 0.3 -o face.zarr
    mars-lidar reconstruct glass.zarr --returns 3 -o maps.zarr --cloud glass.ply --focal-px 110
    mars-lidar reconstruct room.zarr --method maximum_likelihood,peak --no-picture -o maps.npz

    Notes
    -----
    Methods: $methods. docs/reconstruction.md says what each assumes, and for which detectors.
    """
    began = time.perf_counter()
    from mars_lidar.io.maps import check_maps_output, save_maps
    from mars_lidar.reconstruction.stored import reconstruct_stored

    png = out.with_suffix(".png")
    check_maps_output(out, overwrite=overwrite)
    refuse_existing(png, overwrite or not picture, "--overwrite, --no-picture or another --out")
    if out.resolve() == cube.resolve():
        raise ValueError(f"--out must not be the cube itself, got {str(out)!r}")
    if (cloud is None) != (focal_px is None):
        raise ValueError("--cloud and --focal-px belong together: points need the camera's focal length")
    if picture:
        from mars_lidar.plot.reconstruction import reconstruction
    if cloud is not None:
        check_target(cloud, folder=False, overwrite=overwrite)
    if attenuation is not None:
        checks.choice("--attenuation", attenuation, ATTENUATIONS)
    several = _several(returns, keep, from_ns)
    with foreign.opened(cube) as stored:
        names = _methods(method, stored)
        with progress_bar("reconstructing") as progress:
            timed = reconstruct_stored(
                stored,
                _with_false_alarm(names, false_alarm),
                level=level,
                attenuation=attenuation,
                returns=several,
                threads=threads,
                progress=progress,
            )
        if keep is not None or from_ns is not None:
            own = "none" if stored.measured else str(stored.flux.info.get("attenuation", "none"))
            chosen = keep or "strongest", from_ns or 0.0, attenuation or own
            timed = {name: replace(each, result=keep_return(each.result, *chosen)) for name, each in timed.items()}
        else:
            _warn_of_reflection(stored, timed)
        results = {name: each.result for name, each in timed.items()}
        _show(stored, timed)  # first: a disk that is full takes nothing from what is known
        save_maps(out, results, source=str(cube), overwrite=overwrite)
        rows = [("maps", str(out))]
        if cloud is not None and focal_px is not None:
            rows.append(("cloud", f"{cloud}, {_save_cloud(cloud, results, focal_px, overwrite):,} points"))
        if picture:
            save_picture(reconstruction(stored, results), png)
            rows.append(("picture", str(png)))
    table([*rows, ("time", f"{span(time.perf_counter() - began)} in all")])


def _several(returns: int, keep: str | None, from_ns: float | None) -> int:
    """Returns to look for: where one of them is to be chosen, at least two."""
    if keep is not None:
        checks.choice("--keep", keep, KEEP)
        if returns < 2:
            raise ValueError(f"--keep {keep} chooses among several returns: give --returns 2 or more")
    if from_ns is not None:
        checks.real("--from-ns", from_ns, low=0.0)
        return max(returns, 2)
    return returns


def _with_false_alarm(names: list[str], false_alarm: float | None) -> list[str | Method]:
    if false_alarm is None:
        return [*names]
    share = checks.real("--false-alarm", false_alarm, low=1e-12, high=0.5)
    if "maximum_likelihood" not in names:
        raise ValueError(f"--false-alarm belongs to maximum_likelihood, got --method {','.join(names)}")
    return [MaximumLikelihood(false_alarm=share) if name == "maximum_likelihood" else name for name in names]


def _warn_of_reflection(cube: Cube, timed: dict[str, Timed]) -> None:
    """A warning where most first returns stand in the same few bins and there is light beyond."""
    first = next(iter(timed.values())).result
    common = common_delay(first)
    if common is None:
        return
    share, delay = common
    counts = np.zeros(cube.shape[3], np.int64)
    for images, rows in cube.recipe.blocks(cube.recipe.chunks(2**24)):
        counts += np.asarray(cube.histogram[images, rows]).sum((0, 1, 2), dtype=np.int64)
    if has_later_light(counts, first, delay):
        say(
            f"warning: {100 * share:.3g} % of the first returns stand at {delay:.4g} ns "
            f"({first.system.depth_m(delay):.3g} m), and there is light beyond: if that is an internal reflection, "
            f"--from-ns {math.ceil(delay + first.system.pulse.support_ns()[1])} or --returns 2 --keep farthest takes "
            "the surface"
        )


def _methods(text: str, cube: Cube) -> list[str]:
    if text == "all":
        names = []
        for name, each in METHODS.items():
            try:
                each.check(cube.system)
            except ValueError as error:
                if cube.system.detector.mode in each.modes:
                    say(f"left out: {error}")
                continue
            names.append(name)
        if not names:
            raise ValueError("--method all: no method suits this detector; see docs/reconstruction.md")
        return names
    asked = [checks.choice("--method", part.strip(), (*METHODS, "all")) for part in text.split(",")]
    if "all" in asked:
        raise ValueError("--method must be all alone, or names of methods")
    return list(dict.fromkeys(asked))


def _show(cube: Cube, timed: dict[str, Timed]) -> None:
    """One line a method on standard output."""
    from mars_lidar.reconstruction.map_errors import errors_against, ssim_available

    realizations, height, width, _ = cube.shape
    head = ["method", "seconds", "detected %", "saturated %", "misfit %"]
    lines: list[list[str]] = []
    errors = {name: errors_against(cube, each.result) for name, each in timed.items()}
    several = any(each.result.returns is not None for each in timed.values())
    if several:
        head += ["2 returns %", "3 or more %"]
    kinds = list(next(iter(errors.values()), {}))
    ssim = ["SSIM"] if ssim_available() else []
    if kinds and not ssim:
        say("SSIM is left out: it needs the library skimage: pip install 'mars-lidar[estimate]'")
    for kind in kinds:
        unit, wide = ("mm", "depth") if kind == "depth" else ("", kind)
        head += [f"{wide} RMSE {unit}".strip(), "median", "PSNR dB", *ssim]
    for name, each in timed.items():
        flags = each.result.flags
        line = [
            name,
            f"{each.seconds:.3g}",
            f"{100.0 * each.result.detected.mean():.4g}",
            f"{100.0 * ((flags & Flags.SATURATED) > 0).mean():.3g}",
            "-" if math.isnan(each.result.misfits) else f"{100.0 * each.result.misfits:.3g}",
        ]
        if several:
            count = np.zeros(1) if each.result.returns is None else each.result.returns.count
            line += [f"{100.0 * (count == 2).mean():.4g}", f"{100.0 * (count > 2).mean():.4g}"]
        for kind in kinds:
            off, scale = errors[name][kind], 1e3 if kind == "depth" else 1.0
            values = (scale * off.rmse, scale * off.median, off.psnr, *([off.ssim] if ssim else []))
            line += ["-" if math.isnan(value) else f"{value:.4g}" for value in values]
        lines.append(line)
    comparison = ", errors against the cube's own truth" if kinds else ""
    print(f"{realizations} × {height} × {width} pixels{comparison}")
    rows = grid("", head)
    for line in lines:
        rows.add_row(*line)
    screen().print(rows)
    if (height, width) == (1, 1):
        _show_pixel({name: each.result for name, each in timed.items()})
    for name, each in timed.items():
        if advice := each.result.advice:
            share = f"{100.0 * each.result.misfits:.3g} % of the pixels do not fit (0.1 % do so by chance)"
            say(f"warning: {name}: {share}; a better fit: {advice}; mars-lidar calibrate CUBE finds the value")


def _show_pixel(results: dict[str, Reconstruction]) -> None:
    """The estimates of a cube of one pixel: a line for each method, exposure and return."""

    def words(values: FloatArray | None, errors: FloatArray | None, place: tuple[int, ...]) -> str:
        return "-" if values is None else measured(float(values[place]), math.nan if errors is None else errors[place])

    rows = grid("", ["method", "exposure", "depth (m)", "S", "B", "p-value"])
    for name, result in results.items():
        for at in np.ndindex(result.depth_m.shape):
            light: Reconstruction | Returns = result
            places: list[tuple[int, ...]] = [at]
            if result.returns is not None and result.returns.count[at] > 1:
                light, places = result.returns, [(*at, k) for k in range(int(result.returns.count[at]))]
            background, fit = words(result.background, result.background_error, at), words(result.p_value, None, at)
            for place in places:
                depth = words(light.depth_m, light.depth_error_m, place)
                rows.add_row(name, str(at[0]), depth, words(light.signal, light.signal_error, place), background, fit)
    screen().print(rows)
    for name, result in results.items():
        if result.misfits > 0.0:  # NaN without p-values
            say(
                f"warning: {name}: the histogram does not fit the estimate: dead time or pulse may be wrong, or there "
                "is another return, a drift or an effect of the detector; mars-lidar calibrate CUBE finds the value"
            )


def _save_cloud(path: Path, results: dict[str, Reconstruction], focal_px: float, overwrite: bool) -> int:
    from mars_lidar.io import save_cloud

    result = next(iter(results.values()))
    if (every := result.returns) is not None:
        return save_cloud(
            path,
            every.depth_m[0],
            focal_px,
            intensity=every.signal[0],
            error_m=every.depth_error_m[0],
            overwrite=overwrite,
        )
    depth, share = np.where(result.detected, result.depth_m, np.nan)[0], result.reflectivity[0]
    error = None if result.depth_error_m is None else result.depth_error_m[0]
    return save_cloud(path, depth, focal_px, intensity=share, error_m=error, overwrite=overwrite)


reconstruct_command = command(reconstruct, methods=", ".join(METHODS))
