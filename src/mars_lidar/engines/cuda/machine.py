"""The device that runs the kernels: CuPy's current device; in tests the processor (tests/cuda/host_machine.py)."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.imports import MissingLibraryError
from mars_lidar.engines.cuda.kernels import HEADERS, OPTIONS, Kernel, source

_PLAIN_SHARED = 48 << 10  # bytes of a block that need no request


class NoDeviceError(RuntimeError, ValueError):
    """There is no GPU that CuPy can use."""


def cupy_with_device() -> Any:
    """CuPy with a usable device; ImportError or RuntimeError that names the missing part."""
    try:
        import cupy
    except ImportError as error:
        raise MissingLibraryError(
            "device='cuda' needs CuPy: pip install 'mars-lidar[cuda12]' or 'mars-lidar[cuda13]', to suit your driver"
        ) from error
    try:
        number = cupy.cuda.runtime.getDeviceCount()
    except cupy.cuda.runtime.CUDARuntimeError as error:
        raise NoDeviceError(f"device='cuda' found no CUDA device ({error}); use device='cpu'") from error
    if number == 0:
        raise NoDeviceError("device='cuda' found no CUDA device; use device='cpu'")
    return cupy


class Cuda:
    """Arrays and launches, in the order of one stream: CuPy's current device and stream.

    `shared_bytes`: shared memory available to a block; `key` identifies the device.
    """

    def __init__(self) -> None:
        self._cupy = cupy_with_device()
        self._device = self._cupy.cuda.Device()
        self.key: Any = int(self._device.id)
        self.shared_bytes = int(self._device.attributes["MaxSharedMemoryPerBlockOptin"])

    def array(self, host: NDArray[Any]) -> Any:
        """A copy on the device."""
        return self._cupy.asarray(host)

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """An array of zeros on the device."""
        return self._cupy.zeros(shape, dtype)

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """An uninitialised array on the device."""
        return self._cupy.empty(shape, dtype)

    def host(self, array: Any) -> NDArray[Any]:
        """A copy in host memory, after all queued work."""
        copy: NDArray[Any] = array.get()
        return copy

    def address(self, array: Any) -> int:
        """Address of an array's memory."""
        return int(array.data.ptr)

    def resident(self, kernel: Kernel, lanes: int, shared: int) -> int:
        """Blocks that the device runs at the same time."""
        compiled = self._compiled(kernel, shared)
        each = self._cupy.cuda.driver.occupancyMaxActiveBlocksPerMultiprocessor(compiled.kernel.ptr, lanes, shared)
        return max(1, int(each)) * int(self._device.attributes["MultiProcessorCount"])

    def launch(self, kernel: Kernel, blocks: int, lanes: int, argument: bytes, shared: int = 0) -> None:
        """Queue a kernel of one argument."""
        # a structure passed by value: an array of no dimensions
        structure = np.frombuffer(argument, np.dtype((np.void, len(argument)))).reshape(())
        self._compiled(kernel, shared)((blocks,), (lanes,), (structure,), shared_mem=shared)

    def _compiled(self, kernel: Kernel, shared: int) -> Any:
        function = compiled(kernel, int(self._device.id))
        if shared > _PLAIN_SHARED:
            function.max_dynamic_shared_size_bytes = shared
        return function


@lru_cache(maxsize=64)
def compiled(kernel: Kernel, device: int) -> Any:
    """A compiled kernel for a device; CuPy caches it in files."""
    import cupy

    module = cupy.RawModule(
        code=source(kernel.header),
        options=(*OPTIONS, f"-I{HEADERS}"),
        backend="nvrtc",
        name_expressions=(kernel.expression,),
    )
    return module.get_function(kernel.expression)
