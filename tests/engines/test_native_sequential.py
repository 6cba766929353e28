"""The sequential engine by itself: bits, dead time, closed forms and an independent simulator's statistics.

Every statistical check compares a p-value with ALPHA; with some 2,000 of them the file raises a false alarm
with a probability of about 1e-4 for a new choice of seeds. The seeds are fixed.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from native_jobs import Case, chi_square, gaussian_energy, z_to_p
from scipy import stats

from mars_lidar import _core

ALPHA = 5e-8
REFERENCE = Path(__file__).parents[3] / "shared" / "reference"
CASES = sorted(path.stem for path in REFERENCE.glob("*.json"))
IMAGE = Case(signal=[0.0, 0.3, 2.0, 30.0], background=[0.2, 0.0, 1.0, 10.0], delay=[0.1, -3.4, 0.999, 7.5])
SAMPLES = np.array([0.0, 1.0, 5.0, 9.0, 4.0, 0.0, 0.0, 2.0, 1.0])


def sampled_pulse(width: float, start: float):
    knots = np.concatenate([[0.0], np.cumsum(SAMPLES[1:])]) / SAMPLES.sum()
    return _core.PulseTable.sampled(knots, width, start)


def counts(case: Case, threads: int = 1) -> np.ndarray:
    job = case.job()
    out = np.full(job.items, -1, np.int64)
    _core.sequential_counts(job, case.pulse, out, threads, None)
    return out


def timestamps(case: Case):
    offsets = np.concatenate([[0], np.cumsum(counts(case))])
    times, cycle, bins = (np.empty(offsets[-1], t) for t in (np.float64, np.int32, np.int32))
    _core.sequential_timestamps(case.job(), case.pulse, offsets, times, cycle, bins, 2, None)
    return offsets, times, cycle, bins


def packed_histogram(case: Case, offsets: np.ndarray, bins: np.ndarray) -> np.ndarray:
    item = np.repeat(np.arange(offsets.size - 1), np.diff(offsets))
    flat = np.bincount(item * case.bins + bins, minlength=(offsets.size - 1) * case.bins)
    return flat.reshape(-1, case.bins)


@pytest.mark.parametrize("stationary", [False, True])
@pytest.mark.parametrize("dead_time", [0.0, 0.3, 0.6375, 1.0, 40.3])
def test_timestamps_are_the_histogram_and_keep_the_dead_time(stationary: bool, dead_time: float):
    case = IMAGE.change(realizations=3, dead_time=dead_time, stationary=stationary, cycles=1500, bins=100)
    offsets, times, cycle, bins = timestamps(case)
    assert np.array_equal(packed_histogram(case, offsets, bins), case.histogram("sequential"))
    assert times.min() >= 0
    assert times.max() < 1500
    assert np.abs(times - cycle - (bins + 0.5) / 100).max() <= 0.5 / 100 + 1e-9
    same_item = np.ones(times.size - 1, bool)
    same_item[offsets[1:-1] - 1] = False
    assert np.diff(times)[same_item].min() >= dead_time - 1e-9


@pytest.mark.parametrize("engine", ["sequential", "poisson"])
def test_nothing_arrives(engine: str):
    assert not Case(signal=0.0, background=0.0, delay=np.nan).histogram(engine).any()
    assert not Case(waveform=np.zeros(7), background=0.0, stationary=True).histogram(engine).any()


def test_a_full_bin_and_wrong_arrays_are_errors():
    full = Case(signal=0.0, background=100.0, dead_time=0.0, bins=1)
    with pytest.raises(OverflowError, match="65535"):
        full.histogram("sequential", dtype=np.uint16)
    assert full.histogram("sequential", dtype=np.uint32)[0, 0] > 65535
    case = Case()
    with pytest.raises(ValueError, match="out"):
        _core.sequential_histogram(case.job(), case.pulse, np.empty((1, 63), np.uint16), 1, None)
    with pytest.raises(ValueError, match="out"):
        _core.sequential_counts(case.job(), case.pulse, np.empty(2, np.int64), 1, None)
    with pytest.raises(TypeError):
        _core.sequential_histogram(case.job(), case.pulse, np.empty((1, 64), np.float32), 1, None)
    for wrong in (-1, 1):  # offsets of another job must not become writes out of bounds
        n = int(counts(case)[0]) + wrong
        arrays = (np.array([0, n]), np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32))
        with pytest.raises(ValueError, match="offsets"):
            _core.sequential_timestamps(case.job(), case.pulse, *arrays, 1, None)


def test_stops_inside_a_long_pixel():
    def progress(done: int, total: int) -> None:
        raise KeyboardInterrupt

    case = Case(cycles=2**29, signal=50.0)
    begun = time.process_time()
    with pytest.raises(KeyboardInterrupt):
        _core.sequential_counts(case.job(), case.pulse, np.empty(1, np.int64), 1, progress)
    assert time.process_time() - begun < 2.0


KINDS = ["gaussian", "wrapped", "wide", "returns", "sampled", "waveform", "fine waveform", "narrow"]


@pytest.mark.parametrize("engine", ["sequential", "poisson"])
@pytest.mark.parametrize("name", KINDS)
def test_without_dead_time_bins_are_poisson(name: str, engine: str):
    """Phases of every kind of flux against SciPy, and that counts vary as Poisson numbers do."""
    case = Case(signal=2.0, background=0.5, dead_time=0.0, realizations=400, bins=96, seed=5)
    energy = {
        "gaussian": 2.0 * gaussian_energy(0.5, 0.00375, 96),
        "wrapped": 2.0 * gaussian_energy(0.002, 0.00375, 96),
        "wide": 2.0 * gaussian_energy(0.3, 0.2, 96),
        "returns": 1.5 * gaussian_energy(0.25, 0.00375, 96) + 0.5 * gaussian_energy(0.7, 0.00375, 96),
        "narrow": 2.0 * gaussian_energy(0.505, 1e-6, 96),
    }
    if name == "returns":
        case = case.change(signal=[[1.5], [0.5], [0.0]], delay=[4.25, -0.3, np.nan])
    elif name == "sampled":
        case = case.change(pulse=sampled_pulse(0.11, -0.3), delay=0.1)
        edges = np.arange(97) / 96
        knots = np.concatenate([[0.0], np.cumsum(SAMPLES[1:])]) / SAMPLES.sum()
        at = -0.3 + 0.11 * np.arange(9)
        energy[name] = 2.0 * np.diff(sum(np.interp(edges - 0.1 + k, at, knots) for k in (-1, 0, 1)))
    elif name.endswith("waveform"):
        parts = SAMPLES if name == "waveform" else np.random.default_rng(0).exponential(size=1001)
        case = case.change(waveform=2.0 * parts / parts.sum())
        cumulative = np.concatenate([[0.0], np.cumsum(parts)]) / parts.sum()
        energy[name] = 2.0 * np.diff(np.interp(np.arange(97) / 96, np.arange(parts.size + 1) / parts.size, cumulative))
    else:
        special_cases = {"wrapped": (0.002, 0.00375), "wide": (0.3, 0.2), "narrow": (0.505, 1e-6)}
        delay, sigma = special_cases.get(name, (0.5, 0.00375))
        case = case.change(delay=delay, pulse=_core.PulseTable.gaussian(sigma))
    mean = 1000 * (energy[name] + 0.5 / 96)
    cube = case.histogram(engine, threads=2)
    assert chi_square(cube.sum(0), 400 * mean) > ALPHA
    total = cube.sum(1)
    dispersion = np.sum((total - mean.sum()) ** 2) / mean.sum()
    assert 2 * min(stats.chi2.sf(dispersion, 400), stats.chi2.cdf(dispersion, 400)) > ALPHA
    chi = np.sum((cube - mean) ** 2 / mean, axis=0)  # variance of each bin: 400 independent Poisson numbers
    assert z_to_p((chi - 400) / np.sqrt(800 + 400 / mean)).min() > ALPHA


def test_dim_pixels_over_the_longest_exposure_have_no_lattice():
    case = Case(signal=0.0, background=1e-3, cycles=2**29, bins=4096, seed=8)
    offsets, times, cycle, _ = timestamps(case)
    assert chi_square(case.histogram("sequential")[0], np.full(4096, offsets[-1] / 4096)) > ALPHA
    assert chi_square(np.histogram(cycle, 512, (0, 2**29))[0], np.full(512, offsets[-1] / 512)) > ALPHA
    assert abs(offsets[-1] - 2**29 * 1e-3 / (1 + 1e-3 * 0.6375)) < 6 * np.sqrt(2**29 * 1e-3)
    assert np.unique(times).size == times.size


@pytest.mark.full
@pytest.mark.skipif(not CASES, reason="the reference cases are not here")
@pytest.mark.parametrize("name", CASES or ["none"])
def test_agrees_with_an_independent_simulator(name: str):
    """Mean and variance of the count, of every bin and of the signal window, and the lag-1 covariance."""
    reference = json.loads((REFERENCE / f"{name}.json").read_text())
    photons = (reference["S"] + reference["B"]) * reference["cycles"]
    realizations = int(min(20000, 1.5e7 / photons))
    case = Case(
        signal=reference["S"],
        background=reference["B"],
        delay=reference["tau"],
        dead_time=reference["dead"],
        cycles=reference["cycles"],
        bins=reference["bins"],
        realizations=realizations,
        seed=1,
        pulse=_core.PulseTable.gaussian(reference["sigma"]),
    )
    cube = case.histogram("sequential", threads=2).astype(float)
    share = np.sqrt(1 / realizations + 1 / reference["reals"])

    def agree(values: np.ndarray, expected: float | np.ndarray) -> np.ndarray:
        error = np.maximum(values.std(0) * share, 1e-12)  # rare bins may all be empty: dropped below
        return np.atleast_1d(z_to_p((values.mean(0) - expected) / error))

    total = cube.sum(1)
    often = np.array(reference["hist_mean"]) * realizations > 300  # rarer bins are far from normal
    deviation = cube - np.array(reference["hist_mean"])
    lag1 = deviation * np.roll(deviation, -1, axis=1)
    both = often & np.roll(often, -1)
    offsets, times, _, _ = timestamps(case)
    apart = np.abs((times - reference["tau"] + 0.5) % 1.0 - 0.5) <= 3 * reference["sigma"]
    item = np.repeat(np.arange(realizations), np.diff(offsets))
    window = np.bincount(item, apart, minlength=realizations)
    p = [
        agree(total, reference["count_mean"]),
        agree((total - reference["count_mean"]) ** 2, reference["count_var"]),
        agree(cube, np.array(reference["hist_mean"]))[often],
        agree(deviation**2, np.array(reference["hist_var"]))[often],
        agree(lag1, np.array(reference["hist_cov_lag1"]))[both],
        agree(window, reference["win_mean"]),
        agree((window - reference["win_mean"]) ** 2, reference["win_var"]),
    ]
    assert np.concatenate(p).min() > ALPHA
    observed = {int(k): v for k, v in reference["count"].items()}
    n = np.arange(min([*observed, int(total.min())]), max([*observed, int(total.max())]) + 1)
    theirs = np.array([observed.get(int(k), 0) for k in n])
    ours = np.bincount((total - n[0]).astype(int), minlength=n.size)
    group = np.floor(np.cumsum(theirs + ours) / 200).astype(int)
    table = np.array([np.bincount(group, theirs), np.bincount(group, ours)])
    table = table[:, table.sum(0) > 0]
    if table.shape[1] > 1:
        assert stats.chi2_contingency(table).pvalue > ALPHA
