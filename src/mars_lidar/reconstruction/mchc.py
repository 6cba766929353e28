"""Markov-chain histogram correction: Rapp et al., Dead time compensation for high-flux ranging, IEEE TSP 2019."""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.method import _CHAIN, RateMethod


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
    mchc_rates, GeneralisedCoates, mars_lidar.reconstruct

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
    """

    iterations: int = 60
    tolerance: float = 1e-5

    correction = _CHAIN
    name = "mchc"
    modes = ("nonparalyzable", "gated")
    assumes = "a long exposure, in which the phases are stationary"

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


@checked
def mchc_rates(
    cube: ArrayLike,
    system: System,
    *,
    total: ArrayLike | None = None,
    iterations: int = 60,
    tolerance: float = 1e-5,
    threads: int | None = None,
) -> FloatArray:
    """Photons per period in each bin from histograms, by `ChainCorrection`.

    Parameters
    ----------
    cube
        (..., bins) counts.
    system
        The system that recorded them.
    total
        Total photons per period, a scalar or (...), if known, for example from the times between registrations; None:
        the sum of `generalised_coates_rates`.
    iterations, tolerance
        As for `ChainCorrection`.
    threads
        Threads to run on; default: all processors that this process may use.

    Returns
    -------
    NDArray
        (..., bins) photons per period.

    Raises
    ------
    TypeError
        Counts that are not an array of numbers, or not a `System`.
    ValueError
        Counts that are not whole numbers >= 0 or have another number of bins; arguments out of range; a detector to
        which the method does not apply.

    See Also
    --------
    ChainCorrection, generalised_coates_rates

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)
    >>> rates = ml.reconstruction.mchc_rates(counts, system)
    >>> rates.shape, round(float(rates.sum()), 1)  # S + B = 2
    ((1, 1, 1, 128), 1.9)
    """
    return ChainCorrection(iterations=iterations, tolerance=tolerance).rates(cube, system, threads, total)
