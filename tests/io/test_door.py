"""The door that files are read through: no pipes, no bombs, and one error that names the file."""

from __future__ import annotations

import json
import os
import shutil
import struct
import threading
import zipfile
import zlib

import h5py
import numpy as np
import pytest
from harness import make_system
from PIL import Image

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import LIMIT, FileError, reading
from mars_lidar.dataset import DatasetRecipe
from mars_lidar.io.maps import load_maps

SYSTEM = make_system(30.0, 50, 32)
READERS = {
    "cube.h5": io.load,
    "cube.npz": io.load,
    "cube.mat": io.load,
    "photons.npz": ml.Timestamps.load,
    "photons.h5": ml.Timestamps.load,
    "photons.mat": ml.Timestamps.load,
    "light.npy": lambda path: io.read_transient(path, bin_ns=1.0),
    "light.npz": io.read_transient,
    "light.h5": io.read_transient,
    "light.mat": io.read_transient,
    "depth.png": ml.Scene.from_rgbd,
    "depth.npz": ml.Scene.from_rgbd,
    "depth.pfm": ml.Scene.from_rgbd,
    "depth.npy": ml.Scene.from_rgbd,
    "nyu.mat": lambda path: ml.Scene.from_rgbd(path, index=0),
    "maps.h5": load_maps,
    "maps.npz": load_maps,
    "read.mat": io.read_mat,
    "table.h5": ml.Table.load,
    "system.yaml": ml.System.load,
    "system.json": ml.System.load,
    "recipe.yaml": DatasetRecipe.load,
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("content", [b"", b"\0" * 3000, b"PK\3\4 no archive", b"\x89HDF\r\n\x1a\n" + b"\xff" * 200])
def test_whatever_is_in_it_the_error_names_the_file(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=name.replace(".", r"\.")):
        READERS[name](tmp_path / name)


@pytest.mark.skipif(os.name != "posix", reason="needs pipes")
@pytest.mark.parametrize("name", READERS)
def test_pipes_and_devices_are_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    (tmp_path / "zero").mkdir()
    (tmp_path / "zero" / name).symlink_to("/dev/zero")
    for path in (tmp_path / name, tmp_path / "zero" / name):
        errors: list[BaseException] = []

        def read(path=path, errors=errors) -> None:
            try:
                READERS[name](path)
            except Exception as error:
                errors.append(error)

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        thread.join(20)
        assert not thread.is_alive(), f"{path} was read without an end"
        assert isinstance(errors[0], ValueError)
        assert name in str(errors[0])


def test_claims_are_checked_before_memory_is_asked_for(tmp_path, monkeypatch):
    """A few kilobytes that claim terabytes: a picture, an archive, data sets, aliases of YAML."""
    wide = struct.pack(">II", 30_000, 30_000) + bytes([16, 0, 0, 0, 0])
    parts = [(b"IHDR", wide), (b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b"")]
    chunks = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts]
    (tmp_path / "depth.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with zipfile.ZipFile(tmp_path / "depth.npz", "w") as archive, archive.open("depth.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (2**20, 2**20)}
        np.lib.format.write_array_header_1_0(member, header)
        member.write(bytes(1000))
    with h5py.File(tmp_path / "light.h5", "w") as file:
        light = file.create_dataset("transient", (10**4, 10**4, 10**4), "f8", chunks=(1, 8, 8), fillvalue=1.0)
        light.attrs["bin_ns"] = 1
    with h5py.File(tmp_path / "photons.h5", "w") as file:
        file.create_dataset("photon_data/timestamps", (10**12,), "i8", chunks=(1000,))
    bomb = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    bomb += [
        f"{new}: &{new} [{', '.join(['*' + old] * 10)}]" for old, new in zip("abcdefghi", "bcdefghij", strict=True)
    ]
    for name in ("system.yaml", "recipe.yaml"):
        (tmp_path / name).write_text("\n".join(bomb))
    for name in ("depth.png", "depth.npz", "photons.h5", "system.yaml", "recipe.yaml"):
        with pytest.raises(FileError, match=name):
            READERS[name](tmp_path / name)
    with pytest.raises(FileError, match=r"light\.h5: transient would "):
        io.read_transient(tmp_path / "light.h5")
    np.savez_compressed(tmp_path / "zeros.npz", depth=np.ones((600, 600)))
    monkeypatch.setenv(LIMIT, "0.001")
    with pytest.raises(FileError, match=f"zeros.npz.*more than .*{LIMIT}"):
        ml.Scene.from_rgbd(tmp_path / "zeros.npz")
    monkeypatch.setenv(LIMIT, "1")  # raised, it is a scene
    assert ml.Scene.from_rgbd(tmp_path / "zeros.npz").shape == (600, 600)


def test_a_transient_of_absurd_bins_is_refused_at_once(tmp_path):
    np.save(tmp_path / "light.npy", np.ones((2, 2, 100)))
    for bin_ns in (1e7, 1e-12):
        light = io.read_transient(tmp_path / "light.npy", bin_ns=bin_ns)
        with pytest.raises(ValueError, match=r"light\.npy.*bin_ns"):
            light.flux(SYSTEM, signal=1.0)


@pytest.mark.full
def test_deep_or_circular_documents_are_refused(tmp_path):
    for text in ("[" * 5000, "a: &a [*a]", "a: 2020-13-45", "a: \udcff"):
        for name in ("system.yaml", "recipe.yaml"):
            (tmp_path / name).write_bytes(text.encode("utf-8", "surrogateescape"))
            with pytest.raises(FileError, match=name):
                READERS[name](tmp_path / name)
    (tmp_path / "system.json").write_text("[" * 10**5)
    with pytest.raises(FileError, match=r"system\.json"):
        ml.System.load(tmp_path / "system.json")


def test_errors_of_reading_later_name_the_file(tmp_path):
    flux = ml.Flux(np.full((4, 4), 0.5), 0.1, 40.0)
    for suffix in (".h5", ".zarr", ".npz"):
        path = tmp_path / f"cube{suffix}"
        io.simulate_to(path, flux, SYSTEM)
        cube = io.load(path)
        with pytest.raises(IndexError):
            cube.histogram[7]
        cube.close()
    path = tmp_path / "cube.npz"
    whole = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        member = archive.getinfo("histogram.npy")
        where = member.header_offset + 60 + member.compress_size // 2
    whole[where] ^= 1
    path.write_bytes(whole)
    with pytest.raises(FileError, match=r"cube\.npz"):  # small: when its header is read
        np.asarray(io.load(path).histogram)


def test_the_door_lets_through_what_is_no_damage(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("a")
    with pytest.raises(FileNotFoundError, match="does not exist"), reading(tmp_path / "b.txt"):
        pass
    with pytest.raises(io.MissingLibraryError), reading(path):
        raise io.MissingLibraryError("pip install")
    with pytest.raises(MemoryError, match=r"a\.txt"), reading(path):
        raise MemoryError
    with pytest.raises(FileError, match=r"a\.txt: cannot be read as JSON \(KeyError 'x'\)"), reading(path, "JSON"):
        json.loads("{}")["x"]


@pytest.fixture
def folder(tmp_path):
    """A good scene and eight that are damaged in eight ways."""
    (tmp_path / "in").mkdir()
    here = tmp_path / "in"
    np.savez(here / "good.npz", depth=np.full((4, 5), 2.0))
    rows = np.full((4, 5), 2000, np.uint16)
    Image.fromarray(rows).save(here / "a_depth.png")
    (here / "a_depth.png").write_bytes((here / "a_depth.png").read_bytes()[:-30])
    np.savez_compressed(here / "b.npz", depth=np.random.default_rng(1).random((40, 50)))
    damaged = bytearray((here / "b.npz").read_bytes())
    damaged[len(damaged) // 2] ^= 255
    (here / "b.npz").write_bytes(damaged)
    (here / "c.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(109) + b"\xff" * 64)
    with h5py.File(here / "d.mat", "w") as file:
        file["depths"], file["images"] = np.ones((2, 5, 4)), np.ones((2, 3, 5, 4), np.uint8)
    (here / "d.mat").write_bytes((here / "d.mat").read_bytes()[:1500])
    with h5py.File(here / "e.mat", "w") as file:
        file.create_dataset("depths", data=np.ones((1, 5, 4)), chunks=(1, 5, 4), compression="gzip")
        file["images"] = np.ones((1, 3, 5, 4), np.uint8)
        place = file["depths"].id.get_chunk_info(0).byte_offset
    damaged = bytearray((here / "e.mat").read_bytes())
    damaged[place : place + 6] = b"\xff" * 6
    (here / "e.mat").write_bytes(damaged)
    (here / "f.pfm").write_bytes(b"Pf\n4 4\n-1\n" + bytes(20))
    np.save(here / "g_depth.npy", np.full((4, 5), -1.0))
    if os.name == "posix":
        (here / "h_depth.npy").symlink_to("/dev/zero")
    shutil.copy(here / "good.npz", tmp_path / "good.npz")
    return here


def test_damaged_files_in_a_folder_are_left_out_with_their_reason(tmp_path, folder):
    scenes, problems = io.scan(folder)
    assert [scene.depth.name for scene in scenes] == ["good.npz"]
    names = sorted(damaged.name for damaged in folder.iterdir() if damaged.name != "good.npz")
    assert sorted({problem.path.name for problem in problems}) == names
    assert all(str(problem).startswith(str(problem.path)) and len(problem.reason) > 20 for problem in problems)
    recipe = {"scenes": {"path": str(folder)}, "systems": [SYSTEM], "light": {"signal": [1.0]}}
    done = ml.generate(recipe, tmp_path / "s.zarr")
    assert done.shape[0] == 1
    assert sorted({problem.path.name for problem in done.problems}) == names


def test_heaps_and_markers_over_which_libraries_do_not_end_are_refused(tmp_path):
    """Found by tests/fuzz: HDF5 loops over a heap of texts with free space of size 0, ptufile raises 2 to a marker."""
    flux = ml.Flux(np.full((3, 4), 0.5), 0.1, 40.0)
    io.simulate_to(tmp_path / "cube.h5", flux, SYSTEM)
    content = bytearray((tmp_path / "cube.h5").read_bytes())
    heap = content.find(b"GCOL")
    content[heap + 16 : heap + 64] = bytes(48)
    (tmp_path / "cube.h5").write_bytes(content)
    for read in (io.load, ml.Timestamps.load, io.read_transient):
        with pytest.raises(FileError, match=r"cube\.h5: is damaged: the heap of its texts"):
            read(tmp_path / "cube.h5")
    pytest.importorskip("ptufile")
    io.simulate_to(tmp_path / "cube.ptu", flux, SYSTEM)
    content = bytearray((tmp_path / "cube.ptu").read_bytes())
    place = content.find(b"ImgHdr_LineStart") + 40
    content[place : place + 8] = (2**32).to_bytes(8, "little")
    (tmp_path / "cube.ptu").write_bytes(content)
    with pytest.raises(FileError, match=r"cube\.ptu is damaged: ImgHdr_LineStart"):
        io.load(tmp_path / "cube.ptu")
