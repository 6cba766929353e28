"""Coates' correction: registrations of each bin over the periods in which the pixel was armed in it.

Coates, J. Phys. E 1, 878 (1968), exact for synchronous detectors. Generalised to free-running detectors by Gupta,
Ingle, Gupta, Asynchronous single-photon 3D imaging, ICCV 2019; extended here to bins of any brightness, dead times of
any length, and both ends of the exposure (docs/reconstruction.md).
"""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.method import RateMethod


@dataclass(frozen=True)
class Coates(RateMethod):
    """Rates ``l_j = ln[E_j / (E_j - h_j)]``, E_j the armed periods without a registration before bin j (R4, R8).

    For detectors of mode ``"synchronous"``.

    Parameters
    ----------
    filter
        On the rates: as for `MatchedFilter`.

    Raises
    ------
    ValueError
        An unknown filter; ``check``: a detector of another mode.

    See Also
    --------
    coates_rates, GeneralisedCoates, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> system = system.replace(detector=ml.Detector(dead_time_ns=75.0, mode="synchronous"))
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.Coates(filter="linear"))
    >>> abs(float(maps.delay_ns[0, 0, 0]) - 40.0) < 1.0
    True
    """

    name = "coates"
    modes = ("synchronous",)
    assumes = "nothing: exact for synchronous detectors"


@checked
def coates_rates(cube: ArrayLike, system: System, *, threads: int | None = None) -> FloatArray:
    """Photons per period in each bin from histograms of a synchronous detector.

    Parameters
    ----------
    cube
        (..., bins) counts.
    system
        The system that recorded them, of mode ``"synchronous"``.
    threads
        Threads to run on; default: all processors that this process may use.

    Returns
    -------
    NDArray
        (..., bins) photons per period; infinite in bins with a registration in every remaining armed period.

    Raises
    ------
    TypeError
        Counts that are not an array of numbers, or not a `System`.
    ValueError
        Counts that are not whole numbers >= 0, or more than the periods; another mode; effects that cannot be
        corrected.

    See Also
    --------
    Coates, generalised_coates_rates

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> system = system.replace(detector=ml.Detector(dead_time_ns=75.0, mode="synchronous"))
    >>> counts = ml.simulate(ml.Flux(1.0, 0.1, 40.0), system, seed=0)
    >>> rates = ml.reconstruction.coates_rates(counts, system)
    >>> rates.shape, int(rates[0, 0, 0].argmax())  # the bin of 40 ns
    ((1, 1, 1, 128), 51)
    """
    return Coates().rates(cube, system, threads)


@dataclass(frozen=True)
class GeneralisedCoates(RateMethod):
    """Rates whose expected registrations equal those of the bins, with the armed time of the histogram (R8).

    `filter` on the rates: as for `MatchedFilter`.

    Parameters
    ----------
    filter
        On the rates: as for `MatchedFilter`.

    Raises
    ------
    ValueError
        An unknown filter; ``check``: a detector of another mode.

    See Also
    --------
    generalised_coates_rates, Coates, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.GeneralisedCoates(filter="linear"))
    >>> abs(float(maps.delay_ns[0, 0, 0]) - 40.0) < 1.0
    True
    """

    name = "generalised_coates"
    modes = ("nonparalyzable", "gated")
    assumes = "nothing of the flux but its period"


@checked
def generalised_coates_rates(cube: ArrayLike, system: System, *, threads: int | None = None) -> FloatArray:
    """Photons per period in each bin from histograms of a free-running detector.

    No pulse shape is assumed. The variance of a dim bin's rate l is l / D, with D its armed periods, and bins are
    independent.

    Parameters
    ----------
    cube
        (..., bins) counts.
    system
        The system that recorded them.
    threads
        Threads to run on; default: all processors that this process may use.

    Returns
    -------
    NDArray
        (..., bins) photons per period; infinite in bins with a registration in every armed period.

    Raises
    ------
    TypeError
        Counts that are not an array of numbers, or not a `System`.
    ValueError
        Counts that are not whole numbers >= 0, or more than the periods allow; a detector to which this does not apply.

    See Also
    --------
    GeneralisedCoates, coates_rates, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)
    >>> rates = ml.reconstruction.generalised_coates_rates(counts, system)
    >>> rates.shape, round(float(rates.sum()), 1)  # S + B = 2
    ((1, 1, 1, 128), 1.9)
    """
    return GeneralisedCoates().rates(cube, system, threads)
