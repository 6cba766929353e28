"""Datasets as the files that networks of the field load: a layout is a row of keys, and one file is one exposure.

The keys, units and names are those that the loaders of these networks read:

- Lindell, O'Toole, Wetzstein (ACM TOG 37, 113, 2018) and Peng et al. (ECCV 2020): ``lindell``,
- the variant of the former's that draws its photons anew while it trains: ``deepsensorfusion``,
- Sun, Lindell, Solgaard, Wetzstein (Optics Express 28, 14948, 2020), SPADnet: ``sun``,
- Gutierrez-Barragan et al. (NeurIPS 2023), learned compressive histograms: ``gutierrez``.
"""

from __future__ import annotations

import io
import json
import math
import re
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import beside
from mars_lidar._base.memory import check_memory
from mars_lidar._base.progress import callback_of
from mars_lidar._base.types import Progress
from mars_lidar.dataset.arrays import MAPS
from mars_lidar.dataset.network_keys import Exposure, check_size, psf, pulse_in_bins
from mars_lidar.dataset.samples import sample_parts
from mars_lidar.dataset.store import Dataset, open_dataset
from mars_lidar.dataset.write import Maker
from mars_lidar.instrument.system import System
from mars_lidar.io.mat import write_variables

_NAMES = {"intensity_hr": "intensity"}  # what another name is stored under
WEBDATASET = "webdataset"
_TAR_BYTES = 256 * 2**20  # of counts
_MONOCULAR_M = 10.0  # depth of grey value 255 in SPADnet's images


@dataclass(frozen=True)
class Layout:
    """A layout: names of the files with ``{scene}``, ``{number}`` and ``{level}``, and the variables in each.

    `lists` is the file that the loader's list names, relative to the folder `inside`; `root` are files for the whole
    dataset, `pictures` the images beside an exposure, `size` what the loader has written into it, if anything.
    """

    files: dict[str, tuple[str, ...]]
    lists: str
    inside: str = ""
    root: dict[str, Callable[[System], dict[str, Any]]] | None = None
    pictures: dict[str, str] | None = None
    size: tuple[int, ...] = ()


_SPAD, _INTENSITY = "{scene}/spad_{number:04d}_p{level}.mat", "{scene}/intensity_{number:04d}.mat"
_LINDELL = ("spad", "rates", "bin", "bin_hr", "SBR", "photons")
_MEANS = ("SBR", "mean_signal_photons", "mean_background_photons", "bin_size")
LAYOUTS = {
    "lindell": Layout({_SPAD: _LINDELL, _INTENSITY: ("intensity_hr",)}, _INTENSITY, size=(64, 64, 1024)),
    "deepsensorfusion": Layout(
        {_SPAD: (*_LINDELL, "signal_ppp", "ambient_ppp", "pulse"), _INTENSITY: ("intensity_hr",)},
        _INTENSITY,
        root={"simulated_data/dark_img.mat": lambda system: {"dark_img": np.zeros((50, 64))}},
        size=(64, 64, 1024),
    ),
    "sun": Layout(
        {"spad_nyuv2/{scene}/spad_{number:04d}_nl{level}.mat": ("spad", "intensity", "depth", *_MEANS)},
        "{scene}/spad_{number:04d}_nl{level}.mat",
        pictures={
            "mono_nyuv2/{scene}/{number:04d}_truth.png": "depth",
            "mono_nyuv2/{scene}/{number:04d}_pred.png": "level_depth",
        },
        size=(512, 512),
    ),
    "gutierrez": Layout(
        {
            _SPAD: (
                *("spad", "rates", "bin", "range_bins", "est_range_bins_argmax", "est_range_bins_lmf"),
                *("intensity", "photons", *_MEANS),
            )
        },
        _SPAD,
        root={"PSF_used_for_simulation.mat": lambda system: {"psf": psf(system)}},
    ),
}


@dataclass(frozen=True)
class Exported:
    """What `export` did: how many files of exposures it wrote, the list of them, and what to know of them."""

    files: int
    listed: Path
    notes: tuple[str, ...]


@checked
def export(
    dataset: Dataset | str | Path,
    out: str | Path,
    *,
    layout: str,
    fill: bool = False,
    progress: Progress | bool | None = None,
) -> Exported:
    """Write every exposure of a dataset as a file that a network's loader reads.

    Parameters
    ----------
    dataset
        What `mars_lidar.generate` wrote, or its path.
    out
        A folder that is not there yet, or is empty. The loader's list in it, ``list.txt``, holds a file a line. It
        appears when all is written; what stops the writing leaves nothing under its name.
    layout
        One of `LAYOUTS`; or ``"webdataset"``: tar files ``shard-000000.tar``, ... of about 256 MiB for WebDataset, in
        which an exposure is ``SAMPLE-REALIZATION`` with an array of counts (H, W, bins), a ``.npy`` for each map, and
        ``json``, its numbers and its system.
    fill
        Give pixels without a return the depth, bin and rates of the nearest pixel with one. Otherwise their bin is 0,
        and loaders that divide rates by their sum make NaN of them.
    progress
        Called as ``progress(done, total)`` after each exposure; True: a bar.

    Raises
    ------
    ValueError, TypeError
        An unknown layout, or what it cannot hold; nothing was written.
    OSError
        `out` has something in it, or cannot be written.
    """
    told = callback_of(progress, "exporting")
    source = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    checks.choice("layout", layout, (*LAYOUTS, WEBDATASET))
    folder = Path(out)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists already and is not an empty folder")
    if layout == WEBDATASET:
        if fill:
            raise ValueError("fill belongs to the layouts of networks; webdataset has the maps as they are")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with beside(folder, folder=True) as unfinished:
            written = _write_tars(unfinished, source, told)
        return Exported(written, folder / "list.txt", ())
    chosen = LAYOUTS[layout]
    replaced = ("intensity", ".mat") if chosen.lists == _INTENSITY else ()  # by loaders, in the whole path
    if any(word in str(folder) for word in replaced) or len(str(folder).split()) != 1:
        raise ValueError(f"out must not have {' or '.join((*replaced, 'a blank'))} in its path, got {str(folder)!r}")
    height, width, bins = source.histogram.shape[2:]
    names = {name for keys in chosen.files.values() for name in keys}
    if "rates" in names:
        check_size("rates", 4 * height * width * bins)
        check_memory(24 * height * width * bins, "the rates of an exposure", "generate smaller crops")
    if "pulse" in names:
        for system in source.recipe.systems:
            pulse_in_bins(system, np.zeros((1, 1)), np.ones((1, 1)))
    folder.parent.mkdir(parents=True, exist_ok=True)
    with beside(folder, folder=True) as unfinished:
        written = _write(unfinished, folder, source, chosen, fill, told)
    return Exported(written, folder / "list.txt", tuple(_notes(layout, chosen, (height, width, bins))))


def _write_tars(folder: Path, source: Dataset, progress: Progress | None) -> int:
    """Write tar files of all exposures, and the list of their names; returns how many exposures."""
    samples, realizations = source.histogram.shape[:2]
    nbytes = math.prod(source.histogram.shape[2:]) * source.histogram.dtype.itemsize
    of_a_tar = max(1, _TAR_BYTES // nbytes)
    systems, names = [each.to_dict() for each in source.recipe.systems], source.scene_names()
    places = [(sample, realization) for sample in range(samples) for realization in range(realizations)]
    listed: list[str] = []
    for first in range(0, len(places), of_a_tar):
        listed.append(f"shard-{len(listed):06d}.tar")
        with tarfile.open(folder / listed[-1], "x", format=tarfile.PAX_FORMAT) as tar:
            for number, (sample, realization) in enumerate(places[first : first + of_a_tar], first + 1):
                scene, system, signal, sbr = sample_parts(source.recipe, sample)
                numbers = {
                    "sample": sample,
                    "realization": realization,
                    "scene": scene,
                    "scene_name": names[scene],
                    "system": systems[system],
                    "signal_level": signal,
                    "sbr": sbr if math.isfinite(sbr) else "inf",
                    "seed": int(source.seeds[sample]),
                }
                arrays = {"counts": np.asarray(source.histogram[sample, realization])}
                arrays |= {name: np.asarray(source.maps[name][sample]) for name in MAPS}
                content = {f"{name}.npy": _npy(values) for name, values in arrays.items()}
                content["json"] = json.dumps(numbers).encode()
                for suffix, data in content.items():
                    entry = tarfile.TarInfo(f"{sample:07d}-{realization:05d}.{suffix}")
                    entry.size = len(data)
                    tar.addfile(entry, io.BytesIO(data))
                if progress is not None:
                    progress(number, len(places))
    (folder / "list.txt").write_text("".join(f"{name}\n" for name in listed))
    return len(places)


def _npy(values: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def _write(folder: Path, final: Path, source: Dataset, chosen: Layout, fill: bool, told: Progress | None) -> int:
    """Write the files of all exposures into `folder`, which will be `final`; returns how many exposures."""
    samples, realizations = source.histogram.shape[:2]
    maker, written = Maker(source), 0
    listed: list[str] = []
    for path, content in (chosen.root or {}).items():
        _save(folder / path, content(source.recipe.systems[0]))
    for sample in range(samples):
        scene, which, signal, sbr = sample_parts(source.recipe, sample)
        level = source.recipe.light.levels.index((signal, sbr))
        for realization in range(realizations):
            place = {
                "scene": f"{scene:05d}_{_plain(source.scene_names()[scene])}",
                "number": which * realizations + realization + 1,
                "level": level + 1,
            }
            exposure = Exposure(maker, sample, realization, fill)
            for pattern, keys in chosen.files.items():
                file = folder / pattern.format(**place)
                if not file.exists():  # the intensity of all levels of light is one file
                    _save(file, {_NAMES.get(key, key): exposure[key] for key in keys})
            for pattern, key in (chosen.pictures or {}).items():
                picture = folder / pattern.format(**place)
                if not picture.exists():  # the depth of all levels of light is one picture
                    _save_depth(picture, exposure[key])
            line = chosen.lists.format(**place)
            entry = line if chosen.pictures else str(final / line)
            if entry not in listed:
                listed.append(entry)
            written += 1
            if told is not None:
                told(written, samples * realizations)
    (folder / "list.txt").write_text("".join(f"{entry}\n" for entry in listed))
    if chosen.pictures:
        (folder / "blacklist.txt").write_text("")
    return written


def _notes(name: str, layout: Layout, shape: tuple[int, ...]) -> list[str]:
    out = []
    if layout.size and shape[: len(layout.size)] != layout.size:
        sizes = [" x ".join(map(str, one)) for one in (layout.size, shape[: len(layout.size)])]
        out.append(f"the loader of {name} has {sizes[0]} written into it, and these files hold {sizes[1]}")
    if layout.pictures:
        out.append("*_pred.png hold one depth each, the median of the scene: put a monocular network's in their place")
    return out


def _plain(name: str) -> str:
    """A scene's name without what loaders' lists cannot have."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").replace("intensity", "i").replace("spad", "s")[-60:]


def _save(path: Path, variables: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "xb") as file:
        write_variables(file, variables)


def _save_depth(path: Path, depth_m: NDArray[np.float64]) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    grey = np.clip(np.round(255.0 / _MONOCULAR_M * depth_m), 0, 255).astype(np.uint8)
    with open(path, "xb") as file:
        Image.fromarray(grey).save(file, format="PNG")
