"""`generate`: from a recipe to a dataset on disk, on one machine or on many, in one run or in several."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mars_lidar._base import checks, files
from mars_lidar._base.arguments import checked
from mars_lidar._base.buckets import in_bucket, place_of
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import check_threads, no_thread, thread_count
from mars_lidar._base.types import Progress
from mars_lidar._version import __version__
from mars_lidar.dataset import cluster
from mars_lidar.dataset.cluster import LOOK_S, Crew, Team
from mars_lidar.dataset.ingest import create
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.store import Dataset, Item, open_dataset
from mars_lidar.dataset.write import Failed, Made, Maker, fingerprint
from mars_lidar.io.scene_files import Problem
from mars_lidar.io.zarr_store import check_zarr_threads

_NAMED = 5  # most parts named in an error
BUFFER_BYTES = 512 * 2**20  # of all chunks that are made at the same time on one machine


@dataclass(frozen=True)
class Generated:
    """Result of `generate`: the dataset, and the parts and seconds of the run.

    Attributes
    ----------
    path
        The dataset.
    shape
        (samples, realizations, H, W, bins) of its histogram.
    problems
        Files that were skipped, each with the reason.
    parts, parts_before
        Number of parts made in this run, and number that existed before.
    simulate_s, write_s
        Seconds spent on simulation, and on encoding and writing, summed over threads.
    seconds
        Wall clock.

    See Also
    --------
    generate

    Examples
    --------
    >>> import tempfile
    >>> import mars_lidar as ml
    >>> system = {
    ...     "period_ns": 100.0, "cycles": 200, "bins": 64,
    ...     "pulse": {"kind": "gaussian", "sigma_ns": 1.0}, "detector": {"dead_time_ns": 75.0},
    ... }
    >>> recipe = {"scenes": {"example": "room", "size": [8, 12]}, "systems": system, "light": {"signal": 0.5}}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     done = ml.generate(recipe, f"{folder}/set.zarr")
    >>> done.path.name, done.problems
    ('set.zarr', ())
    """

    path: Path
    shape: tuple[int, ...]
    problems: tuple[Problem, ...]
    parts: int
    parts_before: int
    simulate_s: float
    write_s: float
    seconds: float


@checked
def generate(
    recipe: DatasetRecipe | dict[str, Any] | str | Path | None,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    threads: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | bool | None = None,
) -> Generated:
    """Simulate a dataset, scenes x systems x levels of light x realizations, into a Zarr store.

    The store does not depend on threads, workers, or interruptions: the same recipe gives the same files, byte for
    byte. Read it with ``xarray.open_zarr(out)`` or, as training examples, with `mars_lidar.learn.StoredDataset`.

    Parameters
    ----------
    recipe
        A YAML file, or its content as a dictionary (paths are then relative to the working directory), or a
        `mars_lidar.dataset.DatasetRecipe`. docs/generate.md explains the keys. None, with `resume`: the one in the
        store.
    out
        The store, ``NAME.zarr``.
    resume
        Continue an interrupted run with the same recipe; a complete store is left unchanged.
    overwrite
        Replace an existing store. The new one is written beside it, as ``NAME.incomplete.zarr``, and takes its place
        when complete; open readers of the old store then get an error, never a mixture of both.
    threads
        Threads of this process; default: all processors it may use. With `workers`: of each worker, default 1.
    workers
        Run on so many worker processes (dask.distributed; extra ``cluster``).
    scheduler
        Address of a running dask scheduler, whose workers see `out` under the same path.
    progress
        Called with (parts done, all parts); True: a bar, or a line every 30 s without a terminal.

    Raises
    ------
    FileNotFoundError
        The recipe or a file that it names.
    ValueError, TypeError
        A bad recipe or argument; nothing was written.
    FileExistsError
        `out` exists, and neither `resume` nor `overwrite` is given.
    mars_lidar.io.WriteError, mars_lidar.io.Interrupted
        Interrupted (a full disk, Ctrl-C); the message states how to continue.

    See Also
    --------
    simulate, Scene, mars_lidar.learn.StoredDataset

    Examples
    --------
    >>> import tempfile
    >>> import mars_lidar as ml
    >>> system = {
    ...     "period_ns": 100.0, "cycles": 200, "bins": 64,
    ...     "pulse": {"kind": "gaussian", "sigma_ns": 1.0}, "detector": {"dead_time_ns": 75.0},
    ... }
    >>> scenes = {"example": "room", "size": [8, 12]}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     recipe = {"scenes": scenes, "systems": system, "light": {"signal": [0.1, 1.0]}}
    ...     done = ml.generate(recipe, f"{folder}/set.zarr")
    >>> done.shape  # (samples, realizations, H, W, bins)
    (2, 1, 8, 12, 64)
    """
    began = time.perf_counter()
    progress = callback_of(progress, "generating")
    target = _target(out)
    threads = None if threads is None else checks.integer("threads", threads, low=1, high=1024)
    with _begun(recipe, target, resume, overwrite, _crew(workers, scheduler)) as (store, dataset, crew):
        dataset.tidy()
        todo = [] if dataset.complete else dataset.missing()
        before = sum(1 for _ in dataset.items()) - len(todo)
        totals = _Totals(before, before + len(todo), progress)
        team: AbstractContextManager[Team] = _here(dataset, len(todo), threads)
        if crew is not None:
            team = contextlib.nullcontext(crew.team(dataset, threads or 1))
        _make(dataset, team, todo, totals)
        if not dataset.complete:
            dataset.tidy()  # of workers that were killed while others went on
            dataset.finish()
        dataset = _in_place(store, target, dataset)
    return totals.generated(target, dataset, time.perf_counter() - began)


@checked
def begin(
    recipe: DatasetRecipe | dict[str, Any] | str | Path,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Generated:
    """Begin a dataset whose parts other processes make: read its scenes and create its arrays.

    Afterwards `make_part` runs in any process, in any order and concurrently, such as in the jobs of a job array; then
    `finish`. The store is that of `generate`, byte for byte.

    Parameters
    ----------
    recipe, out, resume, overwrite
        As for `generate`.
    workers, scheduler
        As for `generate`: they read the scenes.

    Returns
    -------
    Generated

    Raises
    ------
    TypeError, ValueError
        A bad recipe or argument; nothing was written.
    FileExistsError
        `out` exists, and neither `resume` nor `overwrite` is given.

    See Also
    --------
    make_part, finish, mars_lidar.generate

    Examples
    --------
    >>> import tempfile
    >>> from mars_lidar import dataset
    >>> system = {
    ...     "period_ns": 100.0, "cycles": 200, "bins": 64,
    ...     "pulse": {"kind": "gaussian", "sigma_ns": 1.0}, "detector": {"dead_time_ns": 75.0},
    ... }
    >>> recipe = {"scenes": {"example": "room", "size": [8, 12]}, "systems": system, "light": {"signal": [0.1, 1.0]}}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     begun = dataset.begin(recipe, f"{folder}/set.zarr")
    ...     parts = [dataset.make_part(f"{folder}/set.zarr", (k, 2)) for k in (1, 2)]  # anywhere, in any order
    ...     done = dataset.finish(f"{folder}/set.zarr")
    >>> done.shape  # (samples, realizations, H, W, bins)
    (2, 1, 8, 12, 64)
    """
    began, target = time.perf_counter(), _target(out)
    with _begun(recipe, target, resume, overwrite, _crew(workers, scheduler)) as (_, dataset, _):
        return _Totals(0, 0, None).generated(target, dataset, time.perf_counter() - began)


@checked
def make_part(
    out: str | Path, part: tuple[int, int], *, threads: int | None = None, progress: Progress | bool | None = None
) -> Generated:
    """Make the K-th of N parts of a dataset that `begin` created; existing files are not made again.

    Parameters
    ----------
    out
        The store.
    part
        (K, N), K from 1 to N.
    threads, progress
        As for `generate`.

    Returns
    -------
    Generated

    Raises
    ------
    TypeError
        Arguments of another kind.
    ValueError
        An invalid part (K, N); a store that `begin` did not create, or that another version or other bits began.
    FileNotFoundError
        No store.

    See Also
    --------
    begin, finish

    Examples
    --------
    >>> import tempfile
    >>> from mars_lidar import dataset
    >>> system = {
    ...     "period_ns": 100.0, "cycles": 200, "bins": 64,
    ...     "pulse": {"kind": "gaussian", "sigma_ns": 1.0}, "detector": {"dead_time_ns": 75.0},
    ... }
    >>> recipe = {"scenes": {"example": "room", "size": [8, 12]}, "systems": system, "light": {"signal": 0.5}}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     begun = dataset.begin(recipe, f"{folder}/set.zarr")
    ...     made = dataset.make_part(f"{folder}/set.zarr", (1, 1))
    >>> made.parts
    2
    """
    began, target = time.perf_counter(), _target(out)
    which = checks.integer("K", part[0], low=1, high=2**31)
    of = checks.integer("N", part[1], low=which, high=2**31)
    with _alone(target, shared=True):
        store, dataset = _opened(target)
        if dataset.complete:
            return _Totals(0, 0, None).generated(target, dataset, time.perf_counter() - began)
        if dataset.attrs.get("bits") != fingerprint():
            raise ValueError(f"this machine draws other counts than that on which {store} was begun")
        with _explained(store, target):
            share = _share(list(dataset.items()), which, of)
            todo = dataset.missing(share)
            totals = _Totals(len(share) - len(todo), len(share), callback_of(progress, "generating"))
            _make(dataset, _here(dataset, len(todo), threads), todo, totals)
    return totals.generated(target, dataset, time.perf_counter() - began)


@checked
def finish(out: str | Path) -> Generated:
    """Mark a dataset complete after `make_part` has made all its parts.

    Only files for which the writer stored no checksum are read again.

    Parameters
    ----------
    out
        The store.

    Returns
    -------
    Generated

    Raises
    ------
    TypeError
        `out` is not a path.
    ValueError
        A part is missing.
    FileNotFoundError
        No store.

    See Also
    --------
    begin, make_part

    Examples
    --------
    >>> import tempfile
    >>> from mars_lidar import dataset
    >>> system = {
    ...     "period_ns": 100.0, "cycles": 200, "bins": 64,
    ...     "pulse": {"kind": "gaussian", "sigma_ns": 1.0}, "detector": {"dead_time_ns": 75.0},
    ... }
    >>> recipe = {"scenes": {"example": "room", "size": [8, 12]}, "systems": system, "light": {"signal": 0.5}}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     begun = dataset.begin(recipe, f"{folder}/set.zarr")
    ...     made = dataset.make_part(f"{folder}/set.zarr", (1, 1))
    ...     done = dataset.finish(f"{folder}/set.zarr")
    >>> done.shape
    (1, 1, 8, 12, 64)
    """
    began, target = time.perf_counter(), _target(out)
    with _alone(target):
        store, dataset = _opened(target)
        with _explained(store, target):
            if not dataset.complete:
                dataset.tidy()
                if missing := dataset.missing():
                    total = sum(1 for _ in dataset.items())
                    raise files.IncompleteFileError(
                        f"{len(missing)} of {total} shards of {store} are missing, the first "
                        f"{dataset.files(missing[0])[0]}: run the --part jobs that did not end well again"
                    )
                dataset.finish()
            dataset = _in_place(store, target, dataset)
    return _Totals(0, 0, None).generated(target, dataset, time.perf_counter() - began)


def _share(items: list[Item], which: int, of: int) -> list[Item]:
    """Contiguous parts of the maps and of the counts: neighbours share scenes."""
    out = []
    for kind in ("maps", "histogram"):
        some = [item for item in items if item.kind == kind]
        out += some[(which - 1) * len(some) // of : which * len(some) // of]
    return out


def _target(out: str | Path) -> Path:
    target: Path = place_of(out)
    checks.suffix("out", target, [".zarr"])
    check_zarr_threads()
    return target


def _crew(workers: int | None, scheduler: str | None) -> AbstractContextManager[Crew | None]:
    """Workers, which start when they are needed; ValueError where they cannot start."""
    if workers is not None and scheduler is not None:
        raise ValueError("workers start a cluster and scheduler joins one: give one of them")
    if workers is None and scheduler is None:
        return contextlib.nullcontext()
    cluster.reach(scheduler)  # before the scenes are read
    return cluster.crew(None if workers is None else checks.integer("workers", workers, low=1, high=1024), scheduler)


@contextlib.contextmanager
def _begun(
    recipe: DatasetRecipe | dict[str, Any] | str | Path | None,
    target: Path,
    resume: bool,
    overwrite: bool,
    workers: AbstractContextManager[Crew | None],
) -> Iterator[tuple[Path, Dataset, Crew | None]]:
    """Context manager: the store to be written, its dataset with all scenes, and the workers.

    No other process can write the store meanwhile, and errors state what remains on the disk.
    """
    if resume and overwrite:
        raise ValueError("resume and overwrite exclude each other")
    wanted, folder = read_recipe(recipe)
    if not (in_bucket(target) and resume):
        files.check_target(target, folder=True, overwrite=overwrite or resume)
    with _alone(target):  # the store is examined under the lock, because another run may just have finished it
        beside = target if in_bucket(target) else files.successor(target)
        if overwrite and beside.exists():
            shutil.rmtree(beside)  # of a stopped run that is repeated
        replacing = overwrite and target.exists()  # by a store that is made beside it, or one that was begun so
        store = beside if replacing or (resume and beside.exists()) else target
        there = store.exists() and resume
        if there:
            dataset = open_dataset(str(store), allow_incomplete=True)
            _check_same(store, dataset, wanted)
        elif wanted is None:
            raise ValueError(f"{target} does not exist: there is nothing to resume, and no recipe is given")
        if not (in_bucket(target) and there):
            files.check_target(target, folder=True, overwrite=overwrite or there)
        begun = there and dataset.planned
        if not begun and wanted is None:
            raise ValueError(f"{target} was stopped before its scenes were in: give the recipe again to resume")
        with _explained(store, target), workers as crew:
            if not begun:
                assert wanted is not None
                create(store, wanted, folder, crew)
                dataset = open_dataset(str(store), allow_incomplete=True)
            yield store, dataset, crew


def _opened(target: Path) -> tuple[Path, Dataset]:
    """The store that `begin` began, made by this version."""
    store = target if in_bucket(target) or not files.successor(target).exists() else files.successor(target)
    dataset = open_dataset(str(store), allow_incomplete=True)
    _check_same(store, dataset, None)
    if not dataset.planned:
        raise files.IncompleteFileError(f"{store} was stopped before its scenes were in: --begin --resume goes on")
    return store, dataset


def _in_place(store: Path, target: Path, dataset: Dataset) -> Dataset:
    """The complete dataset under its final name."""
    if store == target:
        return dataset
    files.exchange(store, target)
    return open_dataset(str(target))


@contextlib.contextmanager
def _explained(store: Path, target: Path) -> Iterator[None]:
    """Context manager: errors of the file system and of threads, and Ctrl-C, state what remains on the disk."""
    try:
        yield
    except KeyboardInterrupt:
        raise files.Interrupted(f"interrupted; {_remaining(store, target)}") from None
    except RuntimeError as error:
        if not no_thread(error):
            raise
        text = f"{error}: give fewer threads, or more memory; {_remaining(store, target)}"
        raise files.WriteError(errno.EAGAIN, text) from error
    except MemoryError as error:
        raise files.WriteError(errno.ENOMEM, f"{error or 'no memory'}; {_remaining(store, target)}") from error
    except OSError as error:
        if isinstance(error, FileNotFoundError | FileExistsError) and not store.exists():
            raise
        raise files.WriteError(error.errno, f"{error.strerror or error}; {_remaining(store, target)}") from error


def read_recipe(recipe: DatasetRecipe | dict[str, Any] | str | Path | None) -> tuple[DatasetRecipe | None, Path]:
    """The recipe in any of its forms, and the folder that its paths are relative to."""
    if recipe is None or isinstance(recipe, DatasetRecipe):
        return recipe, Path()
    if isinstance(recipe, dict):
        return DatasetRecipe.from_dict(recipe), Path()
    return DatasetRecipe.load(recipe), Path(recipe).parent


class _Totals:
    """Adds up the times of the parts and reports the progress."""

    def __init__(self, done: int, total: int, progress: Progress | None) -> None:
        self._done, self._total, self._progress = done, total, progress
        self._before = done
        if progress is not None:
            progress(done, total)  # the parts of an earlier run
        self.simulate_s = self.write_s = 0.0

    def add(self, made: Made) -> None:
        self._done += 1
        self.simulate_s += made.simulate_s
        self.write_s += made.write_s
        if self._progress is not None:
            self._progress(self._done, self._total)

    def generated(self, target: Path, dataset: Dataset, seconds: float) -> Generated:
        """The result of a run."""
        problems, shape = tuple(dataset.problems), tuple(dataset.histogram.shape)
        made = self._done - self._before
        return Generated(target, shape, problems, made, self._before, self.simulate_s, self.write_s, seconds)


def _make(dataset: Dataset, team: AbstractContextManager[Team], todo: Sequence[Item], totals: _Totals) -> None:
    """Make the missing parts."""
    for item in todo:
        for damaged in dataset.files(item):  # else Zarr would read it before it is replaced
            damaged.unlink(missing_ok=True)
    if todo:
        _make_all(team, todo, totals.add)


@contextlib.contextmanager
def _here(dataset: Dataset, parts: int, threads: int | None) -> Iterator[Team]:
    """Threads, each of which simulates, packs and writes parts of its own.

    Simulator and compressors run without Python's lock. Where so many chunks would not fit in `BUFFER_BYTES`, fewer
    parts are made at a time, each on several threads.
    """
    team = thread_count(threads or None)
    array = dataset.histogram
    waveforms = dataset.scenes.waveform_parts(dataset.recipe.systems)
    chunk = making_bytes(array.chunks, array.dtype.itemsize, waveforms)
    teams = max(1, min(team, parts, BUFFER_BYTES // chunk))
    check_threads(team)
    stop, local = threading.Event(), threading.local()

    makers: list[Maker] = []

    def make(items: Sequence[Item]) -> list[Made | Failed]:
        if not hasattr(local, "maker"):
            local.maker = Maker(dataset, max(1, team // teams), stop)
            makers.append(local.maker)
        return [local.maker.attempt(item) for item in items]

    with ThreadPoolExecutor(teams) as pool:
        try:
            yield Team(pool, make, lambda: teams)
        except BaseException:
            stop.set()  # the simulator checks it every 50 ms, and the pool waits for all threads
            raise
        for maker in makers:
            maker.notes.write()


def _make_all(team: AbstractContextManager[Team], todo: Sequence[Item], add: Callable[[Made], None]) -> None:
    """Make all parts of `todo` concurrently; WriteError at the end if some could not be written."""
    given, failed, seconds = 0, list[Failed](), 0.0
    with team as crew:
        running: set[Future[list[Made | Failed]]] = set()
        while True:
            while len(running) < crew.capacity() and given < len(todo):
                batch = todo[given : given + crew.parts_of_a_task(seconds, len(todo) - given)]
                given += len(batch)
                running.add(crew.executor.submit(crew.make, batch))
            if not running:
                break
            done, running = wait(running, timeout=LOOK_S, return_when=FIRST_COMPLETED)  # workers may come and go
            for future in done:
                for each in future.result():
                    if isinstance(each, Failed):
                        failed.append(each)
                        continue
                    add(each)
                    own = each.simulate_s + each.write_s
                    seconds = own if seconds == 0.0 else 0.9 * seconds + 0.1 * own
    if failed:
        names = ", ".join(sorted(each.name for each in failed)[:_NAMED])
        more = f" and {len(failed) - _NAMED} more" if len(failed) > _NAMED else ""
        raise files.WriteError(
            failed[0].number,
            f"{len(failed)} parts could not be written in four attempts ({failed[0].reason}): {names}{more}",
        )


def making_bytes(chunk: Sequence[int], itemsize: int, waveform_parts: int) -> int:
    """Memory for making a chunk: its dense counts, and waveforms of its pixels, which are copied twice."""
    return math.prod(chunk) * itemsize + 3 * 8 * math.prod(chunk[2:4]) * waveform_parts


def _check_same(target: Path, dataset: Dataset, wanted: DatasetRecipe | None) -> None:
    if dataset.attrs.get("version") != __version__:
        raise ValueError(
            f"{target} was begun by mars-lidar {dataset.attrs.get('version')} and this is {__version__}: "
            "their counts may differ; use that version or start again with overwrite"
        )
    if wanted is None:
        return
    old, new = json.loads(dataset.recipe.to_json()), json.loads(wanted.to_json())
    for name in new:
        if old.get(name) != new[name]:
            raise ValueError(
                f"{target} was begun with another recipe: {name} was {json.dumps(old.get(name))}, "
                f"now {json.dumps(new[name])}; start again with overwrite, or choose another name"
            )


def _remaining(store: Path, target: Path) -> str:
    """Description of what is on the disk, for an error."""
    try:
        dataset = Dataset(store)
        if not dataset.planned:
            raise ValueError
        dataset.tidy()
        total, missing = sum(1 for _ in dataset.items()), len(dataset.missing())
        text = f"{total - missing} of {total} parts of {store} are written, marked incomplete"
    except (OSError, ValueError, KeyError, RuntimeError, MemoryError):
        text = f"{store} is left behind without counts, marked incomplete"
    if store != target:
        text += f", and {target} is what it was before"
    if not in_bucket(target):
        text += f" ({shutil.disk_usage(target.parent).free / 1e9:,.3f} GB free there)"
    return f"{text}: continue with --resume (resume=True)"


@contextlib.contextmanager
def _alone(target: Path, *, shared: bool = False) -> Iterator[None]:
    """Context manager: a lock beside the store while it is written; that of a killed process does not block others.

    Processes that make parts of the store share it (`shared`).
    """
    if in_bucket(target):  # an object store has no locks
        yield
        return
    lock = target.with_name(target.name + ".lock")
    while True:
        with files.open_own(lock) as held:
            try:
                import fcntl
            except ImportError:  # Windows
                yield
                return
            try:
                fcntl.flock(held, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(f"{target} is being written by another process (its lock is {lock})") from None
            except OSError:  # a file system without locks
                pass
            if not (lock.exists() and os.path.samestat(lock.stat(), os.fstat(held.fileno()))):
                continue  # its owner removed the file after it was opened here
            try:
                yield
            finally:
                with contextlib.suppress(OSError):  # the last process that shares the lock removes it
                    if shared:
                        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    lock.unlink(missing_ok=True)
            return
