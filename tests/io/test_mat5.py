"""MATLAB files of version 5 whose elements have types that there are not, over which SciPy ends the process."""

from __future__ import annotations

import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, savemat

from mars_lidar import io
from mars_lidar._base.files import FileError, read_mat5, whole
from mars_lidar._base.mat5 import check_elements

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
    check_elements(path)
    assert (read_mat5(path)["a"] == loadmat(path)["a"]).all()
    savemat(tmp_path / "four.mat", {"a": np.arange(3.0)}, format="4")
    assert read_mat5(tmp_path / "four.mat")["a"].size == 3


def test_a_type_that_there_is_not_is_refused(tmp_path: Path):
    """It ended the process: 0x0409 in the place of 9, doubles."""
    path = written(tmp_path / "a.mat", packed=False)
    content = bytearray(path.read_bytes())
    at = content.index(b"\t\0\0\0\x60\0\0\0")  # 12 doubles
    content[at + 1] = 4
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"a\.mat.*no element is of type 1033"):
        read_mat5(path)
    with pytest.raises(FileError, match="no element is of type"):
        io.read_transient(path, bin_ns=1.0, name="a")


def test_a_packed_type_that_there_is_not_is_refused(tmp_path: Path):
    plain = written(tmp_path / "a.mat", packed=False).read_bytes()
    size = int.from_bytes(plain[132:136], "little")
    variable = bytearray(plain[128 : 136 + size])
    variable[variable.index(b"\t\0\0\0\x60\0\0\0")] = 8
    packed = zlib.compress(bytes(variable))
    head = plain[:128] + (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little")
    (tmp_path / "b.mat").write_bytes(head + packed)
    with pytest.raises(FileError, match="no element is of type 8"):
        read_mat5(tmp_path / "b.mat")


def test_chunks_that_no_file_can_list_are_refused(tmp_path: Path):
    """HDF5 keeps 4 kB of each chunk that is read, also of those that are not there: 3 GB for a file of 14 kB."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("a", (756_484, 7, 7), "f8", chunks=(1, 7, 7))
        with pytest.raises(FileError, match="756484 chunks"):
            whole(data)
