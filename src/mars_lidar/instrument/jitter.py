"""Timing jitter: the delay of a recorded time after its avalanche."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import constructed_by_name
from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.instrument.pulse import FWHM_PER_SIGMA, SampledPulse, shape_from_dict
from mars_lidar.instrument.tolerances import TOL


@constructed_by_name
@dataclass(frozen=True, kw_only=True)
class Jitter:
    """Timing jitter: Gaussian difference of a recorded time from its avalanche, plus an exponential delay for a share.

    Parameters
    ----------
    sigma_ns
        Standard deviation of the Gaussian, of mean 0, ns. FWHM = 2.355 sigma; `Jitter.from_fwhm` takes that instead.
    tail_ns
        Mean of the exponential delay of carriers that diffuse into the multiplication region, ns.
    tail_fraction
        Share of the avalanches with this exponential delay, in [0, 1].

    Raises
    ------
    TypeError
        A width or fraction is not a number.
    ValueError
        `sigma_ns` is not positive, or one of `tail_ns` and `tail_fraction` is 0 without the other.

    See Also
    --------
    SampledJitter, Detector

    Examples
    --------
    >>> import mars_lidar as ml
    >>> ml.Detector(dead_time_ns=75.0, jitter=ml.Jitter(sigma_ns=0.1)).jitter.sigma_ns
    0.1
    """

    sigma_ns: float
    tail_ns: float = 0.0
    tail_fraction: float = 0.0

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        set_field(self, "sigma_ns", checks.real("sigma_ns", self.sigma_ns, low=0.0, strict_low=True))
        set_field(self, "tail_ns", checks.real("tail_ns", self.tail_ns, low=0.0))
        set_field(self, "tail_fraction", checks.real("tail_fraction", self.tail_fraction, low=0.0, high=1.0))
        if (self.tail_ns > 0.0) != (self.tail_fraction > 0.0):
            raise ValueError(
                "tail_ns and tail_fraction of a jitter belong together: both positive, or both 0, "
                f"got {self.tail_ns:g} ns and {self.tail_fraction:g}"
            )

    @classmethod
    def from_fwhm(cls, *, fwhm_ns: float, tail_ns: float = 0.0, tail_fraction: float = 0.0) -> Jitter:
        """Jitter whose Gaussian has the full width at half maximum `fwhm_ns` (ns)."""
        sigma = checks.real("fwhm_ns", fwhm_ns, low=0.0, strict_low=True) / FWHM_PER_SIGMA
        return cls(sigma_ns=sigma, tail_ns=tail_ns, tail_fraction=tail_fraction)

    @property
    def std_ns(self) -> float:
        """Standard deviation, ns."""
        f = self.tail_fraction
        return math.sqrt(self.sigma_ns**2 + f * (2.0 - f) * self.tail_ns**2)

    @property
    def finest_ns(self) -> float:
        """Standard deviation of its narrowest feature, ns, that of the Gaussian: a tail does not smooth it."""
        return self.sigma_ns

    def reach_ns(self) -> tuple[float, float]:
        """Interval outside of which less than 1e-16 of the records lie, ns."""
        return -8.5 * self.sigma_ns, 8.5 * self.sigma_ns + 37.0 * self.tail_ns

    def cumulative(self, t_ns: ArrayLike) -> FloatArray:
        """P(jitter <= t) (...) for `t_ns` (...)."""
        from scipy.special import ndtr

        t = np.asarray(t_ns, dtype=np.float64)
        late = self._exponential(t) if self.tail_fraction > 0.0 else 0.0
        return np.asarray(ndtr(t / self.sigma_ns) - self.tail_fraction * late, dtype=np.float64)

    def integral(self, t_ns: ArrayLike) -> FloatArray:
        """Integral of `cumulative` from -infinity to `t_ns` (...), ns."""
        from scipy.special import ndtr

        t = np.asarray(t_ns, dtype=np.float64)
        z = t / self.sigma_ns
        gauss = self.sigma_ns * (z * ndtr(z) + np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))
        if self.tail_fraction == 0.0:
            return np.asarray(gauss, dtype=np.float64)
        # of Gaussian + exponential: density (ndtr - F) / tail, hence the integral of F is that of ndtr - tail F
        return np.asarray(gauss - self.tail_fraction * self.tail_ns * (ndtr(z) - self._exponential(t)))

    def _exponential(self, t: FloatArray) -> FloatArray:
        """P(Gaussian <= t < Gaussian + exponential): Phi(z) minus the law of the sum."""
        from scipy.special import erfcx, ndtr

        z, ratio = t / self.sigma_ns, self.sigma_ns / self.tail_ns
        x = (ratio - z) / math.sqrt(2.0)
        near = np.exp(-0.5 * z * z) * 0.5 * erfcx(np.maximum(x, -5.0))
        exponent = np.minimum(0.5 * ratio * ratio - t / self.tail_ns, 700.0)
        return np.asarray(np.where(x > -5.0, near, np.exp(exponent) * ndtr(z - ratio)), dtype=np.float64)

    def check(self, period_ns: float) -> None:
        """Check sigma, 1e-6 to 1/20 of `period_ns` (8.5 sigma within half a period), and the tail's mean."""
        if not 1e-6 * period_ns <= self.sigma_ns <= TOL.jitter_periods * period_ns:
            raise ValueError(
                f"sigma_ns of a jitter must lie in [{1e-6 * period_ns:g}, {TOL.jitter_periods * period_ns:g}] ns "
                f"(1e-6 to 1/20 period), got {self.sigma_ns:g}"
            )
        if self.tail_ns > period_ns:
            raise ValueError(f"tail_ns of a jitter must be at most the period, {period_ns:g} ns, got {self.tail_ns:g}")

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `jitter_from_dict` makes an equal jitter."""
        tail = {"tail_ns": self.tail_ns, "tail_fraction": self.tail_fraction} if self.tail_fraction > 0.0 else {}
        return {"kind": "gaussian", "sigma_ns": self.sigma_ns, **tail}


@constructed_by_name
@dataclass(frozen=True)
class SampledJitter:
    """A measured jitter: density of the delay of a recorded time after its avalanche, constant on samples.

    Parameters
    ----------
    values
        (n,) non-negative, of positive sum.
    bin_ns
        Sample width, ns; n x bin_ns must fit in the laser period.
    origin
        Where the jitter is 0: ``"peak"``, ``"centroid"`` or ``"first"``, see `SampledPulse`.

    Raises
    ------
    TypeError
        Values or times that are not numbers.
    ValueError
        Samples that are not 1-D, finite and non-negative, or sum to 0.

    See Also
    --------
    Jitter, Detector

    Examples
    --------
    >>> import mars_lidar as ml
    >>> jitter = ml.SampledJitter([1.0, 4.0, 2.0, 1.0], bin_ns=0.05)
    >>> ml.Detector(dead_time_ns=75.0, jitter=jitter).dead_time_ns
    75.0
    """

    values: tuple[float, ...]
    bin_ns: float
    origin: Literal["peak", "centroid", "first"] = "peak"

    def __post_init__(self) -> None:
        shape = SampledPulse(self.values, self.bin_ns, self.origin)
        object.__setattr__(self, "values", tuple(shape.values.tolist()))
        object.__setattr__(self, "bin_ns", shape.bin_ns)

    @cached_property
    def shape(self) -> SampledPulse:
        """The density as a pulse."""
        return SampledPulse(self.values, self.bin_ns, self.origin)

    @property
    def std_ns(self) -> float:
        """Standard deviation, ns."""
        return math.sqrt(max(self._moment(2) - self._moment(1) ** 2, 0.0))

    @property
    def finest_ns(self) -> float:
        """Standard deviation of its narrowest feature, a sample, ns."""
        return self.bin_ns / math.sqrt(12.0)

    def __repr__(self) -> str:
        return f"SampledJitter({len(self.values)} samples, bin_ns={self.bin_ns:g}, origin={self.origin!r})"

    def _moment(self, order: int) -> float:
        edges, mass = self._edges(), np.diff(self.cumulative(self._edges()))
        power = (edges[1:] ** (order + 1) - edges[:-1] ** (order + 1)) / ((order + 1) * np.diff(edges))
        return float(mass @ power)

    def _edges(self) -> FloatArray:
        low, high = self.reach_ns()
        return np.linspace(low, high, round((high - low) / self.bin_ns) + 1)

    def reach_ns(self) -> tuple[float, float]:
        """Interval outside of which no records lie, ns."""
        return self.shape.support_ns()

    def cumulative(self, t_ns: ArrayLike) -> FloatArray:
        """P(jitter <= t) (...) for `t_ns` (...)."""
        return self.shape.cumulative(t_ns)

    def integral(self, t_ns: ArrayLike) -> FloatArray:
        """Integral of `cumulative` from -infinity to `t_ns` (...), ns: quadratic on each sample."""
        t, edges = np.asarray(t_ns, dtype=np.float64), self._edges()
        level = self.cumulative(edges)
        below = np.concatenate([[0.0], np.cumsum(0.5 * (level[1:] + level[:-1]) * np.diff(edges))])
        k = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, edges.size - 2)
        inside = np.clip(t - edges[k], 0.0, edges[k + 1] - edges[k])
        area = below[k] + inside * 0.5 * (level[k] + self.cumulative(edges[k] + inside))
        return np.asarray(area + np.maximum(t - edges[-1], 0.0), dtype=np.float64)

    def check(self, period_ns: float) -> None:
        """The record fits in the period `period_ns`."""
        self.shape.check(period_ns)

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `jitter_from_dict` makes an equal jitter."""
        return {"kind": "sampled", "values": list(self.values), "bin_ns": self.bin_ns, "origin": self.origin}


def jitter_from_dict(data: Any) -> Jitter | SampledJitter:
    """The jitter that `to_dict` described; it is Gaussian where no kind is given."""
    named = {"kind": "gaussian", **data} if isinstance(data, dict) else data
    jitter: Jitter | SampledJitter = shape_from_dict(
        "jitter", named, Jitter, SampledJitter, ("tail_ns", "tail_fraction")
    )
    return jitter
