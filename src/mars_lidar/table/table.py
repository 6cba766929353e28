"""The lookup table over (S, B) at a canonical delay: built once for a system, valid for any pixel.

The paper's table (arXiv 2512.04924): 256 x 100 entries on [0.01, 10]^2; delay invariance replaces a third axis. This
table has the exact law of the finite exposure, its dependence on the delay, any number of cycles, and interpolation.
docs/table.md describes its content and errors.
"""

from __future__ import annotations

import contextlib
import json
import time
import warnings
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.display import brief
from mars_lidar._base.files import reading, reason
from mars_lidar._base.progress import callback_of, of_part
from mars_lidar._base.resources import check_memory, thread_count
from mars_lidar._base.types import ArrayLike, FloatArray, IndexArray, NDArray, Progress
from mars_lidar._version import __version__
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import require_mode
from mars_lidar.statistics.chain import ConvergenceError, Rearm
from mars_lidar.statistics.moments import exposure_moments, normalised
from mars_lidar.statistics.tolerances import TOL as STATISTICS
from mars_lidar.table import storage
from mars_lidar.table.axes import PAPER_GRID, Grid, axis_values, describe
from mars_lidar.table.entries import (
    Entries,
    Evaluation,
    Lookup,
    Method,
    NodeLaws,
    StartPhases,
    evaluate,
    node_laws,
    read_pixels,
    start_phases,
)
from mars_lidar.table.error import QuantisationError, deviations, dim_pixels, law_variation, random_pixels
from mars_lidar.table.tolerances import TOL

Interpolation = Literal["bilinear", "nearest"]

Axes = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Table:
    """Count law and histogram shape over a grid of (S, B); made by `build`, `load` or `cached`.

    Attributes
    ----------
    system
        Laser, detector and histogram; its `cycles` are the default of the methods.
    method
        ``"exposure"`` or ``"mars"``.
    signal, background
        (nS,), (nB,) axes, photons per period, ascending. The first may be 0: pixels without a return.
    rearm
        Re-arming of the chain, for ``"mars"``.
    tolerance
        Tolerance of the exposure statistics.
    provenance
        Origin of the table: version, request, description of the axes, seconds, and the measured error.
    entries, start_phases
        Cumulants and shapes of every entry, and the change of the cumulants with the delay (docs/table.md, 1 and 3).
    laws
        Exact count laws of the entries whose four cumulants do not determine them (`statistics.matched.trusted`).

    See Also
    --------
    Lookup, QuantisationError, simulate, count_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=64,
    ...     pulse=ml.GaussianPulse(sigma_ns=2.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> table = ml.Table.build(system, signal=(0.1, 2.0, 6), background=(0.1, 1.0, 4), tolerance=1e-3)
    >>> pixel = table.lookup(ml.Flux(0.5, 0.5, 30.0))
    >>> pixel.cumulants[0, :2].round()  # mean and variance of the count
    array([587., 202.])
    >>> cube = ml.simulate(ml.Flux(0.5, 0.5, 30.0), system, engine="mars", table=table)
    """

    system: System
    method: Method
    signal: FloatArray
    background: FloatArray
    rearm: Rearm
    tolerance: float
    provenance: dict[str, Any]
    entries: Entries = field(repr=False)
    start_phases: StartPhases = field(repr=False)
    laws: NodeLaws = field(repr=False)

    __repr__ = brief

    @classmethod
    @checked
    def build(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        *,
        method: Method = "exposure",
        rearm: Rearm = "centre",
        tolerance: float = STATISTICS.law_tolerance,
        threads: int | None = None,
        progress: Progress | bool | None = None,
    ) -> Table:
        """Build a table: evaluate every entry.

        Parameters
        ----------
        system
            Laser, detector and histogram. Its detection efficiency and dark counts are ignored (`System.detected`).
        signal, background
            Axes, detected photons per period (`Flux.detected`): ``(low, high, points)`` for 0 and `points` log-spaced
            values, or an array of values. At 0 cumulants have the slopes of a Poisson law.
        method
            ``"exposure"``: exact statistics of the finite exposure. ``"mars"``: the paper's, Markov chain and
            Gaussian of the Markov-renewal law, asymptotic in the exposure.
        rearm
            ``"centre"`` or ``"edge"`` of the bin, for ``"mars"``.
        tolerance
            Of each entry, for ``"exposure"``: see `exposure_moments`.
        threads
            Threads to run on; default: all processors that this process may use.
        progress
            Called as ``progress(done, total)``; an exception from it stops the build.

        Raises
        ------
        ValueError, TypeError
            An invalid argument, before any work.
        ConvergenceError
            An entry could not be evaluated; the message names it.
        """
        require_mode("a table", system)
        system = system.detected()  # its axes are detected photons
        axes = axis_values("signal", signal), axis_values("background", background)
        if rearm != "centre" and method != "mars":
            raise ValueError(f"rearm must be 'centre' for method {method!r}, which has no such option, got {rearm!r}")
        tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
        progress = callback_of(progress, "building a table")
        evaluation = Evaluation(method, rearm, tolerance, thread_count(threads))
        began = time.perf_counter()
        table = _evaluated(system, axes, evaluation, progress)
        error = table.quantisation_error(samples=TOL.error_pixels, threads=evaluation.threads)
        longest = table._long_error(evaluation.threads)
        table.provenance.update(
            key=storage.request_key(system, axes, method=method, rearm=rearm, tolerance=tolerance),
            error=error.to_dict(),
            error_longest=None if longest is None else longest.to_dict(),
            build_s=time.perf_counter() - began,
        )
        return table

    @classmethod
    @checked
    def cached(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        **options: Any,
    ) -> Table:
        """The table of `build` from the user's cache (docs/lookup_table.md), built and stored there if missing.

        Arguments, `options` included, are those of `build`. If the cache cannot be written, the table is built with a
        warning.
        """
        own, existing = cls._search(system, signal, background, options)
        if existing is None:
            table = cls.build(system.detected(), signal, background, **options)
            try:
                storage.put_into_cache(table.save, own)
            except OSError as error:
                warnings.warn(
                    f"the table cannot be kept in {own.parent} ({reason(error)}) and will be built again the next "
                    "time; MARS_LIDAR_CACHE names another folder",
                    UserWarning,
                    stacklevel=2,
                )
                return table
        return cls.load(existing or own, system)

    @classmethod
    @checked
    def cached_path(cls, system: System, signal: Grid, background: Grid, **options: Any) -> Path:
        """File of the table in the cache, built and stored there if missing.

        Arguments, `options` included, are those of `build`. A table for another number of cycles is used if all its
        entries are valid for those of `system`.
        """
        own, existing = cls._search(system, signal, background, options)
        if existing is None:
            storage.put_into_cache(cls.build(system.detected(), signal, background, **options).save, own)
        return existing or own

    @classmethod
    def _search(
        cls, system: System, signal: Grid, background: Grid, options: dict[str, Any]
    ) -> tuple[Path, Path | None]:
        """Path of the table in the cache, and the existing file that can be used instead, or None."""
        system = system.detected()
        chosen: dict[str, Any] = {
            "method": "exposure",
            "rearm": "centre",
            "tolerance": STATISTICS.law_tolerance,
        } | options
        unknown = set(chosen) - {"method", "rearm", "tolerance", "threads", "progress"}
        if unknown:
            raise TypeError(f"the options are those of Table.build, got {sorted(unknown)[0]!r}")
        axes = axis_values("signal", signal), axis_values("background", background)
        request = {name: chosen[name] for name in ("method", "rearm", "tolerance")}
        own, others = storage.cached_candidates(storage.request_key(system, axes, **request), system.cycles)
        for path in (own, *others):
            with contextlib.suppress(OSError, ValueError):  # absent, out of reach, damaged, or of too few cycles
                cls.load(path, system)
                return own, path
        return own, None

    @checked
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write to an HDF5 file `path` (.h5, .hdf5), renamed to its final name when complete.

        An existing file is an error unless `overwrite` is true.
        """
        made_for = self.system.replace(cycles=self.entries.cycles)
        header = {
            "system": made_for.to_json(),
            "method": self.method,
            "rearm": self.rearm,
            "tolerance": self.tolerance,
            "provenance": json.dumps(self.provenance),
        }
        arrays: dict[str, NDArray[Any]] = {"signal": self.signal, "background": self.background}
        for prefix, part in (("", self.entries), ("phase_", self.start_phases), ("law_", self.laws)):
            arrays |= {prefix + name: each for name, each in vars(part).items() if isinstance(each, np.ndarray)}
        arrays["phase_settled"] = arrays["phase_settled"].astype(np.uint8)
        storage.write(Path(path), header, arrays, overwrite)

    @classmethod
    @checked
    def load(cls, path: str | Path, system: System | None = None) -> Table:
        """Read the table in the file `path`, for `system` (None: the system of the table).

        Raises
        ------
        ValueError
            The table is of another system; the message names the field that differs. Another number of cycles is
            accepted if all entries are valid for it.
        """
        with reading(path, "a table of mars-lidar") as source:
            header, arrays = storage.read(source)
            made_for = System.from_json(header["system"])
            system = made_for if system is None else system.detected()
            storage.compare(source, made_for, system)
            arrays["phase_settled"] = arrays["phase_settled"].astype(bool)
            own = {each.name: arrays[each.name] for each in fields(Entries) if each.name not in ("cycles", "startup")}
            table = cls(
                system,
                header["method"],
                arrays["signal"],
                arrays["background"],
                header["rearm"],
                float(header["tolerance"]),
                json.loads(header["provenance"]),
                Entries(cycles=made_for.cycles, **own, startup=arrays.get("startup")),
                StartPhases(**{each.name: arrays["phase_" + each.name] for each in fields(StartPhases)}),
                NodeLaws(**{each.name: arrays["law_" + each.name] for each in fields(NodeLaws)}),
            )
            if not table.serves(system.cycles):
                raise ValueError(
                    f"{source} is a table of another system: cycles is {made_for.cycles} there and {system.cycles} "
                    "here, and not every entry holds for other cycles"
                )
            return table

    @checked
    def lookup(
        self,
        flux: Flux,
        *,
        cycles: int | None = None,
        interpolation: Interpolation = "bilinear",
        outside: Literal["error", "exact"] = "error",
        threads: int | None = 1,
    ) -> Lookup:
        """Entries for the pixels of a flux.

        Parameters
        ----------
        flux
            Light of one return a pixel, detected photons per period (`Flux.detected`); P is the number of its pixels,
            in C order.
        cycles
            Laser periods of the exposure; None: the system's.
        interpolation
            ``"bilinear"``: the mean histogram is a mixture of four, linear in S and in B; cumulants are bicubic in
            their logarithms. ``"nearest"``: the nearest entry, as in the paper.
        outside
            ``"error"``, or ``"exact"``: pixels beyond the axes are marked in `Lookup.outside` for the caller.
        threads
            Threads to run on; the result does not depend on it.

        Raises
        ------
        TypeError
            `flux` is not a `Flux`.
        ValueError
            Pixels outside the table (the message names the range), entries that are not valid for `cycles`, or a flux
            with a waveform or several returns.
        """
        if flux.waveform is not None or len(flux.returns_signal) != 1:
            raise ValueError("flux must have one return a pixel: a table has none for waveforms or several returns")
        light = flux.signal, flux.background, flux.delay_ns
        return self.at(*light, cycles=cycles, interpolation=interpolation, outside=outside, threads=threads)

    @checked
    def at(
        self,
        signal: ArrayLike,
        background: ArrayLike,
        delay_ns: ArrayLike | None = None,
        *,
        cycles: int | None = None,
        interpolation: Interpolation = "bilinear",
        outside: Literal["error", "exact"] = "error",
        threads: int | None = 1,
    ) -> Lookup:
        """`lookup` of arrays `signal`, `background` and `delay_ns` that broadcast, for engines.

        Without delays, at the canonical t_r / 2; `cycles`, `interpolation`, `outside` and `threads` as there.
        """
        periods = self._cycles(cycles)
        team = thread_count(threads)
        s, b, phase, beyond = read_pixels(
            self.system.period_ns, (self.signal, self.background), signal, background, delay_ns, outside
        )
        inside = np.flatnonzero(~beyond)
        rows, weights = np.zeros((s.size, 4), np.int64), np.zeros((s.size, 4))
        weights[:, 0] = 1.0
        cumulants = np.full((s.size, 4), np.nan)
        everything = inside.size == s.size
        pick: NDArray[np.int64] | slice = slice(None) if everything else inside
        rows[pick], weights[pick], cumulants[pick] = evaluate(
            (self.signal, self.background),
            self.entries.cumulants_at(periods),
            self.limit(periods),
            self.start_phases,
            periods == self.entries.cycles,
            s[pick],
            b[pick],
            phase[pick],
            interpolation == "nearest",
            team,
        )
        if np.isnan(cumulants[inside]).any():
            self._refuse(periods)
        return Lookup(rows, weights, cumulants, beyond)

    def shapes(self, cycles: int | None = None) -> NDArray[np.float32]:
        """Normalised mean histograms at the canonical delay t_r / 2 (nS * nB, bins), float32, read-only.

        Row iS * nB + iB belongs to ``signal[iS], background[iB]``. Computed at each call for cycles other than the
        table's. Rows that are not valid for `cycles` are NaN; `lookup` refuses them.
        """
        shapes = self.entries.shapes_at(self._cycles(cycles)).view()
        shapes.flags.writeable = False
        return shapes

    def serves(self, cycles: int) -> bool:
        """Whether every entry is valid for exposures of `cycles` periods."""
        periods = self._cycles(cycles)
        own = periods == self.entries.cycles
        return own or bool(self.entries.serves(periods).all() and self.start_phases.settled.all())

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        parts = vars(self.entries) | vars(self.laws)
        parts |= {name: getattr(self.start_phases, name) for name in ("correction", "settled")}
        return sum(each.nbytes for each in parts.values() if isinstance(each, np.ndarray))

    def limit(self, cycles: int) -> FloatArray:
        """Slopes of the cumulants (4,) in S and in B without light: of a Poisson law, or of method ``"mars"``."""
        return np.array([1.0, 1.0, 1.0, 1.0] if self.method == "exposure" else [1.0, 1.0, 0.0, 0.0]) * cycles

    def _cycles(self, cycles: int | None) -> int:
        return self.system.cycles if cycles is None else checks.integer("cycles", cycles, low=1, high=10**8)

    def _refuse(self, cycles: int) -> None:
        """Raise, naming the entry that holds for the fewest numbers of cycles."""
        enough = self.entries.enough
        worst = int(np.argmin(enough)) if (enough < 0).any() else int(np.argmax(enough))
        s, b = self.signal[worst // self.background.size], self.background[worst % self.background.size]
        if enough[worst] < 0:
            why = f"the state of a pixel at S = {s:g}, B = {b:g} does not repeat from period to period by then"
        elif enough[worst] > cycles:
            why = f"the state of a pixel at S = {s:g}, B = {b:g} repeats only after {enough[worst]} periods"
        else:
            why = "the effect of the delay has not settled by then"
        raise ValueError(
            f"cycles must be {self.entries.cycles} at some of these pixels, got {cycles}: the table was made for "
            f"{self.entries.cycles} cycles, and {why}"
        )

    @checked
    def quantisation_error(
        self,
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
            and the lowest value, where the axis has a 0, and quarters of these cells come on top.
        threads
            Threads to run on; default: all processors that this process may use.
        """
        samples = checks.integer("samples", samples, low=1, high=1_000_000)
        rng = np.random.default_rng(checks.integer("seed", seed, low=0, high=2**64 - 1))
        periods = self.system.cycles if cycles is None else checks.integer("cycles", cycles, low=1, high=10**8)
        system = self.system.replace(cycles=periods)
        below = interpolation == "bilinear"  # the nearest entry knows nothing between 0 and the lowest value
        signal, background = (random_pixels(rng, axis, samples, below) for axis in (self.signal, self.background))
        if below:
            dim = dim_pixels(self.signal, self.background)
            signal, background = np.append(signal, dim[0]), np.append(background, dim[1])
        evaluation = Evaluation(self.method, self.rearm, self.tolerance, thread_count(threads))
        exact = evaluation.entries(signal, background, system)
        looked_up = self.at(signal, background, cycles=periods, interpolation=interpolation)
        mixed = looked_up.mixture(self.shapes(periods))
        error = deviations(looked_up.cumulants, exact.cumulants)
        shape = 0.5 * np.abs(mixed - exact.shape).sum(-1)
        delayed, delayed_shape = error, shape
        if self.method == "exposure":
            shift = rng.integers(0, system.bins, signal.size)
            delay, cumulants, delayed_shape = self._against_exact(
                signal, background, shift, mixed, periods, evaluation.threads
            )
            law = self.at(signal, background, delay, cycles=periods, interpolation=interpolation)
            delayed = deviations(law.cumulants, cumulants)
        variation = np.maximum(law_variation(error), law_variation(delayed))
        worst = int(np.argmax(np.maximum(variation, shape)))
        return QuantisationError(
            interpolation=interpolation,
            samples=signal.size,
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
            law_max=float(variation.max()),
            worst_signal=float(signal[worst]),
            worst_background=float(background[worst]),
        )

    def _long_error(self, threads: int) -> QuantisationError | None:
        """Errors at the longest exposure, 1e8 cycles; None where some entry does not serve it, or has no exact law."""
        if self.system.cycles != TOL.cycles and not self.entries.serves(TOL.cycles).all():
            return None
        try:
            return self.quantisation_error(samples=TOL.error_pixels, cycles=TOL.cycles, threads=threads)
        except ConvergenceError:  # the law of a random pixel between the entries, which is much of a locked one
            return None

    def start_up_error(
        self,
        signal: FloatArray,
        background: FloatArray,
        delay_ns: FloatArray,
        *,
        cycles: int | None = None,
        interpolation: Interpolation = "bilinear",
        threads: int | None = None,
    ) -> FloatArray:
        """Share (P,) of the registrations that the table misplaces because the shape is that of the canonical delay.

        Total variation between the table's shape, shifted to the delay `delay_ns` (P,) by whole bins, and the exact
        shape, minus the same at the canonical delay. Each pixel is evaluated twice. `interpolation` and
        `cycles` are those of `lookup`, `threads` those of `quantisation_error`.
        """
        periods = self._cycles(cycles)
        entries = self.at(signal, background, cycles=periods, interpolation=interpolation)
        mixed, system = entries.mixture(self.shapes(periods)), self.system
        shift = np.rint((np.asarray(delay_ns) - 0.5 * system.period_ns) / system.bin_ns).astype(np.int64) % system.bins
        delayed, canonical = (
            self._against_exact(signal, background, bins, mixed, periods, threads)[-1]
            for bins in (shift, np.zeros_like(shift))
        )
        return np.maximum(delayed - canonical, 0.0)

    def _against_exact(
        self,
        signal: FloatArray,
        background: FloatArray,
        shift: IndexArray,
        mixed: FloatArray,
        cycles: int,
        threads: int | None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Delays (P,), `shift` bins after the canonical one, the exact cumulants there, and errors (P,) of `mixed`."""
        system = self.system.replace(cycles=cycles)
        delay = np.asarray(0.5 * system.period_ns + shift * system.bin_ns, dtype=np.float64)
        exact = exposure_moments(Flux(signal, background, delay), system, tolerance=self.tolerance, threads=threads)
        moved = np.stack([np.roll(row, k) for row, k in zip(mixed, shift, strict=True)])
        error = 0.5 * np.abs(moved - normalised(exact.histogram).reshape(moved.shape)).sum(-1)
        return delay, exact.cumulants, np.asarray(error, dtype=np.float64)


def _evaluated(system: System, axes: Axes, evaluation: Evaluation, progress: Progress | None) -> Table:
    signal, background = axes
    check_memory(
        2 * 4 * signal.size * background.size * system.bins,
        f"tables of {signal.size} x {background.size} x {system.bins}",
        "take fewer points or bins",
    )
    cells = signal.size * background.size
    settled = cells + max(1, cells // 10)  # the start phases take about so much of the time
    total = settled + max(1, cells // 20)  # and the laws of some entries so much
    entries = evaluation.entries(
        np.repeat(signal, background.size), np.tile(background, signal.size), system, of_part(progress, 0, cells, total)
    )
    phases, laws = StartPhases.none(), NodeLaws.none()
    if evaluation.method == "exposure":
        phases = start_phases(
            system,
            signal,
            background,
            entries.cumulants,
            entries.bins,
            threads=evaluation.threads,
            progress=of_part(progress, cells, settled, total),
        )
        laws = node_laws(
            system,
            signal,
            background,
            entries,
            threads=evaluation.threads,
            progress=of_part(progress, settled, total, total),
        )
    if progress is not None:
        progress(total, total)
    provenance = {"version": __version__, "signal": describe(signal), "background": describe(background)}
    made_as = evaluation.method, signal, background, evaluation.rearm, evaluation.tolerance
    return Table(system, *made_as, provenance, entries, phases, laws)
