"""Study "matched": total variation between the law with four matched cumulants and the exact law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import Flux, System, count_law
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS
from mars_lidar.statistics.count_pmf import total_variation
from mars_lidar.statistics.matched import matched_pmf, trusted
from studies import Facts, Request, Tell
from studies.common.draw import maps
from studies.common.report import Row
from studies.common.sample import PERIOD_NS, log_points, system_of
from studies.count_law.law import gaussian_of, pmf_of

AIM = 0.002  # total variation
_EDGES = (0.0, 0.2, 0.7, 2.3, 9.0, 100.0, np.inf)  # of the variance
_WORST = 12
_LISTED = 0.25  # of the aim: all cells would be a large file of little news
_LOW, _HIGH = 1e-5, 1e-1  # total variation on the colour scale


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
)
QUICK = Settings(
    signal=log_points(4),
    background=log_points(3),
    dead=(0.6375, 1.53),
    cycles=(100,),
    stationary=((0.6375, 100),),
    systems=3,
    pixels=5,
)


@dataclass(frozen=True, eq=False)
class Part:
    """Cells of one system: flux (cells,), exact cumulants (cells, 4), distances to the exact law (cells,)."""

    kind: str  # "armed", "stationary", "random"
    system: System
    signal: FloatArray
    background: FloatArray
    cumulants: FloatArray
    matched: FloatArray
    gaussian: FloatArray
    trusted: NDArray[np.bool_]

    @property
    def dead(self) -> float:
        """Dead time in periods."""
        return self.system.dead_time_periods

    def name(self, k: int) -> str:
        """One cell in words."""
        flux = f"S = {self.signal[k]:.3g}, B = {self.background[k]:.3g}"
        return f"{flux}, t_d = {self.dead:.4g} t_r, {self.system.cycles} cycles"


def grids(settings: Settings, tell: Tell) -> list[Part]:
    """The grids, armed first, then stationary."""
    signal, background = (g.ravel() for g in np.meshgrid(settings.signal, settings.background, indexing="ij"))
    parts = []
    for dead in settings.dead:
        for cycles in settings.cycles:
            parts.append(
                measure("armed", system_of(dead * PERIOD_NS, cycles, sigma_ns=settings.sigma_ns), signal, background)
            )
        tell(f"matched: t_d = {dead:g} t_r, {signal.size * len(settings.cycles)} cells")
    for dead, cycles in settings.stationary:
        system = system_of(dead * PERIOD_NS, cycles, sigma_ns=settings.sigma_ns, start="stationary")
        parts.append(measure("stationary", system, signal, background))
        tell(f"matched: t_d = {dead:g} t_r, {cycles} cycles, stationary, {signal.size} cells")
    return parts


def drawn(settings: Settings, tell: Tell) -> list[Part]:
    """Systems at random: no threshold of the law or of `trusted` was set on them."""
    random = np.random.default_rng(settings.seed)
    parts = []
    for _ in range(settings.systems):
        dead, sigma = float(random.uniform(0.02, 2.5)), float(np.exp(random.uniform(*np.log([0.2, 3.0]))))
        cycles = round(float(np.exp(random.uniform(*np.log([30.0, 3000.0])))))
        signal, background = 10.0 ** random.uniform(-2.0, 1.0, (2, settings.pixels))
        parts.append(measure("random", system_of(dead * PERIOD_NS, cycles, sigma_ns=sigma), signal, background))
    tell(f"matched: {settings.systems * settings.pixels} cells at random")
    return parts


def measure(kind: str, system: System, signal: FloatArray, background: FloatArray) -> Part:
    """Distances of the matched law and of the best Gaussian to the exact law of each cell."""
    exact = count_law(Flux(signal, background, 0.5 * system.period_ns), system)
    windows = matched_pmf(exact.cumulants)
    matched, gaussian = np.empty(signal.size), np.empty(signal.size)
    for k, window in enumerate(windows):
        law = pmf_of(exact, k)
        matched[k] = total_variation(window, law)
        gaussian[k] = total_variation(gaussian_of(exact, k), law)
    return Part(kind, system, signal, background, exact.cumulants, matched, gaussian, trusted(exact.cumulants))


def share(parts: Sequence[Part]) -> dict[str, float]:
    """All cells of some parts together: shares within the aim, and how the criterion fares."""
    matched, gaussian, sure = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("matched", "gaussian", "trusted")
    )
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


def worst(parts: Sequence[Part], number: int) -> list[tuple[Part, int]]:
    """The cells furthest from their exact law."""
    cells = [(part, k) for part in parts for k in range(part.signal.size)]
    return sorted(cells, key=lambda cell: -float(cell[0].matched[cell[1]]))[:number]


def run(request: Request) -> Facts:
    """The grids and the systems at random."""
    settings = QUICK if request.quick else FULL
    parts, others = grids(settings, request.tell), drawn(settings, request.tell)
    armed, stationary = ([part for part in parts if part.kind == kind] for kind in ("armed", "stationary"))
    everything = [*parts, *others]
    kinds = {"grid, armed": armed, "grid, stationary": stationary, "at random": others}
    variance = np.concatenate([part.cumulants[:, 1] for part in everything])
    matched = np.concatenate([part.matched for part in everything])
    gaussian = np.concatenate([part.gaussian for part in everything])
    within = [(low, high, (variance >= low) & (variance < high)) for low, high in pairwise(_EDGES)]
    return {
        "s": settings,
        "kinds": {name: share(cells) for name, cells in kinds.items() if cells},
        "by_variance": [(low, high, matched[here], gaussian[here]) for low, high, here in within],
        "worst": worst(everything, _WORST),
        "rows": [_csv_row(p, k) for p in everything for k in np.flatnonzero((p.matched > _LISTED * AIM) | ~p.trusted)],
        "figures": {"map": _draw(settings, armed)},
    }


def _csv_row(part: Part, k: int | np.intp) -> Row:
    system = part.system
    return {
        "kind": part.kind,
        "signal": float(part.signal[k]),
        "background": float(part.background[k]),
        "dead_time": part.dead,
        "cycles": system.cycles,
        "sigma_ns": system.pulse.to_dict()["sigma_ns"],
        **{f"cumulant_{n + 1}": float(part.cumulants[k, n]) for n in range(4)},
        "tv_exact_matched": float(part.matched[k]),
        "tv_exact_gaussian": float(part.gaussian[k]),
        "trusted": bool(part.trusted[k]),
    }


def _draw(settings: Settings, parts: Sequence[Part]) -> Figure:
    """Maps over S and B: columns for dead times; rows for cycles, and the Gaussian for comparison."""
    shape = len(settings.signal), len(settings.background)
    by = {(round(part.dead, 9), part.system.cycles): part for part in parts}
    chosen = [[by[round(dead, 9), cycles] for dead in settings.dead] for cycles in settings.cycles]
    rows = {
        f"{cycles} cycles\nB": (settings.background, [part.matched.reshape(shape).T for part in here])
        for cycles, here in zip(settings.cycles, chosen, strict=True)
    }
    images = [part.gaussian.reshape(shape).T for part in chosen[0]]
    rows[f"Gaussian,\n{settings.cycles[0]} cycles\nB"] = settings.background, images
    titles, label = [f"{dead:g} $t_r$" for dead in settings.dead], "total variation to the exact law"
    height, norm = 0.5 + 0.95 * len(rows), LogNorm(_LOW, _HIGH)
    figure, axes, bar = maps(height, settings.signal, rows, titles, norm, label)
    for ax, part in zip(axes[:-1].flat, chain(*chosen), strict=True):
        at = ~part.trusted
        ax.plot(part.signal[at], part.background[at], "x", ms=1.4, mew=0.4, color=COLOURS[0])
    bar.ax.axhline(AIM, color=COLOURS[0], lw=0.8)
    return figure
