"""Laser pulses: the temporal shape s(t) of the returned signal, detector response included.

A pulse integrates to one and is wrapped into the laser period, so its tails continue in the neighbouring
period. Times are relative to the delay of a return: positive is later.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, constructed_by_name
from mars_lidar._base.display import as_html
from mars_lidar._base.native import _core
from mars_lidar.instrument.tolerances import TOL

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
_ORIGINS = ("peak", "centroid", "first")


class Pulse(ABC):
    """A pulse shape s(t), unit energy. Concrete pulses are final, frozen, hashable and serialisable.

    See Also
    --------
    GaussianPulse, SampledPulse

    Examples
    --------
    >>> import mars_lidar as ml
    >>> pulse = ml.GaussianPulse(sigma_ns=1.0)
    >>> isinstance(pulse, ml.Pulse), float(pulse.cumulative(0.0))
    (True, 0.5)
    """

    @abstractmethod
    def support_ns(self) -> tuple[float, float]:
        """Interval around the delay outside of which the pulse carries no energy, in ns."""

    @abstractmethod
    def cumulative(self, t_ns: ArrayLike) -> NDArray[np.float64]:
        """Energy before `t_ns` (any shape, ns after the delay), without wrapping: 0 to 1."""

    @abstractmethod
    def check(self, period_ns: float) -> None:
        """Raise ValueError if this pulse cannot be used at the laser period `period_ns`."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `pulse_from_dict` makes an equal pulse."""

    @abstractmethod
    def _native(self, period_ns: float) -> _core.PulseTable:
        """The sampler's table; built without libm, so the same to the last bit on every machine."""

    def _repr_html_(self) -> str:
        """Draw the pulse over its support."""
        edges = np.linspace(*self.support_ns(), TOL.curve_points + 1)
        density = np.diff(self.cumulative(edges)) / np.diff(edges)
        return as_html(self, {"pulse (1/ns) over the time after the delay (ns)": (edges[1:], density)})

    def wrapped_cumulative(self, t_ns: ArrayLike, period_ns: float) -> NDArray[np.float64]:
        """Energy of the pulse train of period `period_ns` from a fixed origin to `t_ns`; increases by 1 each period.

        Its differences are exact energies of intervals, wrap-around included.
        """
        t = np.asarray(t_ns, dtype=np.float64)
        flat, total = t.reshape(-1), np.empty(t.size)
        for start in range(0, t.size, TOL.times_together):  # what stays in the processor's own memory
            some = slice(start, start + TOL.times_together)
            total[some] = self._train(flat[some], period_ns)
        return total.reshape(t.shape)

    def _train(self, t: NDArray[np.float64], period_ns: float) -> NDArray[np.float64]:
        """`wrapped_cumulative` of some times (n,)."""
        low, high = self.support_ns()
        total = np.ones_like(t)
        whole = np.floor((t - high) / period_ns)
        rest = t - whole * period_ns  # in [high, high + period): one pulse is over, later ones may have begun
        for k in range(1, math.ceil((high - low) / period_ns) + 1):
            late = rest - k * period_ns
            begun = late > low
            total[begun] += self.cumulative(late[begun])
        return total + whole

    def bin_energy(self, delay_ns: ArrayLike, period_ns: float, bins: int) -> NDArray[np.float64]:
        """Energy of the wrapped pulse in each of `bins` equal bins of the period.

        Parameters
        ----------
        delay_ns
            Delay of the return (...), ns.
        period_ns
            Laser period, ns.
        bins
            Bins of the period.

        Returns
        -------
        NDArray
            (..., bins); sums to 1 over the last axis.
        """
        edges = np.linspace(0.0, period_ns, bins + 1)
        delays = np.asarray(delay_ns, dtype=np.float64)
        delay = delays.reshape(-1, 1)
        low, high = self.support_ns()
        reached = math.ceil((high - low) / period_ns * bins) + 3  # bins of a pulse, one more at either end for rounding
        if 2 * reached >= bins or not np.isfinite(delay).all():
            return np.diff(self.wrapped_cumulative(edges - delays[..., None], period_ns), axis=-1)
        first = np.floor((delay + low) / period_ns * bins).astype(np.int64) - 1
        places = (first + np.arange(reached)) % bins
        until, after = (self.wrapped_cumulative(edges[places + k] - delay, period_ns) for k in (0, 1))
        energy = np.zeros((delays.size, bins))
        energy[np.arange(delays.size)[:, None], places] = after - until
        return energy.reshape(*delays.shape, bins)


@constructed_by_name
@dataclass(frozen=True, kw_only=True)
class GaussianPulse(Pulse):
    """Gaussian pulse, centred on the delay.

    FWHM = 2.355 sigma; `GaussianPulse.from_fwhm(fwhm_ns=...)` takes that instead.

    Parameters
    ----------
    sigma_ns
        Standard deviation, ns.

    Raises
    ------
    TypeError
        A width that is not a number.
    ValueError
        `sigma_ns` is not positive and finite; `System` requires 1e-6 to 1 period.

    See Also
    --------
    SampledPulse, System

    Examples
    --------
    >>> import mars_lidar as ml
    >>> pulse = ml.GaussianPulse(sigma_ns=0.5)
    >>> round(pulse.sigma_ns, 2)
    0.5
    """

    sigma_ns: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma_ns", checks.real("sigma_ns", self.sigma_ns, low=0.0, strict_low=True))

    @classmethod
    @checked
    def from_fwhm(cls, *, fwhm_ns: float) -> GaussianPulse:
        """Gaussian pulse of full width at half maximum `fwhm_ns` (ns)."""
        return cls(sigma_ns=checks.real("fwhm_ns", fwhm_ns, low=0.0, strict_low=True) / FWHM_PER_SIGMA)

    @property
    def fwhm_ns(self) -> float:
        """Full width at half maximum, ns."""
        return self.sigma_ns * FWHM_PER_SIGMA

    def support_ns(self) -> tuple[float, float]:
        """+-8.5 sigma: 1e-17 of the energy lies outside."""
        return -TOL.gaussian_sigmas * self.sigma_ns, TOL.gaussian_sigmas * self.sigma_ns

    def cumulative(self, t_ns: ArrayLike) -> NDArray[np.float64]:
        """Phi(t / sigma) of times `t_ns`, relatively accurate in the lower tail."""
        from scipy.special import ndtr

        return np.asarray(ndtr(np.asarray(t_ns, dtype=np.float64) / self.sigma_ns), dtype=np.float64)

    def _train(self, t: NDArray[np.float64], period_ns: float) -> NDArray[np.float64]:
        """As of any pulse; of a wide one by its Fourier series, two or three terms for ten and more pulses."""
        share = self.sigma_ns / period_ns
        if share < TOL.train_periods:
            return super()._train(t, period_ns)
        turn = t / period_ns
        total = turn + 0.5
        for m in range(1, 1 + math.ceil(math.sqrt(TOL.exponent / (2.0 * (math.pi * share) ** 2)))):
            total += math.exp(-2.0 * (math.pi * m * share) ** 2) / (math.pi * m) * np.sin(2.0 * math.pi * m * turn)
        return total

    def check(self, period_ns: float) -> None:
        """Sigma between 1e-6 and 1 times `period_ns`: narrower is a delta function to the sampler, wider is flat."""
        if not 1e-6 * period_ns <= self.sigma_ns <= period_ns:
            raise ValueError(
                f"sigma_ns must lie in [{1e-6 * period_ns:g}, {period_ns:g}] ns (1e-6 to 1 period), "
                f"got {self.sigma_ns:g}"
            )

    def to_dict(self) -> dict[str, Any]:
        """``{"kind": "gaussian", "sigma_ns": ...}``."""
        return {"kind": "gaussian", "sigma_ns": self.sigma_ns}

    def _native(self, period_ns: float) -> _core.PulseTable:
        return _core.PulseTable.gaussian(self.sigma_ns / period_ns)


@constructed_by_name
@dataclass(frozen=True, init=False, repr=False)
class SampledPulse(Pulse):
    """A measured impulse response: constant on samples of width `bin_ns`.

    Parameters
    ----------
    values
        (n,) non-negative, finite, with a positive sum; scaled to unit energy.
    bin_ns
        Sample width, ns. The record lasts n x bin_ns and must fit in the laser period.
    origin
        What the delay of a return refers to:

        - ``"peak"``: the centre of the largest sample (the first of several equal ones),
        - ``"centroid"``: the circular mean of the record,
        - ``"first"``: the start of sample 0.

        For ``"peak"`` and ``"centroid"``, a response that begins at the end of the array and continues at its start is
        rejoined: the record is cut where the smaller of the two samples beside the cut is less, at its ends or
        opposite the origin. For ``"first"`` it is used as given.

    Raises
    ------
    TypeError
        Values or times that are not numbers.
    ValueError
        Samples that are not 1-D, finite and non-negative, or sum to 0; `System` requires that the record fits in a
        period.

    See Also
    --------
    GaussianPulse, System

    Examples
    --------
    >>> import mars_lidar as ml
    >>> pulse = ml.SampledPulse([0.0, 1.0, 3.0, 1.0, 0.0], bin_ns=0.1)
    >>> round(pulse.bin_ns, 2)
    0.1
    """

    values: NDArray[np.float64] = field(compare=False)
    bin_ns: float
    origin: str
    _start_ns: float = field(compare=False)
    _cumulative: NDArray[np.float64] = field(compare=False)
    _bytes: bytes  # of the values, by which pulses are compared

    def __init__(self, values: ArrayLike, bin_ns: float, origin: str = "peak") -> None:
        samples = checks.weights("values", values, most=TOL.samples, what="samples")
        width = checks.real("bin_ns", bin_ns, low=0.0, strict_low=True)
        checks.choice("origin", origin, _ORIGINS)
        samples.flags.writeable = False
        rolled, start = _unroll(samples, width, origin)
        cumulative = np.concatenate([[0.0], np.cumsum(rolled)])
        cumulative /= cumulative[-1]
        for name, value in {
            "values": samples,
            "bin_ns": width,
            "origin": origin,
            "_start_ns": start,
            "_cumulative": cumulative,
            "_bytes": samples.tobytes(),
        }.items():
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        return SampledPulse, (self.values, self.bin_ns, self.origin)

    def __repr__(self) -> str:
        return f"SampledPulse({self.values.size} samples, bin_ns={self.bin_ns:g}, origin={self.origin!r})"

    def support_ns(self) -> tuple[float, float]:
        """Extent of the record around the origin, without samples of zero energy at either end."""
        inside = np.flatnonzero(np.diff(self._cumulative) > 0)
        return (self._start_ns + float(inside[0]) * self.bin_ns, self._start_ns + float(inside[-1] + 1) * self.bin_ns)

    def cumulative(self, t_ns: ArrayLike) -> NDArray[np.float64]:
        """Energy before `t_ns`, piecewise linear: the density is constant on each sample."""
        x = (np.asarray(t_ns, dtype=np.float64) - self._start_ns) / self.bin_ns
        return np.asarray(np.interp(x, np.arange(self._cumulative.size), self._cumulative), dtype=np.float64)

    def check(self, period_ns: float) -> None:
        """The record fits in the period `period_ns`."""
        length = self.values.size * self.bin_ns
        if length > period_ns * (1 + 1e-9):
            raise ValueError(
                f"values must span at most the laser period of {period_ns:g} ns, "
                f"got {self.values.size} samples x {self.bin_ns:g} ns = {length:g} ns"
            )

    def to_dict(self) -> dict[str, Any]:
        """``{"kind": "sampled", "values": [...], "bin_ns": ..., "origin": ...}``."""
        return {"kind": "sampled", "values": self.values.tolist(), "bin_ns": self.bin_ns, "origin": self.origin}

    def _native(self, period_ns: float) -> _core.PulseTable:
        inside = np.flatnonzero(np.diff(self._cumulative) > 0)
        knots = np.ascontiguousarray(self._cumulative[inside[0] : inside[-1] + 2])
        return _core.PulseTable.sampled(knots, self.bin_ns / period_ns, self.support_ns()[0] / period_ns)


def _unroll(samples: NDArray[np.float64], width: float, origin: str) -> tuple[NDArray[np.float64], float]:
    """The record in order of time, and the time of its first edge relative to the origin."""
    n = samples.size
    if origin == "first":
        return samples, 0.0
    if origin == "peak":
        centre = float(np.argmax(samples)) + 0.5
    else:
        angles = 2.0 * np.pi * (np.arange(n) + 0.5) / n
        resultant = np.sum(samples * np.exp(1j * angles)) / samples.sum()
        if abs(resultant) < 1e-9:
            raise ValueError("origin='centroid' is not defined for values without a circular mean: a flat record")
        centre = float(np.angle(resultant)) / (2.0 * np.pi) * n % n
        centre = round(centre * 2.0**20) / 2.0**20  # the last bits of exp and angle differ between machines
    opposite = math.ceil(centre - 0.5 * n - 1e-9)
    first = min((0, opposite), key=lambda cut: min(samples[cut - 1], samples[cut]))
    rolled = np.roll(samples, -first)
    rolled.flags.writeable = False
    return rolled, -((centre - first) % n) * width


def pulse_from_dict(data: Any) -> Pulse:
    """The pulse that `Pulse.to_dict` described."""
    shape: Pulse = shape_from_dict("pulse", data, GaussianPulse, SampledPulse)
    return shape


def shape_from_dict(name: str, data: Any, gaussian: Any, sampled: Any, more: tuple[str, ...] = ()) -> Any:
    """A shape by its kind, `gaussian` or `sampled`, with a width by ``sigma_ns`` or ``fwhm_ns``, and `more` keys."""
    kind = data.get("kind") if isinstance(data, dict) else None
    if kind == "gaussian":
        known = dict(checks.known_keys(name, data, ("kind", "sigma_ns", "fwhm_ns", *more)))
        del known["kind"]
        if ("sigma_ns" in known) == ("fwhm_ns" in known):
            got = "both" if "fwhm_ns" in known else "neither"
            raise ValueError(f"{name} of kind 'gaussian' must give one of sigma_ns and fwhm_ns, got {got}")
        return gaussian.from_fwhm(**known) if "fwhm_ns" in known else gaussian(**known)
    if kind == "sampled":
        known = checks.known_keys(name, data, ("kind", "values", "bin_ns", "origin"), needed=("values", "bin_ns"))
        return sampled(known["values"], known["bin_ns"], known.get("origin", "peak"))
    raise ValueError(f"{name} must be a mapping with kind 'gaussian' or 'sampled', got {data!r}")
