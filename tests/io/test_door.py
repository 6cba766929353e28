"""The door that files are read through: no pipes, no bombs, and one error that names the file."""

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
from harness import make_system, refused
from harness.files import overwrite, write_h5
from PIL import Image

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import LIMIT, FileError, reading
from mars_lidar.dataset import DatasetRecipe
from mars_lidar.io.maps import load_maps

SYSTEM = make_system(30.0, 50, 32)
READERS = {
    **dict.fromkeys(["cube.h5", "cube.npz", "cube.mat", "cube.ptu"], io.load),
    **dict.fromkeys(["photons.npz", "photons.h5", "photons.mat", "photons.ptu"], ml.Timestamps.load),
    "light.npy": lambda path: io.read_transient(path, bin_ns=1.0),
    **dict.fromkeys(["light.npz", "light.h5", "light.mat"], io.read_transient),
    **dict.fromkeys(["depth.png", "depth.tiff", "depth.npz", "depth.pfm", "depth.npy"], ml.Scene.from_rgbd),
    "nyu.mat": lambda path: ml.Scene.from_rgbd(path, index=0),
    **dict.fromkeys(["maps.h5", "maps.npz"], load_maps),
    **dict.fromkeys(["a.npy", "a.npz", "a.mat", "a.h5", "a.tif"], lambda path: io.foreign_cube(path, SYSTEM)),
    "table.h5": ml.Table.load,
    **dict.fromkeys(["system.yaml", "system.json"], ml.System.load),
    "recipe.yaml": DatasetRecipe.load,
}


CONTENTS = [b"", b"\0" * 3000, b"garbage" * 40, b"PK\3\4 no archive", b"\x89HDF\r\n\x1a\n" + b"\xff" * 200]
CONTENTS += [b"\x89PNG\r\n\x1a\n garbage", b"\x93NUMPY"]


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("content", CONTENTS)
def test_whatever_is_in_it_the_error_names_the_file(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    refused(name.replace(".", r"\."), READERS[name], tmp_path / name, error=FileError)


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
        refused(name, READERS[name], tmp_path / name, error=FileError)
    refused(r"light\.h5: transient would ", io.read_transient, tmp_path / "light.h5", error=FileError)
    np.savez_compressed(tmp_path / "zeros.npz", depth=np.ones((600, 600)))
    monkeypatch.setenv(LIMIT, "0.001")
    refused(f"zeros.npz.*more than .*{LIMIT}", ml.Scene.from_rgbd, tmp_path / "zeros.npz", error=FileError)
    monkeypatch.setenv(LIMIT, "1")  # raised, it is a scene
    assert ml.Scene.from_rgbd(tmp_path / "zeros.npz").shape == (600, 600)


def test_a_transient_of_absurd_bins_is_refused_at_once(tmp_path):
    np.save(tmp_path / "light.npy", np.ones((2, 2, 100)))
    for bin_ns in (1e7, 1e-12):
        light = io.read_transient(tmp_path / "light.npy", bin_ns=bin_ns)
        refused(r"light\.npy.*bin_ns", light.flux, SYSTEM, signal=1.0)


@pytest.mark.full
def test_deep_or_circular_documents_are_refused(tmp_path):
    for text in ("[" * 5000, "a: &a [*a]", "a: 2020-13-45", "a: \udcff"):
        for name in ("system.yaml", "recipe.yaml"):
            (tmp_path / name).write_bytes(text.encode("utf-8", "surrogateescape"))
            refused(name, READERS[name], tmp_path / name, error=FileError)
    (tmp_path / "system.json").write_text("[" * 10**5)
    refused(r"system\.json", ml.System.load, tmp_path / "system.json", error=FileError)


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
    with zipfile.ZipFile(path) as archive:
        member = archive.getinfo("histogram.npy")
        where = member.header_offset + 60 + member.compress_size // 2
    overwrite(path, where, 1)
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
    overwrite(here / "b.npz", (here / "b.npz").stat().st_size // 2, 255)
    (here / "c.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(109) + b"\xff" * 64)
    write_h5(here / "d.mat", {"depths": np.ones((2, 5, 4)), "images": np.ones((2, 3, 5, 4), np.uint8)})
    (here / "d.mat").write_bytes((here / "d.mat").read_bytes()[:1500])
    with h5py.File(here / "e.mat", "w") as file:
        file.create_dataset("depths", data=np.ones((1, 5, 4)), chunks=(1, 5, 4), compression="gzip")
        file["images"] = np.ones((1, 3, 5, 4), np.uint8)
        place = file["depths"].id.get_chunk_info(0).byte_offset
    overwrite(here / "e.mat", place, b"\xff" * 6)
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
    overwrite(tmp_path / "cube.h5", b"GCOL", bytes(48), after=16)
    for read in (io.load, ml.Timestamps.load, io.read_transient):
        refused(r"cube\.h5: is damaged: the heap of its texts", read, tmp_path / "cube.h5", error=FileError)
    pytest.importorskip("ptufile")
    io.simulate_to(tmp_path / "cube.ptu", flux, SYSTEM)
    overwrite(tmp_path / "cube.ptu", b"ImgHdr_LineStart", (2**32).to_bytes(8, "little"), after=40)
    refused(r"cube\.ptu is damaged: ImgHdr_LineStart", io.load, tmp_path / "cube.ptu", error=FileError)
