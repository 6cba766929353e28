"""MATLAB files of version 5 whose elements have types that there are not, over which SciPy ends the process."""

import struct
import time
import zlib
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import refused
from harness.files import overwrite
from scipy.io import loadmat, savemat

from mars_lidar import io
from mars_lidar._base.files import FileError, read_mat5, whole
from mars_lidar._base.mat5 import variables

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
