"""Mean histograms of finite exposures in every mode of the detector, and their shape by three methods."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import PLAIN, Cells, fine_histograms
from mars_lidar.statistics.chain import PhaseChain, Rearm
from mars_lidar.statistics.electronics import ELECTRONICS_MODES, moments, stationary_records
from mars_lidar.statistics.moments import normalised, refined_moments, stationary_histogram
from mars_lidar.statistics.paralyzable import paralyzable_histograms
from mars_lidar.statistics.synchronous import cumulants_of, first_arrivals, synchronous_pmfs
from mars_lidar.statistics.timing import recorded
from mars_lidar.statistics.tolerances import LAW, TOL

# --- Mean histogram ------------------------------------------------------------------------------------------------


@checked
def mean_histogram(
    flux: Flux, system: System, *, tolerance: float = TOL.law_tolerance, threads: int | None = None
) -> FloatArray:
    """Mean histogram of the finite exposure, exact for every mode of the detector.

    It sums to the mean count and includes jitter, code widths and, for modes ``"nonparalyzable"`` and ``"gated"``, the
    dead time of the electronics (to 1e-3, see `electronics_moments`).

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), photons per period, and the system; a gate must be fixed.
    tolerance
        The grid is refined until the result moves by less than this, in [1e-9, 0.1] (`Exposure.movement`).
    threads
        Threads to run on; default: all processors that this process may use.

    Returns
    -------
    NDArray
        (..., bins) expected registrations in `System.cycles` periods.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        A tolerance out of range, a moving gate, or effects whose mean is not known: afterpulses, twilight pulses, slow
        recovery, crosstalk, limits of events, and electronics dead time in other modes.
    ConvergenceError
        No grid meets the tolerance, or the exposure is too long to be computed; the message names the cell.

    See Also
    --------
    registration_pdf, photons_per_bin, joint_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> light = ml.Flux(signal=1.0, background=1.0, delay_ns=40.0)
    >>> mean = ml.mean_histogram(light, system)
    >>> mean.shape, round(float(mean.sum()), 1)
    ((128,), 815.2)
    """
    cells = Cells.of_flux(flux, system, what="mean_histogram", modes=MODES, effects=histogram_effects(system))
    return mean_histograms(cells, tolerance, threads).reshape(*cells.shape, system.bins)


def histogram_effects(system: System) -> tuple[str, ...]:
    """Effects of the detector that the mean histogram treats in the mode of `system`."""
    slow = ("electronics_dead_time_ns",) if system.detector.mode in ELECTRONICS_MODES else ()
    return (*LIGHT_EFFECTS, *slow, *TIMING_EFFECTS)


def mean_histograms(cells: Cells, tolerance: float, threads: int | None) -> FloatArray:
    """`mean_histogram` of checked cells: (cells, bins)."""
    if "electronics_dead_time_ns" in cells.system.detector.effects:
        return moments(cells, max(tolerance, TOL.records), LAW).histogram.reshape(cells.size, cells.system.bins)
    return recorded(cells, lambda some, parts: _registrations(some, parts, tolerance, threads), tolerance)


def _registrations(cells: Cells, bins: int, tolerance: float, threads: int | None) -> FloatArray:
    mode = cells.system.detector.mode
    if mode == "synchronous":
        armed = first_arrivals(cells)
        registered = np.maximum(armed.sum(-1), np.finfo(float).tiny)
        mean = np.array([cumulants_of(law)[0] for law in synchronous_pmfs(cells)])
        return np.asarray(armed * (mean / registered)[:, None], dtype=np.float64)
    if mode == "paralyzable":
        return paralyzable_histograms(cells, tolerance)
    if cells.system.start == "stationary" and cells.system.dead_time_periods > 0.0:
        # every period has the same mean: the cost, and a refusal, do not depend on the number of cycles
        cycles = cells.system.cycles
        return cycles * stationary_histogram(cells, bins, tolerance=tolerance, threads=threads, periods=cycles)

    def compute(some: Cells, bins: int) -> FloatArray:
        exposure = refined_moments(some, bins, tolerance=tolerance, threads=threads, budget=LAW)
        return exposure.histogram.reshape(some.size, bins)

    return fine_histograms(cells, bins, tolerance, compute)


# --- Shape ---------------------------------------------------------------------------------------------------------


@checked
def registration_pdf(
    flux: Flux,
    system: System,
    method: Literal["exposure", "stationary", "chain"] = "exposure",
    *,
    rearm: Rearm | None = None,
    tolerance: float = TOL.law_tolerance,
    threads: int | None = None,
) -> FloatArray:
    """Shape of the mean histogram: the distribution of registrations over the bins of the period.

    Parameters
    ----------
    flux, system, tolerance, threads
        As `count_law`.
    method
        - ``"exposure"``: mean histogram of the finite exposure, the mean of measurements,
        - ``"stationary"``: that of one period of a stationary pixel,
        - ``"chain"``: stationary distribution of the Markov chain of phases (arXiv 2509.20500), for detectors
          of mode ``"nonparalyzable"``; the first two are for every mode (docs/detectors.md), and for dead time of the
          electronics (to 1e-3 in total variation) with modes ``"nonparalyzable"`` and ``"gated"``.
    rearm
        ``"centre"`` (default) or ``"edge"`` of the bin, for ``"chain"`` only.

    Returns
    -------
    NDArray
        (..., bins), non-negative; sums to 1 over the last axis. A cell without any flux has the uniform
        shape, the limit of little background.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        An unknown `method`, `rearm` without ``"chain"``, or a detector that the method does not describe.
    ConvergenceError
        No grid meets the tolerance; the message names the cell.

    See Also
    --------
    count_law, joint_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> pdf = ml.registration_pdf(ml.Flux(signal=1.0, background=1.0, delay_ns=40.0), system)
    >>> pdf.shape
    (128,)
    """
    edge = rearm_of(rearm, method == "chain", f"method {method!r}")
    cells = Cells.of_flux(
        flux,
        system,
        what=f"registration_pdf of method {method!r}",
        modes=PLAIN if method == "chain" else MODES,
        effects=LIGHT_EFFECTS if method == "chain" else histogram_effects(system),
    )
    if method == "chain":
        shape = _chain_shapes(cells, edge)
    elif method == "exposure" or system.detector.mode == "synchronous":  # every exposure has the same shape
        shape = mean_histograms(cells, tolerance, threads)
    elif system.detector.mode == "paralyzable":
        warm = replace(cells, system=system.replace(start="stationary"))
        shape = mean_histograms(warm, tolerance, threads)
    elif "electronics_dead_time_ns" in system.detector.effects:
        shape = stationary_records(cells, tolerance=tolerance, threads=threads)
    else:
        shape = recorded(
            cells,
            lambda some, parts: stationary_histogram(some, parts, tolerance=tolerance, threads=threads),
            tolerance,
        )
    return normalised(shape).reshape(*cells.shape, system.bins)


def rearm_of(rearm: Rearm | None, used: bool, by: str) -> Rearm:
    """The argument `rearm`, which must be None unless the chain is `used`."""
    if rearm is not None and not used:
        raise ValueError(f"rearm must be None for {by}, which has no such option, got {rearm!r}")
    return rearm or "centre"


def chain_of(cells: Cells, k: int, edge: Rearm = "centre") -> PhaseChain | None:
    """The chain of one cell; None where there is no flux."""
    if cells.signal[k] + cells.background[k] == 0.0:
        return None
    return PhaseChain.from_flux(cells.flux(k), cells.system, rearm=edge)


def _chain_shapes(cells: Cells, edge: Rearm) -> FloatArray:
    """Registrations per period (cells, bins), by the chain on its grid, summed into histogram bins."""
    bins = cells.system.bins
    out = np.zeros((cells.size, bins))
    for k in range(cells.size):
        chain = chain_of(cells, k, edge)
        if chain is not None:
            out[k] = chain.stationary().pdf.reshape(bins, -1).sum(-1)
    return out
