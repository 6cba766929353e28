"""Timing of cases in turn, in one process."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from benchmarks.config import Config

Case = Callable[[], object]


@dataclass(frozen=True)
class Timing:
    """Wall and CPU seconds (of all threads) of each turn."""

    wall: tuple[float, ...]
    cpu: tuple[float, ...]

    @property
    def median(self) -> float:
        """Wall seconds."""
        return statistics.median(self.wall)

    @property
    def least(self) -> float:
        """Wall seconds."""
        return min(self.wall)

    @property
    def cpu_median(self) -> float:
        """CPU seconds."""
        return statistics.median(self.cpu)

    def ratio(self, other: Timing) -> float:
        """Wall time over another's, median over the turns: noise that lasts longer than a turn cancels."""
        return statistics.median(a / b for a, b in zip(self.wall, other.wall, strict=True))

    def cpu_ratio(self, other: Timing) -> float:
        """The same of CPU time."""
        return statistics.median(a / b for a, b in zip(self.cpu, other.cpu, strict=True))


def in_turn(cases: Mapping[str, Case], config: Config) -> dict[str, Timing]:
    """Run all cases once a turn, each turn beginning with another case, until repeats or seconds are used up.

    A first turn warms up caches, pages and clocks and is not counted, unless it alone uses up the time.
    """
    names = list(cases)
    began = time.perf_counter()
    turns = [_turn(names, cases)]
    if time.perf_counter() - began < config.seconds:
        turns.clear()
    while not turns or (len(turns) < config.repeats and time.perf_counter() - began < config.seconds):
        first = len(turns) % len(names)
        turns.append(_turn(names[first:] + names[:first], cases))
    return {
        name: Timing(tuple(turn[name][0] for turn in turns), tuple(turn[name][1] for turn in turns)) for name in names
    }


def _turn(names: list[str], cases: Mapping[str, Case]) -> dict[str, tuple[float, float]]:
    return {name: _once(cases[name]) for name in names}


def _once(case: Case) -> tuple[float, float]:
    gc.collect()
    gc.disable()
    try:
        wall, cpu = time.perf_counter(), time.process_time()
        result = case()
        spent = time.perf_counter() - wall, time.process_time() - cpu
    finally:
        gc.enable()
    del result  # giving memory back is not part of the work
    return spent
