"""Study "law": how far each count law is from the exact one, over flux, exposure and dead time.

With `--data` every law is also compared with reference cases that another program simulated. A case, a JSON file, holds
``S``, ``B`` (photons per period); ``tau``, ``sigma``, ``dead`` (laser periods); ``cycles``; and ``count``,
{registrations: realizations}: an exposure on [0, cycles), armed at 0, Gaussian pulse.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import CountLaw, Flux, System, count_law
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.matched import matched_pmf, trusted
from mars_lidar.statistics.pmf import Pmf, gaussian_pmf, total_variation
from studies import Facts, Request
from studies.common import distance
from studies.common.draw import maps
from studies.common.report import Row
from studies.common.sample import PERIOD_NS, log_points, system_of

LAWS = {
    "matched": "four cumulants",
    "gaussian": "best Gaussian",
    "mars": "mars, centre",
    "mars_edge": "mars, edge",
    "renewal": "renewal",
    "poisson": "Poisson",
}
AIM = 0.002  # total variation of the law of four cumulants
FEW, STILL, VISIBLE = 10.0, 1.0, 0.01  # E N below FEW, Var N below STILL, total variation above VISIBLE
MODERATE = 200.0  # E N from where a Poisson law is within VISIBLE of its Gaussian
LISTED = 0.25  # of the aim: all cells would be a large file of little news
_EDGES = (0.0, 0.2, 0.7, 2.3, 9.0, 100.0, np.inf)  # of the variance
_WORST = 12
_LOW, _HIGH = 1e-5, 1.0  # total variation on the colour scale
_REFERENCE_SEED, _REFERENCE_PERIOD_NS = 20262, 100.0
_LIMIT_Z, _LIMIT_P = 4.0, 1e-4
KEYS = ("S", "B", "tau", "sigma", "dead", "cycles", "count")

# E |z^3 - 3 z| / 12, z standard normal: total variation of the first Edgeworth term per unit of skewness
_PER_SKEWNESS = (1.0 + 4.0 * float(np.exp(-1.5))) / (6.0 * float(np.sqrt(2.0 * np.pi)))


@dataclass(frozen=True)
class Settings:
    """Grids over (S, B) for each dead time and number of cycles, and systems drawn at random."""

    signal: tuple[float, ...]
    background: tuple[float, ...]
    dead: tuple[float, ...]  # periods
    cycles: tuple[int, ...]
    stationary: tuple[tuple[float, int], ...]  # dead time and cycles, again with a stationary start
    systems: int  # drawn at random
    pixels: int  # of each
    draws: int  # of the bootstrap of a reference case
    sigma_ns: float = 0.5
    seed: int = 20272


FULL = Settings(
    signal=log_points(24),
    background=log_points(20),
    dead=(0.1, 0.5625, 0.6375, 0.95, 0.9766, 1.0, 1.53),
    cycles=(100, 1000, 10000),
    stationary=((0.1, 1000), (0.6375, 100), (0.9766, 1000), (1.53, 100)),
    systems=100,
    pixels=40,
    draws=20_000,
)
QUICK = Settings(log_points(4), log_points(3), (0.6375, 1.53), (100,), ((0.6375, 100),), systems=3, pixels=5, draws=500)


@dataclass(frozen=True, eq=False)
class Part:
    """Cells of one system: flux (cells,), exact cumulants (cells, 4), by law the distance to the exact one (cells,)."""

    kind: str  # "armed", "stationary", "random"
    system: System
    signal: FloatArray
    background: FloatArray
    cumulants: FloatArray
    distance: dict[str, FloatArray]
    trusted: NDArray[np.bool_]

    def name(self, k: int | np.intp) -> str:
        """One cell in words."""
        flux = f"S = {self.signal[k]:.3g}, B = {self.background[k]:.3g}"
        return f"{flux}, t_d = {self.system.dead_time_periods:.4g} t_r, {self.system.cycles} cycles"


def laws_of(flux: Flux, system: System) -> dict[str, CountLaw]:
    """Every law in closed form, of cells (cells,)."""
    law = partial(count_law, flux, system)
    exact = law("exact")
    assert exact.pmf is not None  # the longest of them, which may be refused
    marked = {"mars": law("mars"), "mars_edge": law("mars", rearm="edge")}
    return {"exact": exact} | marked | {name: law(name) for name in ("renewal", "poisson")}


def pmfs_of(laws: dict[str, CountLaw]) -> Iterator[dict[str, Pmf]]:
    """The laws of each cell: the exact one, and `LAWS` in their order."""
    exact = laws["exact"]
    for k, matched in enumerate(matched_pmf(exact.cumulants)):
        pmfs = {name: Pmf(int(law.support[k, 0]), law.pmf[k]) for name, law in laws.items()}
        pmfs |= {"matched": matched, "gaussian": gaussian_pmf(float(exact.mean[k]), float(exact.variance[k]))}
        yield {name: pmfs[name] for name in ("exact", *LAWS)}


def measure(kind: str, system: System, signal: FloatArray, background: FloatArray) -> Part:
    """Distances of every law to the exact law of each cell; NaN where that takes too long."""
    flux = Flux(signal, background, 0.5 * system.period_ns)
    far = np.full((len(LAWS), signal.size), np.nan)

    def fill(first: int, end: int) -> None:
        try:
            for k, pmfs in enumerate(pmfs_of(laws_of(flux[first:end], system)), first):
                far[:, k] = [total_variation(pmfs[name], pmfs["exact"]) for name in LAWS]
        except ConvergenceError:
            if end - first > 1:
                middle = (first + end) // 2
                fill(first, middle)
                fill(middle, end)

    fill(0, signal.size)
    cumulants = count_law(flux, system).cumulants
    by_law = dict(zip(LAWS, far, strict=True))
    return Part(kind, system, signal, background, cumulants, by_law, trusted(cumulants))


def grids(settings: Settings, tell: Callable[[str], object]) -> list[Part]:
    """The grids, armed first, then stationary."""
    signal, background = (g.ravel() for g in np.meshgrid(settings.signal, settings.background, indexing="ij"))
    cases = [("armed", dead, cycles) for dead in settings.dead for cycles in settings.cycles]
    parts = []
    for start, dead, cycles in cases + [("stationary", *case) for case in settings.stationary]:
        system = system_of(dead * PERIOD_NS, cycles, sigma_ns=settings.sigma_ns).replace(start=start)
        parts.append(measure(start, system, signal, background))
        tell(f"law: t_d = {dead:g} t_r, {cycles} cycles, {start}, {signal.size} cells")
    return parts


def drawn(settings: Settings, tell: Callable[[str], object]) -> list[Part]:
    """Systems at random: no threshold of the law of four cumulants or of `trusted` was set on them."""
    random = np.random.default_rng(settings.seed)
    parts = []
    for _ in range(settings.systems):
        dead, sigma = float(random.uniform(0.02, 2.5)), float(np.exp(random.uniform(*np.log([0.2, 3.0]))))
        cycles = round(float(np.exp(random.uniform(*np.log([30.0, 3000.0])))))
        signal, background = 10.0 ** random.uniform(-2.0, 1.0, (2, settings.pixels))
        parts.append(measure("random", system_of(dead * PERIOD_NS, cycles, sigma_ns=sigma), signal, background))
    tell(f"law: {settings.systems * settings.pixels} cells at random")
    return parts


class Cells:
    """Cells of several parts together whose exact law is known; `refused`: the number of the others."""

    def __init__(self, parts: Sequence[Part]) -> None:
        known = [np.isfinite(part.distance["matched"]) for part in parts]
        self.refused = sum(int((~some).sum()) for some in known)
        pairs = list(zip(parts, known, strict=True))
        self.distance = {law: np.concatenate([part.distance[law][some] for part, some in pairs]) for law in LAWS}
        self.cumulants = np.concatenate([part.cumulants[some] for part, some in pairs])
        self.trusted = np.concatenate([part.trusted[some] for part, some in pairs])
        self.cells = [(part, int(k)) for part, some in pairs for k in np.flatnonzero(some)]

    def where(self, law: str, here: NDArray[np.bool_] | slice = slice(None)) -> dict[str, Any]:
        """Of some cells and one law: the number, the median and largest distance, and where that is."""
        far = self.distance[law][here]
        if not far.size:
            return {"cells": 0, "median": np.nan, "largest": np.nan, "cell": "", "beyond": 0}
        part, k = self.cells[np.arange(len(self.cells))[here][far.argmax()]]
        size = {"median": float(np.median(far)), "largest": float(far.max()), "cell": part.name(k)}
        return size | {"cells": far.size, "beyond": int((far > VISIBLE).sum())}

    def share(self) -> dict[str, float]:
        """Shares within the aim, and how the criterion fares."""
        matched, gaussian, sure = self.distance["matched"], self.distance["gaussian"], self.trusted
        good = matched <= AIM
        return {
            "cells": matched.size,
            "within": float(good.mean()),
            "within_gaussian": float((gaussian <= AIM).mean()),
            "worst": float(matched.max()),
            "worst_gaussian": float(gaussian.max()),
            "untrusted": float((~sure).mean()),
            "missed": int((~good & sure).sum()),  # trusted, but beyond the aim
            "needless": int((good & ~sure).sum()),  # not trusted, but within the aim
            "worst_trusted": float(matched[sure].max(initial=0.0)),
        }

    def regimes(self) -> dict[str, NDArray[np.bool_]]:
        """Cells by what their count is like."""
        mean, variance = self.cumulants[:, 0], self.cumulants[:, 1]
        some, free = mean >= FEW, variance >= np.maximum(STILL, 0.25 * mean)
        return {
            "few photons: E N < 10": ~some,
            "locked or saturated: E N >= 10, Var N < 1": some & (variance < STILL),
            "sub-Poissonian: 1 <= Var N < E N / 4": some & (variance >= STILL) & (variance < 0.25 * mean),
            f"moderate: 10 <= E N < {MODERATE:g}, Var N >= E N / 4": some & (mean < MODERATE) & free,
            f"many: E N >= {MODERATE:g}, Var N >= E N / 4": (mean >= MODERATE) & free,
        }


def run(settings: Settings, request: Request) -> Facts:
    """The grids, the systems at random, and the reference cases if there are any."""
    parts, others = grids(settings, request.tell), drawn(settings, request.tell)
    armed, stationary = ([part for part in parts if part.kind == kind] for kind in ("armed", "stationary"))
    kinds = {"grid, armed": armed, "grid, stationary": stationary, "at random": others}
    everything, on_grid = Cells([*parts, *others]), Cells(armed)
    variance, third = everything.cumulants[:, 1], on_grid.cumulants
    plain = (third[:, 0] >= FEW) & (third[:, 1] >= STILL)
    skewness = np.abs(third[plain, 2]) / third[plain, 1] ** 1.5
    listed = [(p, k) for p, k in everything.cells if p.distance["matched"][k] > LISTED * AIM or not p.trusted[k]]
    cases = {path.stem: _read(path) for path in request.cases()}
    references = [row for k, (name, case) in enumerate(cases.items()) for row in compare(name, case, settings.draws, k)]
    return {
        "kinds": {name: Cells(cells).share() for name, cells in kinds.items()},
        "everything": everything,
        "grid": on_grid,
        "ratio": on_grid.distance["gaussian"][plain] / (_PER_SKEWNESS * skewness),
        "by_dead": {
            dead: Cells([p for p in armed if math.isclose(p.system.dead_time_periods, dead)]) for dead in settings.dead
        },
        "by_variance": [
            (low, high, everything.distance["matched"][here], everything.distance["gaussian"][here])
            for low, high in pairwise(_EDGES)
            if (here := (variance >= low) & (variance < high)).any()
        ],
        "worst": sorted(everything.cells, key=lambda cell: -float(cell[0].distance["matched"][cell[1]]))[:_WORST],
        "references": references,
        "cases": cases,
        "rows": [_csv_row(part, k) for part, k in listed],
        "tables": {"reference": references},
        "figures": {"map": _draw(settings, armed)},
    }


def _csv_row(part: Part, k: int) -> Row:
    return {
        "kind": part.kind,
        "signal": float(part.signal[k]),
        "background": float(part.background[k]),
        "dead_time": part.system.dead_time_periods,
        "cycles": part.system.cycles,
        "sigma_ns": part.system.pulse.to_dict()["sigma_ns"],
        **{f"cumulant_{n + 1}": float(part.cumulants[k, n]) for n in range(4)},
        **{f"tv_exact_{law}": float(far[k]) for law, far in part.distance.items()},
        "trusted": bool(part.trusted[k]),
    }


def _draw(settings: Settings, parts: Sequence[Part]) -> Figure:
    """Maps over S and B: columns for dead times; rows for four cumulants by cycles, then for every other law."""
    shape, middle = (len(settings.signal), len(settings.background)), settings.cycles[len(settings.cycles) // 2]
    by = {(round(part.system.dead_time_periods, 9), part.system.cycles): part for part in parts}
    lines = [("matched", cycles) for cycles in settings.cycles]
    rows, chosen = {}, []
    for law, cycles in lines + [(law, middle) for law in LAWS if law not in ("matched", "poisson")]:
        here = [by[round(dead, 9), cycles] for dead in settings.dead]
        images = [part.distance[law].reshape(shape).T for part in here]
        rows[f"{LAWS[law]},\n{cycles} cycles\nB"] = settings.background, images
        chosen += here if law == "matched" else []
    titles, label = [f"{dead:g} $t_r$" for dead in settings.dead], "total variation to the exact law"
    height = 0.5 + 0.95 * len(rows)
    figure, axes, bar = maps(height, settings.signal, rows, titles, LogNorm(_LOW, _HIGH), label)
    for ax, part in zip(axes[: len(lines)].flat, chosen, strict=True):
        at = ~part.trusted
        ax.plot(part.signal[at], part.background[at], "x", ms=1.4, mew=0.4, color=COLOURS[0])
    bar.ax.axhline(AIM, color=COLOURS[0], lw=0.8)
    return figure


def compare(name: str, case: dict[str, Any], draws: int, number: int) -> list[dict[str, Any]]:
    """Every law beside one reference case, at the case's own delay; z in standard errors, p of the G-test.

    ``good``: mean and variance within 4 standard errors, total variation below the limit, p above 1e-4.
    """
    random, period = np.random.default_rng([_REFERENCE_SEED, number]), _REFERENCE_PERIOD_NS
    system = system_of(case["dead"] * period, case["cycles"], period_ns=period, sigma_ns=case["sigma"] * period)
    counts, times = np.array([[int(n), int(m)] for n, m in case["count"].items()]).T
    size = int(times.sum())
    sample = Pmf(int(counts.min()), np.bincount(counts - counts.min(), weights=times) / size)
    mean = float((counts * (times / size)).sum())
    laws = laws_of(Flux([float(case["S"])], float(case["B"]), case["tau"] * period), system)
    [pmfs] = pmfs_of(laws)
    exact = laws["exact"].cumulants[0]
    noise = distance.sampling_floor(pmfs["exact"], size, draws, random)
    results = []
    for key, pmf in pmfs.items():
        # those that are not among the laws have mean and variance of the exact law
        expected, variance = (float(v) for v in laws.get(key, laws["exact"]).cumulants[0, :2])
        row: dict[str, Any] = {
            "case": name,
            "law": key,
            "size": size,
            "mean": expected,
            "variance": variance,
            # what the sample's mean and variance scatter by is known from the exact law
            "z_mean": distance.mean_score(expected, float(exact[1]), mean, size),
            "z_variance": distance.variance_score(exact, sample, size, variance),
            "distance": total_variation(pmf, sample),
            "floor": float(noise.mean()),
            "limit": float(np.quantile(noise, 0.999)),
            "p_value": distance.g_test(pmf, sample, size),
        }
        close = max(abs(row["z_mean"]), abs(row["z_variance"])) <= _LIMIT_Z
        results.append(row | {"good": close and row["distance"] <= row["limit"] and row["p_value"] > _LIMIT_P})
    return results


def _read(path: Path) -> dict[str, Any]:
    case: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    missing = [key for key in KEYS if key not in case]
    if missing:
        raise ValueError(f"reference case {path.name} must hold {', '.join(KEYS)}, it lacks {', '.join(missing)}")
    return case
