"""Engines side by side on one scene: time, counts, and the joint statistics of a few pixels.

Samples of one engine are compared with the exact finite-exposure statistics where those exist, and with the
samples of a reference engine in what has no prediction. Engines draw from streams of their own, so that the
stated errors hold also between engines that would share their draws.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import check_memory, thread_count
from mars_lidar._base.types import FloatArray, Progress
from mars_lidar.engines import ENGINES, Engine, find_engine
from mars_lidar.engines.simulation import simulate
from mars_lidar.engines.table_reader import image_table
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.plot.views import example_pixels, incident_rate
from mars_lidar.statistics import ConvergenceError, count_law, exposure_moments, joint_law

SIGNIFICANT = 5.0  # standard scores from which a deviation is called wrong: 6e-7 by chance
_BLOCK_BYTES = 2**25  # of histograms at a time


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error, and the standard scores `z` by which it deviates; NaN: compared with nothing."""

    value: float
    error: float = math.nan
    z: float = math.nan

    @property
    def wrong(self) -> bool:
        """Whether the deviation is significant."""
        return abs(self.z) > SIGNIFICANT


@dataclass(frozen=True)
class Moments:
    """Mean and variance of a count."""

    mean: Estimate
    variance: Estimate

    @classmethod
    def of(cls, counts: NDArray[np.int64], goal: FloatArray | Moments | None = None) -> Moments:
        """Statistics of a sample (n,), scored against the cumulants (4,) of a law, or against another sample.

        The error of the variance comes from the fourth moment. A law adds what it knows to the errors: a
        count that hardly ever changes looks certain in a sample.
        """
        n = counts.size
        mean = float(counts.mean())
        d = counts - mean
        variance, fourth = float(d @ d) / (n - 1), float((d**4).mean())
        errors = math.sqrt(variance / n), math.sqrt(max(fourth - variance**2 * (n - 3) / (n - 1), 0.0) / n)
        goals, spread = (math.nan, math.nan), errors
        if isinstance(goal, Moments):
            goals = goal.mean.value, goal.variance.value
            spread = math.hypot(errors[0], goal.mean.error), math.hypot(errors[1], goal.variance.error)
        elif goal is not None:
            goals = float(goal[0]), float(goal[1])
            known = goals[1], max(float(goal[3]) + 2.0 * goals[1] ** 2, 0.0)
            spread = max(errors[0], math.sqrt(known[0] / n)), max(errors[1], math.sqrt(known[1] / n))
        scored = zip((mean, variance), errors, goals, spread, strict=True)
        return cls(*(Estimate(value, error, score(value - g, s)) for value, error, g, s in scored))


def score(difference: float, error: float) -> float:
    """Standard scores; 0 where nothing varies and nothing differs."""
    if math.isnan(difference):
        return math.nan
    if error > 0.0:
        return difference / error
    return 0.0 if abs(difference) < 1e-9 else math.copysign(math.inf, difference)


def ratio(a: Estimate, b: Estimate) -> Estimate:
    """a / b of independent estimates, scored by their difference."""
    if not b.value > 0:
        return Estimate(math.nan)
    value = a.value / b.value
    return Estimate(
        value, math.hypot(a.error, value * b.error) / b.value, score(a.value - b.value, math.hypot(a.error, b.error))
    )


def mean_of(values: FloatArray, goal: float) -> Estimate:
    """Mean of independent values (n,)."""
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(values.size)
    return Estimate(mean, error, score(mean - goal, error))


def lag1(histograms: NDArray[np.unsignedinteger[Any]]) -> Estimate:
    """Sum over all bins of Cov(h_j, h_j+1), cyclic, over the mean count, of exposures (n, bins)."""
    n, bins = histograms.shape
    mean = histograms.sum(0, dtype=np.int64) / n
    if mean.sum() == 0.0 or bins < 2:
        return Estimate(math.nan)
    product = np.empty(n)
    step = max(1, _BLOCK_BYTES // (8 * bins))
    for first in range(0, n, step):
        rows = slice(first, first + step)
        d = histograms[rows] - mean.astype(np.float32)  # rounded to 1e-7: far below what sampling leaves open
        product[rows] = np.einsum("ij,ij->i", d[:, :-1], d[:, 1:]) + d[:, -1] * d[:, 0]
    total = float(mean.sum())
    return Estimate(float(product.sum()) / (n - 1) / total, float(product.std(ddof=1)) / math.sqrt(n) / total)


_PIXELS, _WAVEFORMS = 4096, 256  # of an image, at most, and where each has a shape of its own: else on a coarser grid
_LAG_BINS = 2048  # beyond them the lag-1 covariance, which needs every bin as a window, takes seconds
_WINDOW_EDGE = np.exp(-4.5)  # of the largest signal rate: three standard deviations of a Gaussian pulse


@dataclass(frozen=True, eq=False)
class Expected:
    """Exact mean and variance (ceil(H / step), ceil(W / step)) of the count on every `step`-th row and column."""

    step: int
    mean: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, flux: Flux, system: System, threads: int) -> Expected | None:
        """Of an image; None where there are no exact statistics."""
        shaped = flux.waveform is not None or len(flux.returns_signal) > 1
        most, step = (_WAVEFORMS if shaped else _PIXELS), 1
        while -(-flux.shape[0] // step) * -(-flux.shape[1] // step) > most:
            step += 1
        try:
            law = exposure_moments(flux[::step, ::step], system.replace(bins=1), threads=threads)
        except (ConvergenceError, ValueError):
            return None
        return cls(step, np.asarray(law.mean), np.asarray(law.variance))

    def on_grid(self, image: FloatArray) -> FloatArray:
        """An image (..., H, W) at these pixels."""
        return image[..., :: self.step, :: self.step]


@dataclass(frozen=True, eq=False)
class SceneStatistics:
    """One engine on the whole image.

    Attributes
    ----------
    seconds
        Wall time of each cube, into memory that has been touched.
    registrations
        Of a cube, on average.
    mean_counts
        Mean count (H, W) over the cubes.
    relative_bias
        Total counts over the expected total - 1; over the reference engine's total where nothing is predicted.
    dispersion
        Mean of (count - expected)^2 / variance over pixels and cubes: 1 where mean and variance are right.
    """

    seconds: tuple[float, ...]
    registrations: float
    mean_counts: FloatArray
    relative_bias: Estimate
    dispersion: Estimate

    @classmethod
    def of(
        cls, drawn: FloatArray, seconds: Sequence[float], expected: Expected | None, other: FloatArray | None
    ) -> SceneStatistics:
        """Of counts (cubes, H, W); errors from the spread over pixels, which are independent."""
        bias = dispersion = Estimate(math.nan)
        goal, mean = other, drawn.mean(0)
        if expected is not None:
            goal, mean = expected.mean, expected.on_grid(mean)
            moves = expected.variance > 0.0
            if moves.sum() > 1:
                off = (expected.on_grid(drawn) - expected.mean)[:, moves]
                dispersion = mean_of((off**2 / expected.variance[moves]).mean(0), 1.0)
        if goal is not None and goal.size > 1 and (total := float(goal.mean())) > 0.0:
            excess = mean_of((mean - goal).ravel(), 0.0)
            bias = Estimate(excess.value / total, excess.error / total, excess.z)
        return cls(tuple(seconds), float(drawn.sum() / len(drawn)), drawn.mean(0), bias, dispersion)

    @property
    def median_s(self) -> float:
        """Median wall time of a cube."""
        return float(np.median(self.seconds))


@dataclass(frozen=True, eq=False)
class PixelLaw:
    """Exact law of one pixel: cumulants (4,) of the count and of that in the signal window, the latter None if unknown.

    `lag1`: sum over all bins of Cov(h_j, h_j+1), cyclic, over the mean count, or NaN.
    """

    cumulants: FloatArray
    window: FloatArray | None
    lag1: float

    @classmethod
    def of(cls, pixel: Flux, system: System, window: NDArray[np.bool_], threads: int) -> PixelLaw:
        """Of a pixel's light; the joint statistics as far as the closed form has them in a second or so."""
        cumulants = np.asarray(count_law(pixel, system, threads=threads).cumulants)
        try:
            joint = joint_law(pixel, system)
            # cumulants of a Gaussian: they only keep errors from being too small
            moments = np.array([*joint.window(window.astype(np.float64)), 0.0, 0.0]) if window.any() else None
        except (ConvergenceError, ValueError):
            return cls(cumulants, None, math.nan)
        quick = system.bins <= _LAG_BINS and joint.settled >= 0  # else each window is run through the exposure
        known = quick and joint.count_mean > 0
        return cls(cumulants, moments, float(joint.lag(1).sum()) / joint.count_mean if known else math.nan)


@dataclass(frozen=True, eq=False)
class PixelStatistics:
    """One engine at one pixel.

    Attributes
    ----------
    counts
        Of all registrations; `window` of those within the bins where the signal's rate exceeds exp(-9/2) of
        its largest value, which is +-3 sigma of a Gaussian pulse (NaN without a signal).
    window_ratio
        Variance of the window count over that of the reference engine.
    lag1
        Sum over all bins of Cov(h_j, h_j+1) over the mean count.
    """

    counts: Moments
    window: Moments
    window_ratio: Estimate
    lag1: Estimate

    @classmethod
    def of(
        cls,
        histograms: NDArray[np.unsignedinteger[Any]],
        window: NDArray[np.bool_],
        law: PixelLaw | None,
        other: PixelStatistics | None,
    ) -> PixelStatistics:
        """Of exposures (n, bins): against the law, and against the reference engine in what has none."""
        count_goal: FloatArray | Moments | None = other.counts if other else None
        window_goal: FloatArray | Moments | None = other.window if other else None
        if law is not None:
            count_goal = law.cumulants
            window_goal = window_goal if law.window is None else law.window
        counts = Moments.of(histograms.sum(1, dtype=np.int64), count_goal)
        inside = Moments(Estimate(math.nan), Estimate(math.nan))
        if window.any():
            inside = Moments.of(histograms[:, window].sum(1, dtype=np.int64), window_goal)
        relative = Estimate(math.nan) if other is None else ratio(inside.variance, other.window.variance)
        lag, known = lag1(histograms), Estimate(math.nan)
        if law is not None and math.isfinite(law.lag1):
            known = Estimate(law.lag1, 0.0)
        elif other is not None:
            known = other.lag1
        z = score(lag.value - known.value, math.hypot(lag.error, known.error))
        return cls(counts, inside, relative, Estimate(lag.value, lag.error, z))

    @property
    def scored(self) -> dict[str, Estimate]:
        """All that is compared with something, by name."""
        return {
            "mean": self.counts.mean,
            "variance": self.counts.variance,
            "window_mean": self.window.mean,
            "window_variance": self.window.variance,
            "window_ratio": self.window_ratio,
            "lag1": self.lag1,
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """Engines and pixels in the order asked for.

    Attributes
    ----------
    expected
        Exact mean and variance of the count at (some of) the pixels of the image.
    scenes
        The whole image, by engine.
    pixels
        (y, x) of each representative pixel, by name.
    laws, statistics
        By pixel, the exact prediction, and the statistics by engine.
    skipped, unpredicted
        Engines that were not run and pixels without a prediction, and why.
    table
        How the whole image was drawn by engines that evaluate each pixel: from which table; "" without one.
    """

    flux: Flux
    system: System
    against: str
    realizations: int
    expected: Expected | None
    scenes: dict[str, SceneStatistics]
    pixels: dict[str, tuple[int, int]]
    laws: dict[str, PixelLaw]
    statistics: dict[str, dict[str, PixelStatistics]]
    skipped: dict[str, str]
    unpredicted: dict[str, str]
    table: str = ""


def compare(
    flux: Flux,
    system: System,
    engines: Sequence[str | Engine] = (),
    *,
    against: str = "exact",
    realizations: int = 10_000,
    repeats: int = 5,
    pixels: dict[str, tuple[int, int]] | None = None,
    depth_m: NDArray[np.float64] | None = None,
    seed: int = 0,
    threads: int | None = None,
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
        (y, x) of representative pixels by name; default `mars_lidar.plot.example_pixels`: bright, dim, edge.
    depth_m
        True depth (H, W), m, by which a pixel at an edge is found; default that of the flux's delays.
    seed, threads, progress
        As `simulate`.

    Raises
    ------
    ValueError, TypeError
        A bad argument, or a reference engine that cannot do this flux and system.
    MemoryError
        A cube, or the histograms of a pixel, would not fit.
    """
    if system.detector.crosstalk is not None:
        raise ValueError(
            "compare draws single pixels, which crosstalk ties to their neighbours, got "
            f"crosstalk={system.detector.crosstalk!r}; simulate whole images with engine 'sequential'"
        )
    chosen = _engines(engines, against)
    n = checks.integer("realizations", realizations, low=50, high=10**7)
    cubes = checks.integer("repeats", repeats, low=1, high=1000)
    seed = checks.integer("seed", seed, low=0, high=2**64 - 1)
    team, flux = thread_count(threads), flux.image
    depth = np.asarray(system.depth_m(flux.delay_ns % system.period_ns)) if depth_m is None else np.asarray(depth_m)
    places = example_pixels(flux, depth) if pixels is None else pixels
    for name, (y, x) in places.items():
        if not (0 <= y < flux.shape[0] and 0 <= x < flux.shape[1]):
            raise ValueError(f"pixels must lie in the image of shape {flux.shape}, got {name!r} at ({y}, {x})")
    each = system.bins * system.histogram_dtype.itemsize
    check_memory(n * each, f"{n} histograms", "ask for fewer realizations")
    check_memory(flux.background.size * each, f"a cube of {flux.shape} pixels", "compare a smaller image")

    tell, done = callback_of(progress, "comparing"), 0
    expected, laws, unpredicted = Expected.of(flux, system, team), dict[str, PixelLaw](), dict[str, str]()
    windows = {name: signal_window(flux, system, y, x) for name, (y, x) in places.items()}
    for name, place in places.items():
        try:
            laws[name] = PixelLaw.of(flux[place], system, windows[name], team)
        except (ConvergenceError, ValueError) as error:
            unpredicted[name] = str(error)
    scenes, skipped = dict[str, SceneStatistics](), dict[str, str]()
    statistics = {name: dict[str, PixelStatistics]() for name in places}
    whole, table = _with_table(chosen, flux, system, team)
    for name, engine in chosen.items():
        stream = _stream(seed, name)
        try:
            engine.check(flux, system)
            drawn, seconds = _timed(flux, system, whole[name], cubes, stream, team)
        except (ValueError, ConvergenceError) as error:
            if name == against:
                raise
            skipped[name] = str(error)
            continue
        other = scenes[against].mean_counts if against in scenes else None
        scenes[name] = SceneStatistics.of(drawn, seconds, expected, other)
        for pixel, (y, x) in places.items():
            histograms = simulate(
                flux[y : y + 1, x : x + 1],
                system,
                engine=engine,
                realizations=n,
                pixel_index=np.array([y * flux.shape[1] + x], dtype=np.int64),
                seed=stream,
                threads=team,
            ).reshape(n, -1)
            row = statistics[pixel]
            row[name] = PixelStatistics.of(histograms, windows[pixel], laws.get(pixel), row.get(against))
        done += 1
        if tell is not None:
            tell(done, len(chosen))
    order = [name for name in _names(engines, against) if name in scenes]
    return Comparison(
        flux,
        system,
        against,
        n,
        expected,
        {name: scenes[name] for name in order},
        places,
        laws,
        {pixel: {name: row[name] for name in order} for pixel, row in statistics.items()},
        skipped,
        unpredicted,
        table,
    )


def signal_window(flux: Flux, system: System, y: int, x: int) -> NDArray[np.bool_]:
    """Bins (bins,) where the signal's rate exceeds exp(-9/2) of its largest; none without a signal."""
    signal = incident_rate(flux, system, y, x) - flux.background[y, x] / system.bins
    return np.asarray(signal > max(_WINDOW_EDGE * float(signal.max()), 1e-12 * float(flux.total[y, x])))


def _timed(
    flux: Flux, system: System, engine: Engine, repeats: int, seed: int, threads: int
) -> tuple[FloatArray, list[float]]:
    """Counts (repeats, H, W) of cubes drawn one after another, and the seconds that each takes."""
    cube = np.zeros((1, *flux.shape, system.bins), system.histogram_dtype)
    cube.fill(0)  # zeros alone is memory that is not there yet
    seconds, counts = [], []
    for k in range(repeats):
        began = time.perf_counter()
        simulate(flux, system, engine=engine, first_realization=k, seed=seed, threads=threads, out=cube)
        seconds.append(time.perf_counter() - began)
        counts.append(cube[0].sum(-1, dtype=np.int64))
    return np.array(counts, dtype=np.float64), seconds


def _names(engines: Sequence[str | Engine], against: str) -> list[str]:
    """In the order asked for, the reference first where nobody asked for it."""
    names = [e.name if isinstance(e, Engine) else e for e in engines] or list(ENGINES)
    return names if against in names else [against, *names]


def _engines(engines: Sequence[str | Engine], against: str) -> dict[str, Engine]:
    """Engines by name, the reference first: the others are compared with it."""
    given = {e.name if isinstance(e, Engine) else e: find_engine(e) for e in engines} or dict(ENGINES)
    checks.choice("against", against, tuple(ENGINES | given))
    return {against: given.pop(against, None) or ENGINES[against], **given}


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


def _stream(seed: int, engine: str) -> int:
    """Seed of an engine's own streams; whatever other engines are run beside it."""
    state = np.random.SeedSequence([seed, zlib.crc32(engine.encode())]).generate_state(1, np.uint64)
    return int(state[0])
