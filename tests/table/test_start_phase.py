"""Start-phase corrections (docs/table.md, 3): the adjoint recursion against the forward one, pixel by pixel."""

import numpy as np
import pytest
from harness.ledger import require
from scipy.stats import norm
from table.cases import small_table, table_system

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.statistics import exposure_moments
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure import blank, native_light
from mars_lidar.table.entries import start_phases

PHASES = np.array([0, 60, 200, 240, 256, 262, 300, 400, 512])
GRID = 512


def corrections(signal, background, system, *, level="", cumulants=None):
    """(cells, phases, 4) of the adjoint recursion on 512 bins, and when it settled."""
    cells = Cells.of(signal, background, system)
    out, law = np.zeros((cells.size, 4 * PHASES.size)), blank(cells, 1)
    _core.exposure_moments(
        grid=cells.grid(GRID, 1),
        light=native_light(cells, GRID),
        cumulants=law.cumulants if cumulants is None else cumulants,
        cumulant_rates=law.cumulant_rates,
        histogram=law.histogram,
        histogram_rate=law.histogram_rate,
        settled=law.settled,
        threads=2,
        level=level,
        phase=PHASES.astype(np.int32),
        correction=out,
    )
    return out.reshape(cells.size, PHASES.size, 4), law.settled


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", [0.0007, 0.013, 0.25, 0.6, 1.0, 1.53, 3.2])
def test_one_sweep_gives_the_cumulants_at_every_delay(start, dead):
    rng = np.random.default_rng(5)
    signal, background = 10 ** rng.uniform(-2, 1, (2, 5))
    system = table_system(dead, cycles=4000, start=start)
    own = np.empty((5, 4))
    result, settled = corrections(signal, background, system, cumulants=own)
    delay = system.period_ns * (0.5 - PHASES / GRID)
    exact = exposure_moments(ml.Flux(signal[:, None], background[:, None], delay), system, tolerance=1e-5).cumulants
    spread = np.sqrt(exact[:, :1, 1])[..., None] ** np.arange(1, 5)
    error = (result - (exact - exact[:, :1])) / spread
    assert (settled >= 0).sum() >= 3
    assert np.abs(error[settled >= 0]).max() < 3e-4
    assert np.abs(own - exact[:, 0]).max(0) == pytest.approx(0, abs=1e-4 * np.abs(exact[:, 0]).max())


def test_what_the_correction_is_worth():
    """The oracle of the test above would notice if there were none; and t_d = t_r needs none."""
    system = table_system(0.6, cycles=500)
    effect, _ = corrections(10.0, 0.05, system)
    law = exposure_moments(ml.Flux(10.0, 0.05, 0.5 * system.period_ns), system)
    assert np.ptp(effect[0, :, 0]) > 0.3
    assert np.ptp(effect[0, :, 1]) > 0.15 * law.variance
    nothing, _ = corrections(10.0, 0.05, system.replace(detector=ml.Detector(dead_time_ns=100.0)))
    assert np.abs(nothing).max() < 1e-9
    warm, _ = corrections(10.0, 0.05, system.replace(start="stationary"))
    assert np.abs(warm[..., 0]).max() < 1e-9  # the mean of a warmed-up pixel knows no phase,
    assert np.ptp(warm[0, :, 1]) > 0.01 * law.variance  # its variance does


def test_a_constant_rate_has_no_phase():
    result, _ = corrections(0.0, [0.1, 2.0], table_system(0.37, cycles=2000))
    assert np.abs(result).max() < 1e-9


def test_vector_widths_agree():
    system = table_system(0.6, cycles=300)
    signal, background = [0.1, 1.0, 9.0], [1.0, 0.2, 0.05]
    first, _ = corrections(signal, background, system, level=_core.levels()[-1])
    for level in _core.levels():
        assert np.array_equal(corrections(signal, background, system, level=level)[0], first), level


@pytest.mark.full
@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_interpolated_over_pixels_and_phases(start):
    table = small_table(start)
    rng = np.random.default_rng(11)
    signal, background = 10 ** rng.uniform(-1.6, 0.99, 150), 10 ** rng.uniform(-1.2, 0.69, 150)
    delay = rng.uniform(-100, 300, 150)
    moved, canonical = (
        exposure_moments(ml.Flux(signal, background, d), table.system, tolerance=1e-6)
        for d in (delay, 0.5 * table.system.period_ns)
    )
    exact = (moved.cumulants - canonical.cumulants)[:, :2]
    result = table.at(signal, background, delay_ns=delay).cumulants - table.at(signal, background).cumulants
    scale = np.maximum(np.sqrt(moved.variance), 0.5)[:, None] ** np.arange(1, 3)
    assert (np.abs(result[:, :2] - exact) / scale).max() < 2e-3
    effect = (np.abs(exact) / scale).max(0)
    assert effect[1] > 0.03
    assert effect[0] > 0.1 or start == "stationary"


@pytest.mark.parametrize(("dead", "cycles"), [(0.6, 4), (2.53, 60)])
def test_exposures_that_end_before_they_settle(dead, cycles):
    """Start and end of such an exposure know each other: cells where that matters are run phase by phase."""
    system = table_system(dead, cycles=cycles)
    signal, background = np.array([0.0, 0.1, 3.0, 10.0]), np.array([0.01, 0.1, 1.0])
    s, b = np.repeat(signal, 3), np.tile(background, 4)
    entries = exposure_moments(ml.Flux(s, b, 0.5 * system.period_ns), system)
    phases = start_phases(system, signal, background, entries.cumulants, entries.bins, threads=2)
    assert not phases.settled.all()
    for node in (phases.phase.size // 3, phases.phase.size // 2):
        delay = system.period_ns * (0.5 - phases.phase[node])
        exact = exposure_moments(ml.Flux(s, b, delay), system).cumulants - entries.cumulants
        text = phases.correction.reshape(phases.settled.size, -1, 4)[:, node]
        scale = np.maximum(np.sqrt(entries.variance), 0.5)[:, None] ** np.arange(1, 3)
        rows = np.searchsorted(signal, phases.signal)[:, None] * 3 + np.searchsorted(background, phases.background)
        assert (np.abs(text - exact[rows.reshape(-1)])[:, :2] / scale[rows.reshape(-1)]).max() < 5e-3


@pytest.mark.full
def test_against_photon_by_photon_simulation():
    """A bright pixel armed half way up its pulse, in a table, and in the sequential engine."""
    table, shots = small_table(), 20_000
    signal, background, delay = 6.0, 0.11, 1.0
    counts = (
        ml.simulate(ml.Flux(signal, background, delay), table.system, engine="sequential", realizations=shots, seed=3)
        .sum(-1)
        .ravel()
    )
    mean, variance, _, fourth = table.at(signal, background, delay_ns=delay).cumulants[0]
    noise = np.sqrt((fourth + 2 * variance**2) / shots)
    require(
        {
            "mean": 2 * norm.sf(abs(counts.mean() - mean) / np.sqrt(variance / shots)),
            "variance": 2 * norm.sf(abs(counts.var(ddof=1) - variance) / noise),
        },
        "table at a delay of 1 ns",
    )
    canonical = table.at(signal, background).cumulants[0, 0]
    assert abs(canonical - mean) > 10 * np.sqrt(variance / shots)  # which the canonical law would not have passed
