"""The processor in the place of a GPU: the kernels' source compiled for it, blocks and threads one after another."""

from pathlib import PurePath
from typing import Any

import numpy as np
from native_emulation import run_kernel
from numpy.typing import NDArray

from mars_lidar.engines.cuda.kernels import Kernel


class Host:
    """A machine of `resident_blocks`, whose blocks have `shared_bytes` of memory."""

    key = "host"

    def __init__(self, shared_bytes: int = 227 << 10, resident_blocks: int = 3) -> None:
        self.shared_bytes, self.blocks = shared_bytes, resident_blocks
        self.launched: list[str] = []

    def array(self, host: NDArray[Any]) -> NDArray[Any]:
        return np.array(host, order="C")

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        return np.zeros(shape, dtype)

    def empty(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        made = np.empty(shape, dtype)
        made.view(np.uint8).fill(0xA5)
        return made

    def host(self, array: NDArray[Any]) -> NDArray[Any]:
        return array.copy()

    def address(self, array: NDArray[Any]) -> int:
        assert array.flags.c_contiguous
        return int(array.ctypes.data)

    def resident(self, kernel: Kernel, lanes: int, shared: int) -> int:
        return self.blocks

    def launch(self, kernel: Kernel, blocks: int, lanes: int, argument: bytes, shared: int = 0) -> None:
        assert shared <= self.shared_bytes
        self.launched.append(kernel.expression)
        run_kernel(PurePath(kernel.header).stem, kernel.expression, argument, blocks, lanes, shared)
