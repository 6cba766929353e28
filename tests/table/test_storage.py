"""Table files, the cache, and the command `mars-lidar table`."""

import h5py
import numpy as np
import pytest
from harness import refused
from table.cases import small_table, table_system

import mars_lidar as ml
from mars_lidar.table import storage
from mars_lidar.table.axes import axis_values
from tests.harness.command import command_line, ok, run


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MARS_LIDAR_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.full
@pytest.mark.parametrize("method", ["exposure", "mars"])
def test_a_file_says_what_the_table_said(tmp_path, method):
    table = small_table(method=method)
    table.save(tmp_path / "t.h5")
    assert [p.name for p in tmp_path.iterdir()] == ["t.h5"]
    read = ml.Table.load(tmp_path / "t.h5", table.system)
    assert ml.Table.load(tmp_path / "t.h5").system == table.system
    (tmp_path / "t.h5").write_bytes(b"")  # a table that was mapped would end the process here
    assert (read.system, read.method, read.provenance) == (table.system, method, table.provenance)
    assert read.nbytes == table.nbytes
    for name in ("row", "first", "offsets", "pmf"):
        assert np.array_equal(getattr(read.laws, name), getattr(table.laws, name))
    assert (table.laws.row.size > 0) == (method == "exposure")
    for cycles in (None, 1000):
        assert np.array_equal(read.shapes(cycles), table.shapes(cycles))
        a, b = (t.at([0.4, 3.0, 0.0], 1.3, delay_ns=[3.0, 70.0, 1.0], cycles=cycles) for t in (read, table))
        for name in ("rows", "weights", "cumulants"):
            assert np.array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bins": 64}, "bins is 32 there and 64 here"),
        ({"period_ns": 90.0}, "period_ns is 100.0 there and 90.0 here"),
        ({"start": "stationary"}, "start is 'armed' there"),
        ({"detector": ml.Detector(dead_time_ns=61.0)}, r"detector.dead_time_ns is 60.0 there and 61.0 here"),
        ({"pulse": ml.GaussianPulse(sigma_ns=3.0)}, r"pulse.sigma_ns is 2.0 there and 3.0 here"),
        ({"cycles": 2}, "cycles is 200 there and 2 here"),
    ],
)
def test_another_system_is_refused(tmp_path, change, message):
    table = small_table()
    table.save(tmp_path / "t.h5")
    with pytest.raises(ValueError, match=f"is a table of another system: {message}"):
        ml.Table.load(tmp_path / "t.h5", table.system.replace(**change))
    longer = ml.Table.load(tmp_path / "t.h5", table.system.replace(cycles=900))
    assert np.array_equal(longer.at(1.0, 1.0).cumulants, table.at(1.0, 1.0, cycles=900).cumulants)
    assert np.array_equal(longer.shapes(), table.shapes(900))


@pytest.mark.parametrize("number", [1, 3])
def test_files_of_other_formats_are_refused(tmp_path, number):
    small_table().save(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        file.attrs["format"] = number
        file.attrs.pop("sha256", None)  # the sum of what it was
    refused(f"is a table of format {number}; this version reads format 2", ml.Table.load, tmp_path / "t.h5")


def test_files_that_are_not_tables(tmp_path, monkeypatch):
    table = small_table()
    refused(r"path must end in .h5 or .hdf5", table.save, tmp_path / "t.npz")
    table.save(tmp_path / "t.h5")
    refused("exists already", table.save, tmp_path / "t.h5", error=FileExistsError)
    table.save(tmp_path / "t.h5", overwrite=True)
    refused("does not exist", ml.Table.load, tmp_path / "no.h5", table.system, error=FileNotFoundError)
    (tmp_path / "text.h5").write_text("no")
    refused("cannot be read as an HDF5 file", ml.Table.load, tmp_path / "text.h5", table.system)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["kind"] = "something"
    refused("not a table of mars-lidar", ml.Table.load, tmp_path / "other.h5", table.system)

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(storage, "seal", fail)
    refused("disk full", table.save, tmp_path / "half.h5", error=OSError)
    assert not list(tmp_path.glob("half*"))


def test_the_cache_builds_once(own_cache, monkeypatch):
    system = table_system(cycles=300)
    grids = {"signal": (0.1, 5.0, 6), "background": (0.1, 2.0, 5)}
    first = ml.Table.cached(system, **grids, threads=1)
    (file,) = own_cache.iterdir()
    monkeypatch.setattr(ml.Table, "build", lambda *_, **__: pytest.fail("built again"))
    again = ml.Table.cached(system, **grids)
    longer = ml.Table.cached(system.replace(cycles=4000), **grids)
    assert np.array_equal(first.shapes(), again.shapes())
    assert longer.system.cycles == 4000
    assert storage.cached_tables() == [file]
    monkeypatch.undo()
    for other in ({"tolerance": 1e-3}, {"method": "mars"}, {"background": (0.1, 2.0, 4)}):
        key = storage.request_key(
            system,
            tuple(axis_values(name, (grids | other)[name]) for name in ("signal", "background")),
            method=other.get("method", "exposure"),
            rearm="centre",
            tolerance=other.get("tolerance", 1e-4),
        )
        assert not file.name.startswith(key), other
    refused("got 'grid'", ml.Table.cached, system, grid=3, error=TypeError)


def test_a_damaged_file_in_the_cache_is_replaced(own_cache):
    system = table_system(cycles=300)
    ml.Table.cached(system, [0.5, 1.0], [0.2, 0.4], threads=1)
    (file,) = own_cache.iterdir()
    file.write_bytes(file.read_bytes()[:3000])
    table = ml.Table.cached(system, [0.5, 1.0], [0.2, 0.4], threads=1)
    assert table.at(1.0, 0.4).cumulants[0, 0] > 0


def test_where_the_cache_is(tmp_path, monkeypatch):
    monkeypatch.delenv("MARS_LIDAR_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert storage.cache_folder() == tmp_path / "mars-lidar"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "me"))
    assert storage.cache_folder() == tmp_path / "me" / ".cache" / "mars-lidar"


@pytest.mark.full
def test_commands(tmp_path, own_cache):
    small = ["--signal", "0.1,5,5", "--background", "0.1,2,4", "--bins", 32, "--pulse-sigma-ns", 4, "--threads", 1]
    ok("table", "build", *small, "-o", tmp_path / "t.h5")
    printed = run("table", "info", tmp_path / "t.h5")
    words = "0 and 5 log-spaced values in [0.1, 5]", "105 MB", "108 GB", "start phases", "exact laws"
    for word in words:
        assert word in printed.output, word
    assert run("table", "build", *small, "-o", tmp_path / "t.h5").exit_code == 2
    ok("table", "build", *small)
    ok("table", "build", *small, "--method", "mars")
    assert len(list(own_cache.iterdir())) == 2
    listed = run("table", "info").output
    assert "2 files" in listed
    assert "mars, S 0 and 5" in listed
    for bad in (["--signal", "1,2"], ["--method", "no"]):
        assert run("table", "build", *small, *bad).exit_code == 2
    assert run("table", "info", tmp_path / "no.h5").exit_code == 2
    (own_cache / "notes.txt").write_text("mine")
    assert "nothing was removed" in command_line(["table", "clear"], input="n\n").output
    assert "removed 2 files" in run("table", "clear", "--yes").output
    assert [p.name for p in own_cache.iterdir()] == ["notes.txt"]
    assert "holds no tables" in run("table", "clear", "--yes").output


def test_a_cache_that_cannot_be_written_costs_the_next_build_and_no_more(tmp_path, monkeypatch):
    """Homes of compute nodes are read-only often enough; for root no folder is, so a file stands in its way."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MARS_LIDAR_CACHE", str(tmp_path / "file" / "cache"))
    system = small_table().system
    with pytest.warns(UserWarning, match=r"cannot be kept in .*file.cache .*MARS_LIDAR_CACHE"):
        table = ml.Table.cached(system, [0.5, 1.0], [0.2, 0.4], threads=1)
    assert table.at(0.7, 0.3).cumulants.shape == (1, 4)
    with pytest.raises(OSError):  # a path cannot be given
        ml.Table.cached_path(system, [0.5, 1.0], [0.2, 0.4], threads=1)
