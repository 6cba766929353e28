"""Tensors on their way from a loader's worker: large ones in memory that comes back, small ones by value.

PyTorch moves every tensor of a batch into shared memory of its own: fresh pages for each cube, which cost as much as
simulating dim light, and a connection between the processes for each map and number. Here a worker keeps some pieces
of memory (`Slot`), which the receiving process maps once; a word in each tells whether the receiver still holds what
it was sent. The memory is anonymous (memfd) and goes with the processes, however they end.
"""

from __future__ import annotations

import mmap
import os
import sys
import weakref
from multiprocessing import reduction
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

ABLE = hasattr(os, "memfd_create")  # Linux; elsewhere tensors go PyTorch's way
_KEPT = 8  # slots of a worker that are used again
_FREE, _SENT = 0, 1


class Slot:
    """Shared memory that holds one tensor at a time."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.word = -(-size // 64) * 64  # where the word is
        self._file = os.memfd_create("mars_lidar", os.MFD_CLOEXEC)
        weakref.finalize(self, os.close, self._file)
        os.ftruncate(self._file, self.word + 8)
        shared = mmap.mmap(self._file, self.word + 8)
        self._bytes = np.frombuffer(shared, np.uint8, size)
        self._state = np.frombuffer(shared, np.uint64, 1, self.word)
        self._known = False  # to the receiver
        self.kept: tuple[int, ...] = ()  # what its worker uses again
        self._alone = self._references()

    def _references(self) -> int:
        return sys.getrefcount(self._bytes)

    def free(self) -> bool:
        """Whether no tensor is in it, neither here nor at the receiver's."""
        return self._state[0] == _FREE and self._references() == self._alone

    def tensor(self, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
        """Its memory."""
        return torch.from_numpy(self._bytes).view(dtype).view(shape)

    def message(self) -> tuple[Any, ...]:
        """What lets the receiver find it, who now has it."""
        self._state[0] = _SENT
        first, self._known = not self._known, True
        file = reduction.DupFd(self._file) if first else None
        return os.getpid(), id(self), self.size, self.word, file, self.kept


class Slots:
    """A worker's slots."""

    def __init__(self) -> None:
        self._slots: list[Slot] = []

    def take(self, shape: tuple[int, ...], dtype: torch.dtype) -> tuple[torch.Tensor, Slot]:
        """A tensor of any content, and where it is."""
        size = int(np.prod(shape)) * dtype.itemsize
        free = [slot for slot in self._slots if slot.size == size and slot.free()]
        if not free:
            free = [Slot(size)]
            self._slots = [*self._slots[1 - _KEPT :], *free]
        free[0].kept = tuple(map(id, self._slots))
        return free[0].tensor(shape, dtype), free[0]

    def __getstate__(self) -> dict[str, Any]:
        return {"_slots": []}  # each process makes its own


class Passed(torch.Tensor):
    """A tensor as a worker gives it out; what is computed from it is an ordinary one, and so is what arrives."""

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]
    slot: Slot | None


def passed(example: Any, cube: torch.Tensor, slot: Slot | None) -> Any:
    """The dictionary of an example, its dense tensors `Passed`: `cube` in its slot, the others by value."""
    if isinstance(example, dict):
        return {name: passed(one, cube, slot) for name, one in example.items()}
    if example.layout != torch.strided or (example is cube and slot is None):
        return example
    out = example.as_subclass(Passed)
    out.slot = slot if example is cube else None
    return out


def _reduced(tensor: Passed) -> tuple[Any, ...]:
    if tensor.slot is None:
        return torch.from_numpy, (tensor.detach().numpy(),)
    place = tensor.dtype, tuple(tensor.shape), tensor.stride(), tensor.storage_offset()
    return _arrived, (*tensor.slot.message(), *place)


reduction.ForkingPickler.register(Passed, _reduced)

_mapped: dict[tuple[int, int], mmap.mmap] = {}  # in the receiving process: memory of slots, by process and slot


def _arrived(
    process: int,
    key: int,
    size: int,
    word: int,
    file: Any,
    kept: tuple[int, ...],
    dtype: torch.dtype,
    shape: tuple[int, ...],
    stride: tuple[int, ...],
    offset: int,
) -> torch.Tensor:
    if file is not None:
        opened = file.detach()
        _mapped[process, key] = mmap.mmap(opened, word + 8)
        os.close(opened)
        for place in list(_mapped):  # what is not sent again
            if place[1] not in kept if place[0] == process else not _runs(place[0]):
                _mapped.pop(place, None)
    shared = _mapped[process, key]
    content, state = np.frombuffer(shared, np.uint8, size), np.frombuffer(shared, np.uint64, 1, word)
    weakref.finalize(content, _returned, state).atexit = False  # once no tensor, view or array holds it
    return torch.from_numpy(content).view(dtype).as_strided(shape, stride, offset)


def _returned(state: NDArray[np.uint64]) -> None:
    state[0] = _FREE


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it runs, as someone else
        pass
    return True


def forget() -> None:
    """Of a worker that was forked: what its parent had mapped."""
    _mapped.clear()
