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

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.cached import cached_property
from mars_lidar._base.files import beside
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import FloatArray, NDArray, Progress
from mars_lidar.dataset.arrays import MAPS, sample_parts
from mars_lidar.dataset.store import Dataset, open_dataset, read_sparse
from mars_lidar.dataset.write import Maker
from mars_lidar.instrument.system import System
from mars_lidar.io import mat
from mars_lidar.io.mat import write_variables
from mars_lidar.light.flux import Flux

_PULSE_BINS, _PULSE_PEAK = 16, 6  # bins of the pulse that `deepsensorfusion` reads, and index of its peak
_PULSE_LEAST = 0.999  # least share of the energy of a pulse in these bins
_NAMES = {"intensity_hr": "intensity"}  # name of a variable in the file, where it differs from its key
WEBDATASET = "webdataset"
_TAR_BYTES = 256 * 2**20  # of counts
_MONOCULAR_M = 10.0  # depth of grey value 255 in SPADnet's images


@dataclass(frozen=True)
class Layout:
    """A layout: names of the files with ``{scene}``, ``{number}`` and ``{level}``, and the variables in each.

    `lists` is the file that the loader's list names, relative to the folder `inside`; `root` are files for the whole
    dataset, `pictures` the images beside an exposure, `size` the shape (H, W) or (H, W, bins) that the loader assumes,
    empty for any.
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
    """Result of `export`: the number of files it wrote, their list, and notes."""

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
    """Write every exposure of a dataset as a file for the loader of a published network.

    Parameters
    ----------
    dataset
        A dataset of `mars_lidar.generate`, or its path.
    out
        A new or empty folder. Its ``list.txt``, the list that the loader reads, has one file per line. The folder
        appears when all files are written; an interruption leaves nothing under its name.
    layout
        One of `LAYOUTS`; or ``"webdataset"``: tar files ``shard-000000.tar``, ... of about 256 MiB for WebDataset, in
        which an exposure is ``SAMPLE-REALIZATION`` with an array of counts (H, W, bins), a ``.npy`` for each map, and
        ``json``, its numbers and its system.
    fill
        Give pixels without a return the depth, bin and rates of the nearest pixel with one. Otherwise their bin is 0,
        and loaders that divide rates by their sum turn them into NaN.
    progress
        Called as ``progress(done, total)`` after each exposure; True: a bar.

    Raises
    ------
    ValueError, TypeError
        An unknown layout, or data that it cannot contain; nothing was written.
    OSError
        `out` is not empty or cannot be written.
    """
    report = callback_of(progress, "exporting")
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
            written = _write_tars(unfinished, source, report)
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
        written = _write(unfinished, folder, source, chosen, fill, report)
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


def _write(folder: Path, final: Path, source: Dataset, chosen: Layout, fill: bool, report: Progress | None) -> int:
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
            if report is not None:
                report(written, samples * realizations)
    (folder / "list.txt").write_text("".join(f"{entry}\n" for entry in listed))
    if chosen.pictures:
        (folder / "blacklist.txt").write_text("")
    return written


def _notes(name: str, layout: Layout, shape: tuple[int, ...]) -> list[str]:
    out = []
    if layout.size and shape[: len(layout.size)] != layout.size:
        sizes = [" x ".join(map(str, size)) for size in (layout.size, shape[: len(layout.size)])]
        out.append(f"the loader of {name} assumes arrays of {sizes[0]}, and these files have {sizes[1]}")
    if layout.pictures:
        out.append("*_pred.png hold one depth each, the median of the scene: put a monocular network's in their place")
    return out


def _plain(name: str) -> str:
    """A scene's name without characters and words that the loaders misread in their lists."""
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


class Exposure:
    """The variables of one exposure; `fill` gives pixels without a return those of the nearest pixel with one.

    Photons are those of the detected flux before dead time: detection efficiency and dark counts are in them.
    """

    def __init__(self, maker: Maker, sample: int, realization: int, fill: bool) -> None:
        self._dataset, self._sample, self._realization = maker.dataset, sample, realization
        self._system = maker.dataset.recipe.systems[sample_parts(maker.dataset.recipe, sample)[1]]
        self._flux: Flux = maker.flux(sample).detected(self._system)
        lit = self._flux.signal > 0
        self._place: Any = ...
        if fill and lit.any() and not lit.all():
            from scipy.ndimage import distance_transform_edt

            self._place = tuple(distance_transform_edt(~lit, return_distances=False, return_indices=True))
        content = maker.scene(sample)
        self._depth: FloatArray = np.nan_to_num(np.where(lit, content.depth_m, 0.0)[self._place])
        reflectivity = np.nan_to_num(content.reflectivity)
        self._reflectivity: FloatArray = reflectivity / max(1.0, float(reflectivity.max(initial=0.0)))

    @cached_property
    def _bins(self) -> tuple[NDArray[Any], FloatArray]:
        whole, fine = mat.return_bins(self._flux, self._system)
        return whole[self._place], fine[self._place]

    @cached_property
    def _counts(self) -> Any:
        """(H W, bins), pixel y W + x."""
        return read_sparse(self._dataset, self._sample, self._realization)

    def _spad(self) -> Any:
        from scipy import sparse

        counts = self._counts
        height, width = self._flux.shape
        row = counts.row % width * height + counts.row // width
        check_size("spad", 12 * counts.nnz)
        return sparse.csc_matrix((counts.data.astype(np.float64), (row, counts.col)), shape=counts.shape)

    def _fullest(self) -> NDArray[Any]:
        counts = self._counts
        order = np.lexsort((counts.col, -counts.data.astype(np.int64), counts.row))
        pixels, first = np.unique(counts.row[order], return_index=True)
        out = np.ones(counts.shape[0], np.uint16 if counts.shape[1] < 2**16 else np.uint32)
        out[pixels] = counts.col[order][first] + 1
        return out.reshape(self._flux.shape)

    def _matched(self) -> NDArray[Any]:
        """Bin of the largest value of the counts correlated with the pulse, from 1; the first of equals."""
        counts = self._counts.toarray().astype(np.float64)
        pulse = self._system.pulse.bin_energy(0.5 * self._system.bin_ns, self._system.period_ns, self._system.bins)
        spectrum = np.fft.rfft(counts, axis=-1) * np.conj(np.fft.rfft(pulse))
        matched = np.fft.irfft(spectrum, n=self._system.bins, axis=-1).round(9)
        kind = np.uint16 if self._system.bins < 2**16 else np.uint32
        return np.asarray((matched.argmax(-1) + 1).astype(kind).reshape(self._flux.shape))

    def _pulse(self) -> NDArray[np.float64]:
        delay = np.where(self._flux.signal > 0, self._flux.delay_ns, 0.0)
        return np.asarray(pulse_in_bins(self._system, delay, self._flux.signal)[self._place])

    def _median(self) -> NDArray[np.float64]:
        known = self._depth[self._depth > 0]
        return np.full(self._depth.shape, np.median(known) if known.size else 0.0)

    def _photons(self, per_period: NDArray[np.float64]) -> float:
        """Of an exposure before dead time, mean over pixels."""
        mean = float(per_period.mean()) * self._system.cycles
        whole = float(round(mean))  # loaders cut it to an integer: 19.999999999999996 is 20
        return whole if math.isclose(mean, whole, rel_tol=1e-12) else mean

    def _ratio(self) -> float:
        background = self._photons(self._flux.background)
        return self._photons(self._flux.signal) / background if background else np.inf

    def __getitem__(self, key: str) -> Any:
        return KEYS[key](self)


KEYS: dict[str, Callable[[Exposure], Any]] = {  # maps are (H, W)
    "spad": Exposure._spad,  # sparse (H W, bins), pixel y + H x as MATLAB counts
    "rates": lambda e: mat.rates(e._flux, e._system).astype(np.float32)[e._place],  # (H, W, bins), largest bin 1
    "bin": lambda e: e._bins[0],  # of the return, from 1; 0 without one
    "range_bins": lambda e: e._bins[0],
    "bin_hr": lambda e: mat.larger(e._bins[1]),  # the same as a real number, at 8 times the size
    "est_range_bins_argmax": Exposure._fullest,  # bin, from 1; the first of equals
    "est_range_bins_lmf": Exposure._matched,  # of the counts correlated with the pulse, from 1; the first of equals
    "depth": lambda e: e._depth,  # m; 0 without a return
    "level_depth": Exposure._median,  # of the scene, m, in every pixel
    "intensity": lambda e: e._reflectivity,  # in [0, 1]
    "intensity_hr": lambda e: mat.larger(np.round(255.0 * e._reflectivity).astype(np.uint8)),  # at 8 times the size
    "signal_ppp": lambda e: e._flux.signal,  # photons per laser pulse
    "ambient_ppp": lambda e: e._flux.background / e._system.bins,  # photons per laser pulse and bin
    "pulse": Exposure._pulse,  # (H, W, 16), its energy in bins around that of the return, which is the seventh
    "mean_signal_photons": lambda e: e._photons(e._flux.signal),
    "photons": lambda e: e._photons(e._flux.signal),
    "mean_background_photons": lambda e: e._photons(e._flux.background),
    "SBR": Exposure._ratio,  # mean_signal_photons / mean_background_photons; inf without background
    "bin_size": lambda e: 1e-9 * e._system.bin_ns,  # s
}


def pulse_in_bins(system: System, delay_ns: NDArray[Any], signal: NDArray[Any]) -> NDArray[np.float64]:
    """Energy (H, W, 16) of the pulse at each delay (H, W), ns, in bins of which the seventh is the delay's.

    A ValueError where more than a thousandth of the energy of a pixel with `signal` (H, W) lies in no such bin.
    """
    place = np.floor(np.mod(delay_ns, system.period_ns) / system.bin_ns).astype(np.int64) % system.bins
    inside = (place[..., None] - _PULSE_PEAK + np.arange(_PULSE_BINS)) % system.bins
    out = np.empty((*delay_ns.shape, _PULSE_BINS))
    for y in range(len(delay_ns)):  # a row at a time: all bins of an image need not fit in memory
        energy = system.pulse.bin_energy(delay_ns[y], system.period_ns, system.bins)
        out[y] = np.take_along_axis(energy, inside[y], axis=-1)
    if (out.sum(-1)[signal > 0] < _PULSE_LEAST).any():
        beyond = 100 * (1 - float(out.sum(-1)[signal > 0].min()))
        raise ValueError(
            f"deepsensorfusion holds pulses of {_PULSE_BINS} bins with their peak in the seventh, and {beyond:.2g} % "
            f"of the energy of this one lie beyond, in bins of {1e3 * system.bin_ns:.4g} ps"
        )
    return out


def psf(system: System) -> NDArray[np.float64]:
    """(bins, 1), energy of the pulse in bins, around the middle of those that hold any."""
    energy = np.roll(system.pulse.bin_energy(0.5 * system.bin_ns, system.period_ns, system.bins), system.bins // 2)
    held = np.flatnonzero(energy > 1e-6 * energy.max())
    half = max(system.bins // 2 - held[0], held[-1] - system.bins // 2)
    first, last = max(0, system.bins // 2 - half), min(system.bins, system.bins // 2 + half + 1)
    return np.asarray(energy[first:last, None])


def check_size(name: str, size: int) -> None:
    """Raise ValueError where a variable of `size` bytes does not fit a MATLAB v5 file."""
    if size > mat.MAX_BYTES:
        raise ValueError(f"a variable of a .mat (v5) takes less than 2 GiB, and {name} would {size / 2**30:.3g} GiB")
