"""Exact pmfs whose support is guessed from cumulants that are known but roughly."""

import numpy as np
import pytest
from harness import make_system

from mars_lidar.statistics import count_pmf as _pmf
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.count_pmf import exact_pmfs, guessed_pmfs, total_variation
from mars_lidar.statistics.exposure import refined_moments

SYSTEM = make_system(63.75, 120, 32)


def cells():
    signal, background = np.array([8.0, 3.0, 0.3, 0.001, 6.0]), np.array([0.02, 0.5, 3.0, 0.002, 0.2])
    some = Cells.of(signal, background, SYSTEM, delay_ns=[3.0, 50.0, 60.0, 10.0, 97.0])
    result = refined_moments(some, 1, tolerance=1e-4, threads=1)
    return some, result.cumulants.reshape(-1, 4), result.bins.reshape(-1)


def alone(monkeypatch):
    """Cells whose law is computed by their own cumulants."""
    asked, compute = [], _pmf._by_own_cumulants
    monkeypatch.setattr(_pmf, "_by_own_cumulants", lambda cell, threads: asked.append(1) or compute(cell, threads))
    return asked


def test_they_are_the_exact_ones(monkeypatch):
    some, cumulants, bins = cells()
    asked, windows = alone(monkeypatch), []
    for guess, truth in zip(
        guessed_pmfs(some, cumulants, bins, 1, windows.append), exact_pmfs(some, cumulants, bins, 1), strict=True
    ):
        assert total_variation(guess, truth) < 1e-11
    assert not asked
    assert windows[-1] == some.size


@pytest.mark.parametrize(
    "wrong",
    [
        lambda k: k + np.array([25.0, 0, 0, 0]),  # elsewhere altogether
        lambda k: k + np.array([1.0, 0, 0, 0]),  # by a good part of the spread
        lambda k: k * [1.0, 1e-6, 1, 1],  # far too narrow
        lambda k: k * [1.0, 1e6, 1, 1],  # wider than a guess may be
    ],
)
def test_a_wrong_guess_is_noticed(monkeypatch, wrong):
    some, cumulants, bins = cells()
    wide = np.array([1, 2, 4])  # counts of some spread: the others are all but certain
    some, cumulants, bins = some.part(wide), cumulants[wide], bins[wide]
    asked = alone(monkeypatch)
    guesses = guessed_pmfs(some, np.asarray(wrong(cumulants)), bins, 1)
    for guess, truth in zip(guesses, exact_pmfs(some, cumulants, bins, 1), strict=True):
        assert total_variation(guess, truth) < 1e-6
    assert asked
