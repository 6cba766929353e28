"""The labelled data set of NYUv2, ``nyu_depth_v2_labeled.mat``: 1449 frames of depth and colour.

It is a MATLAB v7.3 file, that is HDF5 with MATLAB's axes reversed: ``depths`` (N, W, H) in metres, holes filled
by its authors, and ``images`` (N, 3, W, H), 8 bits. Depth is perpendicular to the image plane (focal length
about 519 px; N. Silberman et al., ECCV 2012).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.files import check_claim
from mars_lidar._base.hdf5 import open_hdf5
from mars_lidar.io.rgbd.pixels import describe


def is_labelled(path: Path) -> bool:
    """Whether a .mat is of version 7.3 and has NYUv2's ``depths`` or ``images``."""
    import h5py

    if not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as file:
        return "depths" in file or "images" in file


def frames(path: Path) -> int:
    """Number of frames in the file."""
    with _opened(path) as file:
        return int(file["depths"].shape[0])


def read_frame(path: Path, index: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Depth (H, W), m, and colours (H, W, 3), uint8, of a frame; only this frame is read."""
    with _opened(path) as file:
        depths, images = file["depths"], file["images"]
        k = checks.integer("index", index, low=0, high=int(depths.shape[0]) - 1)
        check_claim(path, 4 * 8 * depths[:1].size, f"frame {k}")
        depth, image = np.asarray(depths[k]), np.asarray(images[k])
    return depth.T, image.transpose(2, 1, 0)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import h5py

    with open_hdf5(path, "NYUv2's labelled .mat, of MATLAB v7.3") as file:
        for name in ("depths", "images"):
            if not isinstance(file.get(name), h5py.Dataset):
                raise ValueError(f"{path}: must hold 'depths' and 'images' as NYUv2 does, got {', '.join(file)}")
        depths, images = file["depths"], file["images"]
        if depths.ndim != 3 or images.shape != (depths.shape[0], 3, *depths.shape[1:]) or depths.size == 0:
            told = f"{describe(depths)} and {describe(images)}"
            raise ValueError(f"{path}: depths must be (N, W, H) and images (N, 3, W, H), got {told}")
        yield file
