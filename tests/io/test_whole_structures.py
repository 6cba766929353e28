"""Structures of files that compiled code would follow blindly: sparse indices, storage elsewhere, claimed shapes."""

import json
import os
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from harness import make_system, refused
from harness.files import overwrite, write_h5
from scipy import sparse
from scipy.io import loadmat, savemat

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import FileError, read_mat5, whole
from mars_lidar._base.mat5 import variables
from mars_lidar._base.sparse import check_sparse, dense_counts
from mars_lidar.io.foreign import foreign_cube

SYSTEM = make_system(30.0, 5000, 32)


def counts() -> sparse.csc_matrix:
    """(12, 32), row indices of which the last bytes of a .mat tell."""
    dense = np.random.default_rng(1).poisson(0.6, (12, 32)).astype(float)
    return sparse.csc_matrix(dense)


def with_index(where: str, value: int) -> sparse.csc_matrix:
    """A matrix whose `where` ("indices", "indptr") is wrong at one place, as SciPy builds it without a look."""
    matrix = counts()
    getattr(matrix, where)[3] = value
    return matrix


WRONG = [("indices", 12), ("indices", 400), ("indices", -1), ("indptr", -3), ("indptr", 2**20)]


def save_v73(path: Path, matrix: sparse.csc_matrix) -> None:
    """As MATLAB writes a sparse matrix in version 7.3."""
    with h5py.File(path, "w") as file:
        group = file.create_group("spad")
        group.attrs["MATLAB_sparse"] = np.uint64(matrix.shape[0])
        group["data"], group["ir"], group["jc"] = matrix.data, matrix.indices, matrix.indptr


def save_npz(path: Path, matrix: sparse.csc_matrix) -> None:
    np.savez(path, indices=matrix.indices, indptr=matrix.indptr, format=b"csc", shape=matrix.shape, data=matrix.data)


def save_v5(path: Path, matrix: sparse.csc_matrix) -> None:
    """SciPy writes the indices as they are."""
    savemat(path, {"spad": matrix})


WRITERS = {"v5.mat": save_v5, "v73.mat": save_v73, "sparse.npz": save_npz}


@pytest.mark.parametrize("name", WRITERS)
def test_whole_sparse_matrices_are_read(name, tmp_path):
    WRITERS[name](tmp_path / name, counts())
    cube = foreign_cube(tmp_path / name, SYSTEM, image=(3, 4))
    assert int(np.asarray(cube.histogram).sum()) == counts().sum()


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize(("where", "value"), WRONG)
def test_indices_outside_of_a_sparse_matrix_are_refused(name, where, value, tmp_path):
    """They ended the process, or changed memory beyond the array."""
    path = tmp_path / name
    matrix = with_index(where, value)
    if name == "v5.mat":  # SciPy's writer looks at the pointers, so they are changed in the file
        savemat(path, {"spad": counts()})
        overwrite(path, getattr(counts(), where).astype("<i4").tobytes(), np.int32(value).tobytes(), after=12)
    else:
        WRITERS[name](path, matrix)
    refused(name, foreign_cube, path, SYSTEM, image=(3, 4), error=FileError)
    refused(name, io.load, path)


@pytest.mark.parametrize("name", ["v73.mat", "sparse.npz"])
@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("indices", lambda values: values + 0.5),
        ("indices", lambda values: values.astype("S4")),
        ("indptr", lambda values: values.astype(float)),
        ("indptr", lambda values: np.append(values[:-1], values[-1] - 2)),
    ],
)
def test_indices_of_another_type_or_to_some_of_the_values_are_refused(name, part, change, tmp_path):
    """SciPy makes integers of any type, and leaves out what is beyond the last end."""
    matrix = counts()
    given = {key: getattr(matrix, key) for key in ("shape", "data", "indices", "indptr")}
    given[part] = change(given[part])
    WRITERS[name](tmp_path / name, SimpleNamespace(**given))
    refused(name, foreign_cube, tmp_path / name, SYSTEM, image=(3, 4), error=FileError)


@pytest.mark.parametrize("offset", [1000, -1000, 2**40])
def test_diagonals_outside_of_a_matrix_are_refused(offset, tmp_path):
    """Their counts were left out; 2^40 became 0."""
    matrix = counts().todia()
    offsets = matrix.offsets.astype(np.int64) + offset
    np.savez(tmp_path / "a.npz", format=b"dia", shape=matrix.shape, data=matrix.data, offsets=offsets)
    refused(r"a\.npz.*diagonal", foreign_cube, tmp_path / "a.npz", SYSTEM, image=(3, 4), error=FileError)


def test_sums_of_counts_do_not_wrap_around():
    """94 counts of 2^63 became 94 zeros, and 200 + 200 in bytes 144."""
    huge = sparse.csr_array(np.full((12, 32), 2**63, np.uint64))
    refused("counts", io.from_histograms, huge, SYSTEM)
    twice = sparse.coo_array((np.array([200, 200], np.uint8), ([1, 1], [2, 2])), shape=(12, 32))
    for matrix in (twice, sparse.csr_array((twice.data, [2, 2], [0, 0, *[2] * 11]), shape=(12, 32))):
        assert dense_counts("counts", matrix)[1, 2] == 400


def test_rows_of_matlab_ascend(tmp_path):
    matrix = counts()
    first, second = matrix.indices[:2].copy()
    matrix.indices[:2] = second, first
    save_v73(tmp_path / "v73.mat", matrix)
    refused("do not ascend", foreign_cube, tmp_path / "v73.mat", SYSTEM, image=(3, 4), error=FileError)
    check_sparse("counts", matrix)  # SciPy's may be in any order


def test_a_sparse_matrix_in_memory_is_checked():
    refused("counts is damaged", io.from_histograms, with_index("indices", 4000), SYSTEM)
    matrix = counts()
    assert (dense_counts("counts", matrix) == matrix.toarray()).all()
    assert dense_counts("counts", matrix).dtype == np.uint32
    assert dense_counts("counts", matrix / 3).dtype == np.float64
    assert (dense_counts("counts", matrix.tocoo()) == matrix.toarray()).all()
    assert (dense_counts("counts", matrix.todia()) == matrix.toarray()).all()
    bad = matrix.tocoo()
    bad.coords[0][0] = 99
    refused("outside of its shape", dense_counts, "counts", bad)


def test_the_depth_networks_layout_is_checked(tmp_path):
    flux = ml.Flux(np.linspace(0.1, 2.0, 12).reshape(3, 4), 0.1, 40.0)
    io.simulate_to(tmp_path / "cube.mat", flux, SYSTEM)
    from scipy.io import loadmat

    contents = {k: v for k, v in loadmat(tmp_path / "cube.mat").items() if not k.startswith("__")}
    spad = contents["spad"].tocsc()
    spad.indices[3] = 400
    savemat(tmp_path / "bad.mat", contents | {"spad": spad})
    refused(r"bad\.mat.*damaged", io.load, tmp_path / "bad.mat", error=FileError)


def secret(folder: Path) -> Path:
    path = folder / "secret.txt"
    path.write_bytes(b"not for you, 32 bytes of a file!" * 12)
    return path


def external(path: Path, name: str, shape: tuple[int, ...], dtype: str) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset(name, shape, dtype, external=[(str(secret(path.parent)), 0, h5py.h5f.UNLIMITED)])
        file[name].attrs["bin_ns"] = 1.0


def test_values_in_other_files_are_not_read(tmp_path):
    external(tmp_path / "a.h5", "counts", (3, 4, 32), "u1")
    with pytest.raises(FileError, match=r"a\.h5: the values of /counts lie in other files"):
        foreign_cube(tmp_path / "a.h5", SYSTEM)
    external(tmp_path / "b.h5", "transient", (3, 4, 8), "f4")
    with pytest.raises(FileError, match=r"b\.h5: the values of /transient lie in other files"):
        io.read_transient(tmp_path / "b.h5")


def test_virtual_data_and_links_to_other_files_are_not_followed(tmp_path):
    write_h5(tmp_path / "other.h5", {"counts": np.ones((3, 4, 32), np.uint8)})
    layout = h5py.VirtualLayout((3, 4, 32), "u1")
    layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "counts", (3, 4, 32))
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        file.create_virtual_dataset("counts", layout)
    write_h5(tmp_path / "link.h5", {"group/counts": h5py.ExternalLink(str(tmp_path / "other.h5"), "/counts")})
    for name in ("virtual", "link"):
        refused(rf"{name}\.h5.*other file", foreign_cube, tmp_path / f"{name}.h5", SYSTEM, error=FileError)


def test_a_cell_that_refers_to_another_file_is_not_read(tmp_path):
    path = tmp_path / "cells.mat"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("#refs#/a", (32,), "u1", external=[(str(secret(tmp_path)), 0, h5py.h5f.UNLIMITED)])
        cells = file.create_dataset("t_ns", (1, 1), h5py.ref_dtype)
        cells[0, 0] = data.ref
    refused(r"cells\.mat.*other files", ml.Timestamps.load, path, period_ns=100.0, error=FileError)


BUDGET_S, BUDGET_MIB = 3.0, 200.0


@pytest.mark.full
@pytest.mark.parametrize("bomb", ["npz_shape", "npz_zeros", "h5_fill", "sparse_shape", "npy_times"])
def test_a_small_file_is_refused_cheaply(bomb, tmp_path):
    """No input below 1 MB takes more than 200 MiB or 3 s before it is refused."""
    path = tmp_path / ("bomb.h5" if bomb == "h5_fill" else "bomb.npz")
    if bomb == "npz_shape":  # the shape claimed by histogram.npy, whose bytes are not there
        flux = ml.Flux(np.full((3, 4), 0.5), 0.1, 40.0)
        io.simulate_to(tmp_path / "good.npz", flux, SYSTEM)
        with zipfile.ZipFile(tmp_path / "good.npz") as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
            for member in old.namelist():
                content = old.read(member)
                if member == "histogram.npy":
                    header = {"descr": "<u2", "fortran_order": False, "shape": (2**26, 3, 4, 32)}
                    from io import BytesIO

                    out = BytesIO()
                    np.lib.format.write_array_header_1_0(out, header)
                    content = out.getvalue() + content[128:]
                new.writestr(member, content)
    elif bomb == "npz_zeros":
        np.savez_compressed(path, counts=np.zeros((300, 300, 2000), np.uint16))
    elif bomb == "npy_times":
        np.savez_compressed(path, counts=np.zeros((512, 512, 100), np.float64))
    elif bomb == "sparse_shape":
        save_npz(path, sparse.csc_matrix(([1.0], ([5], [7])), shape=(10**7, 3000)))
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("counts", (2000, 2000, 1000), "u2", chunks=(100, 100, 1000))
    assert path.stat().st_size < 10**6
    code = f"""
import json, resource, time
from pathlib import Path
import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.foreign import foreign_cube
import h5py, scipy.io, scipy.sparse
detector = ml.Detector(dead_time_ns=30.0)
system = ml.System(period_ns=100.0, cycles=5000, bins=32, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=detector)
used = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, began = used(), time.process_time()
for read in (lambda p: foreign_cube(p, system), lambda p: io.load(p)):
    try:
        read(Path({str(path)!r}))
        raise SystemExit("it was read")
    except ValueError as error:
        assert {str(path)!r} in str(error), error
print(json.dumps([time.process_time() - began, used() - before]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=False)
    assert done.returncode == 0, done.stderr
    seconds, mib = json.loads(done.stdout)
    assert seconds < BUDGET_S
    assert mib < BUDGET_MIB


# MATLAB files of version 5 whose elements have types that there are not, over which SciPy ends the process.


CONTENT = {
    "a": np.arange(12.0).reshape(3, 4),
    "b": np.array([[1 + 2j]]),
    "c": "text",
    "cells": np.array([np.zeros(3), "x", np.array([np.ones(2)], dtype=object)], dtype=object),
    "s": {"inner": {"x": np.int16(3), "name": "y"}},
    "empty": np.zeros((0, 3)),
    "flags": np.array([True, False]),
}


def written(path: Path, *, packed: bool, **content: object) -> Path:
    """A file of SciPy's."""
    savemat(path, {**CONTENT, **content}, do_compression=packed)
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_whole_files_pass(packed: bool, tmp_path: Path):
    path = written(tmp_path / "a.mat", packed=packed)
    assert [each.name for each in variables(path)] == list(CONTENT)
    read, scipys = read_mat5(path), loadmat(path)
    assert read.keys() == scipys.keys()
    for name in CONTENT:
        assert repr(read[name]) == repr(scipys[name])
    assert (read_mat5(path, ["a", "none"])["a"] == CONTENT["a"]).all()
    assert "b" not in read_mat5(path, ["a"])
    savemat(tmp_path / "four.mat", {"a": np.arange(3.0), "b": np.eye(2)}, format="4")
    assert read_mat5(tmp_path / "four.mat", ["a"])["a"].size == 3
    assert read_mat5(tmp_path / "four.mat")["b"].size == 4


@pytest.mark.parametrize("packed", [False, True])
def test_what_was_checked_is_what_is_read(packed: bool, tmp_path: Path):
    """A file that is replaced between the check and the reading ended the process; a cut one still names itself."""
    path = written(tmp_path / "a.mat", packed=packed)
    results = {each.name: each for each in variables(path)}
    content = results["a"].element()
    damaged = bytearray(path.read_bytes())
    damaged[136 + 60 :] = bytes(len(damaged) - 196)
    path.write_bytes(damaged)
    assert (loadmat(BytesIO(content))["a"] == CONTENT["a"]).all()
    if packed:
        refused("", results["cells"].element, error=(ValueError, zlib.error))


def test_a_packed_variable_with_a_wrong_checksum_is_refused(tmp_path: Path):
    path = tmp_path / "a.mat"
    savemat(path, {"a": np.arange(1000.0)}, do_compression=True)
    overwrite(path, -2, 1)  # of its Adler-32
    refused(r"a\.mat", read_mat5, path, error=FileError)


def test_a_bomb_of_empty_cells_is_refused(tmp_path: Path):
    """1.4 million cells in 350 kB: SciPy makes an array of each."""
    path = tmp_path / "a.mat"
    savemat(path, {"b": np.zeros(1)})
    empty = struct.pack("<12I", 14, 40, 6, 8, 6, 0, 5, 8, 0, 0, 1, 0)
    number = 1_400_000
    inside = struct.pack("<10I", 6, 8, 1, 0, 5, 8, 1, number, 1 | 1 << 16, 97) + empty * number
    packed = zlib.compress(struct.pack("<II", 14, len(inside)) + inside, 9)
    path.write_bytes(path.read_bytes()[:128] + struct.pack("<II", 15, len(packed)) + packed)
    began = time.process_time()
    refused(r"a\.mat", read_mat5, path, error=FileError)
    assert time.process_time() - began < 3.0


def test_a_type_that_there_is_not_is_refused(tmp_path: Path):
    """It ended the process: 0x0409 in the place of 9, doubles."""
    path = written(tmp_path / "a.mat", packed=False)
    overwrite(path, b"\t\0\0\0\x60\0\0\0", b"\4", after=1)  # of 12 doubles
    refused(r"a\.mat.*no element is of type 1033", read_mat5, path, error=FileError)
    refused("no element is of type", io.read_transient, path, bin_ns=1.0, name="a", error=FileError)


def test_a_packed_type_that_there_is_not_is_refused(tmp_path: Path):
    plain = written(tmp_path / "a.mat", packed=False).read_bytes()
    size = int.from_bytes(plain[132:136], "little")
    variable = bytearray(plain[128 : 136 + size])
    variable[variable.index(b"\t\0\0\0\x60\0\0\0")] = 8
    packed = zlib.compress(bytes(variable))
    head = plain[:128] + (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little")
    (tmp_path / "b.mat").write_bytes(head + packed)
    refused("no element is of type 8", read_mat5, tmp_path / "b.mat", error=FileError)


def test_chunks_that_no_file_can_list_are_refused(tmp_path: Path):
    """HDF5 keeps 4 kB of each chunk that is read, also of those that are not there: 3 GB for a file of 14 kB."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("a", (756_484, 7, 7), "f8", chunks=(1, 7, 7))
        refused("756484 chunks", whole, data, error=FileError)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        (9, 0x08, "lacks a part"),  # complex, without an imaginary part
        (8, 5, "lacks a part"),  # sparse, without rows and ends
        (4, 12, "no flags"),
        (36, 64, "do not fill"),  # its values go on into the next cell
        (40, 14, "no element is of type 14"),  # a matrix in the place of numbers
        (44, 1, "a part too many"),
    ],
)
def test_cells_whose_parts_are_not_those_of_their_class_are_refused(packed, place, value, reason, tmp_path: Path):
    """The first ended the process: SciPy took the next cell for numbers."""
    head = [6, 8, 6, 0, 5, 8, 1, 3, 1, 0, 9, 24]  # flags, (1, 3), no name, three doubles
    cell = bytearray(struct.pack("<12I3d", *head, 1.0, 2.0, 3.0))
    cell[place] = value
    cells = b"".join(struct.pack("<II", 14, len(cell)) + each for each in (bytes(cell), bytes(cell)))
    inside = struct.pack("<10I", 6, 8, 1, 0, 5, 8, 1, 2, 1 | 1 << 16, 97) + cells
    variable = struct.pack("<II", 14, len(inside)) + inside
    if packed:
        variable = struct.pack("<II", 15, len(zlib.compress(variable))) + zlib.compress(variable)
    savemat(tmp_path / "a.mat", {"b": np.zeros(1)})
    (tmp_path / "a.mat").write_bytes((tmp_path / "a.mat").read_bytes()[:128] + variable)
    refused(rf"a\.mat.*{reason}", read_mat5, tmp_path / "a.mat", error=FileError)
