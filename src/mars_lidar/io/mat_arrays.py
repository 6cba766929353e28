"""Arrays of numbers in .mat (v5, v7.3) and HDF5 files of others, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base.files import read_mat5, whole
from mars_lidar._base.hdf5 import open_hdf5

_CELLS = "#refs#"  # where MATLAB puts what the cells of a v7.3 file hold


def mat_arrays(path: Path, *, deep: bool = True) -> dict[str, Any]:
    """Variables of a .mat: arrays in MATLAB's order, sparse matrices, and cells (H, W) as arrays of arrays.

    `deep`: those within structures of a v7.3 file as well.
    """
    import h5py

    if h5py.is_hdf5(path):
        return hdf5_arrays(path, of_matlab=True, deep=deep)
    return {name: found for name, found in read_mat5(path).items() if not name.startswith("__")}


def hdf5_arrays(path: Path, *, of_matlab: bool = False, deep: bool = True) -> dict[str, Any]:
    """The arrays of an HDF5 file, of all its groups; a sparse one of MATLAB is a group of three.

    `of_matlab`: axes are stored in reverse, cells as references, and an empty array as its own size.
    """
    import h5py
    from scipy import sparse

    out: dict[str, Any] = {}
    parts: set[str] = set()

    def visit(name: str, item: Any) -> None:
        if (not deep and "/" in name) or name.partition("/")[0] == _CELLS or name in parts:
            return
        if isinstance(item, h5py.Group) and "MATLAB_sparse" in item.attrs:
            columns = whole(item["jc"]).astype(np.int64)
            data, rows = (whole(item[part]) if part in item else np.zeros(0) for part in ("data", "ir"))
            shape = (int(item.attrs["MATLAB_sparse"]), len(columns) - 1)
            out[name] = sparse.csc_array((data, rows.astype(np.int64), columns), shape=shape)
            parts.update(f"{name}/{part}" for part in item)
        elif not isinstance(item, h5py.Dataset):
            return
        elif of_matlab and item.dtype == h5py.ref_dtype:
            references = np.atleast_2d(whole(item)).T
            out[name] = np.empty(references.shape, object)
            for place, reference in np.ndenumerate(references):
                part = item.file[reference]
                out[name][place] = np.empty(0) if part.attrs.get("MATLAB_empty", 0) else whole(part).ravel()
        elif item.dtype.kind in "iuf" and item.ndim and not item.attrs.get("MATLAB_empty", 0):
            out[name] = whole(item).T if of_matlab else whole(item)

    with open_hdf5(path) as file:
        file.visititems(visit)
    return out
