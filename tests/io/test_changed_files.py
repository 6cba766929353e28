"""What was opened is what is read: a file that is cut short, changed or replaced meanwhile raises by its name."""

import os

import h5py
import numpy as np
import pytest
from harness import refused
from scipy.io import savemat
from store_cases import SYSTEM, one_return

from mars_lidar import io
from mars_lidar._base.files import FileError, NpyFile
from mars_lidar._base.tolerances import TOL

LIGHT = np.random.default_rng(1).random((40, 5, 60))


def write(path, light, **more):
    """A transient of this suffix."""
    if path.suffix == ".npy":
        np.save(path, light)
    elif path.suffix == ".npz":
        np.savez(path, transient=light, bin_ns=1.0)
    elif path.suffix == ".mat":
        savemat(path, {"transient": light, "bin_ns": 1.0})
    else:
        with h5py.File(path, "w") as file:
            if path.name.startswith("capture"):
                file["H"], file["H_format"], file["delta_t"], file["t_start"] = light.transpose(2, 1, 0), 1, 0.3, 0.0
            else:
                file["transient"] = light
    return path


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def replace(path):
    os.replace(write(path.with_name("capture_2" + path.suffix), LIGHT + 1.0), path)


def rewrite(path):
    content = path.read_bytes()
    path.write_bytes(content[:-8] + bytes(8))


@pytest.mark.parametrize("change", [cut, replace, rewrite, os.remove])
@pytest.mark.parametrize("name", ["light.npy", "light.h5", "capture.h5", "light.npz", "light.mat"])
def test_a_transient_that_changes_is_not_read(tmp_path, name, change):
    path = write(tmp_path / name, LIGHT)
    transient = io.read_transient(path, bin_ns=1.0)
    first = transient.rows(slice(0, 10))
    assert np.allclose(first, LIGHT[:10])
    change(path)
    if path.suffix in (".npz", ".mat"):  # in memory
        assert np.allclose(transient.rows(slice(10, 40)), LIGHT[10:])
        return
    with pytest.raises(FileError, match=f"{name} was changed, replaced or removed after it was opened"):
        transient.rows(slice(10, 40))


@pytest.mark.parametrize("change", [cut, os.remove])
@pytest.mark.parametrize("suffix", [".npz", ".ptu", ".mat"])
def test_a_cube_that_changes_is_not_read(tmp_path, suffix, change):
    path = tmp_path / f"cube{suffix}"
    if suffix == ".ptu":
        pytest.importorskip("ptufile")
    io.simulate_to(path, one_return(), SYSTEM)
    with io.load(path) as whole:
        counts = np.asarray(whole.histogram)
    with io.load(path) as cube:
        change(path)
        if suffix == ".mat":  # in memory, sparse
            assert np.array_equal(cube.histogram, counts)
        else:
            refused("was changed, replaced or removed after it was opened", np.asarray, cube.histogram, error=FileError)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", [(7,), (6, 5), (40, 5, 60), (9, 2, 3, 4), (0, 3)])
def test_rows_of_a_npy_are_those_of_numpy(tmp_path, monkeypatch, shape, order):
    monkeypatch.setitem(vars(TOL), "slab_bytes", 700)
    values = np.asarray(np.random.default_rng(2).random(shape), order=order)
    np.save(tmp_path / "a.npy", values)
    file = NpyFile(tmp_path / "a.npy")
    assert (file.shape, file.dtype) == (shape, values.dtype)
    for rows in (slice(None), slice(2, 5), slice(0, 0), slice(1, None, 2), slice(-2, None), slice(5, 2)):
        assert np.array_equal(file[rows], values[rows])


def test_a_npy_that_claims_more_than_it_holds_is_refused(tmp_path):
    with open(tmp_path / "a.npy", "wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (2**40, 3, 4)})
        stream.write(bytes(1000))
    with pytest.raises(FileError, match=r"a\.npy: .*takes 105553116266496 bytes, and it has 1000"):
        io.read_transient(tmp_path / "a.npy", bin_ns=1.0)
