"""The benchmarks run and their tables are whole; no time is asserted."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks are run from the checkout, not installed
from harness import refused

from benchmarks import __main__ as command
from benchmarks import child, rows, workload
from benchmarks.config import Config
from benchmarks.floor import LANES, Bandwidth, clock, operations
from benchmarks.report import Goal, Section, table
from benchmarks.timing import Timing, in_turn
from mars_lidar import _core

TINY = Config(mode="tiny", side=8, bins=64, cycles=8, repeats=2, seconds=0.0, table_entries=2, starts=1, commands=1)
IN_PROCESS = ("exact", "paths", "effects", "exposure")
TIMING_COLUMNS = {
    *("case", "engine", "level", "threads", "pixels", "cycles", "S + B", "registrations", "ms", "ms least", "CPU ms"),
    *("ns/reg/core", "x reference", "MiB written", "write floor ms", "ops/reg least", "ops floor ns/reg", "turns"),
}


@pytest.fixture(scope="module")
def report():
    return command.run(TINY, IN_PROCESS)


@pytest.mark.full
def test_every_section_has_a_whole_table(report):
    assert len(report.sections) == len(IN_PROCESS)
    for name, section in zip(IN_PROCESS, report.sections, strict=True):
        assert section.rows, name
        for row in section.rows:
            assert list(row) == list(section.rows[0]), name
            assert row["ms"] > 0
        if name != "exposure":
            assert set(section.rows[0]) == TIMING_COLUMNS


@pytest.mark.full
def test_every_level_is_in_the_first_table(report):
    rows = report.sections[0].rows
    assert {row["level"] for row in rows if row["engine"] == "exact"} == set(_core.levels())
    assert "sequential" in {row["engine"] for row in rows}


@pytest.mark.full
def test_goals_stand_beside_measured_values(report):
    text = report.markdown()
    assert len(report.goals) >= 8
    for goal in report.goals:
        assert np.isfinite(goal.measured)
        assert goal.what in text
    for key in ("processor", "vector levels", "NumPy", "date", "load"):
        assert report.machine[key]


@pytest.mark.full
def test_command_saves_markdown_and_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "QUICK", TINY)
    command.main(["--quick", "--only", "exact", "--only", "import", "--out", str(tmp_path)])
    assert (tmp_path / "tiny-exact-import.md").read_text() in capsys.readouterr().out
    data = json.loads((tmp_path / "tiny-exact-import.json").read_text())
    titles = [section["title"] for section in data["sections"]]
    assert titles == ["Exact engine, canonical cube", "Import"]
    assert {goal["met"] for goal in data["goals"]} <= {True, False}


def test_unknown_section_is_refused(capsys):
    refused("", command.main, ["--only", "nonsense"], error=SystemExit)
    assert "nonsense" in capsys.readouterr().err


@pytest.mark.full
def test_imports_are_timed_in_a_fresh_interpreter():
    section = command.run(TINY, ("import",)).sections[0]
    assert [row["case"] for row in section.rows] == ["import numpy", "import mars_lidar"]


@pytest.mark.full
def test_users_calls_are_measured_in_fresh_interpreters():
    section = command.run(TINY, ("user",)).sections[0]
    assert {row["call"] for row in section.rows} == set(child.CALLS)
    assert {row["MiB"] for row in section.rows if row["call"] == "cube"} == {8 * 8 * 64 * 2 / 2**20}
    assert all(row["whole process above it MiB"] > row["above it MiB"] for row in section.rows)


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from /proc")
def test_a_call_tells_its_peak():
    """Memory that a call frees before it ends counts: 64 MiB, which no allocator takes from memory that it has kept."""
    total, used = child.measured(lambda: np.ones(2**26, np.uint8).sum())
    assert total == 2**26
    assert used["peak"] - used["before"] > 0.9 * 2**26


@pytest.mark.full
def test_turns_are_paired_and_counted():
    calls = []
    cases = {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}
    times = in_turn(cases, Config(mode="", repeats=3))
    assert len(times["a"].wall) == len(times["b"].wall) == 3
    assert "".join(calls) == "ab" + "ab" + "ba" + "ab"  # one to warm up, then each begins with another case


def test_ratios_are_taken_within_a_turn():
    assert Timing((2.0, 8.0, 4.0), (1.0, 1.0, 1.0)).ratio(Timing((1.0, 2.0, 4.0), (1.0, 1.0, 1.0))) == 2.0


def test_clock_is_that_of_dependent_additions():
    """No compiler has taken the chain apart, and the floor is of that clock, not of the processor's description."""
    assert _core.addition_chain(1000) == 16_000
    hertz = clock()
    assert 3e8 < hertz < 1e10
    load = workload.canonical(TINY)
    level = _core.levels()[-1]
    run = workload.EngineRun(load, level=level)
    timing, bandwidth = Timing((1.0,), (1.0,)), Bandwidth(1.0, 1.0, 1.0, 1.0)
    text = rows.engine_row("a", run, timing, bandwidth)["ops floor ns/reg"]
    assert text == pytest.approx(1e9 * operations(level).seconds(hertz))


def test_wider_levels_need_fewer_operations():
    counts = [operations(level).total for level in LANES]
    assert counts == sorted(counts)


def test_goals_are_computed():
    assert Goal("time", 2.0, 3.0, "s").met
    assert not Goal("time", 4.0, 3.0, "s").met
    assert Goal("ratio", 21.0, 20.0, "", at_least=True).met
    assert "**not met**" in table([Goal("time", 4.0, 3.0, "s").row()])
    assert Section("Empty").markdown() == "## Empty"


@pytest.mark.full
def test_stream_is_measured_beside_the_engine():
    section = command.run(TINY, ("stream",)).sections[0]
    workers = [row["workers"] for row in section.rows]
    assert set(workers) == {0, 1, TINY.threads} | {2**k for k in range(10) if 2**k < TINY.threads}
    assert all(row["cubes/s"] > 0 for row in section.rows)
    assert [row["of the engine's rate, CPU"] for row in section.rows if row["case"] == "bare engine"] == [1.0, 1.0]


@pytest.mark.full
def test_forward_models_are_measured_with_their_gradients():
    section = command.run(TINY, ("forward",)).sections[0]
    assert {row["bins"] for row in section.rows} == {64}
    for row in section.rows:
        value, both = row["value, CPU us a pixel"], row["value and gradient"]
        assert value > 0.0
        assert (both is None) == (row["case"] == "mean_histogram")


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:the bins of:UserWarning")  # of a tiny configuration
def test_estimators_are_timed():
    reconstruction = command.run(TINY, ("reconstruction",)).sections[0]
    assert {row["method"] for row in reconstruction.rows} >= {"maximum_likelihood", "mchc", "coates", "matched_filter"}
    assert all(row["us per pixel"] > 0 for row in reconstruction.rows)
    assert [goal.unit for goal in reconstruction.goals] == ["s", "us", "us"]
