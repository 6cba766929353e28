"""The study of table errors: it writes what it measures."""

import csv

import pytest

import studies
from studies import Request


@pytest.mark.full
def test_the_study_writes_its_report(tmp_path):
    messages = []
    paths = studies.run("table", Request(tmp_path, quick=True, tell=messages.append))
    assert [path.name for path in paths] == ["table.md", "table.csv"]
    text = paths[0].read_text()
    assert "| 75 | armed | exposure | 1000 | bilinear |" in text
    assert "--quick" in text
    rows = [line.split(",") for line in paths[1].read_text().splitlines()]
    at = rows[0].index("mean max")
    bilinear, nearest = (float(row[at]) for row in rows[1:3])
    assert bilinear < 0.1 * nearest
    assert len(messages) == 1


def test_the_start_up_study_writes_its_report(tmp_path):
    paths = studies.run("start-up", Request(tmp_path, quick=True))
    assert [path.name for path in paths] == ["start_up.md", "start_up.csv"]
    rows = list(csv.DictReader(paths[1].read_text().splitlines()))
    short, long = (max(float(r["displaced"]) for r in rows if r["cycles"] == n) for n in ("100", "1000"))
    assert short == pytest.approx(long, rel=0.05)  # start-up does not grow with the exposure
    assert 0.5 < short < 2.0
    dim = max(float(r["tv"]) for r in rows if float(r["signal"]) <= 0.1 and float(r["background"]) <= 0.1)
    assert 0.0 < dim < 0.1 * max(float(r["tv"]) for r in rows)
    assert "registrations of an exposure are displaced" in paths[0].read_text()
