"""Arrays of numbers in .npz, .mat (v5, v7.3) and HDF5 files of other programs, by name."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import mat5
from mars_lidar._base.files import check_claim, open_npz, read_mat5, reading, size_on_disk, whole
from mars_lidar._base.hdf5 import CELLS, open_hdf5
from mars_lidar._base.sparse import check_sparse, check_stored, is_sparse
from mars_lidar.io.store import OnDisk

_FEW_CELLS, _CELL_BYTES = 50_000, 8  # cells of any file; bytes of a file that each of more takes at least


@dataclass(frozen=True)
class NamedArrays:
    """The arrays at the top of an open file."""

    names: list[str]
    read: Callable[[Iterable[str]], dict[str, Any]]  # those that are there; of HDF5 on disk until they are indexed
    turned: bool = False  # whether axes are stored in reverse, as version 7.3 of a .mat has them


@contextlib.contextmanager
def open_arrays(path: Path) -> Iterator[NamedArrays]:
    """An .npz, .mat or HDF5 file."""
    import h5py

    if path.suffix.lower() == ".npz":
        with open_npz(path) as archive:
            yield NamedArrays(archive.files, lambda some: {name: archive[name] for name in some if name in archive})
    elif h5py.is_hdf5(path):
        with open_hdf5(path) as file:
            arrays = {name: OnDisk(data, path) for name, data in file.items() if isinstance(data, h5py.Dataset)}
            turned = path.suffix.lower() == ".mat"
            yield NamedArrays([*arrays], lambda some: {name: arrays[name] for name in some if name in arrays}, turned)
    else:
        with reading(path, "a .mat of version 5"):
            names = [head.name for head in mat5.variables(path)]
        yield NamedArrays(names, lambda some: _plain(read_mat5(path, some)))


def mat_arrays(path: Path, names: list[str] | None = None, *, deep: bool = True) -> dict[str, Any]:
    """Variables of a .mat: arrays in MATLAB's order, sparse matrices, and cells (H, W) as arrays of arrays.

    `names`: read only these variables, of version 5. `deep`: include those within structures of a v7.3 file.
    """
    import h5py

    if h5py.is_hdf5(path):
        return hdf5_arrays(path, of_matlab=True, deep=deep)
    return _plain(read_mat5(path, names))


def _plain(variables: dict[str, Any]) -> dict[str, Any]:
    """Without SciPy's entries on the file itself."""
    return {name: array for name, array in variables.items() if not name.startswith("__")}


def hdf5_arrays(path: Path, *, of_matlab: bool = False, deep: bool = True) -> dict[str, Any]:
    """The arrays of an HDF5 file, of all its groups; a sparse one of MATLAB is a group of three.

    `of_matlab`: axes are stored in reverse, cells as references, and an empty array as its own size.
    """
    import h5py

    out: dict[str, Any] = {}
    parts: set[str] = set()

    def visit(name: str, item: Any) -> None:
        if (not deep and "/" in name) or name.partition("/")[0] == CELLS or name in parts:
            return
        if isinstance(item, h5py.Group) and "MATLAB_sparse" in item.attrs:
            out[name] = _sparse(name, item)
            parts.update(f"{name}/{part}" for part in item)
        elif not isinstance(item, h5py.Dataset):
            return
        elif of_matlab and item.dtype == h5py.ref_dtype:
            references = np.atleast_2d(whole(item)).T
            out[name] = _cells(path, name, item.file, references)
        elif item.dtype.kind in "iuf" and item.ndim and not item.attrs.get("MATLAB_empty", 0):
            out[name] = whole(item).T if of_matlab else whole(item)

    with open_hdf5(path) as file:
        file.visititems(visit)
    return out


def _cells(path: Path, name: str, file: Any, references: Any) -> Any:
    """What the cells of MATLAB 7.3 hold, which may be the same for many of them."""
    if references.size > max(_FEW_CELLS, size_on_disk(path) // _CELL_BYTES):  # each takes some 20 us to open
        raise ValueError(f"{path}: {name} would have {references.size:,} cells, more than it can fill: is it damaged?")
    out, claimed = np.empty(references.shape, object), 0
    for place, reference in np.ndenumerate(references):
        part = file[reference]
        claimed += getattr(part, "nbytes", 0)
        check_claim(path, claimed, name)
        out[place] = _cell(f"{name}[{place}]", part)
    return out


def _sparse(name: str, group: Any) -> Any:
    """A sparse matrix of MATLAB 7.3: a group of columns' ends, rows and values."""
    from scipy import sparse

    columns = whole(group["jc"])
    data, rows = (whole(group[part]) if part in group else np.zeros(0, int) for part in ("data", "ir"))
    check_stored({"indices": rows, "indptr": columns})
    shape = (int(group.attrs["MATLAB_sparse"]), len(columns) - 1)
    matrix = sparse.csc_array((data, rows.astype(np.int64), columns.astype(np.int64)), shape=shape)
    check_sparse(name, matrix, sorted_rows=True)
    return matrix


def _cell(name: str, part: Any) -> Any:
    """What a cell of MATLAB 7.3 holds: a sparse matrix, an array, or of photon times a vector."""
    if "MATLAB_sparse" in part.attrs:
        return _sparse(name, part)
    if not hasattr(part, "shape"):
        raise ValueError(f"{name} is a structure or cell within a cell, which is not read")
    if part.attrs.get("MATLAB_empty", 0):
        return np.empty(0)
    values = whole(part)
    return values.ravel() if values.size == max((0, *values.shape)) else values.T


def cell_arrays(variables: dict[str, Any]) -> dict[str, Any]:
    """Arrays in cells of a .mat that are not photon times, by names such as ``spad[2]`` (the second, as in MATLAB)."""
    out: dict[str, Any] = {}
    for name, values in variables.items():
        if isinstance(values, np.ndarray) and values.dtype == object:
            out |= {f"{name}[{k}]": cell for k, cell in enumerate(values.ravel(order="F"), start=1) if _is_deep(cell)}
    return out


def _is_deep(cell: Any) -> bool:
    """Whether this is a sparse matrix, or an array of numbers that is no vector."""
    if not isinstance(cell, np.ndarray):
        return is_sparse(cell)
    return cell.size > 1 and 1 not in cell.shape and cell.dtype.kind in "iuf"
