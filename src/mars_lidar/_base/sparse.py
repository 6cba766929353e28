"""Sparse matrices of files and callers: their indices are checked before compiled code follows them.

SciPy writes through the indices of a matrix without a look at them: one that is out of range ends the process, or
changes memory beyond the array.
"""

from __future__ import annotations

import math
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

    `sorted_rows`: each index comes once and they ascend, as MATLAB keeps them.
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


def dense_bytes(matrix: Any) -> int:
    """Memory of `dense_counts`."""
    return math.prod(map(int, matrix.shape)) * _counts_type(matrix).itemsize


def dense_counts(name: str, matrix: Any) -> NDArray[Any]:
    """All elements (rows, columns), checked; floats that are whole numbers as integers, which take less memory."""
    check_sparse(name, matrix)
    return np.asarray(matrix.astype(_counts_type(matrix)).toarray())


def _counts_type(matrix: Any) -> np.dtype[Any]:
    """uint32 where the stored elements are counts, each of which comes once, else the type of the matrix."""
    stored: np.dtype[Any] = np.dtype(matrix.dtype)
    data = matrix.data if matrix.format in (*_COMPRESSED, *_EXPANDED) else None
    if data is None or stored.kind not in "iuf" or (matrix.format == "coo" and not matrix.has_canonical_format):
        return stored
    with np.errstate(invalid="ignore"):
        are_counts = bool(((data >= 0) & (data == np.floor(data))).all()) and float(data.sum()) < TOL.counts
    return np.dtype(np.uint32) if are_counts and stored.itemsize > 4 else stored
