"""Engines that draw pixels from a lookup table, if given, and evaluate the others.

This module checks that the table fits the system, reads the entries of pixels, makes a record for the file of a cube,
and evaluates exact count laws for pixels whose four cumulants do not determine the law.
"""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray, IndexArray, NDArray, Progress
from mars_lidar.engines.engine import Engine, Task
from mars_lidar.engines.pixels import Alignment, single_return
from mars_lidar.engines.synthesis import Batch, CountLaws, Run, Tabulated
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import Cells, require_mode
from mars_lidar.statistics.matched import trusted
from mars_lidar.statistics.moments import normalised
from mars_lidar.statistics.pmf import Pmf, guessed_pmfs
from mars_lidar.table.table import Table

_INTERPOLATIONS = ("bilinear", "nearest")
_OUTSIDE = ("error", "exact")


@dataclass(frozen=True, eq=False)
class PixelEntries:
    """Table entries of some pixels (P,) of the image, in the order of the grid.

    Neighbours on the grid are adjacent, so that their rows stay in the processor's cache.
    """

    pixels: IndexArray
    signal: FloatArray
    background: FloatArray
    delay_ns: FloatArray
    cumulants: FloatArray
    shapes: NDArray[np.float32]
    guides: NDArray[np.float32]
    rows: IndexArray
    weights: FloatArray
    alignment: Alignment

    def batch(self, laws: CountLaws) -> Batch:
        """The batch of these pixels, with counts from `laws`."""
        return Batch(self.pixels, self.shapes, self.rows, self.weights, laws, self.alignment, self.guides)


class TableReader:
    """A table as read by an engine: the table, its interpolation, and the treatment of pixels beyond its grid."""

    def __init__(self, table: Table, interpolation: str | None, outside: str | None) -> None:
        if not (callable(getattr(table, "lookup", None)) and callable(getattr(table, "shapes", None))):
            raise TypeError(f"table must be a mars_lidar.Table, got {table!r}")
        self.table = table
        given = "bilinear" if interpolation is None else interpolation
        nearest = checks.choice("interpolation", given, _INTERPOLATIONS) == "nearest"
        self.refuses = checks.choice("outside", "error" if outside is None else outside, _OUTSIDE) == "error"
        self.interpolation: Literal["bilinear", "nearest"] = "nearest" if nearest else "bilinear"

    @property
    def settings(self) -> dict[str, Any]:
        """Settings on which a cube depends: interpolation and table."""
        return {"interpolation": self.interpolation, "table": table_record(self.table)}

    def check(self, flux: Flux, system: System) -> None:
        """Check that the table is of this system (for any cycles) and every pixel has one return within its grid."""
        ours, theirs = system.detected().to_dict(), self.table.system.to_dict()
        for name in ours:
            if name != "cycles" and ours[name] != theirs[name]:
                raise ValueError(f"table must be of this system: {name} is {ours[name]}, the table's {theirs[name]}")
        flux = flux.detected(system)
        single = single_return(flux)
        if single is None:
            what = "a waveform" if flux.waveform is not None else "several returns in a pixel"
            raise ValueError(f"flux must have one return a pixel with a table, got {what}; leave the table out")
        if self.refuses:
            self._check_range(single[0], flux.background.reshape(-1))

    def _check_range(self, signal: FloatArray, background: FloatArray) -> None:
        """Raise ValueError unless every pixel is within the grid; of pixels without a return, the background."""
        beyond, ranges = np.zeros(signal.size, dtype=bool), []
        for name, photons, axis in (
            ("signal", signal, self.table.signal),
            ("background", background, self.table.background),
        ):
            out = (photons < axis[0]) | (photons > axis[-1])
            if name == "signal":
                out &= photons > 0.0
            if out.any():
                low, high = photons[out].min(), photons[out].max()
                ranges.append(f"{name} {low:.4g} to {high:.4g} (the table: {axis[0]:g} to {axis[-1]:g})")
            beyond |= out
        if ranges:
            raise ValueError(
                f"table must reach every pixel, but {int(beyond.sum())} of {beyond.size} lie outside of it: "
                f"{', '.join(ranges)} photons per period; build it over that range, or give outside='exact' "
                "(--table-outside exact) to evaluate each of those by itself, which takes some ms"
            )

    def warn_of_start_up(self, task: Task) -> None:
        """Warn, before drawing, if the table misplaces the start-up of a short armed exposure.

        At most some registrations are misplaced, so that only short exposures are evaluated, at some of the brightest
        pixels. The report has the error, ``start_up_error``.
        """
        system, single = task.system, single_return(task.flux)
        assert single is not None  # see check
        if system.start != "armed" or system.dead_time_periods == 0.0 or self.table.method != "exposure":
            return
        signal, delay, background = single[0], single[1], task.flux.background.reshape(-1)
        total = signal + background
        expected = system.cycles * total / (1.0 + total * system.dead_time_periods)
        within = (signal > 0.0) & (signal >= self.table.signal[0]) & (signal <= self.table.signal[-1])
        within &= (background >= self.table.background[0]) & (background <= self.table.background[-1])
        some = np.flatnonzero(within & (expected * TOL.misplaced_share < TOL.misplaced))
        some = some[np.argsort(-total[some], kind="stable")][: TOL.start_up_pixels]
        if not some.size:
            return
        error = self._start_up_error(signal[some], background[some], delay[some], task)
        worst = int(np.argmax(error))
        task.report["start_up_error"] = float(error[worst])
        if error[worst] > TOL.misplaced_share:
            at = some[worst]
            warnings.warn(
                f"table places {error[worst]:.2g} of the registrations ({error[worst] * expected[at]:.2g} of "
                f"{expected[at]:.3g}) wrongly at S = {signal[at]:.3g}, B = {background[at]:.3g}, "
                f"delay_ns = {delay[at]:.4g}: its shapes are those of one delay, and in {system.cycles} cycles from an "
                "armed start the start-up counts; leave the table out, or take engine 'exact'",
                UserWarning,
                stacklevel=2,
            )

    def _start_up_error(self, signal: FloatArray, background: FloatArray, delay: FloatArray, task: Task) -> FloatArray:
        """`Table.start_up_error`, cached for further exposures of the same pixels."""
        cycles = task.system.cycles
        asked = (self.interpolation, cycles, signal.tobytes(), background.tobytes(), delay.tobytes())
        last = _last_start_up.get(self.table)
        if last is None or last[0] != asked:
            error = self.table.start_up_error(
                signal,
                background,
                delay,
                cycles=cycles,
                interpolation=self.interpolation,
                threads=task.threads,
            )
            last = _last_start_up[self.table] = asked, error
        return last[1]

    def read(self, task: Task, pixels: IndexArray) -> tuple[PixelEntries, IndexArray]:
        """Entries of the `pixels` within the grid of the table, and the pixels beyond it."""
        single = single_return(task.flux)
        assert single is not None  # see check
        system = task.system
        signal, delay = single[0][pixels], single[1][pixels]
        background = np.ascontiguousarray(task.flux.background.reshape(-1)[pixels])
        look = self.table.at(
            signal,
            background,
            delay_ns=delay,
            cycles=system.cycles,
            interpolation=self.interpolation,
            outside="exact",
            threads=task.threads,
        )
        order = np.flatnonzero(~look.outside)
        order = order[np.argsort(look.rows[order, 0])]
        signal, background, delay = signal[order], background[order], delay[order]
        cumulants = look.cumulants[order]
        alignment = Alignment.of(system, signal, background, delay, cumulants[:, 0] / system.cycles)
        entries = PixelEntries(
            pixels[order],
            signal,
            background,
            delay,
            cumulants,
            *_shapes(self.table, system.cycles),
            look.rows[order],
            look.weights[order],
            alignment,
        )
        return entries, pixels[look.outside]


# For cycles other than its own a table computes its shapes at each call, which takes longer than a cube. The last
# shapes are therefore cached for the lifetime of the table, together with the sampler's guides to them.
_last_shapes: WeakKeyDictionary[Table, tuple[int, NDArray[np.float32], NDArray[np.float32]]] = WeakKeyDictionary()

# Another exposure of an image, with another seed, has the same error of the start-up: 9 ms of a processor.
_last_start_up: WeakKeyDictionary[Table, tuple[tuple[Any, ...], FloatArray]] = WeakKeyDictionary()


def _shapes(table: Table, cycles: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Shapes, and the sampler's guides to them."""
    last = _last_shapes.get(table)
    if last is None or last[0] != cycles:
        shapes = table.shapes(cycles)
        last = _last_shapes[table] = cycles, shapes, np.zeros((len(shapes), 64), np.float32)
    return last[1:]


def table_record(table: Table) -> dict[str, Any]:
    """Identifies a table in the file of a cube: hash of its content, cycles, method and grid.

    The hash covers axes, shapes, and cumulants at the nodes, on which a cube depends.
    """
    signal, background = (np.ascontiguousarray(axis, dtype=np.float64) for axis in (table.signal, table.background))
    nodes = table.at(np.repeat(signal, background.size), np.tile(background, signal.size), interpolation="nearest")
    digest = blake2b(digest_size=16)
    for part in (signal, background, nodes.cumulants, table.shapes()):
        digest.update(np.ascontiguousarray(part).data)
    return {
        "hash": digest.hexdigest(),
        "method": table.method,
        "cycles": table.system.cycles,
        "signal": [float(signal[0]), float(signal[-1]), signal.size],
        "background": [float(background[0]), float(background[-1]), background.size],
    }


def untrusted(run: Run, reader: TableReader, entries: PixelEntries) -> IndexArray:
    """Which of the pixels (ascending) need an exact law: `statistics.matched.trusted`. None of a table of Gaussians."""
    if reader.table.method == "mars" or run.task.system.dead_time_periods == 0.0:
        return np.empty(0, np.int64)
    return np.flatnonzero(~trusted(entries.cumulants, threads=run.task.threads))


def exact_laws(run: Run, reader: TableReader, entries: PixelEntries, at: IndexArray) -> Tabulated:
    """Laws of the pixels `at`, each distinct law evaluated once, or taken from the table if stored there."""
    keys = _keys(run, reader, entries, at)
    _, first, law = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    laws = _table_laws(run, reader, entries, at[first], keys[first])
    missing = np.array([k for k, each in enumerate(laws) if each is None], np.int64)
    if missing.size:
        signal, background, phase = keys[first[missing]].T
        system, chosen = run.task.system, at[first[missing]]
        cells = Cells.of(
            signal, background, system, delay_ns=phase * system.period_ns, effects=LIGHT_EFFECTS + TIMING_EFFECTS
        )
        own = reader.table.entries.bins[entries.rows[chosen]]
        bins = np.where(entries.weights[chosen] > 0.0, own, 0).max(-1)  # the finest grid that a corner needed
        report = run.waiting
        waiting = None if report is None else lambda done: report(done, missing.size)
        evaluated = guessed_pmfs(cells, entries.cumulants[chosen], bins, run.task.threads, waiting)
        for k, each in zip(missing, evaluated, strict=True):
            laws[k] = each
    run.count("laws_evaluated", missing.size)
    return Tabulated.of([each for each in laws if each is not None], law.reshape(-1).astype(np.int64))


def _keys(run: Run, reader: TableReader, entries: PixelEntries, at: IndexArray) -> FloatArray:
    """S, B and delay in periods (pixels, 3); with interpolation "nearest", S and B of the nearest entry."""
    table = reader.table
    signal, background = entries.signal[at], entries.background[at]
    if reader.interpolation == "nearest":
        node = entries.rows[at, 0]
        signal, background = table.signal[node // table.background.size], table.background[node % table.background.size]
    phase = entries.delay_ns[at] / run.task.system.period_ns
    return np.stack([signal, background, np.where(signal > 0.0, phase - np.floor(phase), 0.5)], axis=-1)


def _table_laws(
    run: Run, reader: TableReader, entries: PixelEntries, pixels: IndexArray, keys: FloatArray
) -> list[Pmf | None]:
    """Laws stored in the table, which are those of its entries at its own delay and number of cycles."""
    table = reader.table
    if run.task.system.cycles != table.entries.cycles:
        return [None] * pixels.size
    heaviest = entries.weights[pixels].argmax(-1)
    rows = entries.rows[pixels, heaviest]
    signal, background = table.signal[rows // table.background.size], table.background[rows % table.background.size]
    same = (keys[:, 0] == signal) & (keys[:, 1] == background) & (keys[:, 2] == 0.5)
    return [table.laws.law(int(row)) if its_own else None for row, its_own in zip(rows, same, strict=True)]


_PER_DECADE = {"signal": 58, "background": 16}  # 4 % apart: the mean count is then within some 0.002 deviations


def image_table(
    flux: Flux, system: System, threads: int | None = None, progress: Progress | None = None
) -> Table | None:
    """A table that covers the pixels of `flux` for `mars` and `renewal`, from the cache, or built and cached.

    None if a table is impossible or of no use: waveforms, several returns in a pixel, a detector without tables, fewer
    than `Tolerances.table_pixels` distinct pixels. Pixels beyond it (S = 0 or B = 0) are evaluated with
    ``outside="exact"``.
    """
    try:
        require_mode("a table", system)
    except ValueError:
        return None
    light = flux.detected(system)
    single = single_return(light)
    if single is None:
        return None
    signal, background = single[0], light.background.reshape(-1)
    if len(np.unique(np.stack([*single, background], 1), axis=0)) < TOL.table_pixels:
        return None
    options: dict[str, Any] = {"threads": threads, "progress": progress}
    return Table.cached(system, _axis("signal", signal), _axis("background", background), **options)


def _axis(name: str, photons: FloatArray) -> Any:
    """(low, high, points) of an axis that contains all `photons` > 0; two points about them where all are equal."""
    some = photons[photons > 0.0]
    if some.size == 0:
        return np.array([0.0, 1e-6])
    low, high = float(some.min()), float(some.max())
    if high < low * (1.0 + TOL.axis_width):
        return np.array([low * (1.0 - TOL.axis_width), high * (1.0 + TOL.axis_width)])
    first, last = math.floor(8 * math.log10(low)), math.ceil(8 * math.log10(high))  # eighths of a decade
    return 10.0 ** (first / 8), 10.0 ** (last / 8), max(2, 1 + (last - first) * _PER_DECADE[name] // 8)


# --- The engines -----------------------------------------------------------------------------------------------------


class CountTimesShape(Engine):
    """Draws N from a count law and its registrations from a shape, both from a table or evaluated."""

    def __init__(self, table: Table | None, interpolation: str | None, outside: str | None, level: str) -> None:
        for name, value in (("interpolation", interpolation), ("outside", outside)):
            if table is None and value is not None:
                raise ValueError(f"{name} must be None without a table, got {value!r}")
        self.reader = None if table is None else TableReader(table, interpolation, outside)
        self.level = level

    @property
    def settings(self) -> dict[str, Any]:
        """The table, if there is one."""
        return self.reader.settings if self.reader else {}

    def check(self, flux: Flux, system: System) -> None:
        """Raise ValueError unless the table is of this system, with one return a pixel, in its grid (see `outside`)."""
        if self.reader:
            self.reader.check(flux, system)

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Look up or evaluate the pixels, draw their counts, and draw a bin for each count, batch by batch."""
        run = Run(task, out, self.level)
        pixels = np.arange(task.pixel_index.size)
        if self.reader is None:
            self._evaluate(run, pixels)
            return
        self.reader.warn_of_start_up(task)
        step = TOL.looked_up
        outside = [self._look_up(run, self.reader, pixels[k : k + step]) for k in range(0, pixels.size, step)]
        self._evaluate(run, np.concatenate(outside))

    def _look_up(self, run: Run, reader: TableReader, pixels: IndexArray) -> IndexArray:
        """Draws the pixels on the grid; returns the others."""
        with run.stage("lookup_s"):
            entries, outside = reader.read(run.task, pixels)
        run.draw(entries.batch(self._laws_of(run, reader, entries)))
        return outside

    @abstractmethod
    def _laws_of(self, run: Run, reader: TableReader, entries: PixelEntries) -> CountLaws:
        """Laws of the counts of pixels from a table."""

    @abstractmethod
    def _evaluate(self, run: Run, pixels: IndexArray) -> None:
        """Draws pixels without a table."""


def as_shapes(histogram: FloatArray) -> NDArray[np.float32]:
    """Shapes (cells, bins) of histograms (..., bins), as the sampler takes them."""
    return np.ascontiguousarray(normalised(histogram.reshape(-1, histogram.shape[-1])).astype(np.float32))
