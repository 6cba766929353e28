"""Times without a header: .mat of both versions, .npz, cells with scalars and empties."""

import h5py
import numpy as np
import pytest
from harness import refused
from scipy.io import savemat

import mars_lidar as ml

CELLS = [[np.array([850, 2346, 4695]), np.array([])], [np.array([77.0]), np.array([3000, 20, 4000])]]


def cells() -> np.ndarray:
    out = np.empty((2, 2), object)
    for y in range(2):
        for x in range(2):
            out[y, x] = CELLS[y][x]
    return out


def mat_73(path):
    """As MATLAB writes a cell array into HDF5: references, transposed; an empty cell holds its size."""
    with h5py.File(path, "w") as file:
        refs = file.create_dataset("times", (2, 2), h5py.ref_dtype)
        refs.attrs["MATLAB_class"] = np.bytes_(b"cell")
        for y in range(2):
            for x in range(2):
                values = CELLS[y][x]
                part = file.create_dataset(
                    f"#refs#/{y}{x}", data=values[None] if values.size else np.zeros(2, np.uint64)
                )
                if not values.size:
                    part.attrs["MATLAB_empty"] = 1
                refs[x, y] = part.ref
        file.create_dataset("syncPeriod", data=[[782.0]])


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_cells(tmp_path, version):
    path = tmp_path / "cells.mat"
    if version == "5":
        savemat(path, {"times": cells(), "syncPeriod": 782.0, "note": "text"})
    else:
        mat_73(path)
    times = ml.Timestamps.load(path, unit_ns=0.064)
    assert times.shape == (2, 2)
    assert times.counts.tolist() == [[3, 0], [1, 3]]
    assert times.period_ns == pytest.approx(782 * 0.064)
    assert times.bins == 782
    assert times.cycle.tolist() == [1, 3, 6, 0, 0, 3, 5]
    assert times.bin.tolist() == [68, 0, 3, 77, 20, 654, 90]
    assert times.times_ns == pytest.approx(0.064 * (np.array([850, 2346, 4695, 77, 20, 3000, 4000]) + 0.5))
    assert times.info["unit_ns"] == 0.064
    assert times.info["disordered"] == 1


def test_npz_and_names_that_tell_the_unit(tmp_path):
    path = tmp_path / "lab.npz"
    t = np.array([12.25, 130.5, 391.0])
    np.savez(path, t_ns=t, dark=3.0)
    times = ml.Timestamps.load(path, period_ns=100.0, bins=10)
    assert times.times_ns.tolist() == t.tolist()
    assert times.bin.tolist() == [1, 3, 9]
    assert "unit_ns" not in times.info
    np.savez(path, a=t, b=t)
    assert len(ml.Timestamps.load(path, period_ns=100.0, variable="b", unit_ns=2.0)) == 3


def test_errors_name_file_and_cure(tmp_path):
    path = tmp_path / "lab.mat"
    savemat(path, {"a": [1.0, 250.0, 300.0], "b": [1.0, 2.0]})
    for arguments, words in (
        ({"period_ns": 100.0}, "several arrays that could be times: a, b; give variable"),
        ({"period_ns": 100.0, "variable": "c"}, "variable must be one of a, b"),
        ({"period_ns": 100.0, "variable": "a"}, "the unit of 'a' is not stated: give unit_ns"),
        ({"unit_ns": 1.0, "variable": "a"}, "does not state the laser period: give period_ns"),
        ({"unit_ns": 1.0, "variable": "b", "period_ns": 100.0}, "lie within one laser period"),
        ({"unit_ns": 0.0, "variable": "b", "period_ns": 100.0}, "unit_ns must be"),
        ({"unit_ns": 1e9, "variable": "a", "period_ns": 0.01}, r"2\^31 laser periods"),
    ):
        refused(words, ml.Timestamps.load, path, **arguments)
    savemat(path, {"a": [1.0, -2.0, 300.0]})
    refused(r"finite and >= 0, got -2\.0", ml.Timestamps.load, path, unit_ns=1.0, period_ns=100.0)
    savemat(path, {"picture": np.ones((4, 4))})
    refused("has no array of times", ml.Timestamps.load, path, unit_ns=1.0, period_ns=100.0)
    path.write_bytes(b"nothing")
    refused("cannot be read", ml.Timestamps.load, path, unit_ns=1.0, period_ns=100.0)
    for name in ("lab.ptu", "lab.h5"):
        (tmp_path / name).write_bytes(b"")
        refused(r"unit_ns and variable are for \.mat, \.npz and text", ml.Timestamps.load, tmp_path / name, unit_ns=1.0)
