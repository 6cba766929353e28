"""Photon-HDF5 0.5 (photon-hdf5.github.io), photon streams: timestamps, detectors = pixels, nanotimes.

All pixels record simultaneously: ``timestamps`` counts laser periods from the start of the exposure (unit in
s), ``detectors`` is the pixel y W + x, ``nanotimes`` the time since the laser pulse in units of
``bin width / m``, m as large as 16 bits allow (32 for more than 65536 bins): the bin is kept exactly, the
time to half a unit. Photons are in order of time. phconvert writes and validates the file; h5py reads it.
"""

import contextlib
import errno
import json
import os
import re
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import finished_name, whole
from mars_lidar._base.hdf5 import open_hdf5, seal
from mars_lidar._base.imports import needed
from mars_lidar.io.streams.photons import Photons, attributes, fine_times, of_fine_times
from mars_lidar.light.timestamps import Timestamps

_GROUP, _ATTRIBUTES = "mars_lidar", "attributes"  # below /user, which the format leaves to its writers
_PHOTONS = "photon_data"
_FULL = 2**20  # bytes free on a disk that is taken for full


def check_library() -> None:
    """Raise if the library that writes the format is missing."""
    needed("phconvert.hdf5", "Photon-HDF5")


def write(path: Path, times: Timestamps) -> None:
    """Write a stream; the caller renames the complete file."""
    library = needed("phconvert.hdf5", "Photon-HDF5")
    fine = units_per_bin(times.bins)
    kind = np.uint16 if times.bins * fine <= 2**16 else np.uint32
    nanotimes: NDArray[Any] = fine_times(times, fine).astype(kind)
    counts = times.counts.ravel()
    pixels = np.arange(counts.size, dtype=np.uint16 if counts.size <= 2**16 else np.uint32)
    detectors = np.repeat(pixels, counts)
    # in order of time; photons at the same time keep the order of their pixels
    order = np.argsort(times.cycle.astype(np.int64) * (times.bins * fine) + nanotimes, kind="stable")
    period_s = 1e-9 * times.period_ns
    rate_hz = 1.0 / period_s
    content: dict[str, Any] = {
        "description": "Photon stream of a single-photon LiDAR simulated by mars-lidar",
        "acquisition_duration": period_s * times.cycles,
        _PHOTONS: {
            "timestamps": times.cycle[order].astype(np.int64),
            "timestamps_specs": {"timestamps_unit": period_s},
            "detectors": detectors[order],
            "nanotimes": nanotimes[order],
            "nanotimes_specs": {
                "tcspc_unit": period_s / (times.bins * fine),
                "tcspc_range": period_s,
                "tcspc_num_bins": times.bins * fine,
            },
            "measurement_specs": {
                "measurement_type": "generic",
                "laser_repetition_rate": rate_hz,
                "detectors_specs": {"spectral_ch1": pixels},
            },
        },
        "setup": {
            "num_pixels": int(counts.size),
            "num_spots": 1,
            "num_spectral_ch": 1,
            "num_polarization_ch": 1,
            "num_split_ch": 1,
            "modulated_excitation": False,
            "excitation_alternated": [False],
            "excitation_cw": [False],
            "lifetime": True,
            "laser_repetition_rates": [rate_hz],
            "detectors": {"id": pixels, "id_hardware": pixels, "counts": counts},
        },
        "user": {_GROUP: {_ATTRIBUTES: json.dumps(attributes(times))}},
    }
    try:
        try:
            with warnings.catch_warnings(), open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
                warnings.simplefilter("ignore")  # of PyTables, about names that are no Python identifiers
                packing = {"complevel": 1, "complib": "zlib", "fletcher32": True}
                library.save_photon_hdf5(content, str(path), overwrite=True, warnings=False, compression=packing)
        finally:
            file = content.get("_data_file")
            if file is not None and file.isopen:
                file.close()
        _name_and_seal(path, finished_name(path))
    except Exception as error:  # on a full disk PyTables raises a back trace, or phconvert reads other values back
        number = re.search(r"errno = (\d+)", str(error))
        full = shutil.disk_usage(path.parent).free < _FULL
        if number is None and not full and not isinstance(error, library.Invalid_PhotonHDF5):
            raise
        code = int(number[1]) if number else errno.ENOSPC if full else errno.EIO
        raise OSError(code, "Photon-HDF5 could not be written") from None


def read(path: Path, period_ns: float | None, bins: int | None) -> Timestamps:
    """Read a stream; `period_ns` and `bins` are for files of other programs."""
    with _opened(path) as file:
        photons = _photons(path, file)
        own = file.get(f"user/{_GROUP}/{_ATTRIBUTES}")
        attrs = {} if own is None else json.loads(own[()])  # text or bytes
    if not attrs or photons.fine is None:
        return photons.timestamps(period_ns, bins)
    if period_ns is not None or bins is not None:
        raise ValueError(f"{path} states its period and bins: period_ns and bins are for streams of other programs")
    order = np.argsort(photons.detector, kind="stable")
    since, fine = photons.fine[order].astype(np.int64), units_per_bin(int(attrs["bins"]))
    return of_fine_times(attrs, photons.clock[order], since, fine, photons.detector)


def photons(path: Path) -> Photons:
    """The photons of one spot in a file of another program."""
    with _opened(path) as file:
        return _photons(path, file)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with open_hdf5(path) as file:
        if _PHOTONS not in file:
            raise ValueError(f"{path} is not Photon-HDF5 of one spot: it has no group 'photon_data'")
        yield file


def _photons(path: Path, file: Any) -> Photons:
    data = file[_PHOTONS]
    timestamps = whole(data["timestamps"])
    detectors = whole(data["detectors"]) if "detectors" in data else np.zeros(timestamps.shape, np.uint8)
    clock_ns = 1e9 * float(data["timestamps_specs/timestamps_unit"][()])
    if "nanotimes" not in data:
        return Photons(timestamps, clock_ns, detectors, str(path))
    rates: Any = whole(file["setup/laser_repetition_rates"]) if "setup/laser_repetition_rates" in file else []
    period = 1e9 / float(rates[0]) if len(rates) else clock_ns
    return Photons(
        timestamps, clock_ns, detectors, str(path), whole(data["nanotimes"]), 1e9 * _tcspc_unit(file), period
    )


def is_stream(path: Path) -> bool:
    """Whether the file has a group of photons."""
    with open_hdf5(path) as file:
        return _PHOTONS in file


def _name_and_seal(path: Path, target: Path) -> None:
    """Put the name that the file will have where phconvert put the one that it has now, and the sum over all."""
    import h5py

    with h5py.File(path, "r+") as file:
        for name, value in (("filename", target.name), ("filename_full", str(target.absolute()))):
            place = f"identity/{name}"
            if place not in file:
                continue
            labels = dict(file[place].attrs)
            del file[place]
            file[place] = np.bytes_(value.encode())
            file[place].attrs.update(labels)
        seal(file)


def _tcspc_unit(file: Any) -> float:
    """Unit of the nanotimes in s: below the photons, or (format 0.5) one per detector."""
    place = f"{_PHOTONS}/nanotimes_specs/tcspc_unit"
    if place in file:
        return float(whole(file[place]))
    units = np.unique(whole(file["setup/detectors/tcspc_unit"]))
    if units.size != 1:
        raise ValueError(f"its detectors have {units.size} different TCSPC units, and one is needed")
    return float(units[0])


def units_per_bin(bins: int) -> int:
    """Units of the nanotimes in a histogram bin."""
    return 2**16 // bins if bins <= 2**16 else 2**32 // (bins * 2**8)
