"""Study "quantisation": errors of a table lookup, nearest and interpolated, over the number of entries."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import Flux, System, Table
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS
from mars_lidar.statistics import Exposure, exposure_moments
from mars_lidar.statistics.count_pmf import total_variation
from mars_lidar.statistics.matched import matched_pmf
from studies import Facts, Request, Tell
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.common.sample import PERIOD_NS, system_of

Interpolation = Literal["nearest", "bilinear"]

INTERPOLATIONS: tuple[Interpolation, ...] = ("nearest", "bilinear")
_DASH = dict(zip(INTERPOLATIONS, ("--", "-"), strict=True))
LOW, HIGH = 0.01, 10.0  # photons per period, of both axes
VISIBLE = 0.002  # total variation of the count law, or standard deviations of the mean, that a lookup may cost
ERRORS = {  # in words
    "mean": "mean, standard deviations",
    "variance": "variance, relative",
    "shape": "shape, total variation",
    "law": "count law, total variation",
}


@dataclass(frozen=True)
class Settings:
    """Configuration of the study: table sizes (points in S, in B), dead times (ns), pixels to look up."""

    sizes: tuple[tuple[int, int], ...]
    dead_ns: tuple[float, ...]
    pixels: int
    cycles: int = 1000
    bins: int = 1024
    sigma_ns: float = 0.5
    seed: int = 20269

    def system(self, dead_ns: float) -> System:
        """Armed start."""
        return system_of(dead_ns, self.cycles, bins=self.bins, sigma_ns=self.sigma_ns)


FULL = Settings(
    sizes=((16, 10), (32, 20), (64, 25), (128, 50), (256, 100), (512, 200)),
    dead_ns=(75.0, 85.0),
    pixels=3000,
)
QUICK = Settings(sizes=((4, 3), (16, 12)), dead_ns=(75.0,), pixels=60, cycles=100, bins=128)


@dataclass(frozen=True, eq=False)
class Cost:
    """One table, one way to look up: errors (pixels,) by name, the table's size and seconds to build.

    `mean` in standard deviations of the count; `variance` relative; `shape` and `law` total variations.
    """

    dead_ns: float
    size: tuple[int, int]
    interpolation: Interpolation
    errors: dict[str, FloatArray]
    seconds: float
    megabytes: float


def compute(settings: Settings, tell: Tell) -> list[Cost]:
    """All tables and ways of lookup, on pixels drawn log-uniformly over the table's range."""
    random = np.random.default_rng(settings.seed)
    signal, background = np.exp(random.uniform(np.log(LOW), np.log(HIGH), (2, settings.pixels)))
    costs = []
    for dead_ns in settings.dead_ns:
        system = settings.system(dead_ns)
        truth = exposure_moments(Flux(signal, background, 0.5 * system.period_ns), system)
        for size in settings.sizes:
            began = time.perf_counter()
            table = Table.build(system, signal=(LOW, HIGH, size[0]), background=(LOW, HIGH, size[1]))
            seconds = time.perf_counter() - began
            shapes = table.shapes()
            for interpolation in INTERPOLATIONS:
                result = table.at(signal, background, interpolation=interpolation)
                errors = _errors(result.rows, result.weights, result.cumulants, shapes, truth)
                costs.append(Cost(dead_ns, size, interpolation, errors, seconds, shapes.nbytes / 1e6))
            tell(f"quantisation: t_d = {dead_ns:g} ns, {size[0]} x {size[1]} in {seconds:.1f} s")
    return costs


def _errors(
    rows: NDArray[np.int64],
    weights: FloatArray,
    cumulants: FloatArray,
    shapes: NDArray[np.float32],
    truth: Exposure,
) -> dict[str, FloatArray]:
    """Errors (pixels,) by name; the delay is the canonical one, so that only the fluxes are off the grid."""
    mean, variance = truth.mean, truth.variance
    expected = truth.histogram / mean[:, None]
    # one pixel at a time: no copies of the whole table
    mixed = (w @ shapes[r].astype(np.float64) for r, w in zip(rows, weights, strict=True))
    # the law of four cumulants for both, so that what is left is the lookup's
    laws = (matched_pmf(c) for c in (cumulants, truth.cumulants))
    return {
        "mean": np.abs(cumulants[:, 0] - mean) / np.sqrt(variance),
        "variance": np.abs(cumulants[:, 1] / variance - 1.0),
        "shape": np.array([0.5 * np.abs(m - e).sum() for m, e in zip(mixed, expected, strict=True)]),
        "law": np.array([total_variation(first, other) for first, other in zip(*laws, strict=True)]),
    }


def run(request: Request) -> Facts:
    """All tables and ways of lookup."""
    settings = QUICK if request.quick else FULL
    costs = compute(settings, request.tell)
    findings = []
    for dead, interpolation in product(settings.dead_ns, INTERPOLATIONS):
        here = [c for c in costs if c.dead_ns == dead and c.interpolation == interpolation]
        good = [c for c in here if np.quantile(c.errors["law"], 0.95) <= VISIBLE]
        least = min(good, key=lambda c: c.size[0] * c.size[1], default=None)
        findings.append((dead, interpolation, least, here[-1]))
    return {
        "s": settings,
        "period_ns": PERIOD_NS,
        "findings": findings,
        "costs": costs,
        "rows": [_csv_row(cost) for cost in costs],
        "figures": {"": _figure(settings, costs)},
    }


def _figure(settings: Settings, costs: Sequence[Cost]) -> Figure:
    figure, axes = panels(2.5, 1, len(ERRORS), sharex=True)
    for ax, key in zip(axes[0], ERRORS, strict=True):
        for (k, dead), (interpolation, dash) in product(enumerate(settings.dead_ns), _DASH.items()):
            here = [c for c in costs if c.dead_ns == dead and c.interpolation == interpolation]
            entries = [c.size[0] * c.size[1] for c in here]
            words = f"{interpolation}, $t_d$ = {dead:g} ns"
            ax.plot(entries, [c.errors[key].mean() for c in here], dash, color=COLOURS[k], lw=1.2, label=words)
            ax.plot(entries, [np.quantile(c.errors[key], 0.95) for c in here], dash, color=COLOURS[k], lw=0.5)
        ax.set(xscale="log", yscale="log", xlabel="entries")
        ax.tick_params(axis="x", which="minor", labelbottom=False)
        ax.set_title(ERRORS[key], loc="left", fontsize=7.0)
    legend_below(figure, axes[0, :1], 4)
    return figure


def _csv_row(cost: Cost) -> Row:
    row: dict[str, object] = {
        "dead_time_ns": cost.dead_ns,
        "signal_points": cost.size[0],
        "background_points": cost.size[1],
        "lookup": cost.interpolation,
        "megabytes": cost.megabytes,
        "build_seconds": cost.seconds,
    }
    for key in ERRORS:
        values = cost.errors[key]
        row |= {f"{key}_mean": float(values.mean()), f"{key}_95": float(np.quantile(values, 0.95))}
        row[f"{key}_largest"] = float(values.max())
    return row
