"""The command ``python -m studies compare``: what it prints and writes, and its exit codes."""

from __future__ import annotations

import json
import math

import pytest

from studies.compare.command import main
from studies.compare.report import cell, with_error
from studies.compare.sample import Estimate
from tests.harness.command import command_line

SMALL = ["--scene", "room", "--size", "12", "--cycles", "50", "--bins", "64"]
SMALL += ["--realizations", "300", "--budget-s", "600"]


@pytest.mark.full
def test_the_command_prints_draws_and_writes_numbers(tmp_path):
    out, numbers = tmp_path / "c.png", tmp_path / "c.json"
    arguments = [*SMALL, "--engines", "exact, poisson", "--pixels", "2", "--repeats", "2", "-o", str(out)]
    done = command_line([*arguments, "--json", str(numbers)], main=main)
    assert done.exit_code == 0, done.output
    assert out.read_bytes().startswith(b"\x89PNG")
    lines = done.stdout.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 100
    rows = {name: [line for line in lines if line.startswith(name)] for name in ("exact", "poisson", "predicted")}
    assert [len(rows[name]) for name in ("exact", "poisson", "predicted")] == [3, 3, 2]
    assert all("!" in line for line in rows["poisson"])
    assert not any("!" in line for line in rows["exact"])
    data = json.loads(numbers.read_text())
    assert list(data["scenes"]) == ["exact", "poisson"]
    bright, law = data["statistics"]["bright"], data["laws"]["bright"]
    assert bright["poisson"]["counts"]["mean"]["z"] > 5
    assert bright["exact"]["window_ratio"]["value"] == 1.0
    for name, predicted in zip(("mean", "variance"), law["window"], strict=True):
        drawn = bright["exact"]["window"][name]
        assert drawn["z"] == pytest.approx((drawn["value"] - predicted) / drawn["error"], rel=0.2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.json", "c.png"]
    again = command_line(arguments, main=main)
    assert (again.exit_code, "exists already" in again.stderr) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--engines", "exact,fast"], "--engines must be one of"),
        (["--against", "fast"], "against must be one of"),
        (["--pixel", "3"], "--pixel must be two integers Y,X"),
        (["--pixel", "3,12"], "pixels must lie in the image of shape (12, 12), got '3,12'"),
        (["-o", "table.txt"], "--out must end in .png, .pdf or .svg"),
        (["--json", "no/such/folder.json"], "there is no folder no/such"),
    ],
)
def test_bad_input_of_the_command_is_exit_code_2(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    out = [] if "-o" in arguments else ["-o", "c.png"]
    done = command_line([*SMALL, "--pixels", "1", "--repeats", "1", *out, *arguments], main=main)
    assert done.exit_code == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.full
def test_own_pixels_are_compared(tmp_path):
    out = tmp_path / "c.svg"
    own = ["--engines", "exact", "--repeats", "1", "--pixel", "3,4", "--pixel", "7,8"]
    done = command_line([*SMALL, *own, "-o", str(out)], main=main)
    assert done.exit_code == 0, done.output
    assert "3,4 pixel (y 3, x 4)" in done.stdout
    assert "7,8 pixel (y 7, x 8)" in done.stdout
    assert out.stat().st_size > 2000


def test_numbers_are_written_to_their_error():
    assert with_error(858.4412, 0.1234) == "858.44(12)"
    assert with_error(858.4412, 0.34) == "858.4(3)"
    assert with_error(13181.3, 309.4) == "13181(309)"
    assert with_error(161013133.0, 6331063.0) == "1.61e+08"
    assert with_error(-0.0262, 0.0015) == "-0.0262(15)"
    assert with_error(1.0, 0.97) == "1.0(10)"
    assert with_error(0.25, math.nan) == "0.25"
    assert with_error(math.nan, 1.0) == "–"
    wrong = cell(Estimate(1.0, 0.1, -5.1))
    assert (wrong.plain, wrong.style) == ("1.00(10)!", "bold red")
    assert cell(Estimate(1.0, 0.1, -4.9)).plain == "1.00(10) "
    assert not Estimate(1.0, 0.1, math.nan).wrong
