"""The study of table errors: it writes what it measures."""

from mars_lidar.studies import STUDIES, Request


def test_the_study_writes_its_report(tmp_path):
    told = []
    paths = STUDIES["table"][1](Request(tmp_path, quick=True, tell=told.append))
    assert [path.name for path in paths] == ["table.md", "table.csv"]
    text = paths[0].read_text()
    assert "| 75 | armed | exposure | 1000 | bilinear |" in text
    assert "--quick" in text
    rows = [line.split(",") for line in paths[1].read_text().splitlines()]
    at = rows[0].index("mean max")
    bilinear, nearest = (float(row[at]) for row in rows[1:3])
    assert bilinear < 0.1 * nearest
    assert len(told) == 1
