"""PTU of PicoQuant, cubes: a T3 image that labs' programs open; realizations are its frames.

The format holds photons, not counts: `ptufile.PtuWriter` puts those of a pixel one laser period after the
other, so that any reader that makes an image of the file gets the cube back. *When* in the exposure a photon
came is not in it; `mars_lidar.io.streams.ptu_stream` writes photons with their real times.
"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import TemporarySibling
from mars_lidar._base.memory import check_memory
from mars_lidar._base.optional import needed
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.io.store import LazyCounts, OpenedStore, Writer
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


class PtuWriter(Writer):
    """Writes a sibling of the target, image by image, and renames it at the end."""

    def __init__(self, path: Path, recipe: Recipe) -> None:
        check(recipe)
        ptufile = needed("ptufile", "a .ptu")
        system = recipe.system
        _, height, width, bins = recipe.shape
        size = height * width * bins * recipe.dtype.itemsize
        check_memory(3 * size, f"the images of {path}, which are written whole,", "a .zarr or .h5 is written in parts")
        self.chunks = recipe.chunks(size)
        self._image = np.empty((height, width, bins), recipe.dtype)
        self._rows = 0
        self._periods = _pixel_periods(recipe)
        self._sibling = TemporarySibling(path)
        self._ptu: Any = None
        period_s = 1e-9 * system.period_ns
        self._file = open(self._sibling.path, "w+b")  # noqa: SIM115  # closed by `finish` and `abandon`
        try:
            attrs = {"kind": KIND, "complete": True, **layout.attributes(recipe)}
            arrays = {v.name: v.data for v in layout.variables(recipe)}
            spanned = period_s * self._periods * math.prod(recipe.shape[:3])
            self._ptu = ptufile.PtuWriter(
                self._file,
                (1, height, width, 1, bins),
                period_s,
                period_s / bins,
                period_s * self._periods,
                record_type=ptufile.PtuRecordType.GenericT3,
                tags=ptu_header.tags(attrs, arrays, spanned),
            )
            self._header_bytes = self._file.tell()
        except BaseException:
            self.abandon()
            raise

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

    def finish(self, registrations: int) -> None:
        """Put the number of records into the header, close the file, and put it in its place."""
        records = (self._file.tell() - self._header_bytes) // 4
        self._ptu.close()
        ptu_header.set_integer(self._file, self._header_bytes, b"TTResult_NumberOfRecords", records)
        ptu_header.set_integer(self._file, self._header_bytes, ptu_header.PHOTONS.encode(), registrations)
        self._file.close()
        self._sibling.publish()

    def abandon(self) -> str:
        """Remove the unfinished sibling."""
        with contextlib.suppress(Exception):
            self._file.close()
        return self._sibling.discard()


class _PtuCounts(LazyCounts):
    """The counts of a file."""

    def __init__(self, path: Path, recipe: Recipe | Recording) -> None:
        self._path, self._recipe = path, recipe
        self.shape = recipe.shape
        self.dtype = recipe.dtype

    def _read(self) -> NDArray[Any]:
        whole = self._recipe.nbytes + self._path.stat().st_size
        check_memory(whole, f"the counts of {self._path}", "mars-lidar convert makes a .zarr of it elsewhere")
        ptu = ptu_header.opened(self._path)
        try:
            image = ptu.decode_image(channel=0, dtime=self.shape[-1], dtype=self.dtype)
        finally:
            ptu.close()
        if image.shape != (*self.shape[:3], 1, self.shape[3]):
            told = f"{image.shape[:3]} instead of {self.shape[:3]} (realization, y, x)"
            raise ValueError(f"{self._path} is damaged: its records make an image of {told}")
        return np.ascontiguousarray(image[:, :, :, 0])


def open_writer(path: Path, recipe: Recipe) -> Writer:
    """Begin a file; an existing one is replaced."""
    return PtuWriter(path, recipe)


def open_store(path: Path) -> OpenedStore:
    """Open a file for reading."""
    ptu = ptu_header.opened(path)
    try:
        attrs = ptu_header.attributes(ptu.tags)
        arrays = ptu_header.variables(path, ptu.tags)
        told = int(ptu.tags.get("ImgHdr_MaxFrames", 0))
        attrs["registrations"] = int(ptu.tags.get(ptu_header.PHOTONS, 0))
    finally:
        ptu.close()
    if attrs.get("kind") != KIND:
        raise ValueError(
            f"{path} is not a cube written by mars-lidar; mars_lidar.Timestamps.load reads photon streams, "
            f"ptufile.imread any image"
        )
    layout.check_format(path, attrs)
    recipe = layout.recipe_from(attrs, frozenset(arrays), arrays.__getitem__, told)
    return OpenedStore(attrs, frozenset(arrays), arrays.__getitem__, _PtuCounts(path, recipe), True, "", lambda: None)


def _pixel_periods(recipe: Recipe) -> int:
    """Laser periods given to a pixel: the exposure, or more where its photons could be more."""
    system = recipe.system
    mean = float(recipe.flux.total.max()) * system.cycles
    most = mean + 12.0 * math.sqrt(mean) + 60.0  # of a Poisson count; probability of more: 1e-30
    if system.detector.dead_time_ns > 0:
        most = min(most, system.exposure_ns // system.detector.dead_time_ns + 1)
    return max(system.cycles, math.ceil(most))
