"""Sparse matrices of files and callers: their indices are checked before compiled code follows them.

SciPy uses the indices of a matrix without a bounds check: one out of range crashes the process or overwrites memory
beyond the array.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.tolerances import TOL

_COMPRESSED, _EXPANDED = ("csr", "csc", "bsr"), ("coo", "dia")


def is_sparse(value: Any) -> bool:
    """Whether `value` is a sparse matrix or array of SciPy."""
    return hasattr(value, "toarray") and hasattr(value, "format")


def check_sparse(name: str, matrix: Any, *, sorted_rows: bool = False) -> None:
    """Raise ValueError unless all indices of `matrix` lie inside of it, and its parts have equal sizes.

    `sorted_rows`: indices are unique and ascending, as in MATLAB files.
    """
    name = name or "the matrix"
    if matrix.ndim != 2 or min(matrix.shape) < 0:
        raise ValueError(f"{name} must be a sparse matrix of two dimensions, got shape {matrix.shape}")
    if matrix.format in _COMPRESSED:
        try:
            matrix.check_format(full_check=True)
        except (ValueError, IndexError, TypeError) as error:
            raise ValueError(f"{name} is damaged, a sparse matrix: {error}") from None
        if sorted_rows and not matrix.has_canonical_format:
            raise ValueError(f"{name} is damaged: the rows of its sparse matrix do not ascend")
    elif matrix.format == "coo":
        if len({matrix.data.size, *(index.size for index in matrix.coords)}) != 1:
            raise ValueError(f"{name} is damaged: its indices and values differ in number")
        for index, size in zip(matrix.coords, matrix.shape, strict=True):
            if index.size and not (int(index.min()) >= 0 and int(index.max()) < size):
                raise ValueError(f"{name} is damaged: a sparse index lies outside of its shape {matrix.shape}")


def check_stored(parts: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError unless the indices of a file's sparse matrix are whole numbers, to each of its values.

    SciPy casts any type to integers, drops values beyond the last row or column pointer, and ignores diagonals outside
    the matrix.
    """
    for name in {"indices", "indptr", "row", "col", "offsets"} & parts.keys():
        if parts[name].dtype.kind not in "iu":
            raise ValueError(f"{name} of a sparse matrix must be integers, got {parts[name].dtype}")
    if "indptr" in parts and int(parts["indptr"][-1]) != len(parts["indices"]):
        raise ValueError(f"a sparse matrix has {len(parts['indices'])} values and ends at {parts['indptr'][-1]}")
    if "offsets" in parts:
        rows, columns = map(int, parts["shape"])
        if not all(-rows < int(offset) < columns for offset in parts["offsets"]):
            raise ValueError(f"a diagonal of a sparse matrix lies outside of its shape ({rows}, {columns})")


def dense_bytes(matrix: Any) -> int:
    """Memory of `dense_counts`."""
    return math.prod(map(int, matrix.shape)) * _counts_type(matrix).itemsize


def dense_counts(name: str, matrix: Any) -> NDArray[Any]:
    """All elements (rows, columns), checked; floats that are whole numbers as integers, which take less memory."""
    check_sparse(name, matrix)
    return np.asarray(matrix.astype(_counts_type(matrix)).toarray())


def _counts_type(matrix: Any) -> np.dtype[Any]:
    """uint32 where the stored elements are counts, else that of the matrix; sums of repeated integers do not wrap."""
    stored: np.dtype[Any] = np.dtype(matrix.dtype)
    data = matrix.data if matrix.format in (*_COMPRESSED, *_EXPANDED) else None
    if stored.kind in "iu" and not getattr(matrix, "has_canonical_format", True):
        return np.dtype(np.float64)
    if data is None or stored.kind not in "iuf" or (matrix.format == "coo" and not matrix.has_canonical_format):
        return stored
    with np.errstate(invalid="ignore"):
        whole = bool(((data >= 0) & (data == np.floor(data))).all())
        are_counts = whole and float(data.sum(dtype=np.float64)) < TOL.counts
    return np.dtype(np.uint32) if are_counts and stored.itemsize > 4 else stored
