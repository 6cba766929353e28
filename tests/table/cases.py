"""Systems and tables that the tests of this folder share; times in periods of 100 ns."""

import functools

from harness import system_of

import mars_lidar as ml


def table_system(dead=0.6, cycles=200, **more):
    return system_of(dead, cycles, 32, sigma=0.02, **more)


@functools.cache
def small_table(start="armed", method="exposure"):
    return ml.Table.build(
        table_system(start=start), (0.02, 10.0, 32), (0.05, 5.0, 24), method=method, tolerance=1e-6, threads=2
    )
