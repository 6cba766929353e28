"""What a file of a transient tells beside the light: depth and reflectivity of each pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import open_npz, read_mat5, reading, whole
from mars_lidar._base.hdf5 import open_hdf5
from mars_lidar._base.types import FloatArray

NAMES = ("depth", "reflectivity")


def read_truth(path: str | Path, shape: tuple[int, int]) -> dict[str, FloatArray]:
    """Depth and reflectivity beside a transient of `shape` (H, W), float64, those that are there.

    Arrays ``depth`` (m; 0, NaN and inf mean "no return", which becomes NaN) and ``reflectivity`` ([0, 1]), (H, W), of
    ``.npz``, ``.h5``, ``.hdf5`` and ``.mat`` (turned, as the transient is). A ValueError begins with the file.
    """
    with reading(path, "a transient with depth and reflectivity") as source:
        told: dict[str, FloatArray] = {}
        for name, stored in _read(source).items():
            if stored.shape != shape or stored.dtype.kind not in "fiu":
                raise ValueError(f"{source}: {name} must be real numbers {shape}, got {stored.dtype} {stored.shape}")
            told[name] = stored.astype(np.float64)
        if "depth" in told:
            depth = told["depth"]
            if (depth < 0.0).any():
                raise ValueError(f"{source}: depth must not be negative, got {np.nanmin(depth):g} m")
            told["depth"] = np.where((depth > 0.0) & (depth < np.inf), depth, np.nan)
        if "reflectivity" in told and not ((told["reflectivity"] >= 0.0) & (told["reflectivity"] <= 1.0)).all():
            raise ValueError(f"{source}: reflectivity must lie in [0, 1]")
        return told


def _read(path: Path) -> dict[str, NDArray[Any]]:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with open_npz(path) as archive:
            return {name: archive[name] for name in NAMES if name in archive.files}
    import h5py

    if suffix in (".h5", ".hdf5", ".mat") and h5py.is_hdf5(path):
        with open_hdf5(path) as file:
            found = {name: whole(file[name]) for name in NAMES if isinstance(file.get(name), h5py.Dataset)}
            return {name: stored.T for name, stored in found.items()} if suffix == ".mat" else found
    if suffix == ".mat":
        variables = read_mat5(path, NAMES)
        return {name: np.asarray(variables[name]) for name in NAMES if name in variables}
    return {}
