"""Training examples simulated on demand: no two are equal, and they do not depend on workers."""

from __future__ import annotations

import math
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.resample import image_size
from mars_lidar._base.resources import check_memory, thread_count
from mars_lidar.engines import Engine, check_detector, find_engine
from mars_lidar.engines.simulation import simulate
from mars_lidar.instrument.system import System
from mars_lidar.io.scene_files import SceneFile
from mars_lidar.learn.loaders import UNSIGNED, Buffers, Passes, rank_of, resumed_in_worker, worker_of
from mars_lidar.learn.needed import torch
from mars_lidar.learn.ranges import LogUniform, Range, SystemRange, as_range, as_systems
from mars_lidar.learn.scenes import Sample, Samples, as_source, example_of
from mars_lidar.scene.radiometry import AMBIENTS, ATTENUATIONS
from mars_lidar.scene.scene import Scene


def warn_if_put_together(batched: bool) -> None:
    """In ``__iter__``: warn if the caller is a loader that stacks the examples of the stream.

    No interface provides this; it is read from a variable of the loader's fetcher.
    """
    caller = sys._getframe(2)
    if not caller.f_locals.get("auto_collation", False) or "torch" not in caller.f_code.co_filename:
        return
    info = torch.utils.data.get_worker_info()
    if info is not None and info.id > 0:
        return
    why = (
        "stacks the batches of the stream once more"
        if batched
        else "puts batches together worker by worker: they depend on the number of workers, and cannot be resumed"
    )
    warnings.warn(
        f"this loader {why}: give batch_size to CubeStream and batch_size=None to the loader", UserWarning, stacklevel=4
    )


# --- Examples made ahead -------------------------------------------------------------------------------------------

T = TypeVar("T")


def prefetched(items: Iterator[T], number: int) -> Iterator[T]:
    """The items of an iterator, in order, with up to `number` of them computed ahead by a thread.

    Exceptions of the iterator are raised here, in their place. When this iterator is closed, the thread ends after the
    item that it computes.
    """
    pool, end = ThreadPoolExecutor(1, "mars_lidar.learn"), cast(T, object())
    try:
        coming = deque(pool.submit(next, items, end) for _ in range(number))
        while (item := coming.popleft().result()) is not end:
            coming.append(pool.submit(next, items, end))
            yield item
            del item  # so that its memory can be used again
    finally:
        pool.shutdown(cancel_futures=True)


# --- Counts as tensors ---------------------------------------------------------------------------------------------


class CubeMaker:
    """Simulates the cubes of a batch; `systems` are the extremes of the systems that will be used."""

    def __init__(
        self, engine: Engine, systems: Sequence[System], device: Any, layout: str, axes: str, dtype: Any
    ) -> None:
        for system in systems:
            check_detector(engine, system)
        self._engine = engine
        self._layout = checks.choice("layout", layout, ("dense", "sparse"))
        self._axes = checks.choice("axes", axes, ("THW", "HWT"))
        if dtype is not None and not isinstance(dtype, torch.dtype):
            raise TypeError(f"dtype must be a torch.dtype, or None for the counts as they are, got {dtype!r}")
        self._counts = max((system.histogram_dtype for system in systems), key=lambda dtype: dtype.itemsize)
        self._dtype = dtype
        self._buffers = Buffers()
        self.device = torch.device(device)
        if self.device.type not in ("cpu", "cuda"):
            raise ValueError(f"device must be 'cpu' or 'cuda', got {device!r}")
        self.on_gpu = self.device.type == "cuda"
        if self.on_gpu and not torch.cuda.is_available():
            raise ValueError(
                "device='cuda' needs a GPU and a build of PyTorch for it; torch.cuda.is_available() is False"
            )

    def cubes(self, samples: Sequence[Sample], threads: int) -> torch.Tensor:
        """(samples, T, H, W) or (samples, H, W, T)."""
        shapes = {sample.flux.shape for sample in samples}
        if len(shapes) > 1:
            raise ValueError(f"scenes must be of one size to be stacked, got {sorted(shapes)}; give size")
        shape = (len(samples), *shapes.pop(), samples[0].system.bins)
        if self.on_gpu:
            counts = torch.stack([self._simulated_on_gpu(sample) for sample in samples])
            return self._finished(counts if self._layout == "dense" else counts.to_sparse())
        check_memory(int(np.prod(shape)) * self._counts.itemsize, f"cubes of shape {shape}", "use a smaller batch_size")
        kind = UNSIGNED[self._counts]
        wanted = kind if self._dtype is None else self._dtype
        if self._layout == "sparse":
            counts = self._buffers.take(shape, kind)
            for place, sample in enumerate(samples):
                self._simulated(sample, counts[place : place + 1].numpy(), threads)
            return self._finished(_sparse(counts.numpy()))
        cube = self._buffers.take(shape, wanted)
        for place, sample in enumerate(samples):
            part = cube[place : place + 1]
            if wanted == kind:
                self._simulated(sample, part.numpy(), threads)
                continue
            counts = self._buffers.take((1, *shape[1:]), kind)  # converted while it is still in the cache
            self._simulated(sample, counts.numpy(), threads)
            if wanted == torch.bfloat16:  # which NumPy does not know
                part.copy_(counts)
            else:  # by this thread: those of torch would spin for longer than this takes
                np.copyto(part.numpy(), counts.numpy(), casting="unsafe")
        return self._turned(cube)

    def _simulated(self, sample: Sample, out: NDArray[Any], threads: int) -> None:
        own = sample.system.histogram_dtype == self._counts
        made = simulate(
            sample.flux, sample.system, engine=self._engine, seed=sample.seed, threads=threads, out=out if own else None
        )
        if not own:
            out[:] = made

    def _finished(self, cube: torch.Tensor) -> torch.Tensor:
        return self._turned(cube if self._dtype is None else cube.to(self._dtype))

    def _turned(self, cube: torch.Tensor) -> torch.Tensor:
        if self._axes == "HWT":
            return cube
        turned = cube.permute(0, 3, 1, 2)
        return turned.coalesce() if cube.layout == torch.sparse_coo else turned

    def _simulated_on_gpu(self, sample: Sample) -> torch.Tensor:
        with torch.cuda.device(self.device):
            made: Any = simulate(sample.flux, sample.system, engine=self._engine, seed=sample.seed, device="cuda")
        tensor: torch.Tensor = torch.utils.dlpack.from_dlpack(made)[0]
        return tensor


def _sparse(counts: NDArray[Any]) -> torch.Tensor:
    """COO (samples, H, W, T) of int32."""
    where = np.flatnonzero(counts)
    values = torch.from_numpy(counts.reshape(-1)[where].astype(np.int32))
    indices = torch.from_numpy(np.stack(np.unravel_index(where, counts.shape)).astype(np.int64, copy=False))
    return torch.sparse_coo_tensor(indices, values, counts.shape, is_coalesced=True, check_invariants=False)


# --- The stream ----------------------------------------------------------------------------------------------------

_LAST = 2**62


class CubeStream(torch.utils.data.IterableDataset[dict[str, Any]]):
    """Cubes and their ground truth for a `torch.utils.data.DataLoader`, simulated on demand.

    Sample k of an epoch is a function of (`seed`, epoch, k) and of the settings here, independent of workers, ranks,
    threads and earlier samples. Ranks and workers take batches in turn; none is made twice. Give `batch_size` here
    and ``batch_size=None`` to the loader: the batches are then the same, in the same order, for any number of
    workers, and are simulated in place without a copy.

    An example is a dictionary, with a leading axis where `batch_size` is given: ``counts`` (T, H, W); ``depth`` (m,
    NaN without a return) and ``reflectivity`` (H, W); ``flux``, a dictionary of ``signal``, ``background`` (photons
    per period) and ``delay`` (ns) (H, W); ``system``, a dictionary of ``period_ns``, ``cycles``, ``dead_time_ns``,
    ``sigma_ns``; ``signal_level``, ``sbr``, ``index``, ``seed``. Maps and settings are float32. `sample` returns the
    Scene, Flux and System.

    Parameters
    ----------
    systems
        A System, a list of them (one is drawn for each sample), or a `SystemRange`.
    scenes
        ``"random"`` (default) or ``"room"``: built-in scenes without end. A folder of RGB-D data, as
        `mars_lidar.io.scan` reads it; a dataset of `mars_lidar.generate`, for its maps; Scenes and
        `mars_lidar.io.SceneFile` objects; or arrays: depths (n, H, W) in m, or a dictionary of ``depth``,
        ``reflectivity``, ``background`` (NumPy, PyTorch, or arrays that return these when indexed: memory maps, Zarr).
        In random order; all are used before any is used again. A file that is unreadable or without any return raises a
        warning and is replaced by the next.
    size
        (H, W), or one number for a square: random crops of that size. None: 64 for built-in scenes, else whole
        scenes.
    epoch_size
        Samples in an epoch; None (default): without end.
    batch_size
        Samples stacked into one example; None (default): a single sample without this axis.
    signal, sbr
        Mean signal photons per period over the image, and signal-to-background ratio, as for `mars_lidar.Scene.flux`:
        a number or a range. Default: log-uniform in [0.01, 1] and in [0.1, 10].
    depth_scale
        Factor on the depth: a number or a range.
    flips
        Mirror scenes at random, up-down and left-right.
    attenuation, ambient, dark_count_hz
        As for `mars_lidar.Scene.flux`.
    engine
        Name or `Engine`, as for `mars_lidar.simulate`.
    device
        ``"cpu"``, or ``"cuda"`` for simulation on the GPU, where the cubes remain (in the process of the loader:
        ``num_workers=0``).
    layout
        ``"dense"``, or ``"sparse"``: coalesced COO tensors.
    axes
        ``"THW"``: time first, a view of ``"HWT"`` without a copy (torch's channels-last memory format).
    dtype
        Type of the counts; None: as simulated (uint16 or uint32; int32 for sparse ones).
    reuse
        Mean number of samples from one built-in scene, with different crops, flips, light and instruments.
    seed
        Integer in [0, 2**63).
    threads
        Threads of one process; default: the number of processors over the number of the loader's workers.
    ahead
        Number of examples that a background thread simulates in advance, without workers and on the CPU; 0: none.
        Unlike a worker process, the thread needs no copy of the cubes.
    repeat
        False: every pass is the next epoch, for training. True: every pass is the same epoch, for validation.
    transform
        Called on each example, which its result replaces.
    rank, world_size
        Of a distributed run; default: those of torch.distributed if initialised, else of the environment
        (RANK and WORLD_SIZE, as set by torchrun), else 0 of 1. All ranks give the same number of samples of an
        epoch, so that up to ``world_size - 1`` are omitted.

    Raises
    ------
    ValueError, TypeError
        An invalid argument, or an invalid instrument at an end of the ranges.

    See Also
    --------
    StoredDataset, SystemRange, mars_lidar.simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> stream = ml.learn.CubeStream(system, "room", size=16, batch_size=2, signal=0.5, sbr=2.0, epoch_size=4, seed=1)
    >>> for batch in stream:
    ...     print(tuple(batch["counts"].shape), tuple(batch["depth"].shape))
    (2, 128, 16, 16) (2, 16, 16)
    (2, 128, 16, 16) (2, 16, 16)
    """

    def __init__(
        self,
        systems: System | Sequence[System] | SystemRange,
        scenes: str | Path | Scene | SceneFile | Sequence[Scene | SceneFile] | Mapping[str, Any] | Any = "random",
        *,
        size: int | tuple[int, int] | None = None,
        epoch_size: int | None = None,
        batch_size: int | None = None,
        signal: float | Range = LogUniform(0.01, 1.0),  # noqa: B008  (frozen)
        sbr: float | Range = LogUniform(0.1, 10.0),  # noqa: B008
        depth_scale: float | Range = 1.0,
        flips: bool = True,
        attenuation: Literal["none", "inverse_square"] = "none",
        ambient: Literal["uniform", "reflectivity", "map"] | None = None,
        dark_count_hz: float = 0.0,
        engine: str | Engine = "exact",
        device: str | torch.device = "cpu",
        layout: Literal["dense", "sparse"] = "dense",
        axes: Literal["THW", "HWT"] = "THW",
        dtype: torch.dtype | None = torch.float32,
        reuse: int = 16,
        seed: int = 0,
        threads: int | None = None,
        ahead: int = 1,
        repeat: bool = False,
        transform: Callable[[dict[str, Any]], Any] | None = None,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        super().__init__()
        shape = None if size is None else image_size(size if isinstance(size, tuple | list) else (size, size))
        if shape is None and isinstance(scenes, str) and scenes in Scene.example_names():
            shape = (64, 64)
        drawn = as_systems(systems)
        checks.choice("attenuation", attenuation, ATTENUATIONS)
        checks.choice("ambient", "map" if ambient is None else ambient, AMBIENTS)
        dark = checks.real("dark_count_hz", dark_count_hz, low=0.0)
        self._samples = Samples(
            source=as_source(scenes, shape, reuse),
            systems=drawn,
            size=shape,
            flips=bool(flips),
            signal=as_range("signal", signal),
            sbr=as_range("sbr", sbr, infinite=True),
            depth_scale=as_range("depth_scale", depth_scale),
            lit={"attenuation": attenuation, "ambient": ambient, "dark_count_hz": dark},
            seed=checks.integer("seed", seed, low=0, high=2**63 - 1),
        )
        self._end = _LAST if epoch_size is None else checks.integer("epoch_size", epoch_size, low=1, high=_LAST)
        self._batch = None if batch_size is None else checks.integer("batch_size", batch_size, low=1, high=2**20)
        self._threads = None if threads is None else checks.integer("threads", threads, low=1, high=1024)
        self._ahead = checks.integer("ahead", ahead, low=0, high=1024)
        self._maker = CubeMaker(find_engine(engine), drawn.corners(), device, layout, axes, dtype)
        self._transform = transform
        self._rank, self._world = rank_of(rank, world_size)
        self._repeat = bool(repeat)
        self._passes = Passes()
        self._given = self._pass_start = 0  # batches of the pass given here; in a worker, of the others before them
        self._joined: tuple[int, int, int] | None = None  # epoch, first sample, batches given: of a pass to go on with

    def __repr__(self) -> str:
        size = None if self._end == _LAST else self._end
        settings = {"size": self._samples.size, "epoch_size": size, "batch_size": self._batch}
        given = ", ".join(f"{name}={value}" for name, value in settings.items() if value is not None)
        return f"CubeStream({given}, seed={self._samples.seed}, epoch {self.epoch})"

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Select the `epoch` of the next pass and its first sample `start`, where an earlier run stopped.

        Without this call the first pass is epoch 0, and each pass is the next epoch; with ``repeat=True`` all are the
        same. After n batches a loader has returned samples up to ``n * batch_size * world_size``; a pass that starts
        there has the remaining batches of an uninterrupted run.
        """
        number = checks.integer("epoch", epoch, low=0, high=_LAST)
        self._passes.begin_at(number, checks.integer("start", start, low=0, high=self._end))
        self._given, self._pass_start, self._joined = 0, start, None

    @property
    def epoch(self) -> int:
        """Number of the pass that began last; before any, of the first."""
        first, _ = self._passes.first
        return first if self._repeat else first + max(self._passes.begun - 1, 0)

    def state_dict(self, batches: int | None = None) -> dict[str, int]:
        """Position in the pass, for `load_state_dict`.

        torchdata's ``StatefulDataLoader`` calls it in each of its workers, and resumes exactly with any number of them.
        The parent of a plain loader's workers does not know the position in the pass, because they run ahead.

        Parameters
        ----------
        batches
            Examples taken from a plain loader with workers since the pass began, a number that only the caller knows.
            None: counted here, without workers.

        Raises
        ------
        ValueError
            Without `batches` in the parent of workers.
        """
        _, workers, in_worker = worker_of()
        state = {"seed": self._samples.seed, "epoch": self.epoch}
        if in_worker:
            return state | {"start": self._pass_start, "given_here": self._given, "workers_here": workers}
        if batches is None and self._passes.by_workers:
            raise ValueError(
                "batches must be given: workers of a loader made the pass, and only its caller knows how many batches "
                "were taken; or use torchdata's StatefulDataLoader, whose own state_dict knows"
            )
        given = self._given if batches is None else checks.integer("batches", batches, low=0, high=_LAST)
        start = (self._pass_start if batches is None else self._passes.begun_from) + given * (
            self._batch or 1
        ) * self._world
        return state | {"start": min(start, self._end)}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue from `state`, the result of `state_dict`, with the same settings.

        A pass that was at its end is then empty, and the next pass is the next epoch.
        """
        if resumed_in_worker(state, self._samples.seed):
            self._passes.join(state["epoch"], state["start"])
            self._joined = state["epoch"], state["start"], state["given_here"]
        else:
            self.set_epoch(state["epoch"], state["start"])

    def sample(self, index: int) -> Sample:
        """Scene, Flux, System and seed of sample `index` of this epoch, not simulated."""
        return self._samples.sample(self.epoch, checks.integer("index", index, low=0, high=self._end - 1))

    def __len__(self) -> int:
        """Examples of one pass on this rank, all workers together."""
        if self._end == _LAST:
            raise TypeError("a stream without end has no length; give epoch_size")
        return math.ceil((self._end - self._passes.start) // self._world / (self._batch or 1))

    def __iter__(self) -> Iterator[Any]:
        worker, workers, in_worker = worker_of()
        if in_worker and self._maker.on_gpu:
            raise ValueError("device='cuda' simulates in the process of the loader: use num_workers=0")
        warn_if_put_together(self._batch is not None)
        if self._joined is None:
            before, start = self._passes.begin(worker)
            epoch, given = self._passes.first[0] + (0 if self._repeat else before), 0
        else:
            epoch, start, given = self._joined
        self._joined, self._given, self._pass_start = None, given, start
        threads = self._threads or max(1, thread_count(None) // workers)
        examples: Iterator[tuple[int, dict[str, Any]]] = (
            (place, self._example(epoch, indices, threads))
            for place, indices in enumerate(self._batches(start))
            if place >= given and place % workers == worker
        )
        alone = self._ahead and not in_worker and not self._maker.on_gpu
        return self._given_out(prefetched(examples, self._ahead) if alone else examples)

    def _given_out(self, examples: Iterator[tuple[int, dict[str, Any]]]) -> Iterator[Any]:
        for place, example in examples:
            self._given = place + 1
            yield example if self._transform is None else self._transform(example)
        self._passes.end()

    def _batches(self, start: int) -> Iterator[range]:
        """Samples of this rank, batch by batch: ranks take whole batches in turn, and equal parts of the last ones."""
        batch = self._batch or 1
        turn = batch * self._world
        while start + turn <= self._end:
            yield range(start + self._rank * batch, start + (self._rank + 1) * batch)
            start += turn
        part = (self._end - start) // self._world
        if part:
            yield range(start + self._rank * part, start + (self._rank + 1) * part)

    def _example(self, epoch: int, indices: range, threads: int) -> dict[str, Any]:
        samples = [self._samples.sample(epoch, index) for index in indices]
        example = example_of(samples, self._maker.cubes(samples, threads))
        return _first(example) if self._batch is None else example


def _first(example: dict[str, Any]) -> dict[str, Any]:
    """Without the leading axis."""
    return {name: _first(value) if isinstance(value, dict) else value[0] for name, value in example.items()}
