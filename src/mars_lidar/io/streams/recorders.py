"""Histograms in files of photon counters: .ptu and related formats, .t3r, .spc, .sdt."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import check_claim, reading
from mars_lidar._base.imports import needed
from mars_lidar.io.streams import formats, ptu


@dataclass(frozen=True, eq=False)
class Recorded:
    """Histograms of a recorder, and its description of them."""

    arrays: dict[str, NDArray[Any]]  # by name: (frames, y, x, t), (y, x, t) or (t,) counts
    bin_ns: float | None = None  # width of a bin
    period_ns: float | None = None  # of the laser, as the file has it: a whole number of bins need not fill it
    cycles: int | None = None  # laser periods of a pixel and frame
    notes: tuple[str, ...] = ()  # what else is worth a line


def recorded(path: Path) -> Recorded:
    """Read the histograms of a file."""
    with reading(path, f"a {path.suffix}"):
        if path.suffix == ".sdt":
            return _sdt(path)
        if formats.MODULES.get(path.suffix) == "ptu":
            with ptu.open_ptu(path, trimdims="T") as file:
                if file.is_image:
                    return _image(path, file)
        recording = formats.recorded(path)
        period = recording.period_ns
        cycles = int(recording.clock.max()) + 1 if recording.clock.size and period is not None else None
        return Recorded(recording.histograms(), recording.fine_ns, period, cycles)


def _image(path: Path, ptu: Any) -> Recorded:
    """A scanned image: ptufile puts the photons between the markers of lines and frames into pixels."""
    if not ptu.is_t3:
        raise ValueError(f"{path} is a scan of absolute times (T2): without laser pulses it has no histograms")
    period, width = 1e9 * ptu.global_resolution, 1e9 * ptu.tcspc_resolution
    bins = max(1, round(period / width))
    frames, height, columns, channels, _ = ptu.shape
    check_claim(path, 4.0 * frames * height * columns * bins * channels, "its image")
    image = ptu.decode_image(dtime=bins, dtype=np.uint32, keepdims=True)
    used, total = int(image.sum(dtype=np.uint64)), int(ptu.number_photons)
    notes = (f"{total - used:,} of {total:,} photons lie between lines and frames or beyond the last whole bin",)
    first = next(iter(ptu.active_channels), 0)
    arrays = {}
    for k in range(image.shape[3]):
        counts = image[:, :, :, k]
        if counts.any() or image.shape[3] == 1:
            name = f"channel {k if image.shape[3] > 1 else first}"
            arrays[name] = counts[0] if frames == 1 else counts
    cycles = round(ptu.global_pixel_time)
    return Recorded(arrays, width, period, cycles if cycles > 0 else None, notes if total > used else ())


def _sdt(path: Path) -> Recorded:
    """Becker & Hickl's histograms and images; sdtfile reads them."""
    library = needed("sdtfile", "a .sdt")
    with open(path, "rb") as file, library.SdtFile(file) as sdt:
        blocks = {f"block {k}": np.asarray(data) for k, data in enumerate(sdt.data)}
        times = [np.asarray(axis, np.float64) for axis in sdt.times]
    blocks = {name: data for name, data in blocks.items() if data.dtype.kind in "iu" and data.ndim and data.size > 1}
    widths = {float(axis[1] - axis[0]) * 1e9 for axis in times if axis.size > 1}
    if not blocks:
        raise ValueError(f"{path} holds no histograms: photon by photon is in .spc")
    width = widths.pop() if len(widths) == 1 else math.nan
    return Recorded(blocks, width if width > 0.0 else None)
