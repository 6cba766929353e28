"""The study of quantisation: errors vanish on the nodes, shrink with the grid, and less for the nearest entry."""

import numpy as np
import pytest

from mars_lidar import Flux
from mars_lidar.statistics import exposure_moments
from mars_lidar.table import Table
from studies.table import quantisation
from tests.harness.study import quick_study


@pytest.mark.full
def test_files(tmp_path):
    study = quick_study("quantisation", tmp_path)
    settings = quantisation.QUICK
    assert len(study.rows) == len(settings.sizes) * len(settings.dead_ns) * len(quantisation.INTERPOLATIONS)
    for key in quantisation.ERRORS:
        error = {(row["signal_points"], row["lookup"]): float(row[f"{key}_mean"]) for row in study.rows}
        assert error["16", "bilinear"] < error["16", "nearest"] < error["4", "nearest"]
        assert error["16", "bilinear"] < error["4", "bilinear"]
    assert study.figures == ["quantisation.png"]


@pytest.mark.parametrize("interpolation", quantisation.INTERPOLATIONS)
def test_no_error_on_the_nodes(interpolation):
    system = quantisation.QUICK.system(75.0)
    table = Table.build(system, signal=(0.1, 10.0, 3), background=(0.1, 10.0, 3))
    signal, background = np.array([0.1, 1.0, 10.0]), np.array([1.0, 10.0, 0.1])
    truth = exposure_moments(Flux(signal, background, 0.5 * system.period_ns), system)
    result = table.at(signal, background, interpolation=interpolation)
    errors = quantisation._errors(result.rows, result.weights, result.cumulants, table.shapes(), truth)
    assert all(errors[key].max() < 1e-5 for key in quantisation.ERRORS)
    shifted = quantisation._errors(
        result.rows[[1, 1, 1]], result.weights, result.cumulants[[1, 1, 1]], table.shapes(), truth
    )
    assert shifted["law"][0] > 0.5
    assert shifted["shape"][0] > 0.05
