"""How the entries of a table are evaluated: by the exact recursion, or by the method of the MaRS paper."""

from __future__ import annotations

from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import cell_name, default_bins
from mars_lidar.statistics.chain import PhaseChain, Rearm
from mars_lidar.statistics.renewal import holding_times
from mars_lidar.table.entries import Entries, exposure_entries
from mars_lidar.table.nodes import Method

_BLOCK = 32


@dataclass(frozen=True, eq=False)
class Recipe:
    """How entries are evaluated."""

    method: Method
    rearm: Rearm
    tolerance: float
    threads: int

    def entries(
        self, signal: FloatArray, background: FloatArray, system: System, progress: Progress | None = None
    ) -> Entries:
        """Entries of cells (n,)."""
        if self.method == "mars":
            return renewal_entries(
                signal, background, system, rearm=self.rearm, threads=self.threads, progress=progress
            )
        return exposure_entries(
            signal, background, system, tolerance=self.tolerance, threads=self.threads, progress=progress
        )


def renewal_entries(
    signal: FloatArray,
    background: FloatArray,
    system: System,
    *,
    rearm: Rearm,
    threads: int,
    progress: Progress | None,
) -> Entries:
    """Entries (n,) of N ~ Normal(t / mu, t sigma^2 / mu^3) and of the chain's stationary shape (arXiv 2512.04924).

    The sum of the covariances of the holding times is not truncated: it is what the paper's L lags and p
    eigenpairs approximate (docs/theory.md, 3.10). Asymptotic in the exposure, so linear in it from 1 period on;
    the start of the exposure, and with it the delay, is unknown to this law. Third and fourth cumulants are those
    of a Gaussian, 0.
    """
    n, bins = signal.size, default_bins(system)
    energy = np.maximum(system.pulse.bin_energy(0.5 * system.period_ns, system.period_ns, bins), 0.0)
    rates = np.zeros((n, 4))
    shape = np.full((n, system.bins), 1.0 / system.bins, dtype=np.float32)

    def block(start: int) -> int:
        stop = min(start + _BLOCK, n)
        for k in range(start, stop):
            photons = signal[k] * energy + background[k] / bins
            if photons.any():
                name = cell_name(float(signal[k]), float(background[k]), system)
                times = holding_times(PhaseChain(photons, system.dead_time_periods, rearm, name))
                rates[k, :2] = 1.0 / times.mu, times.sigma2 / times.mu**3
                shape[k] = times.stationary.pdf.reshape(system.bins, -1).sum(-1)
        return stop - start

    with ThreadPoolExecutor(max(1, threads)) as pool:
        waiting = {pool.submit(block, start) for start in range(0, n, _BLOCK)}
        try:
            while waiting:
                done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_EXCEPTION)
                for future in done:
                    future.result()
                if progress is not None:
                    progress(n - min(n, _BLOCK * len(waiting)), n)
        except BaseException:  # Ctrl-C as well: what has not begun never does
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return Entries(
        cycles=system.cycles,
        cumulants=system.cycles * rates,
        rates=rates,
        enough=np.ones(n, np.int64),
        bins=np.full(n, bins, np.int64),
        shape=shape,
        startup=None,
    )
