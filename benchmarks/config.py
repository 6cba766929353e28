"""What is run: sizes, repetitions and time limits of one run of the benchmarks."""

from __future__ import annotations

import os
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Config:
    """One run. Times in seconds; counts of pixels, cycles and registrations are per case.

    `repeats` turns at most, and no new turn once a group of cases has used `seconds`. `budget` limits the
    photons that reach the pixels in one case of a sweep, so that the sequential simulator can follow.
    """

    mode: str
    side: int = 128
    bins: int = 1024
    cycles: int = 1000
    repeats: int = 7
    seconds: float = 10.0
    budget: float = 4e6
    fluxes: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
    exposures: tuple[int, ...] = (10, 100, 1000, 10_000, 100_000)
    images: tuple[int, ...] = (1, 16, 256, 4096, 16_384, 65_536)
    loop_pixels: int | None = 1024  # of the NumPy loop; None: all, nothing scaled
    chain_bins: int = 16_384
    dense_bins: int = 1024
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
    budget=5e5,
    fluxes=(1e-3, 1e-1, 10.0),
    exposures=(10, 1000, 100_000),
    images=(1, 256, 4096),
    loop_pixels=128,
    dense_bins=256,
    table_entries=32,
    starts=5,
    commands=1,
)
DEFAULT = Config(mode="default")
FULL = Config(
    mode="full",
    repeats=21,
    seconds=40.0,
    budget=1.6e7,
    images=(1, 16, 256, 4096, 16_384, 65_536, 262_144),
    loop_pixels=None,
    table_entries=25_600,
    commands=7,
)
