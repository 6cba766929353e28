"""The sequential and the Poisson engine without the Python layers: bits, full bins, and the Poisson sampler."""

import time

import numpy as np
import pytest
from harness import bonferroni, goodness, refused, require
from native_emulation import poisson_sample
from native_jobs import Case, gaussian_energy
from scipy import stats

from mars_lidar import _core

IMAGE = Case(signal=[0.0, 0.3, 2.0, 30.0], background=[0.2, 0.0, 1.0, 10.0], delay=[0.1, -3.4, 0.999, 7.5])


def timestamps(case: Case):
    """Offsets of the items, times, periods and bins."""
    job = case.job()
    counts = np.full(job.items, -1, np.int64)
    _core.sequential_counts(job, case.pulse, counts, 1, None)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    times, cycle, bins = (np.empty(offsets[-1], t) for t in (np.float64, np.int32, np.int32))
    _core.sequential_timestamps(case.job(), case.pulse, offsets, times, cycle, bins, 2, None)
    return offsets, times, cycle, bins


@pytest.mark.parametrize("stationary", [False, True])
@pytest.mark.parametrize("dead_time", [0.0, 0.3, 0.6375, 1.0, 40.3])
def test_timestamps_are_the_histogram_and_keep_the_dead_time(stationary: bool, dead_time: float):
    case = IMAGE.change(realizations=3, dead_time=dead_time, stationary=stationary, cycles=1500, bins=100)
    offsets, times, cycle, bins = timestamps(case)
    item = np.repeat(np.arange(offsets.size - 1), np.diff(offsets))
    flat = np.bincount(item * 100 + bins, minlength=(offsets.size - 1) * 100)
    assert np.array_equal(flat.reshape(-1, 100), case.histogram("sequential"))
    assert times.min() >= 0
    assert times.max() < 1500
    assert np.abs(times - cycle - (bins + 0.5) / 100).max() <= 0.5 / 100 + 1e-9
    assert np.diff(times)[np.diff(item) == 0].min() >= dead_time - 1e-9


@pytest.mark.parametrize("engine", ["sequential", "poisson"])
def test_nothing_arrives(engine: str):
    assert not Case(signal=0.0, background=0.0, delay=np.nan).histogram(engine).any()
    assert not Case(waveform=np.zeros(7), background=0.0, stationary=True).histogram(engine).any()


def test_dim_pixels_over_the_longest_exposure_have_no_lattice():
    case = Case(signal=0.0, background=1e-3, cycles=2**29, bins=4096, seed=8)
    offsets, times, cycle, bins = timestamps(case)
    n = float(offsets[-1])
    p = {
        "bins": goodness(np.bincount(bins, minlength=4096), np.full(4096, n / 4096)),
        "cycles": goodness(np.histogram(cycle, 512, (0, 2**29))[0], np.full(512, n / 512)),
        "number": 2 * stats.norm.sf(abs(n - 2**29 * 1e-3 / (1 + 1e-3 * 0.6375)) / np.sqrt(2**29 * 1e-3)),
    }
    require(p, "sequential, longest exposure")
    assert np.unique(times).size == times.size


@pytest.mark.parametrize(
    ("engine", "signal", "background", "dtype"),
    [
        ("sequential", 0.0, 70.0 * 64, np.uint16),
        ("poisson", 70.0, 0.0, np.uint16),
        ("poisson", 0.0, 70.0 * 64, np.uint16),
        ("poisson", 60.0, 20.0 * 64, np.uint16),
        ("poisson", 1e6, 0.0, np.uint32),
        ("poisson", 0.0, 1e6 * 64, np.uint32),
    ],
)
def test_a_full_bin_is_an_error(engine: str, signal: float, background: float, dtype: type):
    cycles = 1000 if dtype is np.uint16 else 10**6
    case = Case(signal=signal, background=background, delay=0.508, cycles=cycles, dead_time=0.0)
    refused(str(np.iinfo(dtype).max), case.histogram, engine, dtype=dtype, error=OverflowError)


def test_wrong_arrays_are_errors():
    case = Case()
    for call in (_core.sequential_histogram, _core.poisson_histogram):
        refused("out", call, case.job(), case.pulse, np.empty((1, 63), np.uint16), 1, None)
        refused("", call, case.job(), case.pulse, np.empty((1, 64), np.float32), 1, None, error=TypeError)
    refused("out", _core.sequential_counts, case.job(), case.pulse, np.empty(2, np.int64), 1, None)
    for wrong in (-1, 1):  # offsets of another job must not become writes out of bounds
        n = int(timestamps(case)[0][-1]) + wrong
        arrays = (np.array([0, n]), np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32))
        refused("offsets", _core.sequential_timestamps, case.job(), case.pulse, *arrays, 1, None)


def test_stops_inside_a_long_pixel():
    def progress(done: int, total: int) -> None:
        raise KeyboardInterrupt

    case = Case(cycles=2**29, signal=50.0)
    begun = time.process_time()
    arrays = case.job(), case.pulse, np.empty(1, np.int64), 1, progress
    refused("", _core.sequential_counts, *arrays, error=KeyboardInterrupt)
    assert time.process_time() - begun < 2.0


# The Poisson sampler


@pytest.mark.parametrize("mean", [1e-3, 0.1, 0.9, 3.0, 9.999, 10.0, 10.5, 14.0, 30.0, 100.0, 2e3])
def test_sampler_follows_the_poisson_law(mean: float):
    n = 500_000
    x = poisson_sample(1, mean, n)
    k = np.arange(x.max() + 20)
    require({"law": goodness(np.bincount(x, minlength=k.size), n * stats.poisson.pmf(k, mean))}, f"Poisson, {mean:g}")


@pytest.mark.parametrize("mean", [1e4, 1e6, 1e9, 1e12])
def test_sampler_at_large_means(mean: float):
    """Cells of a fifth of a standard deviation against the distribution function, and odd against even."""
    n = 500_000
    x = poisson_sample(1, mean, n)
    edges = np.unique(np.floor(mean + np.sqrt(mean) * np.linspace(-5, 5, 51)))
    expected = n * np.diff(np.concatenate([[0.0], stats.poisson.cdf(edges, mean), [1.0]]))
    observed = np.diff(np.concatenate([[0], np.searchsorted(np.sort(x), edges, side="right"), [n]]))
    parity = stats.binomtest(int((x % 2).sum()), n).pvalue
    require({"law": goodness(observed, expected), "parity": parity}, f"Poisson, {mean:g}")


def test_sampler_at_vanishing_means():
    assert not poisson_sample(1, 0.0, 10).any()
    assert not poisson_sample(1, 1e-12, 1_000_000).any()
    number = poisson_sample(1, 1e-6, 4_000_000).sum()
    require({"number": 2 * min(stats.poisson.cdf(number, 4.0), stats.poisson.sf(number - 1, 4.0))}, "Poisson, 1e-6")


# background of a bin: placed photons, table, rejection
@pytest.mark.parametrize("per_bin", [0.0, 0.02, 2.9, 3.1, 40.0, 9e3, 2e4])
@pytest.mark.parametrize("bins", [96, 1000])
def test_bins_are_independent_poisson_numbers(per_bin: float, bins: int):
    n = 40_000 // bins * 10
    case = Case(signal=0.4, background=per_bin * bins / 1000, delay=-0.001, bins=bins, realizations=n, seed=9)
    mean = 400 * gaussian_energy(-0.001, 0.00375, bins) + per_bin
    cube = case.histogram("poisson", threads=2).astype(float)
    assert not cube[:, mean < 1e-9].any()
    likely = mean > 1e-2
    m = mean[likely]
    deviation = (cube[:, likely] - m) / np.sqrt(m)
    # variance of all bins; covariance of neighbours, of halves of a row, and of successive realizations
    half = m.size // 2
    pairs = (
        (deviation[:, 1:], deviation[:, :-1]),
        (deviation[:, :half], deviation[:, -half:]),
        (deviation[1:], deviation[:-1]),
    )
    z = [(np.sum(deviation**2) - deviation.size) / np.sqrt(n * np.sum(2 + 1 / m))]
    z += [np.sum(a * b) / np.sqrt(a.size) for a, b in pairs]
    total = np.sum((cube.sum(1) - mean.sum()) ** 2) / mean.sum()
    p = {
        "mean": goodness(cube.sum(0)[likely], n * m, fixed_total=False),
        "variance and covariances": bonferroni(2 * stats.norm.sf(np.abs(z))),
        "total": 2 * min(stats.chi2.sf(total, n), stats.chi2.cdf(total, n)),
    }
    require(p, f"Poisson, {per_bin:g} a bin, {bins} bins")
