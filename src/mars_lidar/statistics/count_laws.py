"""`count_law`: the law of the count of a pixel, exact, Gaussian (MaRS, renewal) or Poisson."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from mars_lidar._base.arguments import checked
from mars_lidar._base.cached import cached_property
from mars_lidar._base.display import as_html
from mars_lidar._base.resources import thread_count
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import PLAIN, Cells
from mars_lidar.statistics.chain import Rearm
from mars_lidar.statistics.constant_light import renewal_moments
from mars_lidar.statistics.electronics import record_pmfs
from mars_lidar.statistics.histogram import chain_of, histogram_effects, rearm_of
from mars_lidar.statistics.moments import Exposure, OfCumulants, refined_moments
from mars_lidar.statistics.pmf import Pmf, exact_pmfs, gaussian_pmf, poisson_pmf
from mars_lidar.statistics.renewal import holding_times
from mars_lidar.statistics.synchronous import cumulants_of, synchronous_pmfs
from mars_lidar.statistics.tolerances import LAW, TOL

Method = Literal["exact", "mars", "renewal", "poisson"]


class CountLaw(OfCumulants):
    """Law of the number N of registrations in an exposure, for pixels of shape (...); returned by `count_law`.

    `support`, `pmf` and `cdf` are computed on first use.

    Attributes
    ----------
    system
        Laser, detector and histogram.
    method
        Method of `count_law`.
    cumulants
        (..., 4) mean, variance, third and fourth cumulant of N.
    evaluate
        Argument only, no attribute: function that returns the law of each cell, called on first use.
    exposure
        The `Exposure` from which an exact law is computed (its histogram has a single bin); None for the other methods,
        for mode ``"synchronous"`` and behind electronics with a dead time.

    See Also
    --------
    count_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> light = ml.Flux(signal=1.0, background=1.0, delay_ns=40.0)
    >>> law = ml.count_law(light, system)
    >>> bool(abs(law.pmf.sum() - 1) < 1e-9)
    True
    >>> int(law.support[law.pmf.argmax()])
    815
    """

    def __init__(
        self,
        system: System,
        method: str,
        cumulants: FloatArray,
        evaluate: Callable[[], list[Pmf]],
        exposure: Exposure | None = None,
    ) -> None:
        self.system = system
        self.method = method
        self.cumulants = cumulants
        self.exposure = exposure
        self._evaluate = evaluate

    @cached_property
    def _laws(self) -> list[Pmf]:
        return self._evaluate()

    @cached_property
    def support(self) -> IndexArray:
        """Consecutive counts (..., w) to which `pmf` and `cdf` refer; each cell has its own first count."""
        first = np.array([law.first for law in self._laws]).reshape(self._shape)
        return np.asarray(first[..., None] + np.arange(self._width), dtype=np.int64)

    @cached_property
    def pmf(self) -> FloatArray:
        """P(N = n) (..., w) for n in `support`; the probability of other counts is at most `outside`.

        For the Gaussian laws ("mars", "renewal") the normal density integrated from n - 1/2 to n + 1/2; P(0) includes
        the probability below 0.
        """
        out = np.zeros((len(self._laws), self._width))
        for row, law in zip(out, self._laws, strict=True):
            row[: law.p.size] = law.p
        return out.reshape(*self._shape, self._width)

    @cached_property
    def cdf(self) -> FloatArray:
        """P(N <= n) (..., w) for n in `support`."""
        return np.minimum(np.cumsum(self.pmf, axis=-1), 1.0)

    @cached_property
    def outside(self) -> FloatArray:
        """Bound (...) on the probability outside `support`, and thus on the aliasing of an exact pmf."""
        return np.array([law.outside for law in self._laws]).reshape(self._shape)

    @property
    def _shape(self) -> tuple[int, ...]:
        return self.cumulants.shape[:-1]

    @cached_property
    def _width(self) -> int:
        return max(law.p.size for law in self._laws)

    def __getstate__(self) -> dict[str, Any]:
        """The law with its probabilities, because the function that evaluates them cannot be pickled."""
        laws = self._laws
        return {name: value for name, value in self.__dict__.items() if name != "_evaluate"} | {"_laws": laws}

    def _repr_html_(self) -> str:
        if self.cumulants.ndim == 1:
            return as_html(self, {"probability of N registrations": (self.support, self.pmf)})
        return as_html(self, {"mean count": self.mean} if self.cumulants.ndim == 3 else {})

    def __repr__(self) -> str:
        if self._shape:
            return f"CountLaw(method={self.method!r}, cells of shape {self._shape})"
        return f"CountLaw(method={self.method!r}, mean {self.mean:.6g}, variance {self.variance:.6g})"


@checked
def count_law(
    flux: Flux,
    system: System,
    method: Method = "exact",
    *,
    rearm: Rearm | None = None,
    tolerance: float = TOL.law_tolerance,
    threads: int | None = None,
) -> CountLaw:
    """Law of the number of registrations in one exposure.

    Parameters
    ----------
    flux
        The light of pixels of shape (...); with an armed start the law depends on the delay.
    system
        Laser, detector and histogram (the bins have no influence).
    method
        - ``"exact"``: finite exposure, start and end included, any dead time and every mode of the detector
          (docs/theory_exposure.md, docs/detectors.md); with electronics dead time for modes ``"nonparalyzable"`` and
          ``"gated"``, to 1e-3 (see `electronics_moments`),
        - ``"mars"``: the Gaussian of the MaRS paper (arXiv 2512.04924), the limit of long exposures: it depends neither
          on the start nor, except through the grid, on the delay,
        - ``"renewal"``: the Gaussian of a constant-rate renewal process of equal energy, mean
          lambda t / (1 + lambda t_d) and variance lambda t / (1 + lambda t_d)^3,
        - ``"poisson"``: no dead time, the law of the arrivals (within the gate) for every mode.
    rearm
        ``"centre"`` (default) or ``"edge"`` of the bin, for ``"mars"`` only: where its chain re-arms.
    tolerance
        For ``"exact"``: see `exposure_moments`.
    threads
        Number of threads; default: all processors that this process may use.

    Returns
    -------
    CountLaw
        For cells of shape (...).

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        An unknown `method`, a tolerance out of range, or a detector that the method does not describe: with a moving
        gate, afterpulses, twilight pulses, slow recovery, crosstalk or limits of events; with electronics dead time,
        but for ``"exact"`` in the modes above; for ``"mars"`` and ``"renewal"``, of another mode than
        ``"nonparalyzable"``; for ``"mars"``, with jitter or code widths.
    ConvergenceError
        No grid meets the tolerance, or the exposure is too long to be computed; the message names the cell.

    See Also
    --------
    joint_law, registration_pdf, simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> light = ml.Flux(signal=1.0, background=1.0, delay_ns=40.0)
    >>> law = ml.count_law(light, system)
    >>> round(float(law.mean), 2), round(float(law.variance), 2)
    (815.17, 127.32)
    >>> round(float(ml.count_law(light, system, method="poisson").variance), 2)
    2000.0
    """
    edge = rearm_of(rearm, method == "mars", f"method {method!r}")
    cells = Cells.of_flux(
        flux,
        system,
        what=f"count_law of method {method!r}",
        modes=PLAIN if method in ("mars", "renewal") else MODES,
        effects=histogram_effects(system) if method == "exact" else LIGHT_EFFECTS + TIMING_EFFECTS,
    )
    team = thread_count(threads)
    slow = "electronics_dead_time_ns" in cells.system.detector.effects
    if method == "exact" and (slow or system.detector.mode == "synchronous"):
        laws = record_pmfs(cells, max(tolerance, TOL.records), team) if slow else synchronous_pmfs(cells)
        recorded_cumulants = np.array([cumulants_of(law) for law in laws]).reshape(*cells.shape, 4)
        return CountLaw(system, method, recorded_cumulants, lambda: laws)
    if method == "exact":
        exposure = refined_moments(cells, 1, tolerance=tolerance, threads=team, budget=LAW)
        flat, bins = exposure.cumulants.reshape(-1, 4), exposure.bins.reshape(-1)
        return CountLaw(system, method, exposure.cumulants, lambda: exact_pmfs(cells, flat, bins, team), exposure)
    if method == "poisson":
        means = system.cycles * cells.total
        cumulants = np.repeat(means[:, None], 4, axis=1).reshape(*cells.shape, 4)
        return CountLaw(system, method, cumulants, lambda: [poisson_pmf(float(m)) for m in means])
    mean, variance = _gaussian_moments(method, cells, edge)
    cumulants = np.zeros((*cells.shape, 4))
    cumulants[..., 0], cumulants[..., 1] = mean.reshape(cells.shape), variance.reshape(cells.shape)
    return CountLaw(
        system,
        method,
        cumulants,
        lambda: [gaussian_pmf(float(m), float(v)) for m, v in zip(mean, variance, strict=True)],
    )


def _gaussian_moments(method: str, cells: Cells, edge: Rearm) -> tuple[FloatArray, FloatArray]:
    """Mean and variance (cells,) of the Gaussian laws."""
    if method == "renewal":
        return renewal_moments(cells.signal + cells.background, cells.system)
    mean, variance = np.zeros(cells.size), np.zeros(cells.size)
    for k in range(cells.size):
        chain = chain_of(cells, k, edge)
        if chain is not None:
            times = holding_times(chain)
            mean[k], variance[k] = cells.system.cycles / times.mu, cells.system.cycles * times.sigma2 / times.mu**3
    return mean, variance
