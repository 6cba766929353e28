"""What every effect of the detector is tested for: bits, means, and refusals where no law knows it."""

import numpy as np
from harness import Case, check, require
from harness.check import EVERYTHING, INTERVALS
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines import ENGINES
from mars_lidar.engines.exact import ExactEngine


def exact_against_sequential(made: Case) -> None:
    """Intervals of twilight pulses are all t_d, which the exact engine's phases resolve to 6e-8 of a period."""
    twilight = made.system.detector.twilight_ns > 0.0
    check(ENGINES["exact"], made, ENGINES["sequential"], EVERYTHING - ({INTERVALS} if twilight else set()))


def mean_is(result: np.ndarray, expected: float, about: str) -> None:
    """The mean of independent numbers is the expected one."""
    z = (result.mean() - expected) / (result.std(ddof=1) / np.sqrt(result.size))
    require({"mean": float(2 * stats.norm.sf(abs(z)))}, about)


def bits_do_not_depend(flux: ml.Flux, system: ml.System, engine: str = "exact") -> None:
    """On vector level, threads, and the part of the image; histograms are those of the timestamps."""
    options = {"engine": engine, "seed": 9}
    whole = ml.simulate(flux, system, realizations=2, **options)
    for level in _core.levels() if engine == "exact" else ():
        assert np.array_equal(ml.simulate(flux, system, engine=ExactEngine(level), seed=9, realizations=2), whole)
    for threads in (1, 3):
        assert np.array_equal(ml.simulate(flux, system, realizations=2, threads=threads, **options), whole)
    height, width = flux.shape
    rows, columns = slice(1, max(2, height - 2)), slice(width // 4, width)
    index = np.arange(height * width).reshape(height, width)[rows, columns]
    again = ml.simulate(flux[rows, columns], system, first_realization=1, pixel_index=index, **options)
    assert np.array_equal(again[0], whole[1, rows, columns])
    times = ml.simulate_timestamps(flux, system, realization=1, **options)
    assert np.array_equal(times.histogram(), whole[1])
