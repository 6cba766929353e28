"""Training examples from datasets that `mars_lidar.generate` wrote: each exposure once an epoch, each shard read once.

The order of an epoch is a list of exposures. Shards are shuffled, and the exposures of each `pool` successive shards
are shuffled again. Each rank takes an equal, contiguous part of the list and divides it into batches, so that batches
do not depend on the number of workers. Each worker takes a contiguous section of the batches of a rank, so that a shard
is read by one worker; the loader asks its workers in turn, so that batches arrive in the order `_turns`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.buckets import in_bucket
from mars_lidar._base.files import FileError
from mars_lidar._base.native import _core
from mars_lidar._base.resources import check_memory
from mars_lidar.dataset.arrays import MAPS, sample_parts
from mars_lidar.dataset.store import Block, Dataset, open_dataset, read_block
from mars_lidar.learn.loaders import UNSIGNED, Buffers, Passes, rank_of, resumed_in_worker, worker_of
from mars_lidar.learn.needed import torch
from mars_lidar.learn.tolerances import TOLERANCES

_NATIVE = {  # types that packed counts are decoded to without a copy
    torch.float32: np.float32,
    torch.int16: np.int16,
    torch.int32: np.int32,
    torch.uint16: np.uint16,
    torch.uint32: np.uint32,
}


class StoredDataset(torch.utils.data.IterableDataset[dict[str, Any]]):
    """The exposures of stored datasets, as batches or examples for a `torch.utils.data.DataLoader`.

    Give `batch_size` here and ``batch_size=None`` to the loader: counts are then decoded into the batch itself, and a
    batch contains the same exposures for any number of workers; from two workers on, the order of the batches depends
    on it. A loader that collates single examples also works, at
    the cost of a copy.

    All ranks of a distributed run give the same number of batches, for any number of ranks and workers and any batch
    size. If the number of ranks does not divide the exposures, those at the end of the epoch's order are omitted
    (different ones each epoch), or the first ones of the order are repeated (`uneven`).

    A batch is a dictionary: ``counts`` (B, bins, H, W), the chosen maps (B, H, W) as float32, and for each of its
    exposures ``sample``, ``realization``, ``scene``, ``system``, ``signal_level``, ``sbr``; and ``seed``, torch.uint64,
    because seeds reach 2^64. With several stores, ``store`` is the number of the store of the exposure. An example has
    the same entries without the leading axis.

    Parameters
    ----------
    path
        The dataset, complete; a folder, or a URL such as ``s3://bucket/set.zarr`` (extra ``remote``). Or several
        with equal images and bins: their exposures are concatenated, and samples are numbered consecutively.
    samples
        Numbers of the samples to use, such as a split by scenes; default: all.
    batch_size
        Exposures in a batch; the last batch of an epoch may be smaller. None: single examples.
    shuffle
        False: in the order of the store.
    pool
        Number of shards whose exposures are mixed; a worker keeps them encoded in memory.
    seed
        Seed of the order.
    maps
        Maps in each batch: depth, reflectivity, signal, background, delay.
    axes
        ``"THW"``: time first, as for networks; a view, without a copy, of ``"HWT"``, the order in which counts are
        stored (torch's channels-last memory format).
    dtype
        Type of the counts; default float32.
    uneven
        ``"drop"`` or ``"repeat"`` the exposures that cannot be shared equally among the ranks.
    transform
        Called on each batch (or example), which its result replaces.
    rank, world_size
        Of a distributed run; default: those of torch.distributed if initialised, else of the environment
        (RANK and WORLD_SIZE, as set by torchrun), else 0 of 1.

    Raises
    ------
    ValueError, TypeError
        An invalid argument; a missing or incomplete dataset; stores that do not match; fewer exposures than ranks
        with ``uneven="drop"``.

    See Also
    --------
    CubeStream, mars_lidar.generate

    Examples
    --------
    >>> import tempfile
    >>> import mars_lidar as ml
    >>> system = {
    ...     "period_ns": 100.0, "cycles": 200, "bins": 64,
    ...     "pulse": {"kind": "gaussian", "sigma_ns": 1.0}, "detector": {"dead_time_ns": 75.0},
    ... }
    >>> recipe = {"scenes": {"example": "room", "size": [8, 12]}, "systems": system, "light": {"signal": [0.1, 1.0]}}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     done = ml.generate(recipe, f"{folder}/set.zarr")
    ...     batch = next(iter(ml.learn.StoredDataset(done.path, batch_size=2)))
    >>> tuple(batch["counts"].shape)  # (B, bins, H, W)
    (2, 64, 8, 12)
    """

    def __init__(
        self,
        path: str | Path | Sequence[str | Path],
        *,
        samples: Sequence[int] | NDArray[np.integer[Any]] | None = None,
        batch_size: int | None = None,
        shuffle: bool = True,
        pool: int = 2,
        seed: int = 0,
        maps: Sequence[str] = ("depth", "reflectivity"),
        axes: Literal["THW", "HWT"] = "THW",
        dtype: torch.dtype = torch.float32,
        uneven: Literal["drop", "repeat"] = "drop",
        transform: Callable[[Any], Any] | None = None,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        super().__init__()
        paths = [path] if isinstance(path, str | os.PathLike) else list(path)
        if not paths:
            raise ValueError("path must be a dataset or several, got none")
        self.paths = [str(each) for each in paths]
        self._batch = None if batch_size is None else checks.integer("batch_size", batch_size, low=1, high=2**20)
        self._shuffle = bool(shuffle)
        self._pool = checks.integer("pool", pool, low=1, high=2**31)
        self._seed = checks.integer("seed", seed, low=0, high=2**63 - 1)
        self._maps = tuple(checks.choice("maps", name, tuple(MAPS)) for name in maps)
        self._axes = checks.choice("axes", axes, ("THW", "HWT"))
        if not isinstance(dtype, torch.dtype):
            raise TypeError(f"dtype must be a torch.dtype, got {dtype!r}")
        self._dtype = dtype
        self._uneven = checks.choice("uneven", uneven, ("drop", "repeat"))
        self._transform = transform
        self._rank, self._world = rank_of(rank, world_size)
        # one process of a machine compares the names in a store with its manifest; what any process reads is compared
        # with its sum by that process
        self._stores: list[Dataset] | None = [
            open_dataset(each, listed=os.environ.get("LOCAL_RANK", "0") in ("", "0")) for each in self.paths
        ]
        self._process = os.getpid()
        self._identities = [store.identity for store in self._stores]
        self._shape = _common_shape(self._stores)
        self._exposures = Exposures(self._stores, samples)
        if not self._exposures.number // self._world and self._uneven == "drop":
            raise ValueError(
                f"world_size is {self._world} and there are {self._exposures.number} exposures: no rank would get any; "
                "uneven='repeat' repeats them"
            )
        self._passes = Passes()
        # of the current or next pass, for all processes: the batches before its start, and the workers of the loader
        # that began the epoch, which decide the order of its batches
        self._pass = torch.zeros(2, dtype=torch.int64)
        self._pass.share_memory_()  # type: ignore[no-untyped-call]
        self._given = 0  # batches given in this process since the start of the pass
        self._start = (0, 0, 1)  # epoch, and what `_pass` has, of the pass of this process
        self._joined: tuple[int, int, int, int] | None = None  # a pass to go on with: these three, and those given here
        self._buffers = Buffers()

    def __repr__(self) -> str:
        where = self.paths[0] if len(self.paths) == 1 else f"{len(self.paths)} stores"
        batches = "" if self._batch is None else f", batch_size={self._batch}"
        number = f"{self._exposures.number} exposures{batches}"
        return f"StoredDataset({where!r}, {number}, maps={self._maps}, seed={self._seed})"

    def __len__(self) -> int:
        """Batches (or examples) of one pass on this rank, all workers together."""
        return batches_of_a_rank(self._exposures.number, self._world, self._batch or 1, self._uneven)

    # --- Position --------------------------------------------------------------------------------------------------

    @property
    def epoch(self) -> int:
        """Number of the pass that began last; before any, of the first."""
        return self._passes.first[0] + max(self._passes.begun - 1, 0)

    def set_epoch(self, epoch: int) -> None:
        """Select the `epoch` of the next pass, as with `DistributedSampler`; default: the next epoch."""
        self._begin_at(checks.integer("epoch", epoch, low=0, high=2**62), 0, 0)

    def _begin_at(self, epoch: int, start: int, workers: int) -> None:
        self._passes.begin_at(epoch, start)
        self._pass[0], self._pass[1] = start, workers
        self._given, self._joined = 0, None

    def state_dict(self, batches: int | None = None) -> dict[str, int]:
        """Position in the pass, for `load_state_dict`; with workers of a loader, only with `batch_size`.

        torchdata's ``StatefulDataLoader`` calls it in each of its workers.

        Parameters
        ----------
        batches
            Batches taken from a plain loader with workers since the pass began or was resumed, a number that only the
            caller knows, because workers run ahead. None: counted here, without workers.

        Raises
        ------
        ValueError
            Without `batches`, or without `batch_size`, in the parent of workers.
        """
        _, workers, in_worker = worker_of()
        if in_worker:
            epoch, start, first = self._start
            state = {"seed": self._seed, "epoch": epoch, "start": start, "workers": first}
            return state | {"given_here": self._given, "workers_here": workers}
        if self._passes.by_workers and (batches is None or self._batch is None):
            raise ValueError(
                "batches must be given, and batch_size to StoredDataset: workers of a loader made the pass, and only "
                "its caller knows how many batches were taken; or use torchdata's StatefulDataLoader"
            )
        given = self._given if batches is None else checks.integer("batches", batches, low=0, high=2**62)
        start, first = (int(number) for number in self._pass)
        return {"seed": self._seed, "epoch": self.epoch, "start": min(start + given, len(self)), "workers": first}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continue from `state`, the result of `state_dict`, with the same settings but any number of workers.

        A pass that was at its end is then empty, and the next pass is the next epoch.
        """
        in_worker = resumed_in_worker(state, self._seed)
        epoch, start, first = state["epoch"], state["start"], state["workers"]
        if in_worker:
            self._passes.join(epoch, start)
            self._joined = epoch, start, first, state["given_here"]
        else:
            self._begin_at(epoch, start, first)

    # --- Iteration -------------------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Any]:
        worker, workers, _ = worker_of()
        if self._joined is None:
            before, start = self._passes.begin(worker)
            first = int(self._pass[1]) if start else workers
            epoch, given = self._passes.first[0] + before, 0
        else:
            epoch, start, first, given = self._joined
        self._joined, self._given, self._start = None, given, (epoch, start, first)
        self._pass[0], self._pass[1] = start, first
        return self._given_out(self._batches(self._plan(epoch, start, first, worker, workers)[given:]))

    def _given_out(self, batches: Iterator[Any]) -> Iterator[Any]:
        for batch in batches:
            self._given += 1
            yield batch if self._transform is None else self._transform(batch)
        self._passes.end()

    def _plan(self, epoch: int, start: int, first: int, worker: int, workers: int) -> list[NDArray[np.int64]]:
        """Exposures of each batch that a worker gives after `start` batches of an epoch that `first` workers began."""
        order = self._exposures.order(self._shuffle, self._pool, self._seed, epoch)
        share, size = share_of_rank(order, self._rank, self._world, self._uneven), self._batch or 1
        turns = _turns(len(self), first if self._shuffle else 1)[start:][worker::workers]
        return [share[k * size : (k + 1) * size] for k in turns.tolist()]

    def _batches(self, groups: list[NDArray[np.int64]]) -> Iterator[Any]:
        """The batches of these exposures; shards are read ahead of their use, each once."""
        blocks = self._exposures.block[np.concatenate(groups)] if groups else np.empty(0, np.int64)
        with _Shards(self, blocks) as shards:
            for group in groups:
                batch = self._batch_of(group, shards)
                yield _first(batch) if self._batch is None else batch

    def _batch_of(self, group: NDArray[np.int64], shards: _Shards) -> dict[str, Any]:
        every = self._exposures
        stores, samples, realizations = every.store[group], every.sample[group], every.realization[group]
        blocks = [shards.take(int(block)) for block in every.block[group]]
        counts = self._counts(blocks, samples, realizations, shards)
        batch: dict[str, Any] = {"counts": counts.permute(0, 3, 1, 2) if self._axes == "THW" else counts}
        for name in self._maps:
            rows = [block.map(name, int(sample)) for block, sample in zip(blocks, samples, strict=True)]
            batch[name] = torch.from_numpy(np.stack(rows))
        opened = self._opened()
        recipes = [opened[store].recipe for store in stores]
        parts = [sample_parts(recipe, int(sample)) for recipe, sample in zip(recipes, samples, strict=True)]
        scene, system, signal, sbr = (np.array(column) for column in zip(*parts, strict=True))
        numbers = {
            "sample": samples + every.first_sample[stores],
            "realization": realizations,
            "scene": scene,
            "system": system,
            "signal_level": signal.astype(np.float64),
            "sbr": sbr.astype(np.float64),
        }
        if len(self.paths) > 1:
            numbers["store"] = stores
        batch.update({name: torch.from_numpy(np.asarray(values)) for name, values in numbers.items()})
        seeds = [opened[store].seeds[sample] for store, sample in zip(stores, samples, strict=True)]
        batch["seed"] = torch.tensor([int(seed) for seed in seeds], dtype=torch.uint64)
        return batch

    def _counts(
        self, blocks: list[Block], samples: NDArray[np.int64], realizations: NDArray[np.int64], shards: _Shards
    ) -> torch.Tensor:
        """(B, H, W, bins)."""
        shape = (len(blocks), *self._shape)
        kind = self._dtype if self._dtype in _NATIVE else UNSIGNED[self._exposures.dtype]
        check_memory(int(np.prod(shape)) * kind.itemsize, f"counts of shape {shape}", "use a smaller batch_size")
        out = self._buffers.take(shape, kind)
        rows = out.numpy()
        packed: dict[int, NDArray[np.uint8]] = {}
        for k, (block, sample, realization) in enumerate(
            zip(blocks, samples.tolist(), realizations.tolist(), strict=True)
        ):
            if block.native:
                packed[k] = block.packed(sample, realization)
                continue
            counts = block.exposure(sample, realization, shards.decoded, TOLERANCES.decoded_bytes)
            if not kind.is_floating_point and int(counts.max(initial=0)) > torch.iinfo(kind).max:
                raise ValueError(f"dtype {kind} does not hold a count of {int(counts.max())}")
            np.copyto(rows[k], counts, casting="unsafe")
        if packed:
            flat = rows.reshape(len(blocks), -1)
            target = flat if len(packed) == len(blocks) else np.empty((len(packed), flat.shape[1]), flat.dtype)
            try:
                _core.unpack_batch(list(packed.values()), target)
            except ValueError as error:
                raise FileError(f"counts of {', '.join(self.paths)} as {kind}: {error}") from error
            if target is not flat:
                flat[list(packed)] = target
        if kind == self._dtype:
            return out
        return torch.from_numpy(rows.astype(np.int64)).to(self._dtype)

    def _opened(self) -> list[Dataset]:
        forked = self._process != os.getpid() and any(in_bucket(store.path) for store in self._stores or ())
        if self._stores is None or forked:  # connections do not survive a fork
            self._process = os.getpid()
            stores = [open_dataset(each, listed=False) for each in self.paths]
            for store, identity in zip(stores, self._identities, strict=True):
                if store.identity != identity:
                    raise FileError(f"{store.path} was replaced after it was opened: open it again")
            self._stores = stores
        return self._stores

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_stores": None}  # a worker that is not a fork opens the stores itself


class Exposures:
    """All exposures of some stores: arrays over them, in the order of the stores, and the shards that hold them."""

    def __init__(self, stores: Sequence[Dataset], samples: Any) -> None:
        lengths = [store.histogram.shape[0] for store in stores]
        self.first_sample: NDArray[np.int64] = np.cumsum([0, *lengths[:-1]])
        chosen = np.arange(sum(lengths)) if samples is None else _numbers(samples, sum(lengths))
        store_of = np.repeat(np.arange(len(stores)), lengths)[chosen]
        repeats = np.array([store.histogram.shape[1] for store in stores])[store_of]
        self.store: NDArray[np.int64] = np.repeat(store_of, repeats)
        self.sample: NDArray[np.int64] = np.repeat(chosen, repeats) - self.first_sample[self.store]
        self.realization: NDArray[np.int64] = np.arange(self.sample.size) - np.repeat(
            np.cumsum(repeats) - repeats, repeats
        )
        shards = np.array([store.histogram.shards[:2] for store in stores])[self.store]
        keys = np.stack([self.store, self.sample // shards[:, 0], self.realization // shards[:, 1]])
        self.place, block = np.unique(keys, axis=1, return_inverse=True)  # (store, shard of samples, of realizations)
        self.block: NDArray[np.int64] = block.reshape(-1)
        self.number = int(self.sample.size)
        self.dtype: np.dtype[Any] = np.result_type(*(store.histogram.dtype for store in stores))

    def order(self, shuffle: bool, pool: int, seed: int, epoch: int) -> NDArray[np.int64]:
        """All exposures in the order of an epoch."""
        if not shuffle:
            return np.arange(self.number)
        random = np.random.default_rng([seed, epoch])
        turn = random.permutation(self.place.shape[1])[self.block]  # of the block that holds an exposure
        return np.lexsort((random.random(self.number), turn // pool))


class _Shards:
    """The blocks that a sequence of exposures needs, each read once, the next one while others are in use."""

    def __init__(self, dataset: StoredDataset, blocks: NDArray[np.int64]) -> None:
        self._dataset = dataset
        numbers, first, uses = np.unique(blocks, return_index=True, return_counts=True)
        self._uses = dict(zip(numbers.tolist(), uses.tolist(), strict=True))  # that are still to come
        self._coming = iter(numbers[np.argsort(first)].tolist())
        self._submitted: dict[int, Future[Block]] = {}
        self._begun = set[int]()
        self._reader = ThreadPoolExecutor(1, "mars_lidar.learn")
        self.decoded: dict[Any, NDArray[Any]] = {}  # chunks of several exposures

    def __enter__(self) -> _Shards:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.shutdown(cancel_futures=True)

    def take(self, number: int) -> Block:
        """A block, which is released after its last use."""
        if number not in self._begun:
            self._begun.add(number)
            while number not in self._submitted or len(self._submitted) < len(self._begun & self._uses.keys()) + 1:
                if not self._submit():
                    break
        block = self._submitted[number].result()
        self._uses[number] -= 1
        if not self._uses[number]:
            del self._submitted[number], self._uses[number]
        return block

    def _submit(self) -> bool:
        """Begin to read the next block; False after the last one."""
        number = next(self._coming, None)
        if number is None:
            return False
        store, sample, realization = self._dataset._exposures.place[:, number].tolist()
        opened = self._dataset._opened()[store]
        self._submitted[number] = self._reader.submit(read_block, opened, (sample, realization), self._dataset._maps)
        return True


def _first(batch: dict[str, Any]) -> dict[str, Any]:
    """The only exposure of a batch, its numbers as those of Python."""
    return {name: value[0].item() if value.ndim == 1 and name != "seed" else value[0] for name, value in batch.items()}


# --- How exposures are shared out ----------------------------------------------------------------------------------


def share_of_rank(order: NDArray[np.int64], rank: int, world: int, uneven: str) -> NDArray[np.int64]:
    """Equal contiguous parts of the order: the remainder is dropped, or the first exposures are repeated at the end."""
    each = _each(order.size, world, uneven)
    return np.resize(order, each * world)[rank * each : (rank + 1) * each] if order.size else order


def batches_of_a_rank(exposures: int, world: int, batch: int, uneven: str) -> int:
    """Batches of one pass on each of `world` ranks."""
    return math.ceil(_each(exposures, world, uneven) / batch)


def _each(exposures: int, world: int, uneven: str) -> int:
    return exposures // world if uneven == "drop" else math.ceil(exposures / world)


def _turns(batches: int, workers: int) -> NDArray[np.int64]:
    """Numbers of the batches in the order in which a loader gives them, whose workers have contiguous sections."""
    place = np.arange(batches)
    sizes = [math.ceil((batches - k) / workers) for k in range(workers)]  # larger ones first: no worker ends early
    first = np.cumsum([0, *sizes[:-1]])
    turns: NDArray[np.int64] = first[place % workers] + place // workers
    return turns


def _common_shape(stores: Sequence[Dataset]) -> tuple[int, int, int]:
    shapes = [tuple(store.histogram.shape[2:]) for store in stores]
    for store, shape in zip(stores, shapes, strict=True):
        if shape != shapes[0]:
            raise ValueError(
                f"stores of one dataset must have the same images and bins, got {shapes[0]} in {stores[0].path} and "
                f"{shape} in {store.path}"
            )
    height, width, bins = shapes[0]
    return height, width, bins


def _numbers(samples: Any, number: int) -> NDArray[np.int64]:
    array = np.asarray(samples)
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "iu":
        raise TypeError(f"samples must be a list of integers, got {samples!r}")
    if array.min() < 0 or array.max() >= number:
        raise ValueError(f"samples must lie in [0, {number}), got {array.min()} to {array.max()}")
    return np.unique(array).astype(np.int64)
