"""Simulated straight into tensors: dense or sparse, on the CPU or on the GPU, of the wanted type and order of axes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.memory import check_memory
from mars_lidar.engines import Engine, check_detector
from mars_lidar.instrument.system import System
from mars_lidar.learn.needed import torch
from mars_lidar.learn.sample import Sample
from mars_lidar.simulate import simulate

_UNSIGNED = {np.dtype(np.uint16): torch.uint16, np.dtype(np.uint32): torch.uint32}


class CubeMaker:
    """Makes the cubes of a batch; `systems` are the extremes of what will be asked for."""

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
        kind = _UNSIGNED[self._counts]
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
            sample.flux,
            sample.system,
            engine=self._engine,
            seed=sample.seed,
            threads=threads,
            out=out if own else None,
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


class Buffers:
    """Memory of tensors that nobody holds any more, given out again: fresh pages cost as much as simulating dim light.

    A tensor made from a NumPy array holds a reference to it, and so do all its views through their storage: an array
    with no reference but the one here is free.
    """

    _KEPT = 4

    def __init__(self) -> None:
        self._arrays: list[NDArray[np.uint8]] = []

    def take(self, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
        """A tensor of any content."""
        size = int(np.prod(shape)) * dtype.itemsize
        for place in range(len(self._arrays)):
            if sys.getrefcount(self._arrays[place]) == _ALONE and self._arrays[place].size == size:
                return torch.from_numpy(self._arrays[place]).view(dtype).view(shape)
        array = np.empty(size, np.uint8)
        self._arrays = [*self._arrays[1 - self._KEPT :], array]
        return torch.from_numpy(array).view(dtype).view(shape)

    def __getstate__(self) -> dict[str, Any]:
        return {"_arrays": []}


def _alone() -> int:
    """What `sys.getrefcount` tells of an object that only a list holds; it differs between versions of Python."""
    held = [object()]
    return sys.getrefcount(held[0])


_ALONE = _alone()
