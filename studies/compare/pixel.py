"""One engine at one pixel of an image, and which pixels tell most about an engine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import Engine
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.plot.views import by_signal, example_pixels, incident_rate, with_pixels
from mars_lidar.simulation import simulate
from mars_lidar.statistics.count_pmf import Pmf
from studies.compare.expected import PixelLaw
from studies.compare.sample import Distance, Estimate, Moments, Sample, law_distance, ratio, score, shape_distance

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
        mean_histogram=sample.mean_histogram,
        frequencies=sample.law,
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
