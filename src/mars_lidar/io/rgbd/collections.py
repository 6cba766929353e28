"""The layouts of two collections of scenes: NYUv2 and Middlebury.

The labelled data set of NYUv2 is ``nyu_depth_v2_labeled.mat``: 1449 frames of depth and colour.

It is a MATLAB v7.3 file, that is HDF5 with MATLAB's axes reversed: ``depths`` (N, W, H) in metres, holes filled
by its authors, and ``images`` (N, 3, W, H), 8 bits. Depth is perpendicular to the image plane (focal length
about 519 px; N. Silberman et al., ECCV 2012).

Middlebury has a folder for each stereo scene (vision.middlebury.edu/stereo/data): depth from disparity.

2005 and 2006, ``disp1.png``, ``view1.png``, ``dmin.txt``: depth is ``f b / (d + d_min)``, f = 3740 px and b =
160 mm at full size. The stored d is in pixels of the *full* size at full, half and third size alike (the data
set's page has it divided by 2 or 3 to get pixels of the image at hand), and so is d_min: no scale enters. (On
half-size "Art" this makes the paper cup 72 mm wide and the depth 1.4 to 2.2 m; d_min in half-size pixels would
make it 48 mm.) d = 0 is unknown.

2014 and 2021, ``disp0.pfm``, ``im0.png``, ``calib.txt``: depth is ``f b / (d + doffs)`` with f from the matrix
``cam0`` in pixels, ``baseline`` b in mm, and ``doffs`` the distance in x of the two principal points; d = inf is
unknown (D. Scharstein et al., GCPR 2014).

Depth is perpendicular to the image plane in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.files import check_claim
from mars_lidar._base.hdf5 import open_hdf5
from mars_lidar._base.types import FloatArray
from mars_lidar.io.rgbd import pixels

_FILES_2005 = ("disp1.png", "view1.png", "dmin.txt")
_FILES_2014 = ("disp0.pfm", "im0.png", "calib.txt")
_FOCAL_2005_PX = 3740.0
_BASELINE_2005_M = 0.160


def is_nyu(path: Path) -> bool:
    """Whether a .mat is of version 7.3 and has NYUv2's ``depths`` or ``images``."""
    import h5py

    if not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as file:
        return "depths" in file or "images" in file


def nyu_frames(path: Path) -> int:
    """Number of frames in the file."""
    with _nyu(path) as file:
        return int(file["depths"].shape[0])


def read_nyu(path: Path, index: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Depth (H, W), m, and colours (H, W, 3), uint8, of a frame; only this frame is read."""
    with _nyu(path) as file:
        depths, images = file["depths"], file["images"]
        k = checks.integer("index", index, low=0, high=int(depths.shape[0]) - 1)
        check_claim(path, 4 * 8 * depths[:1].size, f"frame {k}")
        depth, image = np.asarray(depths[k]), np.asarray(images[k])
    return depth.T, image.transpose(2, 1, 0)


@contextmanager
def _nyu(path: Path) -> Iterator[Any]:
    import h5py

    with open_hdf5(path, "NYUv2's labelled .mat, of MATLAB v7.3") as file:
        for name in ("depths", "images"):
            if not isinstance(file.get(name), h5py.Dataset):
                raise ValueError(f"{path}: must hold 'depths' and 'images' as NYUv2 does, got {', '.join(file)}")
        depths, images = file["depths"], file["images"]
        if depths.ndim != 3 or images.shape != (depths.shape[0], 3, *depths.shape[1:]) or depths.size == 0:
            told = f"{pixels.describe(depths)} and {pixels.describe(images)}"
            raise ValueError(f"{path}: depths must be (N, W, H) and images (N, 3, W, H), got {told}")
        yield file


def is_middlebury(folder: Path) -> bool:
    """Whether the folder has the disparities of a scene, of either layout."""
    return any((folder / files[0]).is_file() for files in (_FILES_2005, _FILES_2014))


def read_middlebury(folder: Path) -> tuple[FloatArray, Path]:
    """Depth (H, W) in m, NaN where it is unknown, and the path of the left image."""
    newer = any((folder / name).is_file() for name in (_FILES_2014[0], _FILES_2014[2]))
    files, years = (_FILES_2014, "2014/2021") if newer else (_FILES_2005, "2005/2006")
    missing = [name for name in files if not (folder / name).is_file()]
    if missing:
        either = "" if newer else f", or one of 2014/2021 with {', '.join(_FILES_2014)}"
        raise ValueError(
            f"{folder}: {', '.join(missing)} not found; "
            f"a folder must be a Middlebury {years} scene with {', '.join(files)}{either}"
        )
    return (_depth_2014(folder) if newer else _depth_2005(folder)), folder / files[1]


def _depth_2005(folder: Path) -> FloatArray:
    text = (folder / "dmin.txt").read_text(errors="replace").strip()
    try:
        offset = checks.real("dmin", float(text), low=0.0)
    except ValueError as error:
        raise ValueError(f"{folder / 'dmin.txt'}: must hold one number >= 0, got {text[:40]!r}") from error
    stored = pixels.array(folder / "disp1.png")
    if stored.ndim != 2 or stored.dtype.kind not in "iu":
        told = pixels.describe(stored)
        raise ValueError(f"{folder / 'disp1.png'}: must have one channel of integers, got {told}")
    disparity = stored.astype(np.float64)
    known = np.where(disparity > 0.0, disparity + offset, np.nan)
    return pixels.known(folder / "disp1.png", _FOCAL_2005_PX * _BASELINE_2005_M / known)


def _depth_2014(folder: Path) -> FloatArray:
    focal_px, baseline_mm, offset_px = _calibration(folder / "calib.txt")
    disparity = pixels.floats(folder / "disp0.pfm", "disparity", pixels.read_pfm(folder / "disp0.pfm"))
    shifted = disparity + offset_px
    usable = np.isfinite(disparity) & (disparity > 0.0) & (shifted > 0.0)
    depth = 1e-3 * baseline_mm * focal_px / np.where(usable, shifted, np.nan)
    return pixels.known(folder / "disp0.pfm", depth)


def _calibration(path: Path) -> tuple[float, float, float]:
    """Focal length in px, baseline in mm, and offset of the principal points in px, of a ``calib.txt``."""
    lines = (line.partition("=") for line in path.read_text(errors="replace").splitlines())
    told = {name.strip(): value.strip() for name, _, value in lines}
    numbers = []
    for name in ("cam0", "baseline", "doffs"):
        text = told.get(name)
        if text is None:
            raise ValueError(f"{path}: must give {name}")
        try:  # of the matrix [f 0 cx; 0 f cy; 0 0 1] the first element
            number = float(text.lstrip("[").replace(";", " ").split()[0])
        except (ValueError, IndexError):
            number = math.nan
        if not math.isfinite(number) or (name != "doffs" and number <= 0.0):
            raise ValueError(f"{path}: {name} must begin with a number{' > 0' * (name != 'doffs')}, got {text[:60]!r}")
        numbers.append(number)
    return numbers[0], numbers[1], numbers[2]
