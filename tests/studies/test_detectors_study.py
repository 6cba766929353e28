"""The studies of detector modes and of a detector's effects in their quick form."""

from __future__ import annotations

import pytest
from harness import require
from scipy import stats

from studies.detectors import effects
from studies.detectors import run as detectors
from tests.harness.study import quick_study, read_csv


@pytest.mark.full
def test_modes(tmp_path):
    study = quick_study("detectors", tmp_path)
    assert [row["detector"] for row in study.rows] == [example.name for example in detectors.EXAMPLES]
    assert study.figures == ["detectors_gated.png", "detectors_paralyzable.png", "detectors_synchronous.png"]
    for row in study.rows:
        if row["detector"] == "moving gate":
            assert row["predicted mean"] == "-"
            continue
        require({"mean": 2 * stats.norm.sf(abs(float(row["z mean"])))}, f"detector study, {row['detector']}")


@pytest.mark.full
def test_effects(tmp_path, monkeypatch):
    """A few of its rows; the law of the electronics takes a minute."""
    few = [example for example in effects.EXAMPLES if example.figure in ("", "afterpulsing", "crosstalk", "jitter")]
    monkeypatch.setattr(effects, "EXAMPLES", few)
    study = quick_study("effects", tmp_path)
    assert [row["detector"] for row in study.rows] == [example.name for example in few]
    assert study.figures == ["effects_afterpulsing.png", "effects_crosstalk.png", "effects_jitter.png"]
    assert [abs(float(row["z"])) < 5.4 for row in read_csv(tmp_path / "effects_rate.csv")] == [True] * 5
