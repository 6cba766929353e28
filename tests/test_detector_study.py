"""The study of detector modes in its quick form."""

from __future__ import annotations

import csv

import pytest
from harness import require
from scipy import stats

from studies.__main__ import main
from studies.common.report import MAX_FIGURE_BYTES
from studies.detectors import run as detectors


@pytest.mark.full
def test_quick(tmp_path):
    assert main(["detectors", "--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "detectors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["detector"] for row in rows] == [example.name for example in detectors.EXAMPLES]
    text = (tmp_path / "detectors.md").read_text()
    figures = sorted(path.name for path in tmp_path.glob("*.png"))
    assert figures == ["detectors_gated.png", "detectors_paralyzable.png", "detectors_synchronous.png"]
    for name in figures:
        assert name in text
        assert 5_000 < (tmp_path / name).stat().st_size <= MAX_FIGURE_BYTES
    for row in rows:
        if row["detector"] == "moving gate":
            assert row["predicted mean"] == "-"
            continue
        require({"mean": 2 * stats.norm.sf(abs(float(row["z mean"])))}, f"detector study, {row['detector']}")
