"""How well a table answers between its nodes, and how close its count laws are: on random pixels, by exact laws."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.threads import thread_count
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.distance import Pmf, total_variation
from mars_lidar.statistics.exposure import exposure_moments, normalised
from mars_lidar.statistics.law import count_law
from mars_lidar.statistics.phase_chain import ConvergenceError
from mars_lidar.table.nodes import INTERPOLATIONS, Interpolation, Nodes
from mars_lidar.table.recipe import Recipe

# total variation between normal laws that differ a little: 0.399 per standard deviation of the mean, 0.242 per
# relative change of the variance
_TV_MEAN, _TV_VARIANCE = 1.0 / math.sqrt(2.0 * math.pi), 1.0 / math.sqrt(2.0 * math.pi * math.e)
_LEAST_SPREAD = 0.5  # below it a count is a lottery between two integers, and errors matter in counts
MOST_CYCLES = 10**8  # of a System: the exposure at which errors of the mean are largest


@dataclass(frozen=True)
class QuantisationError:
    """Errors of a table on random pixels between its nodes.

    Errors of the cumulants are in units of powers of the standard deviation, at least 1/2 count. Those called
    `delayed` are at random delays, where an armed start gives another law; the others at the canonical t_r / 2.
    All hold for exposures of `cycles` periods: an error of the mean count per period grows with the exposure, the
    standard deviation with its root, so that errors of the mean in standard deviations grow as the root of the
    exposure. Those of the variance and of the shape do not grow.

    Attributes
    ----------
    interpolation, samples, cycles
        What was measured, on how many pixels, for exposures of how many periods.
    mean_rms, mean_max, variance_rms, variance_max, third_max, fourth_max
        Of the cumulants.
    shape_mean, shape_max
        Total variation between the mixture of shapes and the pixel's own.
    delayed_mean_max, delayed_variance_max, delayed_shape_max
        The same at random delays. The shape is shifted by whole bins, so that nothing but the table errs.
    law_max
        Largest of 0.399 ``|error of the mean|`` + 0.242 ``|error of the variance|``: the total variation between two
        normal laws, to first order; delays included.
    worst_signal, worst_background
        The pixel of `law_max` or `shape_max`, whichever is larger.
    """

    interpolation: str
    samples: int
    cycles: int
    mean_rms: float
    mean_max: float
    variance_rms: float
    variance_max: float
    third_max: float
    fourth_max: float
    shape_mean: float
    shape_max: float
    delayed_mean_max: float
    delayed_variance_max: float
    delayed_shape_max: float
    law_max: float
    worst_signal: float
    worst_background: float

    @property
    def largest(self) -> float:
        """Total variation that the table may be off by: the larger of `law_max` and `shape_max`."""
        return max(self.law_max, self.shape_max)

    def cycles_within(self, allowed: float = 0.05) -> int:
        """Periods up to which the mean is within `allowed` standard deviations, from 1 to 1e8.

        From the error measured at `cycles`, by its growth with the root of the exposure: most exact where measured at
        1e8 cycles, since a standard deviation below half a count, for which short exposures are excused, is excused
        no longer.
        """
        allowed = checks.real("allowed", allowed, low=0.0, strict_low=True)
        worst = max(self.mean_max, self.delayed_mean_max, 1e-300)
        return max(1, int(min(self.cycles * (allowed / worst) ** 2, MOST_CYCLES)))

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self)


def long_error(table: Nodes, samples: int, threads: int | None) -> QuantisationError | None:
    """Errors at the longest exposure, 1e8 cycles; None where some entry does not serve it, or has no exact law."""
    if table.system.cycles != MOST_CYCLES and not table.entries.serves(MOST_CYCLES).all():
        return None
    try:
        return quantisation_error(table, samples=samples, cycles=MOST_CYCLES, threads=threads)
    except ConvergenceError:  # the law of a random pixel between the entries, which is much of a locked one
        return None


def quantisation_error(
    table: Nodes,
    *,
    interpolation: Interpolation = "bilinear",
    samples: int = 200,
    seed: int = 0,
    cycles: int | None = None,
    threads: int | None = None,
) -> QuantisationError:
    """Errors on random pixels between the nodes, against the law of each evaluated directly.

    Parameters
    ----------
    interpolation, cycles
        As `lookup`.
    samples, seed
        Pixels, log-uniform over the axes, with random delays; with ``"bilinear"`` one in eight lies between 0
        and the lowest value, where the axis has a 0.
    """
    checks.choice("interpolation", interpolation, INTERPOLATIONS)
    samples = checks.integer("samples", samples, low=1, high=1_000_000)
    rng = np.random.default_rng(checks.integer("seed", seed, low=0, high=2**64 - 1))
    periods = table.system.cycles if cycles is None else checks.integer("cycles", cycles, low=1, high=10**8)
    system = table.system.replace(cycles=periods)
    below = interpolation == "bilinear"  # the nearest entry knows nothing between 0 and the lowest value
    signal, background = (random_pixels(rng, axis, samples, below) for axis in (table.signal, table.background))
    recipe = Recipe(table.method, table.rearm, table.tolerance, thread_count(threads))
    exact = recipe.entries(signal, background, system)
    found = table.lookup(signal, background, cycles=periods, interpolation=interpolation)
    shapes = table.shapes(periods)
    mixed = np.stack([w @ shapes[r] for r, w in zip(found.rows, found.weights, strict=True)])
    error = deviations(found.cumulants, exact.cumulants)
    shape = 0.5 * np.abs(mixed - exact.shape).sum(-1)
    delayed, delayed_shape = error, shape
    if table.method == "exposure":
        delayed, delayed_shape = _delayed(table, interpolation, rng, signal, background, mixed, periods, threads)
    law = np.maximum(law_variation(error), law_variation(delayed))
    worst = int(np.argmax(np.maximum(law, shape)))
    return QuantisationError(
        interpolation=interpolation,
        samples=samples,
        cycles=periods,
        mean_rms=float(np.sqrt(np.mean(error[:, 0] ** 2))),
        mean_max=float(error[:, 0].max()),
        variance_rms=float(np.sqrt(np.mean(error[:, 1] ** 2))),
        variance_max=float(error[:, 1].max()),
        third_max=float(error[:, 2].max()),
        fourth_max=float(error[:, 3].max()),
        shape_mean=float(shape.mean()),
        shape_max=float(shape.max()),
        delayed_mean_max=float(delayed[:, 0].max()),
        delayed_variance_max=float(delayed[:, 1].max()),
        delayed_shape_max=float(delayed_shape.max()),
        law_max=float(law.max()),
        worst_signal=float(signal[worst]),
        worst_background=float(background[worst]),
    )


def deviations(cumulants: FloatArray, exact: FloatArray) -> FloatArray:
    """Errors (P, 4) of cumulants in powers of the standard deviation, of at least half a count."""
    return np.abs(cumulants - exact) / np.maximum(np.sqrt(exact[:, 1:2]), _LEAST_SPREAD) ** np.arange(1, 5)


def law_variation(error: FloatArray) -> FloatArray:
    """Total variation (P,) between two normal laws with such `deviations`, to first order."""
    return error[:, 0] * _TV_MEAN + error[:, 1] * _TV_VARIANCE


def random_pixels(rng: np.random.Generator, axis: FloatArray, samples: int, below: bool) -> FloatArray:
    """Random values of an axis: log-uniform, and if `below` one in eight in the cell that begins at 0."""
    positive = axis[axis > 0]
    if positive.size == 0:
        return np.zeros(samples)
    values = np.exp(rng.uniform(np.log(positive[0]), np.log(positive[-1]), samples))
    values = np.clip(values, positive[0], positive[-1])
    if below and axis[0] == 0.0:
        low = rng.random(samples) < 0.125
        values[low] = positive[0] * rng.random(int(low.sum()))
    return values


def _delayed(
    table: Nodes,
    interpolation: Interpolation,
    rng: np.random.Generator,
    signal: FloatArray,
    background: FloatArray,
    mixed: FloatArray,
    cycles: int,
    threads: int | None,
) -> tuple[FloatArray, FloatArray]:
    """Errors (P, 4) and (P,) of cumulants and shape at random delays, whole bins from the canonical one."""
    system = table.system.replace(cycles=cycles)
    shift = rng.integers(0, system.bins, signal.size)
    delay = 0.5 * system.period_ns + shift * system.bin_ns
    exact = exposure_moments(signal, background, system, delay_ns=delay, tolerance=table.tolerance, threads=threads)
    found = table.lookup(signal, background, delay_ns=delay, cycles=cycles, interpolation=interpolation)
    turned = np.stack([np.roll(row, k) for row, k in zip(mixed, shift, strict=True)])
    return deviations(found.cumulants, exact.cumulants), 0.5 * np.abs(turned - normalised(exact.histogram)).sum(-1)


@dataclass(frozen=True)
class LawError:
    """Total variation between count laws at random pixels: that with the table's four cumulants, and the exact one.

    Interpolation, start-phase correction and the law itself (`statistics.matched.matched_pmf`) err together here.

    Attributes
    ----------
    samples, cycles
        Pixels, and periods of the exposure.
    mean, largest
        Of the total variation.
    within
        Share of pixels within 0.002.
    trusted
        Share of pixels that `statistics.matched.trusted` holds to be within 0.002.
    largest_trusted
        Largest total variation among those.
    worst_signal, worst_background, worst_delay_ns
        The pixel of `largest`.
    """

    samples: int
    cycles: int
    mean: float
    largest: float
    within: float
    trusted: float
    largest_trusted: float
    worst_signal: float
    worst_background: float
    worst_delay_ns: float

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self)


def law_error(
    table: Nodes, *, samples: int = 50, seed: int = 0, cycles: int | None = None, threads: int | None = None
) -> LawError:
    """Total variation, on random pixels, between the count law that the table leads to and the exact one.

    Some 10 to 20 ms a pixel. Parameters as `quantisation_error`.
    """
    from mars_lidar.statistics.matched import matched_pmf

    samples = checks.integer("samples", samples, low=1, high=100_000)
    rng = np.random.default_rng(checks.integer("seed", seed, low=0, high=2**64 - 1))
    system = table.system if cycles is None else table.system.replace(cycles=cycles)
    signal, background = (random_pixels(rng, axis, samples, True) for axis in (table.signal, table.background))
    delay = rng.uniform(0.0, system.period_ns, samples)
    found = table.lookup(signal, background, delay_ns=delay, cycles=system.cycles)
    exact = count_law(signal, background, system, delay_ns=delay, tolerance=table.tolerance, threads=threads)
    matched = matched_pmf(found.cumulants, threads=threads)
    off = np.array([total_variation(w, Pmf(int(exact.support[k, 0]), exact.pmf[k])) for k, w in enumerate(matched)])
    good = found.trusted()
    worst = int(off.argmax())
    return LawError(
        samples=samples,
        cycles=system.cycles,
        mean=float(off.mean()),
        largest=float(off[worst]),
        within=float(np.mean(off <= 0.002)),
        trusted=float(good.mean()),
        largest_trusted=float(off[good].max()) if good.any() else 0.0,
        worst_signal=float(signal[worst]),
        worst_background=float(background[worst]),
        worst_delay_ns=float(delay[worst]),
    )
