"""Training examples from a dataset that `mars_lidar.generate` wrote: shuffled chunk by chunk, each read once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.files import FileError
from mars_lidar.dataset.arrays import MAPS
from mars_lidar.dataset.samples import sample_parts
from mars_lidar.dataset.store import Dataset, open_dataset
from mars_lidar.learn.needed import torch
from mars_lidar.learn.stream import rank_of, worker_of

_NUMBERS = ("sample", "realization", "scene", "system", "signal_level", "sbr")


class StoredDataset(torch.utils.data.IterableDataset[dict[str, Any]]):
    """The exposures of a stored dataset, as examples for a `torch.utils.data.DataLoader`.

    Every epoch takes the blocks of the store (all that one chunk holds, or an image of several chunks) in another
    order, and mixes the exposures of `pool` blocks at a time: the disk is read in large pieces and each exposure
    once. Processes of a distributed run (ranks) and workers of a loader share the blocks out among themselves; with
    several ranks each gives the same number of examples, so that a few of them are left out of an epoch.

    An example is a dictionary: ``counts`` (bins, H, W) or (H, W, bins), the chosen maps (H, W) as float32, and
    numbers: ``sample``, ``realization``, ``scene``, ``system``, ``signal_level``, ``sbr``; and ``seed``, a tensor of
    torch.uint64, for seeds go up to 2^64, which no signed integer of a batch could hold.

    Parameters
    ----------
    path
        The dataset, complete.
    samples
        Numbers of the samples to use (a split by scenes, say); default: all.
    shuffle
        False: in the order of the store.
    pool
        Blocks that are mixed at a time: the memory of a worker.
    seed
        Of the order.
    maps
        Maps that go along: depth, reflectivity, signal, background, delay.
    axes
        ``"THW"``: time first, as networks take it; ``"HWT"``: as it is stored, without a copy.
    dtype
        Of the counts; default float32.
    transform
        Called on each example; what it returns is given out.
    rank, world_size
        Of a distributed run; default: those of torch.distributed where it is initialised, else of the environment
        (RANK and WORLD_SIZE, as torchrun sets them), else 0 of 1.

    Raises
    ------
    ValueError, TypeError
        A bad argument; a dataset that is incomplete or none.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        samples: Sequence[int] | NDArray[np.integer[Any]] | None = None,
        shuffle: bool = True,
        pool: int = 8,
        seed: int = 0,
        maps: Sequence[str] = ("depth", "reflectivity"),
        axes: Literal["THW", "HWT"] = "THW",
        dtype: torch.dtype = torch.float32,
        transform: Callable[[dict[str, Any]], Any] | None = None,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        super().__init__()
        self.path = Path(path)
        dataset = open_dataset(self.path)
        number = dataset.histogram.shape[0]
        self._samples = np.arange(number) if samples is None else _numbers(samples, number)
        self._shuffle = bool(shuffle)
        self._pool = checks.integer("pool", pool, low=1, high=2**31)
        self._seed = checks.integer("seed", seed, low=0, high=2**63 - 1)
        self._maps = tuple(checks.choice("maps", name, tuple(MAPS)) for name in maps)
        self._axes = checks.choice("axes", axes, ("THW", "HWT"))
        if not isinstance(dtype, torch.dtype):
            raise TypeError(f"dtype must be a torch.dtype, got {dtype!r}")
        self._dtype = dtype
        self._transform = transform
        self._rank, self._world = rank_of(rank, world_size)
        self._epoch = 0
        array = dataset.histogram
        self._realizations = array.shape[1]
        self._block = array.chunks[:2]
        self._identity = dataset.identity
        self._opened: Dataset | None = dataset

    def __repr__(self) -> str:
        exposures = self._samples.size * self._realizations
        return f"StoredDataset({str(self.path)!r}, {exposures} exposures, maps={self._maps}, seed={self._seed})"

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next pass. Call it before every epoch, as with `DistributedSampler`.

        A loader without workers goes on by itself; the workers of others are copies, which would repeat an order.
        """
        self._epoch = checks.integer("epoch", epoch, low=0, high=2**62)

    def __len__(self) -> int:
        """Examples of one pass on this rank, all workers together."""
        return int(self._samples.size) * int(self._realizations) // self._world

    def __iter__(self) -> Iterator[Any]:
        worker, workers, _ = worker_of()
        random = np.random.default_rng([self._seed, self._epoch])
        self._epoch += 1
        blocks = self._blocks()
        if self._shuffle:
            random.shuffle(blocks)
        # all ranks and workers draw the same order, and each takes its own part of it: whole blocks but for the ends
        mine = _share(blocks, self._rank, self._world, worker, workers)
        for first in range(0, len(mine), self._pool):
            examples = [one for block in mine[first : first + self._pool] for one in self._read(block)]
            if self._shuffle:
                np.random.default_rng([self._seed, self._epoch, self._rank, worker, first]).shuffle(examples)
            while examples:
                yield examples.pop(0)()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}  # a worker opens the store itself

    @property
    def _dataset(self) -> Dataset:
        if self._opened is None:
            opened = open_dataset(self.path)
            if opened.identity != self._identity:
                raise FileError(f"{self.path} was replaced after it was opened: open it again")
            self._opened = opened
        return self._opened

    def _blocks(self) -> list[list[tuple[int, int]]]:
        """(sample, realization) of all exposures, grouped by the chunks that hold them."""
        deep, wide = self._block
        blocks: list[list[tuple[int, int]]] = []
        for _, group in itertools.groupby(self._samples.tolist(), key=lambda sample: sample // deep):
            together = list(group)
            for first in range(0, self._realizations, wide):
                numbers = range(first, min(first + wide, self._realizations))
                blocks.append([(sample, number) for sample in together for number in numbers])
        return blocks

    def _read(self, block: list[tuple[int, int]]) -> list[Callable[[], Any]]:
        """The exposures of a block, which become examples when they are called."""
        dataset = self._dataset
        first, number = block[0][0], min(r for _, r in block)
        samples, realizations = slice(first, block[-1][0] + 1), slice(number, max(r for _, r in block) + 1)
        counts = np.asarray(dataset.histogram[samples, realizations])
        maps = {name: np.asarray(dataset.maps[name][samples]) for name in self._maps}
        return [
            lambda s=s, r=r: self._example(  # type: ignore[misc]  # defaults bind the loop's values
                s, r, counts[s - first, r - number], {name: stack[s - first] for name, stack in maps.items()}
            )
            for s, r in block
        ]

    def _example(
        self, sample: int, realization: int, counts: NDArray[Any], maps: dict[str, NDArray[np.float32]]
    ) -> Any:
        scene, system, signal, sbr = sample_parts(self._dataset.recipe, sample)
        # torch computes little with unsigned integers: signed ones of the same bits, or wider where bits are used
        wide = counts.astype(np.int64) if counts.dtype == np.uint32 else _signed(counts)
        histogram = torch.from_numpy(wide).to(self._dtype)
        if self._axes == "THW":
            histogram = histogram.permute(2, 0, 1).contiguous()
        numbers = (sample, realization, scene, system, signal, sbr)
        example: dict[str, Any] = {"counts": histogram}
        example.update({name: torch.from_numpy(one.copy()) for name, one in maps.items()})
        example.update(dict(zip(_NUMBERS, numbers, strict=True)))
        example["seed"] = torch.tensor(int(self._dataset.seeds[sample]), dtype=torch.uint64)
        return example if self._transform is None else self._transform(example)


def _signed(counts: NDArray[np.uint16]) -> NDArray[Any]:
    return counts.astype(np.int32) if counts.max(initial=0) > np.iinfo(np.int16).max else counts.view(np.int16).copy()


def _share(
    blocks: list[list[tuple[int, int]]], rank: int, world: int, worker: int, workers: int
) -> list[list[tuple[int, int]]]:
    """Whole blocks for each worker of each rank, cut only where ranks must have equally many exposures."""
    each = sum(map(len, blocks)) // world
    own, begin = [], -rank * each  # of a block, from the first exposure of this rank on
    for block in blocks:
        if part := block[max(0, -begin) : max(0, each - begin)]:
            own.append(part)
        begin += len(block)
    edges = [math.ceil(k * len(own) / workers) for k in (worker, worker + 1)]
    return own[edges[0] : edges[1]]


def _numbers(samples: Any, number: int) -> NDArray[np.int64]:
    array = np.asarray(samples)
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "iu":
        raise TypeError(f"samples must be a list of integers, got {samples!r}")
    if array.min() < 0 or array.max() >= number:
        raise ValueError(f"samples must lie in [0, {number}), got {array.min()} to {array.max()}")
    return np.unique(array).astype(np.int64)
