"""Engines side by side on one scene: time, counts, and the joint statistics of a few pixels.

Samples of one engine are compared with the exact finite-exposure statistics where those exist, and with the
samples of a reference engine in what has no prediction. Engines draw from streams of their own, so that the
stated errors hold also between engines that would share their draws.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import check_memory, thread_count
from mars_lidar._base.types import Progress
from mars_lidar.engines import ENGINES, Engine, find_engine
from mars_lidar.engines.table_reader import image_table
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics import ConvergenceError
from studies.compare.expected import Expected, PixelLaw, expected_counts, pixel_law
from studies.compare.pixel import (
    PixelStatistics,
    draw_pixel,
    pixel_statistics,
    signal_window,
    telling_pixels,
)
from studies.compare.sample import Sample
from studies.compare.scene import SceneStatistics, scene_statistics


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `compare` found; engines and pixels in the order asked for.

    Attributes
    ----------
    expected
        Exact mean and variance of the count at (some of) the pixels of the image.
    scenes
        The whole image, by engine.
    pixels
        (y, x) of each representative pixel, by name.
    laws
        Exact predictions at each pixel; None where there is none: `unpredicted` says why.
    statistics
        By pixel, then by engine.
    skipped
        Engines that were not run, and why.
    unpredicted
        Pixels without a prediction, and why.
    table
        How the whole image was drawn by engines that evaluate each pixel: from which table; "" without one.
    """

    flux: Flux
    system: System
    against: str
    seed: int
    threads: int
    expected: Expected
    scenes: dict[str, SceneStatistics]
    pixels: dict[str, tuple[int, int]]
    laws: dict[str, PixelLaw | None]
    statistics: dict[str, dict[str, PixelStatistics]]
    skipped: dict[str, str]
    unpredicted: dict[str, str]
    table: str = ""

    @property
    def engines(self) -> list[str]:
        """Engines that were run."""
        return list(self.scenes)


def compare(
    flux: Flux,
    system: System,
    engines: Sequence[str | Engine] = (),
    *,
    against: str = "exact",
    realizations: int = 10_000,
    repeats: int = 5,
    pixels: int | dict[str, tuple[int, int]] = 4,
    depth_m: NDArray[np.float64] | None = None,
    seed: int = 0,
    threads: int | None = None,
    budget_s: float = 4.0,
    progress: Progress | bool | None = None,
) -> Comparison:
    """Run several engines on one image and compare what they draw.

    Parameters
    ----------
    flux, system
        As `simulate`.
    engines
        Names, or engines of your own settings; none: all there are. One that cannot do this flux and system
        is skipped, and the reason kept. Those that evaluate every pixel (``"mars"``, ``"renewal"``), by name, draw the
        whole image from a table over its range, from the cache or built (`mars_lidar.engines.image_table`), and the
        single pixels without it.
    against
        Name of the reference engine, run in any case.
    realizations
        Exposures of each pixel and engine, at least 50.
    repeats
        Cubes of the whole image, each timed.
    pixels
        How many representative pixels are chosen, 1 to 6, or their (y, x) by name.
    depth_m
        True depth (H, W), m, by which a pixel at an edge is found; default that of the flux's delays.
    seed
        Integer in [0, 2**64).
    threads
        Default: all processors this process may use.
    budget_s
        Seconds that an engine may take for the image, and again for the pixels: then it draws fewer.
    progress
        Called as ``progress(done, total)`` after each part; an exception from it stops the run.

    Returns
    -------
    Comparison
        Without a figure, without words.

    Raises
    ------
    ValueError, TypeError
        A bad argument, or a reference engine that cannot do this flux and system.
    MemoryError
        A cube, or the histograms of a pixel, would not fit.
    """
    if not isinstance(flux, Flux):
        raise TypeError(f"flux must be a Flux, got {type(flux).__name__}")
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    if isinstance(engines, str):
        raise TypeError(f"engines must be a sequence of names, got {engines!r}; one engine: [{engines!r}]")
    if system.detector.crosstalk is not None:
        raise ValueError(
            "compare draws single pixels, which crosstalk ties to their neighbours, got "
            f"crosstalk={system.detector.crosstalk!r}; simulate whole images with engine 'sequential'"
        )
    chosen = _engines(engines, against)
    n = checks.integer("realizations", realizations, low=50, high=10**7)
    cubes = checks.integer("repeats", repeats, low=1, high=1000)
    budget = checks.real("budget_s", budget_s, low=0.0, strict_low=True)
    seed = checks.integer("seed", seed, low=0, high=2**64 - 1)
    team = thread_count(threads)
    flux = flux.image
    depth = np.asarray(system.depth_m(flux.delay_ns % system.period_ns)) if depth_m is None else np.asarray(depth_m)
    if depth.shape != flux.shape:
        raise ValueError(f"depth_m must have the shape {flux.shape} of the flux, got {depth.shape}")
    places = pixels if isinstance(pixels, dict) else telling_pixels(flux, depth, pixels)
    _check_places(places, flux)
    each = system.bins * system.histogram_dtype.itemsize
    check_memory(2 * n * each, f"{n} histograms of two engines", "ask for fewer realizations")
    check_memory(flux.background.size * each, f"a cube of {flux.shape} pixels", "compare a smaller image")

    skipped = _refusals(chosen, flux, system, against)
    runs = {name: engine for name, engine in chosen.items() if name not in skipped}
    steps = _Steps(callback_of(progress, "comparing"), 1 + len(runs) * (1 + len(places)))
    expected = expected_counts(flux, system, team, budget)
    steps.done()
    scenes: dict[str, SceneStatistics] = {}
    whole, table = _with_table(runs, flux, system, team)
    for name, engine in list(whole.items()):
        try:
            scenes[name] = scene_statistics(
                flux, system, engine, expected, cubes, _stream(seed, name), team, budget, scenes.get(against)
            )
            steps.done()
        except (ValueError, ConvergenceError) as error:  # what an engine notices only at work
            if name == against:
                raise
            skipped[name] = str(error)
            del runs[name]
            steps.done(1 + len(places))
    laws: dict[str, PixelLaw | None] = {}
    unpredicted: dict[str, str] = {}
    statistics: dict[str, dict[str, PixelStatistics]] = {}
    for pixel, (y, x) in places.items():
        window = signal_window(flux, system, y, x)
        predicted = pixel_law(flux, system, y, x, window, team)
        if isinstance(predicted, str):
            unpredicted[pixel] = predicted
        law = laws[pixel] = None if isinstance(predicted, str) else predicted
        results: dict[str, PixelStatistics] = {}
        reference: Sample | None = None
        for name, engine in runs.items():
            drawn = draw_pixel(flux, system, engine, (y, x), n, _stream(seed, name), team, budget / len(places))
            sample = Sample(drawn, window)
            random = np.random.default_rng([_stream(seed, name), y, x])
            results[name] = pixel_statistics(name, pixel, sample, law, reference, random)
            if name == against:
                reference = sample
            steps.done()
        statistics[pixel] = results
    order = [name for name in _names(engines, against) if name in runs]
    return Comparison(
        flux,
        system,
        against,
        seed,
        team,
        expected,
        {name: scenes[name] for name in order},
        places,
        laws,
        {pixel: {name: result[name] for name in order} for pixel, result in statistics.items()},
        skipped,
        unpredicted,
        table,
    )


def _names(engines: Sequence[str | Engine], against: str) -> list[str]:
    """In the order asked for, the reference first where nobody asked for it."""
    names = [e.name if isinstance(e, Engine) else e for e in engines] or list(ENGINES)
    return names if against in names else [against, *names]


def _engines(engines: Sequence[str | Engine], against: str) -> dict[str, Engine]:
    """Engines by name, the reference first: the others are compared with it."""
    checks.choice("against", against, tuple({**ENGINES, **{e.name: e for e in engines if isinstance(e, Engine)}}))
    given = {e.name if isinstance(e, Engine) else e: find_engine(e) for e in engines}
    if len(given) < len(engines):
        raise ValueError(f"engines must differ, got {[e.name if isinstance(e, Engine) else e for e in engines]}")
    given = given or dict(ENGINES)
    return {against: given.pop(against, None) or ENGINES[against], **given}


def _refusals(engines: dict[str, Engine], flux: Flux, system: System, against: str) -> dict[str, str]:
    reasons: dict[str, str] = {}
    for name, engine in engines.items():
        try:
            engine.check(flux, system)
        except ValueError as error:
            if name == against:
                raise
            reasons[name] = str(error)
    return reasons


def _with_table(runs: dict[str, Engine], flux: Flux, system: System, team: int) -> tuple[dict[str, Engine], str]:
    """The engines for the whole image, those that would evaluate each of its pixels with a table; and which it is."""
    slow = [name for name, engine in runs.items() if engine is ENGINES.get(name) and "table" in engine.options]
    began = time.perf_counter()
    table = image_table(flux, system, team) if slow else None
    if table is None:
        return runs, ""
    text = f"{table.signal.size} × {table.background.size}, found or built in {time.perf_counter() - began:.2g} s"
    changed = {name: find_engine(name, table=table, outside="exact") for name in slow}
    return runs | changed, f"{' and '.join(slow)}: the whole image by a table {text}; single pixels without"


def _check_places(places: dict[str, tuple[int, int]], flux: Flux) -> None:
    if not 1 <= len(places) <= 6:
        raise ValueError(f"pixels must be 1 to 6 pixels, got {len(places)}")
    for name, (y, x) in places.items():
        if not (0 <= y < flux.shape[0] and 0 <= x < flux.shape[1]):
            raise ValueError(f"pixels must lie in the image of shape {flux.shape}, got {name!r} at ({y}, {x})")


def _stream(seed: int, engine: str) -> int:
    """Seed of an engine's own streams; whatever other engines are run beside it."""
    state = np.random.SeedSequence([seed, zlib.crc32(engine.encode())]).generate_state(1, np.uint64)
    return int(state[0])


class _Steps:
    """Counts finished parts."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._made = progress, total, 0

    def done(self, parts: int = 1) -> None:
        self._made += parts
        if self._progress is not None:
            self._progress(self._made, self._total)
