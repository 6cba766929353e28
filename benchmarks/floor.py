"""The floor: the least time that any program needs for the same output, by bytes and by instructions."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.config import Config
from benchmarks.timing import in_turn
from mars_lidar import _core

LANES = {"avx512": 16, "avx2": 8, "vector128": 4, "scalar": 1}

# Vector instructions for one registration of each lane, counted from native/exact/{registration,wait}.h, kernel.cpp
# and native/numbers/{random,word_stream}.h, for one Gaussian return and a dead time that is not a whole number of
# periods; loads of constants left out.
PLAIN = {
    "three words of sfc32: 5 additions, 2 shifts, exclusive or": 3 * 8,
    "Gamma(2) number: 5 for the product, 25 for the logarithm, 1 for its lower bound, 1 for its unit": 32,
    "its two parts: integers either way to float32, their rest, the rates": 10,
    "place in the cells of the waits: low bits of two words": 5,
    "cells, whole periods and fractions of the two waits, check for long waits": 2 * 7 + 2,
    "background arrival: add the wait, carry into the next period": 6,
    "place in the pulse's table, interpolation of the energy": 9,
    "energy of the arrival, number of periods, check for tails": 9,
    "its quantile: size, octave cell, line, sign": 7,
    "the earlier of the two arrivals": 8,
    "end of the dead time": 5,
    "laser period and bin, end of exposure": 13,
}
ROTATIONS = 3  # one instruction with AVX-512 and in scalar code, else three
SELECTIONS = 9  # one instruction from AVX2 on, with SSE2 three; the minimum of integers among them
PAIR_LOOKUPS = 2  # of two floats, forward and inverse table of the pulse: per lane an address and a load each
INCREMENTS = 1  # of the histogram: per lane an address and a read-modify-write
VECTOR_PER_CYCLE, ALL_PER_CYCLE = 2.0, 4.0  # issued by large x86-64 cores since about 2015


@dataclass(frozen=True)
class Operations:
    """Least number of instructions per registration at a vector level."""

    vector: float
    scalar: float

    @property
    def total(self) -> float:
        """Vector and scalar."""
        return self.vector + self.scalar

    def seconds(self, hertz: float) -> float:
        """Least time per registration at this clock."""
        return max(self.vector / VECTOR_PER_CYCLE, self.total / ALL_PER_CYCLE) / hertz


def operations(level: str) -> Operations:
    """Of the exact engine, per registration; moves and address arithmetic of a compiler are not counted."""
    rotation = 1 if level in ("avx512", "scalar") else 3
    selection = 3 if level == "vector128" else 1
    group = sum(PLAIN.values()) + ROTATIONS * rotation + SELECTIONS * selection
    per_lane = 2.0 * (PAIR_LOOKUPS + INCREMENTS)
    if level == "scalar":
        return Operations(0.0, group + per_lane)
    return Operations(group / LANES[level], per_lane)


ADDITIONS = 16  # of a round of `_core.addition_chain`


@lru_cache(maxsize=1)
def clock(rounds: int = 400_000, turns: int = 30) -> float:
    """Hertz at which one busy core runs, by a chain of dependent additions, a cycle each.

    The least time of many turns: what interrupts a turn only makes it longer. Processors run faster than the clock
    that their description tells, which therefore gives no least time.
    """
    seconds = []
    for _ in range(turns):
        began = time.perf_counter()
        _core.addition_chain(rounds)
        seconds.append(time.perf_counter() - began)
    return ADDITIONS * rounds / min(seconds)


@dataclass(frozen=True)
class Bandwidth:
    """Bytes per second of `numpy.ndarray.fill`, into memory written before and into fresh memory."""

    warm_one: float
    warm_all: float
    fresh_one: float
    fresh_all: float

    def seconds(self, size: int, *, threads: int, fresh: bool) -> float:
        """Least time to write `size` bytes."""
        single, every = (self.fresh_one, self.fresh_all) if fresh else (self.warm_one, self.warm_all)
        return size / (single if threads == 1 else every)


def measure_bandwidth(config: Config) -> Bandwidth:
    """On an array as large as the canonical cube, by one thread and by all."""
    size = config.pixels * config.bins * 2
    warm = np.ones(size // 8, np.uint64)
    with ThreadPoolExecutor(config.threads) as pool:

        def fill(array: NDArray[np.uint64], threads: int) -> None:
            list(pool.map(lambda part: part.fill(0), np.array_split(array, threads)))

        times = in_turn(
            {
                "warm_one": lambda: warm.fill(0),
                "warm_all": lambda: fill(warm, config.threads),
                "fresh_one": lambda: np.empty_like(warm).fill(0),
                "fresh_all": lambda: fill(np.empty_like(warm), config.threads),
            },
            config,
        )
    return Bandwidth(**{name: size / timing.median for name, timing in times.items()})
