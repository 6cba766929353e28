"""PTU of PicoQuant, cubes: a T3 image that labs' programs open; realizations are its frames.

The format holds photons, not counts: `ptufile.PtuWriter` puts those of a pixel one laser period after the
other, so that any reader that makes an image of the file gets the cube back. *When* in the exposure a photon
came is not in it; `mars_lidar.io.streams.ptu_stream` writes photons with their real times.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.memory import check_memory
from mars_lidar._base.optional import needed
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.store import FileWriter, LazyCounts, OpenedStore
from mars_lidar.io.streams import ptu_header

KIND = "cube"
_OVERFLOW = ((1 << 31) | (63 << 25) | 1).to_bytes(4, "little")  # generic T3: 1024 laser periods more
_MAX_PIXEL_PERIODS = 2**31  # ptufile counts the periods of a pixel in 32 bits


def check(recipe: Recipe) -> None:
    """Raise ValueError for what the format cannot hold, before any work."""
    needed("ptufile", "a .ptu")
    if recipe.system.bins > ptu_header.MAX_BINS:
        raise ValueError(f"bins must be at most {ptu_header.MAX_BINS} in a .ptu, got {recipe.system.bins}; use .h5")
    if _pixel_periods(recipe) >= _MAX_PIXEL_PERIODS:
        raise ValueError(f"a pixel of a .ptu must span fewer than 2^31 laser periods, got {_pixel_periods(recipe)}")


class PtuWriter(FileWriter):
    """Writes a cube image by image."""

    def _begin(self, recipe: Recipe) -> None:
        check(recipe)
        _, height, width, bins = recipe.shape
        size = height * width * bins * recipe.dtype.itemsize
        what = f"the images of {self._path}, which are written whole,"
        check_memory(3 * size, what, "a .zarr or .h5 is written in parts")
        self.chunks = recipe.chunks(size)
        self._image = np.empty((height, width, bins), recipe.dtype)
        self._rows = 0
        self._periods = _pixel_periods(recipe)
        self._file = open(self._sibling.path, "w+b")  # noqa: SIM115  # closed by `finish` and `abandon`
        self._parts.append(self._file)
        attrs = {"kind": KIND, "complete": True, **layout.attributes(recipe)}
        arrays = {v.name: v.data for v in layout.variables(recipe)}
        self._ptu = ptu_header.new_file(
            self._file, (height, width, bins), recipe.system.period_ns, self._periods, attrs, arrays, recipe.shape[0]
        )
        self._header_bytes = self._file.tell()

    def write(self, realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        """Take rows of an image, or whole images; an image is written when its last row has come."""
        for image in block:
            self._image[rows] = image
            self._rows += rows.stop - rows.start
            if self._rows < self._image.shape[0]:
                continue
            self._rows = 0
            most = int(self._image.sum(-1, dtype=np.uint64).max())
            if most > self._periods:  # the writer would leave photons out without a word
                raise ValueError(f"a pixel of {most} counts does not fit the {self._periods} laser periods of a .ptu")
            self._ptu.write(self._image[None, :, :, None])
            self._file.write(_OVERFLOW)  # the next image begins with its time at 0: time must not run backwards

    def _end(self, registrations: int) -> None:
        """Put the number of records into the header."""
        records = (self._file.tell() - self._header_bytes) // 4
        self._ptu.close()
        ptu_header.set_integer(self._file, self._header_bytes, b"TTResult_NumberOfRecords", records)
        ptu_header.set_integer(self._file, self._header_bytes, ptu_header.PHOTONS.encode(), registrations)


open_writer = PtuWriter


def open_store(path: Path) -> OpenedStore:
    """Open a file for reading."""
    with ptu_header.opened(path) as ptu:
        attrs = ptu_header.attributes(ptu.tags)
        arrays = ptu_header.variables(path, ptu.tags)
        told = int(ptu.tags.get("ImgHdr_MaxFrames", 0))
        attrs["registrations"] = int(ptu.tags.get(ptu_header.PHOTONS, 0))
    if attrs.get("kind") != KIND:
        raise ValueError(
            f"{path} is not a cube written by mars-lidar; mars_lidar.Timestamps.load reads photon streams, "
            f"ptufile.imread any image"
        )
    layout.check_format(path, attrs)
    recipe = layout.recipe_from(attrs, frozenset(arrays), arrays.__getitem__, told)
    shape = recipe.shape

    def counts() -> NDArray[Any]:
        whole = recipe.nbytes + path.stat().st_size
        check_memory(whole, f"the counts of {path}", "mars-lidar convert makes a .zarr of it elsewhere")
        with ptu_header.opened(path) as ptu:
            image = ptu.decode_image(channel=0, dtime=shape[-1], dtype=recipe.dtype)
        if image.shape != (*shape[:3], 1, shape[3]):
            made = f"{image.shape[:3]} instead of {shape[:3]} (realization, y, x)"
            raise ValueError(f"{path} is damaged: its records make an image of {made}")
        return np.ascontiguousarray(image[:, :, :, 0])

    return OpenedStore(attrs, frozenset(arrays), arrays.__getitem__, LazyCounts(shape, recipe.dtype, counts))


def _pixel_periods(recipe: Recipe) -> int:
    """Laser periods given to a pixel: the exposure, or more where its photons could be more."""
    system = recipe.system
    mean = float(recipe.flux.total.max()) * system.cycles
    most = mean + 12.0 * math.sqrt(mean) + 60.0  # of a Poisson count; probability of more: 1e-30
    if system.detector.dead_time_ns > 0:
        most = min(most, system.exposure_ns // system.detector.dead_time_ns + 1)
    return max(system.cycles, math.ceil(most))
