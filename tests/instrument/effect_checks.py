"""What every effect of the detector is tested for: bits, means, and refusals where no law knows it."""

from typing import Any

import numpy as np
from harness import EVERYTHING, INTERVALS, Case, check, require
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


def bits_do_not_depend(flux: ml.Flux, system: ml.System, engine: str = "exact", **options: Any) -> None:
    """On vector level, threads, and the part of image and realizations; histograms are those of the timestamps."""
    given = {"engine": engine, "seed": 9, **options}
    whole = ml.simulate(flux, system, realizations=4, threads=1, **given)
    for threads in (2, 5, None):
        assert np.array_equal(ml.simulate(flux, system, realizations=4, threads=threads, **given), whole)
    height, width = flux.shape
    index, random = np.arange(height * width).reshape(height, width), np.random.default_rng(0)
    for _ in range(4):
        rows, columns, run = (slice(*np.sort(random.choice(n + 1, 2, replace=False))) for n in (height, width, 4))
        part = {"realizations": run.stop - run.start, "first_realization": int(run.start)}
        again = ml.simulate(flux[rows, columns], system, pixel_index=index[rows, columns], **part, **given)
        assert np.array_equal(again, whole[run, rows, columns])
    if engine not in ("exact", "sequential"):
        return
    times = ml.simulate_timestamps(flux, system, realization=1, **given)
    assert np.array_equal(times.histogram(), whole[1])
    for level in _core.levels() if engine == "exact" else ():
        given["engine"] = ExactEngine(level)
        assert np.array_equal(ml.simulate(flux, system, realizations=4, **given), whole)
        same = ml.simulate_timestamps(flux, system, realization=1, threads=3, **given)
        for name in ("times_ns", "cycle", "bin"):
            assert np.array_equal(getattr(same, name), getattr(times, name))
