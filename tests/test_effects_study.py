"""The study of a detector's effects."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from studies.__main__ import main
from studies.detectors import effects


@pytest.mark.full
def test_quick_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A few of its rows; the law of the electronics takes a minute."""
    few = [example for example in effects.EXAMPLES if example.figure in ("", "afterpulsing", "crosstalk", "jitter")]
    monkeypatch.setattr(effects, "EXAMPLES", few)
    assert main(["effects", "--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "effects.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["detector"] for row in rows] == [example.name for example in few]
    text = (tmp_path / "effects.md").read_text()
    figures = sorted(path.name for path in tmp_path.glob("*.png"))
    assert figures == ["effects_afterpulsing.png", "effects_crosstalk.png", "effects_jitter.png"]
    assert all(f"({name})" in text for name in figures)
    with (tmp_path / "effects_rate.csv").open() as file:
        assert [abs(float(row["z"])) < 5.4 for row in csv.DictReader(file)] == [True] * 5
