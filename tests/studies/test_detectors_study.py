"""The study of detector modes and effects in its quick form."""

from __future__ import annotations

import pytest
from harness import require
from scipy import stats

from studies.detectors import run as detectors
from tests.harness.study import quick_study, read_csv


@pytest.mark.full
def test_modes_and_effects(tmp_path, monkeypatch):
    """A few of the effects; the law of the electronics takes a minute."""
    few = [each for each in detectors.EFFECTS if each.figure in ("", "afterpulsing", "crosstalk", "jitter")]
    monkeypatch.setattr(detectors, "EFFECTS", few)
    study = quick_study("detectors", tmp_path)
    assert [row["detector"] for row in study.rows] == [each.name for each in (*detectors.MODES, *few)]
    groups = {each.figure for each in (*detectors.MODES, *few, *detectors.IN_FOG)} - {""}
    assert study.figures == [f"detectors_{name}.png" for name in sorted(groups)]
    fog = read_csv(tmp_path / "detectors_fog.csv")
    for row in (*study.rows, *fog):
        simulated_only = row["detector"] == "moving gate" or row["effect"] in ("afterpulsing", "crosstalk")
        assert (row["predicted mean"] == "-") == simulated_only
        if not simulated_only:
            p = 2 * stats.norm.sf(abs(float(row["z mean"])))
            require({"mean": p}, f"detector study, {row['effect']}, {row['detector']}")
    wall = {row["detector"]: float(row["wall"]) for row in fog}
    assert wall["synchronous"] < 0.4 * wall["non-paralyzable"], "the light of the fog arrives first"
    assert [abs(float(row["z"])) < 5.4 for row in read_csv(tmp_path / "detectors_rate.csv")] == [True] * 5
