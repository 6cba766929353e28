"""Systems and tables that the tests of this folder share; times in periods of 100 ns."""

import functools

import mars_lidar as ml


def make_system(dead=0.6, *, cycles=200, bins=32, sigma=0.02, start="armed"):
    return ml.System(
        period_ns=100.0,
        cycles=cycles,
        bins=bins,
        pulse=ml.GaussianPulse(sigma_ns=100.0 * sigma),
        detector=ml.Detector(dead_time_ns=100.0 * dead),
        start=start,
    )


@functools.cache
def small_table(start="armed", method="exposure"):
    return ml.Table.build(
        make_system(start=start), (0.02, 10.0, 32), (0.05, 5.0, 24), method=method, tolerance=1e-6, threads=2
    )
