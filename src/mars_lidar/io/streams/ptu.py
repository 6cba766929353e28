"""PTU of PicoQuant, cubes: a T3 image that labs' programs open; realizations are its frames.

The format holds photons, not counts: `ptufile.PtuWriter` puts those of a pixel one laser period after the
other, so that any reader that makes an image of the file gets the cube back. *When* in the exposure a photon
came is not in it; `mars_lidar.io.streams.ptu_stream` writes photons with their real times.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import UnchangedFile, beside
from mars_lidar._base.imports import needed
from mars_lidar._base.resources import check_memory
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.store import LazyCounts, OnDisk, OpenedStore, Writer
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


@contextlib.contextmanager
def open_writer(path: Path, recipe: Recipe) -> Iterator[Writer]:
    """Writes a cube image by image; the number of records comes into the header at the end."""
    check(recipe)
    _, height, width, bins = recipe.shape
    size = height * width * bins * recipe.dtype.itemsize
    check_memory(3 * size, f"the images of {path}, which are written whole,", "a .zarr or .h5 is written in parts")
    image, periods = np.empty((height, width, bins), recipe.dtype), _pixel_periods(recipe)
    attrs = {"kind": KIND, "complete": True, **layout.attributes(recipe)}
    arrays = {v.name: v.data for v in layout.variables(recipe)}

    def put(realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        for part in block:
            image[rows] = part
            if rows.stop < height:  # an image is written when its last row has come
                continue
            most = int(image.sum(-1, dtype=np.uint64).max())
            if most > periods:  # the writer would leave photons out without a word
                raise ValueError(f"a pixel of {most} counts does not fit the {periods} laser periods of a .ptu")
            ptu.write(image[None, :, :, None])
            file.write(_OVERFLOW)  # the next image begins with its time at 0: time must not run backwards

    with beside(path) as unfinished, open(unfinished, "w+b") as file:
        ptu = ptu_header.new_file(
            file, (height, width, bins), recipe.system.period_ns, periods, attrs, arrays, recipe.shape[0]
        )
        begin = file.tell()
        writer = Writer(recipe.chunks(size), put)
        yield writer
        records = (file.tell() - begin) // 4
        ptu.close()
        ptu_header.set_integer(file, begin, b"TTResult_NumberOfRecords", records)
        ptu_header.set_integer(file, begin, ptu_header.PHOTONS.encode(), writer.registrations)


def open_store(path: Path) -> OpenedStore:
    """Open a file for reading."""
    opened = UnchangedFile(path)
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
    recipe = layout.recipe_from(attrs, arrays, told)
    shape = recipe.shape

    def counts() -> NDArray[Any]:
        with opened.unchanged(), ptu_header.opened(path) as ptu:
            size = recipe.nbytes + path.stat().st_size
            check_memory(size, f"the counts of {path}", "mars-lidar convert makes a .zarr of it elsewhere")
            image = ptu.decode_image(channel=0, dtime=shape[-1], dtype=recipe.dtype)
        if image.shape != (*shape[:3], 1, shape[3]):
            made = f"{image.shape[:3]} instead of {shape[:3]} (realization, y, x)"
            raise ValueError(f"{path} is damaged: its records make an image of {made}")
        total = int(image.sum(dtype=np.uint64))
        if total != attrs["registrations"]:
            raise ValueError(f"{path} is damaged: its image has {total} of {attrs['registrations']} registrations")
        return np.ascontiguousarray(image[:, :, :, 0])

    return OpenedStore(attrs, arrays | {"histogram": OnDisk(LazyCounts(shape, recipe.dtype, counts), path)})


def _pixel_periods(recipe: Recipe) -> int:
    """Laser periods given to a pixel: the exposure, or more where its photons could be more."""
    system = recipe.system
    mean = float(recipe.flux.total.max()) * system.cycles
    most = mean + 12.0 * math.sqrt(mean) + 60.0  # of a Poisson count; probability of more: 1e-30
    if system.detector.dead_time_ns > 0:
        most = min(most, system.exposure_ns // system.detector.dead_time_ns + 1)
    return max(system.cycles, math.ceil(most))
