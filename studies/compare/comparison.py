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
from mars_lidar.plot.views import by_signal, example_pixels, incident_rate, with_pixels
from mars_lidar.statistics import ConvergenceError, count_law, exposure_moments, joint_law, mean_histogram
from mars_lidar.statistics.count_pmf import Pmf
from studies.compare.sample import Distance, Estimate, Moments, Sample, law_distance, ratio, score, shape_distance

_PIXELS = 4096  # of an image, at most: a larger one is predicted on a coarser grid
_WAVEFORMS = 256  # the same where each pixel has a shape of its own
_CHUNK = 64
_LAG_BINS = 2048  # beyond them the lag-1 covariance, which needs every bin as a window, takes seconds


@dataclass(frozen=True, eq=False)
class PixelLaw:
    """Exact law of one pixel.

    Attributes
    ----------
    cumulants, pmf
        (4,) cumulants and probabilities of the count.
    histogram
        (bins,) mean.
    window
        (2,) mean and variance of the count in the signal window, or None.
    lag1
        Sum over all bins of Cov(h_j, h_j+1), cyclic, over the mean count, or NaN.
    """

    cumulants: FloatArray
    pmf: Pmf
    histogram: FloatArray
    window: FloatArray | None
    lag1: float

    @property
    def counts(self) -> Moments:
        """Mean, variance, Fano factor."""
        return Moments.certain(self.cumulants)


@dataclass(frozen=True, eq=False)
class Expected:
    """Exact mean and variance of the count on every `step`-th row and column of an image.

    `mean` and `variance` are (ceil(H / step), ceil(W / step)), NaN where there was no time or no result.
    """

    step: int
    mean: FloatArray
    variance: FloatArray
    seconds: float

    @property
    def known(self) -> NDArray[np.bool_]:
        """Pixels of that grid that have a prediction."""
        return np.isfinite(self.mean)

    def on_grid(self, image: NDArray[np.float64]) -> FloatArray:
        """An image (..., H, W) at the pixels of the grid."""
        return image[..., :: self.step, :: self.step]


def pixel_law(flux: Flux, system: System, y: int, x: int, window: NDArray[np.bool_], threads: int) -> PixelLaw | str:
    """Exact law of pixel (y, x), or why there is none: no convergence, a detector without exact statistics."""
    try:
        law = count_law(flux[y, x], system, threads=threads)
        histogram = mean_histogram(flux[y, x], system, threads=threads)
        pmf = Pmf(int(law.support[0]), law.pmf)
    except (ConvergenceError, ValueError) as error:
        return str(error)
    return PixelLaw(law.cumulants, pmf, histogram, *_joint(flux[y, x], system, window))


def _joint(pixel: Flux, system: System, window: NDArray[np.bool_]) -> tuple[FloatArray | None, float]:
    """`PixelLaw.window` and `.lag1`, as far as the closed form has them in a second or so."""
    try:
        joint = joint_law(pixel, system)
        moments = np.array(joint.window(window.astype(np.float64))) if window.any() else None
    except (ConvergenceError, ValueError):
        return None, math.nan
    quick = system.bins <= _LAG_BINS and joint.settled >= 0  # else each window is run through the exposure
    return moments, float(joint.lag(1).sum()) / joint.count_mean if quick and joint.count_mean > 0 else math.nan


def expected_counts(flux: Flux, system: System, threads: int, budget_s: float) -> Expected:
    """Exact count statistics over an image, in random order until `budget_s` ends."""
    shaped = flux.waveform is not None or len(flux.returns_signal) > 1
    most, step = (_WAVEFORMS if shaped else _PIXELS), 1
    while -(-flux.shape[0] // step) * -(-flux.shape[1] // step) > most:
        step += 1
    rows, columns = np.meshgrid(*(np.arange(0, n, step) for n in flux.shape), indexing="ij")
    y, x = rows.ravel(), columns.ravel()
    cumulants = np.full((y.size, 4), np.nan)
    order = np.random.default_rng(0).permutation(y.size)
    began = time.perf_counter()

    def in_time(done: int, total: int) -> None:
        if time.perf_counter() - began > budget_s:
            raise _OutOfTimeError

    chunk = 1 if shaped else _CHUNK
    for first in range(0, y.size, chunk):
        part = order[first : first + chunk]
        try:
            in_time(first, y.size)
            cumulants[part] = exposure_moments(
                flux.pixels(y[part] * flux.shape[1] + x[part]),
                system.replace(bins=1),
                threads=threads,
                progress=in_time,
            ).cumulants
        except ConvergenceError:
            continue
        except (_OutOfTimeError, ValueError):  # ValueError: a detector without exact statistics
            break
    mean, variance = (cumulants[:, k].reshape(rows.shape) for k in (0, 1))
    return Expected(step, mean, variance, time.perf_counter() - began)


class _OutOfTimeError(Exception):
    pass


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
    bias
        Mean over the predicted pixels of (mean count - expected) / standard deviation of the count.
    relative_bias
        Total counts over the expected total - 1; over the reference engine's total where nothing is predicted.
    dispersion
        Mean of (count - expected)^2 / variance over pixels and cubes: 1 where mean and variance are right.
    """

    engine: str
    seconds: tuple[float, ...]
    registrations: float
    mean_counts: FloatArray
    bias: Estimate
    relative_bias: Estimate
    dispersion: Estimate

    @property
    def median_s(self) -> float:
        """Median wall time of a cube."""
        return float(np.median(self.seconds))

    @property
    def ns_per_registration(self) -> float:
        """Median time of a cube over its registrations."""
        return 1e9 * self.median_s / self.registrations if self.registrations > 0 else math.nan


def scene_statistics(
    flux: Flux,
    system: System,
    engine: Engine,
    expected: Expected,
    repeats: int,
    seed: int,
    threads: int,
    budget_s: float,
    reference: SceneStatistics | None,
) -> SceneStatistics:
    """Draw up to `repeats` cubes of an image one after another; fewer where `budget_s` ends."""
    cube = np.zeros((1, *flux.shape, system.bins), system.histogram_dtype)
    cube.fill(0)  # zeros alone is memory that is not there yet
    seconds: list[float] = []
    counts: list[NDArray[np.int64]] = []
    while len(seconds) < repeats and sum(seconds) < budget_s:
        began = time.perf_counter()
        simulate(
            flux,
            system,
            engine=engine,
            first_realization=len(seconds),
            seed=seed,
            threads=threads,
            out=cube,
        )
        seconds.append(time.perf_counter() - began)
        counts.append(cube[0].sum(-1, dtype=np.int64))
    drawn = np.array(counts, dtype=np.float64)
    bias, dispersion = _against(expected, drawn)
    return SceneStatistics(
        engine=engine.name,
        seconds=tuple(seconds),
        registrations=float(drawn.sum() / len(drawn)),
        mean_counts=drawn.mean(0),
        bias=bias,
        relative_bias=_relative(expected, drawn, reference),
        dispersion=dispersion,
    )


def _against(expected: Expected, drawn: FloatArray) -> tuple[Estimate, Estimate]:
    """Bias in standard deviations and dispersion; errors from the spread over pixels, which are independent."""
    use = expected.known & (expected.variance > 0)
    if use.sum() < 2:
        return Estimate(math.nan), Estimate(math.nan)
    deviation = (expected.on_grid(drawn)[:, use] - expected.mean[use]) / np.sqrt(expected.variance[use])
    return _mean(deviation.mean(0), 0.0), _mean((deviation**2).mean(0), 1.0)


def _relative(expected: Expected, drawn: FloatArray, reference: SceneStatistics | None) -> Estimate:
    if expected.known.sum() > 1:
        total = float(expected.mean[expected.known].sum())
        difference = (expected.on_grid(drawn).mean(0) - expected.mean)[expected.known]
    elif reference is not None:
        total = float(reference.mean_counts.sum())
        difference = (drawn.mean(0) - reference.mean_counts).ravel()
    else:
        return Estimate(math.nan)
    if total <= 0.0 or difference.size < 2:
        return Estimate(math.nan)
    value = _mean(difference, 0.0)
    return Estimate(value.value * difference.size / total, value.error * difference.size / total, value.z)


def _mean(values: FloatArray, goal: float) -> Estimate:
    """Mean of independent values (n,)."""
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(values.size)
    return Estimate(mean, error, score(mean - goal, error))


_FIRST_BATCH = 50  # realizations after which the time for the rest is known
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
        Sum over all bins of Cov(h_j, h_j+1) over the mean count, and its difference to the prediction, or to
        the reference engine where there is none.
    shape, law
        Total variation of the mean histogram's shape, and of the law of the count.
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


def telling_pixels(flux: Flux, depth_m: NDArray[np.float64], number: int) -> dict[str, tuple[int, int]]:
    """Up to `number` (1 to 6) pixels (y, x) by name.

    A bright, a dim and an edge pixel (see `example_pixels`); one of median signal; the most photons of all,
    where dead time bends most; the least, where laws are far from Gaussian. Fewer where they coincide.
    """
    count = checks.integer("pixels", number, low=1, high=6)
    named = example_pixels(flux, depth_m)
    inside, order = by_signal(flux)
    order = order if order.size else np.flatnonzero(inside)
    some = np.sort(order)
    by_total = some[np.argsort(flux.total.ravel()[some], kind="stable")]
    more = {"median": order[(order.size - 1) // 2], "most": by_total[-1], "least": by_total[0]}
    return dict(list(with_pixels(named, more, flux).items())[:count])


def signal_window(flux: Flux, system: System, y: int, x: int) -> NDArray[np.bool_]:
    """Bins (bins,) where the signal's rate exceeds exp(-9/2) of its largest; none without a signal."""
    signal = incident_rate(flux, system, y, x) - flux.background[y, x] / system.bins
    return np.asarray(signal > max(_WINDOW_EDGE * float(signal.max()), 1e-12 * float(flux.total[y, x])))


def draw_pixel(
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
            alone,
            system,
            engine=engine,
            realizations=len(part),
            first_realization=made,
            pixel_index=place,
            seed=seed,
            threads=team,
            out=part,
        )
        made += len(part)
        each = (time.perf_counter() - began) / made
        batch = min(2 * batch, n - made, int((budget_s - each * made) / each))
        if batch <= 0:
            break
    return out[:made]


def pixel_statistics(
    name: str, pixel: str, sample: Sample, law: PixelLaw | None, reference: Sample | None, random: np.random.Generator
) -> PixelStatistics:
    """One engine against the prediction, and against the reference engine in what has none."""
    theirs = None if reference is None else Moments.of(reference.counts)
    counts = Moments.of(sample.counts, cumulants=None if law is None else law.cumulants, other=theirs)
    window, window_ratio = _window_moments(sample, law, reference)
    lag1, goal = sample.lag1, Estimate(np.nan)
    if law is not None and np.isfinite(law.lag1):
        goal = Estimate(law.lag1, 0.0)
    elif reference is not None:
        goal = reference.lag1
    error, difference = float(np.hypot(lag1.error, goal.error)), lag1.value - goal.value
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
        lag1_error=Estimate(difference, error, score(difference, error)),
        shape=unknown if shape_goal is None else shape_distance(sample, shape_goal, random),
        law=unknown if law_goal is None else law_distance(sample, law_goal, random),
    )


def _window_moments(sample: Sample, law: PixelLaw | None, reference: Sample | None) -> tuple[Moments, Estimate]:
    """Moments of the count in the window, and its variance over that of the reference."""
    nothing = Estimate(np.nan)
    if not sample.window.any():
        return Moments(nothing, nothing, nothing), nothing
    others = None if reference is None else Moments.of(reference.window_counts)
    known = None
    if law is not None and law.window is not None:
        known = np.append(law.window, (0.0, 0.0))  # a Gaussian's: they only keep errors from being too small
    window = Moments.of(sample.window_counts, cumulants=known, other=others)
    if others is not None:
        return window, ratio(window.variance, others.variance)
    own = window.variance
    return window, Estimate(1.0, own.error / own.value if own.value > 0 else np.nan)


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
