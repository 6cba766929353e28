"""Simulation into a file, repetition of a cube, and an estimate of the time in advance."""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np

from mars_lidar._base import manifest
from mars_lidar._base.arguments import checked
from mars_lidar._base.progress import callback_of, of_part, span
from mars_lidar._base.tolerances import TOL
from mars_lidar._base.types import ArrayLike, NDArray, Progress
from mars_lidar.engines import ENGINES, Engine, EngineOptions, check_detector, find_engine
from mars_lidar.engines.engine import given
from mars_lidar.engines.feedback import expected_registrations
from mars_lidar.engines.simulation import simulate
from mars_lidar.engines.table_reader import table_record
from mars_lidar.instrument.system import System
from mars_lidar.io import zarr_store
from mars_lidar.io.cube import Cube, check_output, load, open_writer
from mars_lidar.io.recipe import Recipe
from mars_lidar.light.flux import Flux, StoredFlux
from mars_lidar.table import Table
from mars_lidar.table.storage import cached_tables


@dataclass(frozen=True)
class Written:
    """Result of `simulate_to`.

    Attributes
    ----------
    path
        The file.
    registrations
        Total counts of the cube.
    simulate_s, write_s
        Seconds spent in the engine and on writing.
    report
        Report of the engine, numbers by name, summed over blocks.

    See Also
    --------
    simulate_to

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> written = ml.io.simulate_to(folder / "pair.npz", ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system)
    >>> written.path.name, written.registrations
    ('pair.npz', 1630)
    """

    path: Path
    registrations: int
    simulate_s: float
    write_s: float
    report: dict[str, float] = field(default_factory=dict)

    @property
    def ns_per_registration(self) -> float:
        """Engine time per registration, all threads together; NaN without registrations."""
        return 1e9 * self.simulate_s / self.registrations if self.registrations else math.nan


@checked
def simulate_to(
    path: str | Path,
    flux: Flux,
    system: System,
    *,
    engine: str = "exact",
    realizations: int = 1,
    first_realization: int = 0,
    pixel_index: ArrayLike | None = None,
    seed: int = 0,
    threads: int | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    depth_m: ArrayLike | None = None,
    reflectivity: ArrayLike | None = None,
    source: str = "",
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | bool | None = None,
    **options: Unpack[EngineOptions],
) -> Written:
    """Simulate a cube into a ``.zarr``, ``.h5``, ``.hdf5`` or ``.npz`` of any size.

    Blocks of at most about 64 MiB are simulated and written one after the other, so that the cube need not fit
    in memory; its counts are those of one call of `mars_lidar.simulate`, bit for bit.

    Parameters
    ----------
    path
        The file; its suffix chooses the format.
    flux, system, engine, realizations, first_realization, pixel_index, seed, threads, device
        As for `mars_lidar.simulate`; blocks are copied from a GPU, and the file does not depend on the device.
    **options
        As for `mars_lidar.simulate`; the file stores the name of the engine, its settings, and a hash of the table.
    depth_m, reflectivity
        Maps (H, W) of the scene to store with the counts; default depth: c tau / 2.
    source
        Free text: origin of the scene.
    overwrite
        Replace an existing file, which remains unchanged until the new one is complete.
    resume
        Continue an incomplete ``.zarr``, to the same bits; a complete one is left unchanged. All other arguments must
        be the same.
    progress
        Called with (pixel exposures done, all of them); True: a bar, or a line every 30 s without a terminal.

    Raises
    ------
    ValueError, TypeError
        An invalid argument; nothing was written.
    FileExistsError
        `path` exists and `overwrite` is false.
    MemoryError
        An ``.npz`` that is too large for the memory of this machine.
    WriteError, Interrupted
        Interrupted. A Zarr store remains, marked incomplete; files of other formats are removed.

    See Also
    --------
    mars_lidar.simulate, load, Written

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> written = ml.io.simulate_to(folder / "pair.zarr", ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system)
    >>> ml.io.load(written.path).registrations == written.registrations
    True
    """
    progress = callback_of(progress, "simulating")
    chosen = find_engine(engine, **options)
    recipe = Recipe(
        system=system,
        flux=flux,
        engine=engine,
        seed=seed,
        realizations=realizations,
        first_realization=first_realization,
        pixel_index=pixel_index,  # type: ignore[arg-type]  # it makes arrays of them
        depth_m=depth_m,  # type: ignore[arg-type]
        reflectivity=reflectivity,  # type: ignore[arg-type]
        source=source,
        options=given(options),
        settings=chosen.settings,
    )
    target = Path(path)
    if resume and overwrite:
        raise ValueError("resume and overwrite exclude each other")
    resumed = resume and zarr_store.begun_store(target).exists()
    if not resumed:
        check_output(target, recipe, overwrite=overwrite)
    elif target.suffix != ".zarr":
        raise ValueError(f"resume is for a .zarr, the only format that an interruption leaves, got {str(target)!r}")
    chosen.check(flux, system)  # all pixels, before the first block is simulated
    _try_brightest_pixel(recipe, threads, device)
    begun = zarr_store.unfinished(target, recipe) if resumed else None
    if resumed and begun is None:
        return Written(target, int(load(target).registrations or 0), 0.0, 0.0, {})
    simulate_s = write_s = 0.0
    report: dict[str, float] = {}
    with (
        zarr_store.resumable_writer(target, recipe, begun) if target.suffix == ".zarr" else open_writer(target, recipe)
    ) as writer:
        for images, rows in list(recipe.blocks(writer.chunks))[writer.begun :]:
            began = time.perf_counter()
            of_block: dict[str, float] = {}
            of_whole = _progress_of_block(progress, recipe, images, rows)
            block = _simulate(recipe, images, rows, threads=threads, progress=of_whole, report=of_block, device=device)
            ended = time.perf_counter()
            writer.write(images, rows, block)
            simulate_s += ended - began
            write_s += time.perf_counter() - ended
            for name, value in of_block.items():
                report[name] = report.get(name, 0.0) + value
    return Written(target, writer.registrations, simulate_s, write_s, report)


@checked
def regenerate(
    cube: Cube | Recipe,
    *,
    realizations: slice = slice(None),
    rows: slice = slice(None),
    threads: int | None = None,
    table: Table | None = None,
) -> NDArray[Any]:
    """Simulate a cube, or a part of it, again from its recipe.

    Parameters
    ----------
    cube
        What `load` returned, or its recipe.
    realizations, rows
        Part to simulate: slices of step 1 from the start of the cube.
    threads
        As for `mars_lidar.simulate`.
    table
        The table of the cube, if it was made with one; any other table is refused.

    Returns
    -------
    NDArray
        (realizations, rows, W, bins): the bits of the cube, with the same engine on the same version.

    Raises
    ------
    ValueError, TypeError
        A part outside the cube, a table other than the cube's, or a measured cube, which has no recipe.

    See Also
    --------
    verify, photons

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> path = folder / "pair.npz"
    >>> written = ml.io.simulate_to(path, ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system)
    >>> cube = ml.io.load(path)
    >>> bool((ml.io.regenerate(cube) == cube.histogram).all())
    True
    """
    recipe = _repeatable(cube.simulation("simulating again") if isinstance(cube, Cube) else cube, table)
    parts = []
    count, height = recipe.shape[:2]
    for name, part, size in (("realizations", realizations, count), ("rows", rows, height)):
        first, last, step = part.indices(size)
        if step != 1 or first >= last:
            raise ValueError(f"{name} must select a run of at least one of {size}, got {part!r}")
        parts.append(slice(first, last))
    return _simulate(recipe, *parts, threads=threads)


@checked
def verify(
    cube: Cube, *, threads: int | None = None, progress: Progress | bool | None = None, table: Table | None = None
) -> bool:
    """Whether a repeated simulation gives the stored counts, bit for bit; one block is in memory at a time.

    A cube that was made with a table needs that `table`; any other table is refused. Every byte of a Zarr store is also
    compared with its manifest.

    Parameters
    ----------
    cube
        A cube that `load` returned.
    threads
        As for `mars_lidar.simulate`.
    progress
        Called as ``progress(done, total)``; True: a bar.
    table
        The table of the cube, if it was made with one.

    Raises
    ------
    ValueError, TypeError
        A measured or incomplete cube, or a table other than the cube's.

    See Also
    --------
    regenerate, load

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> path = folder / "pair.npz"
    >>> written = ml.io.simulate_to(path, ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system)
    >>> ml.io.verify(ml.io.load(path))
    True
    """
    progress = callback_of(progress, "verifying")
    recipe = _repeatable(cube.simulation("simulating again"), table)
    if cube.path is not None and cube.path.suffix == ".zarr" and manifest.damage(cube.path):
        return False
    for images, rows in recipe.blocks(recipe.chunks(4 * 2**20)):
        of_whole = _progress_of_block(progress, recipe, images, rows)
        again = _simulate(recipe, images, rows, threads=threads, progress=of_whole)
        if not np.array_equal(again, np.asarray(cube.histogram[images, rows])):
            return False
    return True


def _simulate(recipe: Recipe, images: slice, rows: slice, **how: Any) -> NDArray[Any]:
    """A part of a cube; `how` are further arguments of `mars_lidar.simulate`."""
    counts: Any = simulate(**recipe.part(images, rows), **how)
    here: NDArray[Any] = counts.get() if how.get("device") == "cuda" else counts
    return here


def _repeatable(recipe: Recipe, table: Table | None) -> Recipe:
    """The recipe with the options that its settings ask for, of which only the table is not in a file."""
    recorded = recipe.settings
    table = recipe.options.get("table") if table is None else table
    if table is None and "table" in recorded and (table := _from_cache(recipe.system, recorded["table"])) is None:
        raise ValueError(f"table must be the one that the cube was made with, got None: {_grid(recorded['table'])}")
    options = given(
        {
            "table": table,
            "count": recorded.get("count"),
            "interpolation": recorded.get("interpolation"),
            "outside": None if table is None else "exact",  # no count depends on it
        }
    )
    settings = find_engine(recipe.engine, **options).settings
    if table is not None and settings.get("table") != recorded.get("table"):
        was = _grid(recorded["table"]) if "table" in recorded else "none"
        raise ValueError(f"table must be the one that the cube was made with ({was}), got {_grid(settings['table'])}")
    return recipe.replace(options=options)


def _from_cache(system: System, record: dict[str, Any]) -> Table | None:
    """The table of that record, where the user's cache has it."""
    for path in cached_tables():
        with contextlib.suppress(OSError, ValueError):
            table = Table.load(path, system)
            same = [table.signal.size, table.background.size] == [record["signal"][2], record["background"][2]]
            if same and table_record(table)["hash"] == record["hash"]:
                return table
    return None


def _grid(record: dict[str, Any]) -> str:
    axes = ", ".join("{} {:g} to {:g} in {}".format(name, *record[name]) for name in ("signal", "background"))
    return f"method {record['method']!r}, {axes}, hash {record['hash']}"


def _try_brightest_pixel(recipe: Recipe, threads: int | None, device: Literal["cpu", "cuda"]) -> None:
    """Simulate one pixel, so that invalid arguments are refused before anything is written."""
    y, x = (int(k) for k in np.unravel_index(np.argmax(recipe.flux.total), recipe.flux.shape))
    pixel = recipe.replace(
        flux=recipe.flux[y, x],
        realizations=1,
        pixel_index=np.array([0 if recipe.pixel_index is None else recipe.pixel_index.max()]),
        depth_m=recipe.depth_m[:1, :1],
        reflectivity=None,
    )
    _simulate(pixel, slice(0, 1), slice(0, 1), threads=threads, device=device)


def _progress_of_block(progress: Progress | None, recipe: Recipe, images: slice, rows: slice) -> Progress | None:
    """A callback for one block that reports the progress of the whole cube, in pixel exposures."""
    count, height, width, _ = recipe.shape
    before = images.start * height * width + rows.start * width
    size = (images.stop - images.start) * (rows.stop - rows.start) * width
    return of_part(progress, before, before + size, count * height * width)


@dataclass(frozen=True)
class _Probe:
    """Settings of the measurement of time before a run. They affect the accuracy of the advice, and nothing else."""

    event_s: float = 1e-7  # per event of the slowest engine: runs of less than a second by it are not measured
    least_s: float = 0.1  # shortest measurement, in two steps, or of the whole image ...
    first_s: float = 1.0  # ... or in one step, if that takes longer than this
    pixels: int = 16  # of the first step
    cycles: int = 20_000  # for engines that draw photon by photon, whose time is proportional to the exposure
    worth: float = 3.0  # ratio of times from which a faster engine is mentioned


_PROBE = _Probe()
_BY_PHOTON = ("exact", "sequential", "poisson")


@dataclass(frozen=True)
class Advice:
    """Approximate seconds of a run, and of the same run with engine `auto`, NaN if that draws another law."""

    seconds: float
    auto_s: float = math.nan

    def __str__(self) -> str:
        """One line, empty for a run that is not long."""
        if self.seconds < TOL.long_s:
            return ""
        faster = (
            f"; --engine auto: about {span(self.auto_s)}, same law" if self.auto_s * _PROBE.worth < self.seconds else ""
        )
        return f"about {span(self.seconds)} on this machine{faster}"


def advice(
    flux: Flux,
    system: System,
    engine: str | Engine = "exact",
    *,
    realizations: int = 1,
    threads: int | None = None,
    options: EngineOptions | None = None,
) -> Advice:
    """Approximate time of `mars_lidar.simulate`, measured in some tenths of a second on pixels spread over the image.

    0, without a measurement, for runs that are short with any engine.
    """
    chosen = find_engine(engine, **(options or {}))
    if isinstance(flux, StoredFlux) or system.detector.crosstalk is not None:  # cannot be measured on single pixels
        return Advice(0.0)
    events = realizations * float(expected_registrations(flux, system).sum())
    if chosen.name in ("sequential", "poisson"):
        events = realizations * float(flux.total.sum()) * system.cycles
    by_pixel = "table" in chosen.options and getattr(chosen, "reader", None) is None
    if events * _PROBE.event_s < 1.0 and not by_pixel:
        return Advice(0.0)
    seconds = realizations * _measured(flux, system, chosen, threads)
    if seconds < TOL.long_s or chosen.name != "exact":
        return Advice(seconds)
    auto = ENGINES["auto"]
    try:
        check_detector(auto, system)
        auto.check(flux, system)
    except ValueError:
        return Advice(seconds)
    return Advice(seconds, realizations * _measured(flux, system, auto, threads))


def _measured(flux: Flux, system: System, engine: Engine, threads: int | None) -> float:
    """Seconds for one image, from some of its pixels: as many as take long enough to be measured."""
    share = 1.0
    if engine.name in _BY_PHOTON and system.cycles > _PROBE.cycles:
        share = system.cycles / _PROBE.cycles
        system = system.replace(cycles=_PROBE.cycles)
    pixels = math.prod(flux.shape)
    step = max(1, math.isqrt(pixels // _PROBE.pixels))
    drawn, spent = 0, 0.0
    while True:
        some = flux[step // 2 :: step, step // 2 :: step]
        before, number = (drawn, spent), math.prod(some.shape)
        began = time.perf_counter()
        simulate(some, system, engine=engine, threads=threads)
        drawn, spent = number, time.perf_counter() - began
        if step == 1 or spent > _PROBE.first_s or (before[0] and spent > _PROBE.least_s):
            # costs that do not depend on the number of pixels, such as that of a plan, occur once
            each = (spent - before[1]) / (drawn - before[0]) if drawn > before[0] else spent / drawn
            return share * (spent + max(0.0, each) * (pixels - drawn))
        step = max(1, step // 2)
