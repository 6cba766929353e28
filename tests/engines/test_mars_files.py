"""Cubes of the engine "mars" in files: settings kept, table named by its content, command line."""

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.table import Table
from tests.harness.command import command_line, fails, ok

SYSTEM = make_system(30.0, 60, 64)
FLUX = ml.Flux(np.linspace(0.2, 1.9, 30).reshape(6, 5), 0.4, np.linspace(0.0, 99.0, 30).reshape(6, 5))


@pytest.fixture(scope="module")
def table() -> Table:
    return Table.build(SYSTEM, (0.1, 2.0, 6), (0.1, 2.0, 6))


@pytest.mark.full
@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
def test_a_file_says_how_it_was_made_and_makes_it_again(tmp_path, table: Table, suffix: str):
    path = tmp_path / f"cube{suffix}"
    options = {"engine": "mars", "count": "gaussian", "interpolation": "nearest"}
    written = io.simulate_to(path, FLUX, SYSTEM, table=table, realizations=2, seed=3, **options)
    assert written.report["pixels_evaluated"] == 0
    assert written.report["sampling_s"] > 0
    expected = ml.simulate(FLUX, SYSTEM, table=table, realizations=2, seed=3, **options)
    with io.load(path) as cube:
        assert np.array_equal(np.asarray(cube.histogram), expected)
        assert (cube.settings["count"], cube.settings["interpolation"]) == ("gaussian", "nearest")
        record = cube.settings["table"]
        assert record["signal"] == [table.signal[0], 2.0, table.signal.size]
        assert io.verify(cube, table=table)
        assert np.array_equal(io.regenerate(cube, rows=slice(2, 4), table=table), expected[:, 2:4])
        refused(f"table must be the one.*got None.*{record['hash']}", io.verify, cube)
        other = Table.build(SYSTEM, (0.1, 2.0, 6), (0.1, 2.0, 7))
        refused(r"table must be the one.*hash", io.regenerate, cube, table=other)


def test_without_a_table_the_count_law_is_kept(tmp_path):
    io.simulate_to(tmp_path / "a.npz", FLUX[:2], SYSTEM, engine="mars", count="gaussian")
    with io.load(tmp_path / "a.npz") as cube:
        assert cube.settings == {"count": "gaussian"}
        assert io.verify(cube)
        with pytest.raises(ValueError, match="table must be the one that the cube was made with \\(none\\)"):
            io.verify(cube, table=Table.build(SYSTEM, (0.1, 2.0, 4), (0.1, 2.0, 4)))


def test_reports_add_up_over_blocks(tmp_path, table: Table, monkeypatch: pytest.MonkeyPatch):
    from mars_lidar.io import recipe

    monkeypatch.setattr(recipe, "BLOCK_BYTES", 5 * 64 * 2)
    bright = ml.Flux(np.full((6, 5), 3.0), 0.4, 20.0)
    some = ml.Flux(np.where(np.eye(6, 5) > 0, 3.0, 1.0), 0.4, 20.0)
    with pytest.raises(ValueError, match="5 of 30 lie outside"):  # of all pixels, before any block is drawn
        io.simulate_to(tmp_path / "a.h5", some, SYSTEM, engine="mars", table=table)
    assert not list(tmp_path.iterdir())
    written = io.simulate_to(tmp_path / "a.h5", bright, SYSTEM, engine="mars", table=table, outside="exact")
    assert written.report["pixels_evaluated"] == 30
    with io.load(tmp_path / "a.h5") as cube:
        assert io.verify(cube, table=table)


def test_command_line(tmp_path, table: Table):
    table.save(tmp_path / "table.h5")
    SYSTEM.save(tmp_path / "spad.yaml")
    options = "--scene room --size 8 --signal 0.5 --no-picture --engine mars --count gaussian"
    arguments = ["simulate", *options.split(), "--system", str(tmp_path / "spad.yaml")]
    more = ["--table", str(tmp_path / "table.h5"), "--interpolation", "nearest", "-o", str(tmp_path / "a.zarr")]
    done = ok(*arguments, *more)
    assert "sampling" in done.output
    assert "pixels evaluated" in done.output
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.settings["interpolation"] == "nearest"
        assert io.verify(cube, table=table)
    printed = command_line(["info", str(tmp_path / "a.zarr")])
    assert "count gaussian" in printed.output
    assert "table" in printed.output
    wrong = command_line([*arguments, "--dead-time-ns", "40", *more[:-1], str(tmp_path / "b.zarr")])
    assert wrong.exit_code == 2
    fails("table", *arguments[:-4], "--engine", "exact", *more[:2], "-o", tmp_path / "c.npz")
