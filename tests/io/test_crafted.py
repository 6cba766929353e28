"""Files that an adversary wrote from the documentation alone; each of these was once read wrongly, or took too long."""

import json
import os
import re
import struct
import time
import warnings
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import refused
from harness.files import overwrite, write_h5
from store_cases import SYSTEM, one_return

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import FileError, read_column
from mars_lidar.dataset import open_dataset


def edit(path: Path, change) -> None:
    """Change a document of a store."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


PATTERN = 77  # bytes of a file that is not part of the store


@pytest.mark.skipif(os.name != "posix", reason="needs links and pipes")
@pytest.mark.parametrize("instead", ["link", "pipe", "device"])
def test_a_chunk_of_an_incomplete_store_is_a_plain_file(tmp_path, instead):
    """A link was read as counts, whatever it points to; a pipe never ended."""
    path = tmp_path / "cube.zarr"
    io.simulate_to(path, one_return(), SYSTEM)
    for name, change in (
        ("zarr.json", lambda d: (d.pop("consolidated_metadata", None), d["attributes"].update(complete=False))),
        ("histogram/zarr.json", lambda d: d.update(codecs=[{"name": "bytes", "configuration": {"endian": "little"}}])),
    ):
        edit(path / name, change)
    for name in ("manifest.sha256", "manifest.xxh128"):
        (path / name).unlink()
    (tmp_path / "secret").write_bytes(bytes([PATTERN]) * 2 * 6 * 5 * 64)
    chunk = next(each for each in sorted((path / "histogram/c").rglob("*")) if each.is_file())
    chunk.unlink()
    {
        "link": lambda: chunk.symlink_to(tmp_path / "secret"),
        "pipe": lambda: os.mkfifo(chunk),
        "device": lambda: chunk.symlink_to("/dev/zero"),
    }[instead]()
    with io.load(path, allow_incomplete=True) as cube, pytest.raises(FileError, match="is a link, a pipe or a device"):
        np.asarray(cube.histogram)


def test_packed_counts_are_of_a_type_of_counts(tmp_path):
    recipe = {"scenes": {"example": "room", "size": [3, 4]}, "systems": [SYSTEM], "light": {"signal": 0.5}}
    ml.generate(recipe | {"store": {"layout": "sparse"}}, tmp_path / "set.zarr")
    for name, change in (
        ("zarr.json", lambda d: d["attributes"].update(complete=False)),
        ("histogram/zarr.json", lambda d: d.update(data_type="float64", fill_value=0.0)),
    ):
        edit(tmp_path / "set.zarr" / name, change)
    stored = open_dataset(tmp_path / "set.zarr", allow_incomplete=True)
    refused(r"set\.zarr", np.asarray, stored.histogram, error=FileError)


def test_cells_of_one_array_and_deep_groups_end_soon(tmp_path):
    """35 kB with four million references; 3,000 groups within each other, which HDF5 looks up one by one."""
    with h5py.File(tmp_path / "cells.mat", "w") as file:
        file["a"] = np.ones(3)
        shape = (2000, 2000)
        file.create_dataset("spad", shape, h5py.ref_dtype, chunks=shape, compression="gzip")[...] = file["a"].ref
    with h5py.File(tmp_path / "many.mat", "w") as file:
        file.create_dataset("a", data=np.zeros((100, 1000, 100)), chunks=(100, 1000, 100), compression="gzip")
        file.create_dataset("spad", (1, 1000), h5py.ref_dtype)[...] = file["a"].ref
    with h5py.File(tmp_path / "deep.h5", "w") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
        group["counts"] = np.ones((3, 4, 64))
    for name in ("cells.mat", "many.mat", "deep.h5"):
        began = time.process_time()
        refused(name.replace(".", r"\."), io.foreign_cube, tmp_path / name, SYSTEM, error=FileError)
        assert time.process_time() - began < 3.0


@pytest.mark.parametrize(
    ("tag", "value"),
    [
        ("MeasDesc_GlobalResolution", -1.0),
        ("MeasDesc_GlobalResolution", 1e300),
        ("ImgHdr_TimePerPixel", 1e-320),
        ("ImgHdr_LineStart", 0),
        ("MarsLidar_Photons", 3),
    ],
)
def test_tags_of_a_ptu_that_move_its_photons_are_refused(tmp_path, tag, value):
    """Each gave another image, with fewer counts than the file tells of."""
    pytest.importorskip("ptufile")
    path = tmp_path / "cube.ptu"
    io.simulate_to(path, one_return(), SYSTEM)
    overwrite(path, tag.encode(), struct.pack("<d" if isinstance(value, float) else "<q", value), after=40)
    refused(r"cube\.ptu", lambda: np.asarray(io.load(path).histogram), error=FileError)


def test_numbers_above_a_column_are_no_words(tmp_path: Path):
    """0x10 was taken for the name of a column, a first count behind a byte order mark for a line of words: left out."""
    for text in ("0x10\n1\n2\n", "1e\n2\n"):
        (tmp_path / "a.csv").write_text(text)
        refused("holds no numbers", read_column, tmp_path / "a.csv")
    for mark in ("", "\ufeff"):  # which spreadsheets put before the text
        (tmp_path / "a.csv").write_text(mark + "# made 2026-11-23\nt_ns, counts\n1, 2\n3, 4\n", encoding="utf-8")
        assert read_column(tmp_path / "a.csv").tolist() == [2.0, 4.0]
        (tmp_path / "a.csv").write_text(mark + "7\n2\n", encoding="utf-8")
        assert read_column(tmp_path / "a.csv").tolist() == [7.0, 2.0]


@pytest.mark.parametrize("times", [(0, 1, 2, 4), (3, 2, 1, 0), (1, 10, 100, 1000), (0, 0, 1, 2)])
def test_times_beside_counts_ascend_in_equal_steps(tmp_path: Path, times):
    """They were not looked at: a line that a recorder leaves out, for no counts, moved all later bins."""
    path = tmp_path / "a.csv"
    path.write_text("".join(f"{time},5\n" for time in times))
    refused(r"a\.csv.*equal steps", io.foreign_cube, path, SYSTEM)
    path.write_text("0.33,5\n0.67,1\n1.00,2\n1.33,4\n")  # thirds, rounded
    assert read_column(path).tolist() == [5.0, 1.0, 2.0, 4.0]
    refused(r"a\.csv.*one column", ml.Timestamps.load, path, unit_ns=1.0, period_ns=0.1)


def test_an_array_that_is_shorter_than_its_file_is_refused(tmp_path: Path):
    """A shape of fewer rows than there are was read without a word."""
    whole = np.arange(12 * 32, dtype=np.int32).reshape(12, 32) % 5
    np.save(tmp_path / "a.npy", whole)
    content = (tmp_path / "a.npy").read_bytes().replace(b"(12, 32)", b"( 2, 32)")
    (tmp_path / "b.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("a.npy", content)
    np.savez(tmp_path / "c.npz", a=whole)
    with warnings.catch_warnings(), zipfile.ZipFile(tmp_path / "c.npz", "a") as archive:
        warnings.simplefilter("ignore", UserWarning)
        archive.writestr("a.npy", (tmp_path / "a.npy").read_bytes())
    for name in ("b.npy", "b.npz", "c.npz"):
        refused(re.escape(name), io.foreign_cube, tmp_path / name, SYSTEM, error=FileError)


def test_text_is_no_capture(tmp_path):
    write_h5(tmp_path / "a.hdf5", {"H": np.full((8, 4, 3), b"1.0"), "H_format": 1, "delta_t": 0.3, "t_start": 0.0})
    refused(r"a\.hdf5.*real numbers", lambda: io.read_transient(tmp_path / "a.hdf5").rows(slice(0, 2)))
