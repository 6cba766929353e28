"""Study "runtime", T2 and T3 of the MaRS paper: time of a cube by stages, and of every simulator along four axes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.machine import load
from mars_lidar import Flux, System, Table, simulate
from mars_lidar.engines import ANY_SYSTEM, Engine, MarsEngine
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from studies import Facts, Request, Tell
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.common.sample import PERIOD_NS, system_of
from studies.runtime.numpy_pipeline import NumpyTable, synthesize

Run = Callable[[int, NDArray[Any]], dict[str, float]]  # seed, memory for the cube -> seconds of stages
TABLE_RANGE = (0.01, 10.0)  # photons per period, of both axes of the tables
NUMPY, TABLED = "numpy", "mars, table"


@dataclass(frozen=True)
class Contender:
    """A simulator by name; `prepare` makes what a run needs beforehand, which is not timed with it."""

    name: str
    words: str
    prepare: Callable[[Flux, System, int], Run]
    tabled: bool = False

    def takes(self, flux: Flux) -> bool:
        """Whether the flux lies within its table."""
        if not self.tabled:
            return True
        low, high = TABLE_RANGE
        fluxes = (flux.signal, flux.background)
        return bool(min(f.min() for f in fluxes) >= low and max(f.max() for f in fluxes) <= high)


class Tables:
    """Tables of so many points in S and B; one serves other numbers of cycles where it holds for them."""

    def __init__(self, points: tuple[int, int]) -> None:
        self._points = points
        self._table: Table | None = None
        self._numpy: NumpyTable | None = None

    def get(self, system: System) -> Table:
        """For `system`."""
        held = self._table
        if held is None or held.system.replace(cycles=system.cycles) != system or not held.serves(system.cycles):
            low, high = TABLE_RANGE
            held = Table.build(system, (low, high, self._points[0]), (low, high, self._points[1]))
            self._table = held
        return held

    def numpy(self, system: System) -> NumpyTable:
        """The same for the pipeline in NumPy; one is held at a time, a full one takes 210 MB."""
        if self._numpy is None or self._numpy.system != system:
            self._numpy = NumpyTable.of(self.get(system), system)
        return self._numpy


def contenders(tables: Tables) -> list[Contender]:
    """All of them; those that need a table share it."""

    def tabled(flux: Flux, system: System, realizations: int) -> Run:
        return _engine(MarsEngine(tables.get(system), outside="exact"), flux, system, realizations)

    def numpy(flux: Flux, system: System, realizations: int) -> Run:
        return partial(_pipeline, tables.numpy(system), flux)

    results = [
        Contender(name, "mars, no table" if name == "mars" else name, partial(_engine, name)) for name in ANY_SYSTEM
    ]
    results.append(Contender(TABLED, "mars, table", tabled, tabled=True))
    return [*results, Contender(NUMPY, "MaRS pipeline in NumPy, table", numpy, tabled=True)]


def _engine(engine: str | Engine, flux: Flux, system: System, realizations: int) -> Run:
    def run(seed: int, out: NDArray[Any]) -> dict[str, float]:
        report: dict[str, float] = {}
        simulate(flux, system, engine=engine, realizations=realizations, seed=seed, out=out, report=report)
        return stages_of(report)

    return run


def _pipeline(table: NumpyTable, flux: Flux, seed: int, out: NDArray[Any]) -> dict[str, float]:
    stages: dict[str, float] = {}
    synthesize(table, flux, out, seed=seed, stages=stages)
    return stages


def stages_of(report: dict[str, float]) -> dict[str, float]:
    """Seconds by stage out of what an engine reports: its entries that end in "_s"."""
    return {key[:-2]: value for key, value in report.items() if key.endswith("_s")}


DEAD_TIME_NS, SIGMA_NS = 85.0, 0.5
FLUX = (0.05, 1.0)  # S and B uniform on this, photons per period


@dataclass(frozen=True)
class Axis:
    """One axis: what varies, its values, and the image, exposure and number that it varies from."""

    name: str
    words: str
    values: tuple[float, ...]
    pixels: int
    cycles: int = 1000
    realizations: int = 1


@dataclass(frozen=True)
class Settings:
    """Configuration of the study."""

    side: int  # of the cube of the stages
    bins: int
    axes: tuple[Axis, ...]
    repeats: int
    limit_s: float  # a point predicted to take longer is left out
    enough_s: float  # repeats end once a contender has had so much
    cube_table: tuple[int, int]  # points in S and B
    axis_table: tuple[int, int]
    seed: int = 20268


def _decades(low: float, high: float, each: int) -> tuple[float, ...]:
    """About `each` points a decade; whole numbers where the axis counts something."""
    points = np.geomspace(low, high, round(np.log10(high / low) * each) + 1)
    return tuple(float(v) for v in (np.unique(np.rint(points)) if low >= 1 else points))


def _axes(pixels: int, most_pixels: int, high: float, each: int) -> tuple[Axis, ...]:
    return (
        Axis("cycles", "laser cycles", _decades(10, 10 * high, each), pixels),
        Axis("flux", "photons per period, S + B, mean", _decades(1e-3, 1e-3 * high, each), pixels),
        Axis("realizations", "realizations of one pixel", _decades(1, high, each), 1),
        Axis("pixels", "pixels", _decades(1, most_pixels, each), 1),
    )


FULL = Settings(
    side=128,
    bins=1024,
    axes=_axes(256, 262_144, 1e5, 2),
    repeats=5,
    limit_s=8.0,
    enough_s=0.5,
    cube_table=(256, 100),
    axis_table=(32, 24),
)
QUICK = Settings(
    side=8,
    bins=128,
    axes=_axes(4, 16, 1e2, 1),
    repeats=1,
    limit_s=0.5,
    enough_s=0.05,
    cube_table=(4, 3),
    axis_table=(4, 3),
)


@dataclass(frozen=True)
class Point:
    """One contender at one value of an axis: least seconds of its repeats, or why there are none."""

    axis: str
    value: float
    contender: str
    seconds: float | None
    why: str = ""
    registrations: float = 0.0  # mean of a pixel, one realization


def image(pixels: int, seed: int, level: float = 1.0) -> Flux:
    """A row of pixels, S and B uniform on `FLUX` times `level`, delays anywhere but at the edges."""
    random = np.random.default_rng([seed, pixels])
    signal, background = (level * random.uniform(*FLUX, (1, pixels)) for _ in range(2))
    return Flux(signal, background, random.uniform(0.1, 0.9, (1, pixels)) * PERIOD_NS)


def system(settings: Settings, cycles: int) -> System:
    """Armed start."""
    return system_of(DEAD_TIME_NS, cycles, bins=settings.bins, sigma_ns=SIGMA_NS)


def cube_stages(settings: Settings, tell: Tell) -> tuple[list[dict[str, Any]], Table]:
    """Every contender on one cube of side x side pixels, and the table that some of them used.

    Least seconds, and the stages of that run. ``prepared``: seconds spent before, on a table or nothing.
    """
    flux, instrument = image(settings.side**2, settings.seed), system(settings, 1000)
    out, rows = _memory(flux, instrument, 1), []
    tables = Tables(settings.cube_table)
    for contender in contenders(tables):
        began = time.perf_counter()
        run = contender.prepare(flux, instrument, 1)
        prepared = time.perf_counter() - began
        seconds, stages = _least({contender.name: run}, out, settings)[contender.name]
        times = {"seconds": seconds, "stages": stages, "prepared": prepared}
        rows.append({"contender": contender.name, "words": contender.words} | times)
        tell(f"runtime: cube, {contender.words}: {seconds:.3g} s")
    return rows, tables.get(instrument)


def along(settings: Settings, axis: Axis, tell: Tell) -> list[Point]:
    """Every contender along one axis; each is stopped where its next point would take too long."""
    points: list[Point] = []
    entrants = contenders(Tables(settings.axis_table))
    for value in axis.values:
        flux, instrument, realizations = _at(settings, axis, value)
        # mean registrations of a pixel in one exposure, from at most 16 of them
        hits = float(simulate(flux[:, :16], instrument.replace(bins=1), seed=settings.seed).mean(dtype=np.float64))
        runs: dict[str, Run] = {}
        for entrant in entrants:
            why = _refusal(settings, entrant, flux, value, points)
            if why:
                points.append(Point(axis.name, value, entrant.name, None, why, hits))
            else:
                runs[entrant.name] = entrant.prepare(flux, instrument, realizations)
        out = _memory(flux, instrument, realizations)
        for name, (seconds, _) in _least(runs, out, settings).items():
            points.append(Point(axis.name, value, name, seconds, "", hits))
        tell(f"runtime: {axis.words} {value:.4g}: {len(runs)} contenders")
    return points


def _at(settings: Settings, axis: Axis, value: float) -> tuple[Flux, System, int]:
    """Flux, system and realizations of one value of an axis."""
    number = round(value)
    pixels = number if axis.name == "pixels" else axis.pixels
    cycles = number if axis.name == "cycles" else axis.cycles
    realizations = number if axis.name == "realizations" else axis.realizations
    level = value / sum(FLUX) if axis.name == "flux" else 1.0
    return image(pixels, settings.seed, level), system(settings, cycles), realizations


def _refusal(settings: Settings, entrant: Contender, flux: Flux, value: float, points: Sequence[Point]) -> str:
    """Why a point is left out, or nothing."""
    own = [p for p in points if p.contender == entrant.name]
    if not entrant.takes(flux):
        return "flux beyond the table"
    if own and own[-1].why.startswith("predicted"):
        return own[-1].why
    timed = [p for p in own if p.seconds is not None]
    if not timed:
        return ""
    last, slope = timed[-1], 1.0
    if len(timed) > 1:
        before = timed[-2]
        rise = float(np.log((last.seconds or 1.0) / (before.seconds or 1.0)))
        slope = min(max(rise / float(np.log(last.value / before.value)), 0.0), 1.5)
    predicted = float(last.seconds or 0.0) * (value / last.value) ** slope
    return f"predicted {predicted:.3g} s" if predicted > settings.limit_s else ""


def _memory(flux: Flux, instrument: System, realizations: int) -> NDArray[Any]:
    """Memory for a cube, written to before."""
    out = np.empty((realizations, *flux.shape, instrument.bins), instrument.histogram_dtype)
    out.fill(1)
    return out


def _least(runs: dict[str, Run], out: NDArray[Any], settings: Settings) -> dict[str, tuple[float, dict[str, float]]]:
    """Least seconds of each run and the stages of that repeat; all in turn, so that disturbances are shared."""
    best: dict[str, tuple[float, dict[str, float]]] = {}
    spent = dict.fromkeys(runs, 0.0)
    for turn in range(settings.repeats):
        for name, run in runs.items():
            if turn and spent[name] >= settings.enough_s:
                continue
            began = time.perf_counter()
            stages = run(settings.seed + turn, out)
            seconds = time.perf_counter() - began
            spent[name] += seconds
            if name not in best or seconds < best[name][0]:
                best[name] = seconds, stages
    return best


_COLOURS = {
    "exact": INK,
    "sequential": COLOURS[1],
    "poisson": COLOURS[0],
    "renewal": COLOURS[2],
    "mars": COLOURS[4],
    TABLED: COLOURS[3],
    "feedback": COLOURS[5],
    NUMPY: MUTED,
}
_OTHER = ("#8c564b", "#7f7f00", "#17607f")  # engines that came later


def _colour(name: str, names: Sequence[str]) -> str:
    unknown = [n for n in names if n not in _COLOURS]
    return _COLOURS[name] if name in _COLOURS else _OTHER[unknown.index(name) % len(_OTHER)]


def along_axes(settings: Settings, points: Sequence[Point]) -> Figure:
    """Seconds against cycles, flux, realizations and pixels; a line ends where the next point was left out."""
    figure, axes = panels(5.2, 2, 2, sharey=True)
    names = list(dict.fromkeys(p.contender for p in points))
    for ax, axis in zip(axes.flat, settings.axes, strict=True):
        for name in names:
            here = [p for p in points if p.axis == axis.name and p.contender == name and p.seconds is not None]
            ax.plot(
                [p.value for p in here],
                [float(p.seconds or 0.0) for p in here],
                marker="o",
                ms=2.4,
                lw=1.0,
                color=_colour(name, names),
                ls="--" if name == NUMPY else "-",
                label=name,
            )
        ax.set(xscale="log", yscale="log", xlabel=axis.words)
        others = {"cycles": f"{axis.pixels} pixels", "flux": f"{axis.pixels} pixels, {axis.cycles} cycles"}
        ax.set_title(others.get(axis.name, f"{axis.cycles} cycles"), loc="left")
    for row in axes:
        row[0].set_ylabel("seconds")
    legend_below(figure, axes[0, :1], min(len(names), 6))
    return figure


# T2 and T3 of arXiv 2512.04924; NumPy on a Ryzen 7 9700X
PAPER_STAGES = {"lookup": 0.020, "alignment": 0.144, "sampling": 0.849}
PAPER_TOTAL, PAPER_SEQUENTIAL = 1.013, 40.831
PAPER_GRID = (256, 100, 1024)  # points in S and B, bins
PAPER_TABLE_MB, PAPER_DELAYS_GB = 105, 108
_BYTES = 4  # float32


def crossover(points: Sequence[Point], axis: str, fast: str, other: str) -> tuple[float | None, str]:
    """Registrations per pixel from which `other` is faster than `fast` along an axis, and the rule in words.

    Interpolated in the logarithms between the points at which both were timed.
    """
    results = {
        name: {p.value: p for p in points if p.axis == axis and p.contender == name and p.seconds is not None}
        for name in (fast, other)
    }
    shared = sorted(set(results[fast]) & set(results[other]))
    if not shared:
        return None, f"{fast} and {other} were not timed together along {axis}"
    hits = [results[fast][v].registrations for v in shared]
    ratio = [float(results[other][v].seconds or 0.0) / float(results[fast][v].seconds or 1.0) for v in shared]
    ahead = np.array(ratio) > 1.0
    if ahead.all() or not ahead.any():
        first, second = (fast, other) if ahead.all() else (other, fast)
        span = f"at {hits[0]:.3g}" if len(hits) == 1 else f"from {min(hits):.3g} to {max(hits):.3g}"
        return None, f"{first} is faster than {second} {span} registrations per pixel, wherever both were timed"
    last = int(np.flatnonzero(ahead)[-1])  # from the next point on, `other` is faster to the end
    if last == len(shared) - 1:
        return None, f"{fast} is faster than {other} at {hits[-1]:.3g} registrations per pixel, not everywhere below"
    a, b = np.log(ratio[last]), np.log(ratio[last + 1])
    place = np.log(hits[last]) + a / (a - b) * np.log(hits[last + 1] / hits[last])
    least = float(np.exp(place))
    return least, f"{fast} is faster than {other} below {least:.3g} registrations per pixel, slower above"


def run(settings: Settings, request: Request) -> Facts:
    """Stages of a cube and four axes, timed."""
    before = load()
    cubes, held = cube_stages(settings, request.tell)
    points = [point for axis in settings.axes for point in along(settings, axis, request.tell)]
    others = [
        other for other in dict.fromkeys(p.contender for p in points) if other not in ("exact", "sequential", "poisson")
    ]
    axes = (("cycles", "exposure grows"), ("flux", "flux grows"))
    return {
        "period_ns": PERIOD_NS,
        "before": before,
        "cubes": cubes,
        "engines": [cube for cube in cubes if cube["contender"] != NUMPY],
        "base": next(cube["seconds"] for cube in cubes if cube["contender"] == NUMPY),
        "rules": [(words, *crossover(points, axis, "exact", other)) for other in others for axis, words in axes],
        "pixels": next(axis.pixels for axis in settings.axes if axis.name == "cycles"),
        "axes": {axis.words: _axis_rows(points, axis.name) for axis in settings.axes},
        "held": held,
        "size": PAPER_GRID[0] * PAPER_GRID[1] * (PAPER_GRID[2] + 2) * _BYTES,
        "rows": [vars(p) | {"seconds": "" if p.seconds is None else p.seconds} for p in points],
        "figures": {"axes": along_axes(settings, points)},
    }


def _axis_rows(points: Sequence[Point], axis: str) -> list[Row]:
    here = [p for p in points if p.axis == axis]
    names = list(dict.fromkeys(p.contender for p in points))
    rows: list[Row] = []
    for value in dict.fromkeys(p.value for p in here):
        at = [p for p in here if p.value == value]
        row: dict[str, object] = {axis: f"{value:.6g}", "registrations per pixel": f"{at[0].registrations:.3g}"}
        for p in sorted(at, key=lambda p: names.index(p.contender)):
            left_out = "outside" if p.why.startswith("flux") else "-"
            row[p.contender] = left_out if p.seconds is None else f"{p.seconds:.3g}"
        rows.append(row)
    return rows
