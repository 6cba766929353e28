"""Methods that correct the rates of a histogram for the periods in which the pixel was not armed.

Coates, J. Phys. E 1, 878 (1968), exact for synchronous detectors. Generalised to free-running detectors by Gupta,
Ingle, Gupta, Asynchronous single-photon 3D imaging, ICCV 2019; extended here to bins of any brightness, dead times of
any length, and both ends of the exposure (docs/reconstruction.md). Markov-chain histogram correction: Rapp et al., Dead
time compensation for high-flux ranging, IEEE TSP 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar._base import checks
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.method import _CHAIN, RateMethod


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
    GeneralisedCoates, ChainCorrection, mars_lidar.reconstruct

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
    >>> int(ml.reconstruction.Coates().rates(counts, system)[0, 0, 0].argmax())  # the bin of 40 ns
    51
    """

    name = "coates"
    modes = ("synchronous",)


@dataclass(frozen=True)
class GeneralisedCoates(RateMethod):
    """Rates whose expected registrations equal those of the bins, with the armed time of the histogram (R8).

    No pulse shape is assumed. The variance of a dim bin's rate l is l / D, with D its armed periods, and bins are
    independent.

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
    Coates, ChainCorrection, mars_lidar.reconstruct

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
    >>> rates = ml.reconstruction.GeneralisedCoates().rates(counts, system)
    >>> rates.shape, round(float(rates.sum()), 1)  # S + B = 2
    ((1, 1, 1, 128), 1.9)
    """

    name = "generalised_coates"
    modes = ("nonparalyzable", "gated")


@dataclass(frozen=True)
class ChainCorrection(RateMethod):
    """Rates whose Markov chain of phases has the histogram f as its stationary distribution.

    ``l <- f; repeat s = (f P(l)) / l, l <- f / s``, scaled to the total flux (R14, R15). The paper estimates the total
    from the times between registrations, which a histogram does not contain; here it is that of `GeneralisedCoates`
    (the number of registrations alone hardly determines it for bright pixels). Phases are assumed stationary: the
    start and the end of the exposure are neglected.

    Parameters
    ----------
    filter
        On the rates: as for `MatchedFilter`.
    iterations, tolerance
        Iteration stops when the rates change by less than `tolerance` of their sum, or after so many iterations.

    Raises
    ------
    ValueError
        An invalid filter, number of iterations or tolerance; ``check``: a detector of another mode than
        ``"nonparalyzable"``, or a dead time below one bin.

    See Also
    --------
    GeneralisedCoates, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.ChainCorrection(filter="linear"))
    >>> abs(float(maps.delay_ns[0, 0, 0]) - 40.0) < 1.0
    True
    >>> round(float(ml.reconstruction.ChainCorrection().rates(counts, system).sum()), 1)  # S + B = 2
    1.9
    """

    iterations: int = 60
    tolerance: float = 1e-5

    correction = _CHAIN
    name = "mchc"
    modes = ("nonparalyzable", "gated")

    def __post_init__(self) -> None:
        super().__post_init__()
        count = checks.integer("iterations", self.iterations, low=1, high=100_000)
        object.__setattr__(self, "iterations", count)
        checks.real("tolerance", self.tolerance, low=0.0, high=0.1, strict_low=True)

    def check(self, system: System) -> None:
        """As for any method; the dead time of `system` must be at least one bin."""
        super().check(system)
        if system.detector.dead_time_ns < system.bin_ns:
            raise ValueError(
                f"method 'mchc' needs a dead time of at least one bin ({system.bin_ns:g} ns), got "
                f"{system.detector.dead_time_ns:g} ns; use 'generalised_coates'"
            )

    @property
    def settings(self) -> dict[str, float]:
        """Number of iterations, and the tolerance."""
        return {"steps": self.iterations, "tolerance": self.tolerance}
