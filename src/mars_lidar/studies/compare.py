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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _validate
from mars_lidar._memory import check_memory
from mars_lidar.engines import ENGINES, Engine, find_engine
from mars_lidar.engines.base import Progress
from mars_lidar.flux import Flux
from mars_lidar.plot.data import incident_rate
from mars_lidar.simulate import simulate
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.exposure import thread_count
from mars_lidar.studies.compare_expected import Expected, PixelLaw, expected_counts, pixel_law
from mars_lidar.studies.compare_pixels import telling_pixels
from mars_lidar.studies.compare_sample import (
    Distance,
    Estimate,
    FloatArray,
    Moments,
    Sample,
    law_distance,
    ratio,
    score,
    shape_distance,
)
from mars_lidar.studies.compare_scene import SceneStatistics, scene_statistics
from mars_lidar.studies.distance import Pmf
from mars_lidar.system import System

_FIRST_BATCH = 200  # realizations after which the time for the rest is known
_WINDOW_EDGE = np.exp(-4.5)  # of the largest signal rate: three standard deviations of a Gaussian pulse


@dataclass(frozen=True, eq=False)
class PixelStatistics:
    """One engine at one pixel.

    Attributes
    ----------
    engine, pixel
        Names.
    realizations
        Independent exposures behind it.
    counts
        Of all registrations; `window` of those within the bins where the signal's rate exceeds exp(-9/2) of
        its largest value, which is +-3 sigma of a Gaussian pulse (NaN without a signal).
    window_ratio
        Variance of the window count over that of the reference engine.
    lag1, lag1_error
        Sum over all bins of Cov(h_j, h_j+1) over the mean count, and its difference to the reference engine.
    shape, law
        Total variation of the mean histogram's shape, and of the law of the count.
    mean_histogram
        (bins,).
    frequencies
        Of the counts.
    """

    engine: str
    pixel: str
    realizations: int
    counts: Moments
    window: Moments
    window_ratio: Estimate
    lag1: Estimate
    lag1_error: Estimate
    shape: Distance
    law: Distance
    mean_histogram: FloatArray
    frequencies: Pmf

    @property
    def scored(self) -> dict[str, Estimate | Distance]:
        """All that is compared with something, by name."""
        return {
            "mean": self.counts.mean,
            "variance": self.counts.variance,
            "fano": self.counts.fano,
            "window_mean": self.window.mean,
            "window_variance": self.window.variance,
            "window_ratio": self.window_ratio,
            "lag1_error": self.lag1_error,
            "shape": self.shape,
            "law": self.law,
        }


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
    progress: Progress | None = None,
) -> Comparison:
    """Run several engines on one image and compare what they draw.

    Parameters
    ----------
    flux, system
        As `simulate`.
    engines
        Names, or engines of your own settings; none: all there are. One that cannot do this flux and system
        is skipped, and the reason kept.
    against
        Name of the reference engine, run in any case.
    realizations
        Exposures of each pixel and engine, at least 50.
    repeats
        Cubes of the whole image, each timed.
    pixels
        How many representative pixels are chosen, 1 to 6, or their (y, x) by name.
    depth_m
        True depth (H, W), m; default that of the flux's delays.
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
    ValueError
        A bad argument, or a reference engine that cannot do this flux and system.
    """
    chosen = _engines(engines, against)
    n = _validate.integer("realizations", realizations, low=50, high=10**7)
    cubes = _validate.integer("repeats", repeats, low=1, high=1000)
    budget = _validate.real("budget_s", budget_s, low=0.0, strict_low=True)
    _validate.integer("seed", seed, low=0, high=2**64 - 1)
    team = thread_count(threads)
    depth = np.asarray(system.depth_m(flux.delay_ns % system.period_ns)) if depth_m is None else np.asarray(depth_m)
    if depth.shape != flux.shape:
        raise ValueError(f"depth_m must have the shape {flux.shape} of the flux, got {depth.shape}")
    places = pixels if isinstance(pixels, dict) else telling_pixels(flux, depth, pixels)
    _check_places(places, flux)
    check_memory(n * system.bins * system.histogram_dtype.itemsize * 2, f"{n} histograms", "ask for fewer realizations")

    skipped = _refusals(chosen, flux, system, against)
    runs = {name: engine for name, engine in chosen.items() if name not in skipped}
    steps = _Steps(progress, 1 + len(runs) * (1 + len(places)))
    expected = expected_counts(flux, system, team, budget)
    steps.done()
    scenes: dict[str, SceneStatistics] = {}
    for name, engine in list(runs.items()):
        try:
            scenes[name] = scene_statistics(
                flux, system, engine, expected, depth, cubes, _stream(seed, name), team, budget, scenes.get(against)
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
        predicted = pixel_law(flux, system, y, x, team)
        if isinstance(predicted, str):
            unpredicted[pixel] = predicted
        law = laws[pixel] = None if isinstance(predicted, str) else predicted
        window = _window(flux, system, y, x)
        found: dict[str, PixelStatistics] = {}
        reference: Sample | None = None
        for name, engine in runs.items():
            drawn = _draw(flux, system, engine, (y, x), n, _stream(seed, name), team, budget / len(places))
            sample = Sample(drawn, window)
            random = np.random.default_rng([_stream(seed, name), y, x])
            found[name] = _statistics(name, pixel, sample, law, reference, random)
            if name == against:
                reference = sample
            steps.done()
        statistics[pixel] = found
    order = [name for name in _names(engines, against) if name in runs]
    return Comparison(
        flux, system, against, seed, team, expected, {name: scenes[name] for name in order}, places, laws,
        {pixel: {name: found[name] for name in order} for pixel, found in statistics.items()}, skipped, unpredicted,
    )  # fmt: skip


def _statistics(
    name: str, pixel: str, sample: Sample, law: PixelLaw | None, reference: Sample | None, random: np.random.Generator
) -> PixelStatistics:
    """One engine against the prediction, and against the reference engine in what has none."""
    theirs = None if reference is None else Moments.of(reference.counts)
    counts = Moments.of(sample.counts, cumulants=None if law is None else law.cumulants, other=theirs)
    lag1 = sample.lag1
    nothing = Estimate(np.nan)
    window = Moments(nothing, nothing, nothing)
    window_ratio, lag1_error = nothing, nothing
    has_window = bool(sample.window.any())
    if has_window:
        others = None if reference is None else Moments.of(reference.window_counts)
        window = Moments.of(sample.window_counts, other=others)
        if others is not None:
            window_ratio = ratio(window.variance, others.variance)
        else:
            own = window.variance
            window_ratio = Estimate(1.0, own.error / own.value if own.value > 0 else np.nan)
    if reference is not None:
        their_lag1 = reference.lag1
        error = float(np.hypot(lag1.error, their_lag1.error))
        difference = lag1.value - their_lag1.value
        lag1_error = Estimate(difference, error, score(difference, error))
    unknown = Distance(np.nan, np.nan, np.nan)
    shape_goal, law_goal = (reference, reference) if law is None else (law.histogram, law.pmf)
    return PixelStatistics(
        engine=name,
        pixel=pixel,
        realizations=sample.size,
        counts=counts,
        window=window,
        window_ratio=window_ratio,
        lag1=lag1,
        lag1_error=lag1_error,
        shape=unknown if shape_goal is None else shape_distance(sample, shape_goal, random),
        law=unknown if law_goal is None else law_distance(sample, law_goal, random),
        mean_histogram=sample.mean_histogram,
        frequencies=sample.law,
    )


def _draw(
    flux: Flux, system: System, engine: Engine, pixel: tuple[int, int], n: int, seed: int, team: int, budget_s: float
) -> NDArray[Any]:
    """Histograms (up to n, bins) of one pixel; fewer where `budget_s` ends, in batches that double."""
    y, x = pixel
    place = np.array([y * flux.shape[1] + x], dtype=np.int64)
    alone = flux[y : y + 1, x : x + 1]
    out = np.empty((n, system.bins), system.histogram_dtype)
    began, made, batch = time.perf_counter(), 0, min(n, _FIRST_BATCH)
    while made < n:
        part = out[made : made + batch].reshape(-1, 1, 1, system.bins)
        simulate(
            alone, system, engine=engine, realizations=len(part), first_realization=made, pixel_index=place,
            seed=seed, threads=team, out=part,
        )  # fmt: skip
        made += len(part)
        each = (time.perf_counter() - began) / made
        batch = min(2 * batch, n - made, int((budget_s - each * made) / each))
        if batch <= 0:
            break
    return out[:made]


def _window(flux: Flux, system: System, y: int, x: int) -> NDArray[np.bool_]:
    """Bins (bins,) where the signal's rate exceeds exp(-9/2) of its largest; none without a signal."""
    signal = incident_rate(flux, system, y, x) - flux.background[y, x] / system.bins
    return np.asarray(signal > max(_WINDOW_EDGE * float(signal.max()), 1e-12 * float(flux.total[y, x])))


def _names(engines: Sequence[str | Engine], against: str) -> list[str]:
    """In the order asked for, the reference first where nobody asked for it."""
    names = [e.name if isinstance(e, Engine) else e for e in engines] or list(ENGINES)
    return names if against in names else [against, *names]


def _engines(engines: Sequence[str | Engine], against: str) -> dict[str, Engine]:
    """Engines by name, the reference first: the others are compared with it."""
    _validate.choice("against", against, tuple({**ENGINES, **{e.name: e for e in engines if isinstance(e, Engine)}}))
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
