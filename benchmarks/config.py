"""What is run: sizes, repetitions and time limits of one run of the benchmarks."""

from __future__ import annotations

import os
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Config:
    """One run. Times in seconds; counts of pixels, cycles and registrations are per case.

    `repeats` turns at most, and no new turn once a group of cases has used `seconds`.
    """

    mode: str
    side: int = 128
    bins: int = 1024
    cycles: int = 1000
    repeats: int = 7
    seconds: float = 10.0
    table_entries: int = 512  # of 25,600
    starts: int = 10  # of the interpreter, for the time of import
    commands: int = 3  # runs of the command line, and fresh interpreters of each user's call

    @property
    def threads(self) -> int:
        """All processors that this process may use."""
        try:
            return len(os.sched_getaffinity(0))
        except AttributeError:
            return os.cpu_count() or 1

    @property
    def pixels(self) -> int:
        """Of the canonical image."""
        return self.side**2

    def describe(self) -> str:
        """The canonical configuration in words."""
        return (
            f"{self.side} x {self.side} x {self.bins} cube, N_r = {self.cycles}, S and B uniform on "
            "[0.05, 1] photons per period (seeded), t_d = 85 ns, t_r = 133.33 ns, Gaussian pulse of sigma "
            "0.5 ns, armed start"
        )


QUICK = Config(
    mode="quick",
    repeats=3,
    seconds=1.0,
    table_entries=32,
    starts=5,
    commands=1,
)
DEFAULT = Config(mode="default")
FULL = Config(
    mode="full",
    repeats=21,
    seconds=40.0,
    table_entries=25_600,
    commands=7,
)
