"""HDF5 that we write carries checksums: no flipped bit changes what is read, and files without them open as before."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import make_system, refused
from harness.files import overwrite

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import FileError
from mars_lidar._base.hdf5 import SEAL, with_checksums
from mars_lidar.io.maps import save_maps

SYSTEM = make_system(30.0, 50, 32)


@pytest.fixture
def files(tmp_path) -> dict[str, Path]:
    flux = ml.Flux(np.linspace(0.1, 1.0, 24).reshape(4, 6), 0.1, 40.0)
    io.simulate_to(tmp_path / "cube.h5", flux, SYSTEM)
    estimate = ml.reconstruct(np.asarray(io.load(tmp_path / "cube.h5").histogram), SYSTEM, "peak")
    save_maps(tmp_path / "maps.h5", {"peak": estimate})
    ml.Table.build(SYSTEM, signal=(0.1, 1, 2), background=(0.1, 1, 2)).save(tmp_path / "table.h5")
    return {path.name: path for path in tmp_path.glob("*.h5")}


def test_every_array_has_a_checksum(files):
    for name in ("cube.h5", "maps.h5"):
        with h5py.File(files[name]) as file:
            assert len(file) > 6
            assert all(data.fletcher32 for data in file.values())
    for path in files.values():
        with h5py.File(path) as file:
            assert len(file.attrs[SEAL]) == 64


def test_photon_hdf5_has_checksums(tmp_path):
    pytest.importorskip("phconvert")
    times = ml.simulate_timestamps(ml.Flux(np.ones((2, 3)), 0.1, 40.0), SYSTEM)
    times.save(tmp_path / "photons.h5")
    with h5py.File(tmp_path / "photons.h5") as file:
        assert all(file[f"photon_data/{name}"].fletcher32 for name in ("timestamps", "detectors", "nanotimes"))
    with h5py.File(tmp_path / "photons.h5", "r+") as file:
        file["photon_data/timestamps_specs/timestamps_unit"][()] = 1.0
    with pytest.raises(FileError, match=r"photons\.h5 is damaged: its attributes or variables have changed"):
        ml.Timestamps.load(tmp_path / "photons.h5")


def test_a_changed_number_is_refused(files):
    """By the checksum of its chunk: the bytes are changed in the file, behind HDF5's back."""
    path = files["cube.h5"]
    with h5py.File(path) as file:
        counts, light = (file[name].id.get_chunk_info(0) for name in ("histogram", "signal"))
    for part, read in ((counts, lambda cube: cube.histogram[0]), (light, lambda cube: cube.flux.signal)):
        overwrite(path, part.byte_offset + part.size // 2, 4)
        refused(r"cube\.h5", lambda read=read: read(io.load(path)), error=FileError)
        overwrite(path, part.byte_offset + part.size // 2, 4)
    with io.load(path) as cube:
        assert cube.histogram[0].sum() == cube.registrations


def test_a_changed_text_is_refused(files):
    """Texts of attributes lie in a heap that has no checksum of HDF5's own."""
    overwrite(files["cube.h5"], b'"period_ns": 100.0', b'"period_ns": 101.0')
    refused(r"cube\.h5 is damaged: its attributes or variables", io.load, files["cube.h5"], error=FileError)


def test_a_cube_without_its_sum_is_refused(files):
    with h5py.File(files["cube.h5"], "r+") as file:
        del file.attrs[SEAL]
    refused(r"cube\.h5 is damaged: it has no attribute sha256", io.load, files["cube.h5"], error=FileError)


@pytest.mark.parametrize("shape", [(), (0,), (3,), (5, 0), (7, 9), (300, 400, 500), (2, 3_000_000)])
def test_chunks_fit_their_array_and_hdf5s_cache(shape):
    given = with_checksums(shape, np.float64)
    if not shape or 0 in shape:
        assert given == {}
        return
    assert all(1 <= part <= whole for part, whole in zip(given["chunks"], shape, strict=True))
    assert 8 * np.prod(given["chunks"]) <= 2**20
