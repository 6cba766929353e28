"""The Zarr codec ``mars_lidar.sparse``: counts of a chunk as gaps and values of the bins that are not zero.

Zarr finds it by the entry point of this package, so that ``xarray.open_zarr`` reads packed histograms like any
others where mars-lidar is installed. The format: docs/generate.md; again in Python: tests/dataset/test_codec.py.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray
from zarr.abc.codec import ArrayBytesCodec
from zarr.registry import register_codec

from mars_lidar._base.native import _core

if TYPE_CHECKING:
    from zarr.core.array_spec import ArraySpec
    from zarr.core.buffer import Buffer, NDBuffer

NAME = "mars_lidar.sparse"


@dataclass(frozen=True)
class SparseCodec(ArrayBytesCodec):
    """Array to bytes: Rice codes of the gaps between nonzero counts, and of these counts minus 1."""

    is_fixed_size = False

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """The codec of a metadata document; it has no settings."""
        return cls()

    def to_dict(self) -> Any:
        """For the metadata document."""
        return {"name": NAME, "configuration": {}}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Not implemented: the size depends on the counts."""
        raise NotImplementedError

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        counts = np.ascontiguousarray(chunk_data.as_numpy_array()).reshape(-1)
        packed = await asyncio.to_thread(_core.pack_counts, counts)
        return chunk_spec.prototype.buffer.from_bytes(packed)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        packed = np.ascontiguousarray(chunk_data.as_numpy_array()).view(np.uint8).reshape(-1)
        dtype = chunk_spec.dtype.to_native_dtype()
        if dtype not in (np.uint16, np.uint32):
            raise ValueError(f"packed counts are uint16 or uint32, not {dtype}")
        out: NDArray[Any] = np.empty(chunk_spec.shape, dtype)
        await asyncio.to_thread(lambda: _core.unpack_counts(packed, out.reshape(-1)))
        return chunk_spec.prototype.nd_buffer.from_numpy_array(out)


register_codec(NAME, SparseCodec)
