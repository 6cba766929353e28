"""Study "table": errors of lookup tables against the exact law of each pixel, over systems and the table's size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar import Flux, QuantisationError, System, Table, count_law
from mars_lidar.statistics import exposure_moments
from mars_lidar.statistics.matched import matched_pmf
from mars_lidar.statistics.pmf import Pmf, total_variation
from mars_lidar.table.error import random_pixels
from studies import Facts, Request
from studies.common.report import Row
from studies.common.sample import system_of

SEED = 20263
LOW, HIGH = 0.01, 10.0  # photons per period, of both axes
DIM = 0.1  # photons per period, signal and background each
START_UP_TOLERANCE = 1e-5
_CASES: tuple[Mapping[str, Any], ...] = (
    {"dead_time_ns": 75.0},
    {"dead_time_ns": 85.0},
    {"dead_time_ns": 85.0, "start": "stationary"},
    {"dead_time_ns": 85.0, "method": "mars"},
    {"dead_time_ns": 13.0},
    {"dead_time_ns": 130.2},
    {"dead_time_ns": 75.0, "cycles": 20},
)
# dead time (ns), cycles: the start-up
_STARTS = ((75.0, 100), (75.0, 1000), (75.0, 10_000), (85.0, 1000), (13.0, 1000), (130.2, 1000), (200.0, 1000))
_AT_DELAY = "interpolation mean_rms mean_max variance_max third_max fourth_max shape_mean shape_max"
_DELAYED = "delayed_mean_max delayed_variance_max delayed_shape_max"
_COLUMNS = {key: key.replace("delayed_", "delayed: ").replace("_", " ") for key in f"{_AT_DELAY} {_DELAYED}".split()}


@dataclass(frozen=True)
class Settings:
    """Points in S and B of the tables of all systems and of others of the first, and how much is measured of each.

    `samples` pixels for cumulants and shape, `laws` for the count law; `cells` and `delays` of the start-up; the first
    so many `systems`.
    """

    points: tuple[int, int]
    sizes: tuple[tuple[int, int], ...]
    samples: int
    laws: int
    cells: int
    delays: int
    systems: int | None = None


FULL = Settings((256, 100), ((16, 10), (32, 20), (64, 25), (128, 50)), samples=400, laws=60, cells=13, delays=24)
QUICK = Settings((24, 16), ((8, 6),), samples=20, laws=4, cells=4, delays=4, systems=1)


@dataclass(frozen=True, eq=False)
class Case:
    """One table, and its errors between entries: bilinear, nearest."""

    table: Table
    errors: tuple[QuantisationError, QuantisationError]
    law: Row

    @classmethod
    def of(cls, settings: Settings, points: tuple[int, int], case: Mapping[str, Any]) -> Case:
        """Build and measure."""
        system = system_of(case["dead_time_ns"], case.get("cycles", 1000), start=case.get("start", "armed"))
        axes = [(LOW, HIGH, number) for number in points]
        table = Table.build(system, *axes, method=case.get("method", "exposure"))
        errors = (
            table.quantisation_error(samples=settings.samples, seed=SEED),
            table.quantisation_error(interpolation="nearest", samples=settings.samples, seed=SEED),
        )
        return cls(table, errors, law_error(table, settings.laws))

    def rows(self) -> Iterator[Row]:
        """Lines of the table of errors between the entries."""
        system = self.table.system
        name = {
            "entries": f"{self.table.signal.size} x {self.table.background.size}",
            "t_d, ns": system.detector.dead_time_ns,
            "start": system.start,
            "method": self.table.method,
            "N_r": system.cycles,
        }
        for errors in self.errors:
            yield name | {words: getattr(errors, key) for key, words in _COLUMNS.items()}

    @property
    def longest(self) -> QuantisationError | None:
        """The errors at 1e8 cycles, where every entry serves them."""
        made = self.table.provenance["error_longest"]
        return None if made is None else QuantisationError(**made)


def run(settings: Settings, request: Request) -> Facts:
    """All tables, built and measured, and the start-up that their shapes leave out."""
    cases, sizes = [], []
    for case in _CASES[: settings.systems]:
        cases.append(Case.of(settings, settings.points, case))
        request.tell(f"table: {case}")
    for points in settings.sizes:
        sizes.append(Case.of(settings, points, _CASES[0]))
        request.tell(f"table: {points[0]} x {points[1]} points")
    starts = [start_up(*case, settings.cells, settings.delays) for case in _STARTS[: settings.systems]]
    rows = [row for case in (*sizes, *cases) for row in case.rows()]
    return {"cases": cases, "sizes": [*sizes, cases[0]], "starts": starts, "rows": rows, "tables": {"start": starts}}


def law_error(table: Table, samples: int) -> Row:
    """Total variation between count laws at random pixels: that with the table's four cumulants, and the exact one.

    It includes the errors of interpolation, of the correction for the start phase and of the law.
    """
    rng, system = np.random.default_rng(SEED), table.system
    signal, background = (random_pixels(rng, axis, samples, True) for axis in (table.signal, table.background))
    delay = rng.uniform(0.0, system.period_ns, samples)
    law = table.at(signal, background, delay)
    exact = count_law(Flux(signal, background, delay), system, tolerance=table.tolerance)
    laws = (Pmf(int(first), p) for first, p in zip(exact.support[:, 0], exact.pmf, strict=True))
    off = np.array([total_variation(*both) for both in zip(matched_pmf(law.cumulants), laws, strict=True)])
    good, worst = law.trusted(), int(off.argmax())
    return {
        "TV mean": float(off.mean()),
        "TV max": float(off[worst]),
        "within 0.002": float(np.mean(off <= 0.002)),
        "trusted": float(good.mean()),
        "TV max of those": float(off[good].max(initial=0.0)),
        "worst S": float(signal[worst]),
        "worst B": float(background[worst]),
    }


def start_up(dead_ns: float, cycles: int, points: int, delays: int) -> Row:
    """How far the shape of the canonical delay, moved to another, is from the exact one: the worst delay of each cell.

    Exact mean histograms alone: what a table without any error of interpolation would give.
    """
    system, levels = system_of(dead_ns, cycles), np.geomspace(LOW, HIGH, points)

    def exact(delay_ns: float, of: System = system) -> Any:
        return exposure_moments(Flux(levels[:, None], levels, delay_ns), of, tolerance=START_UP_TOLERANCE)

    middle, variation = 0.5 * system.period_ns, []
    canonical = exact(middle)
    for shift in np.arange(1, delays) * system.bins // delays:
        mean = exact(middle + shift * system.bin_ns).histogram
        count = mean.sum(-1, keepdims=True)
        moved = np.roll(canonical.histogram, shift, axis=-1)
        moved = moved * (count / moved.sum(-1, keepdims=True))
        variation.append(0.5 * np.abs(moved - mean).sum(-1) / count[..., 0])
    worst = np.max(variation, axis=0)
    at = np.unravel_index(worst.argmax(), worst.shape)
    dim = levels <= 1.001 * DIM
    return {
        "t_d, ns": dead_ns,
        "N_r": cycles,
        "TV median": float(np.median(worst)),
        "TV max": float(worst.max()),
        "at S": float(levels[at[0]]),
        "at B": float(levels[at[1]]),
        "displaced, most": float((worst * canonical.mean).max()),
        "dim: TV max": float(worst[np.ix_(dim, dim)].max()),
    }
