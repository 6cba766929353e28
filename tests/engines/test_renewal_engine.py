"""The renewal baseline: its own count law, the chain's shape at the pixel's delay."""

import numpy as np
import pytest
from harness import counts_against_law, make_system, require
from harness.pvalues import goodness
from scipy import stats

import mars_lidar as ml
from mars_lidar.statistics import exposure_moments
from mars_lidar.table import Table

SYSTEM = make_system(63.75, 400, 128, sigma_ns=1.5, start="stationary")


@pytest.mark.parametrize("with_table", [True, False])
def test_count_and_shape(with_table: bool):
    signal, background, delay = 1.3, 0.4, 31.234
    table = Table.build(SYSTEM, np.array([1.2, 1.3]), np.array([0.4, 0.5])) if with_table else None
    flux = ml.Flux(np.full((2, 4), signal), background, delay)
    cube = ml.simulate(flux, SYSTEM, engine="renewal", table=table, realizations=1000).reshape(-1, SYSTEM.bins)
    renewal = ml.count_law(ml.Flux(signal, background, 0.0), SYSTEM, "renewal")
    mean, variance = float(renewal.mean), float(renewal.variance)
    n = np.arange(int(mean + 12 * np.sqrt(variance)))
    pmf = np.diff(stats.norm.cdf((n + 0.5 - mean) / np.sqrt(variance)), prepend=0.0)
    exact = exposure_moments(ml.Flux(signal, background, delay), SYSTEM).histogram
    observed = cube.sum(0, dtype=np.int64)
    require(
        {
            "count law": counts_against_law(cube.sum(1, dtype=np.int64), pmf),
            "shape": goodness(observed, exact / exact.sum() * observed.sum()),
        },
        f"renewal, table {with_table}",
    )


def test_waveforms_and_returns_are_solved_at_their_own_delays():
    pixel = ml.Flux(np.full((1, 4), 0.9), 0.2, 31.7)
    both = ml.Flux.multi(pixel, ml.Flux(np.full((1, 4), 0.5), 0.0, 77.7))
    cube = ml.simulate(both, SYSTEM, engine="renewal", realizations=1000).reshape(-1, SYSTEM.bins)
    parts = SYSTEM.bins * 64
    wave = 0.9 * SYSTEM.pulse.bin_energy(31.7, 100.0, parts) + 0.5 * SYSTEM.pulse.bin_energy(77.7, 100.0, parts)
    exact = exposure_moments(ml.Flux(waveform=np.maximum(wave, 0.0), background=0.2), SYSTEM).histogram
    observed = cube.sum(0, dtype=np.int64)
    require({"shape": goodness(observed, exact / exact.sum() * observed.sum())}, "renewal, two returns")
