"""Avalanches triggered by avalanches: afterpulses in the same pixel and crosstalk in its neighbours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import constructed_by_name
from mars_lidar.instrument.tolerances import TOL

_KERNELS = {
    "4": ((0.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "8": ((1.0, 1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0, 1.0)),
}


@constructed_by_name
@dataclass(frozen=True, kw_only=True, repr=False)
class Afterpulsing:
    """Afterpulsing: carriers that an avalanche leaves in traps; each, when released, acts like an arriving photon.

    Every avalanche leaves a Poisson number of them (Straka et al., J. Lightwave Technol. 38, 4765 (2020), arXiv
    2001.10036), with independent delays from the avalanche. A carrier that is released during the dead time is
    lost; one that is released while the pixel is armed triggers an avalanche, which leaves carriers again.

    Parameters
    ----------
    probability
        Mean number of carriers per avalanche, in (0, 1), including those that are lost in the dead time. With
        exponential delays a share e^(-t_d / delay) of them outlives the dead time of the avalanche: an
        afterpulse probability p after a dead time, as stated in data sheets, is
        ``Afterpulsing.after_dead_time(probability=p, ...)``.
    delay_ns
        Mean of exponential delays, ns; in place of ``delays`` and ``bin_ns``.
    delays, bin_ns
        ``(n,)`` non-negative density of the delay on samples of `bin_ns` ns from the avalanche on, constant on each.
    generations
        Avalanches of photons (and of crosstalk) are generation 0, those of their carriers generation 1, and so on. Only
        generations below this number leave carriers: 1 is a single afterpulse generation. Default: no limit.

    Raises
    ------
    TypeError
        A probability or delay is not a number.
    ValueError
        A probability outside (0, 1), a delay that is not positive, or both `delay_ns` and `delays`.

    See Also
    --------
    Crosstalk, Detector

    Examples
    --------
    >>> import mars_lidar as ml
    >>> afterpulsing = ml.Afterpulsing(probability=0.02, delay_ns=40.0)
    >>> ml.Detector(dead_time_ns=30.0, afterpulsing=afterpulsing).afterpulsing.delay_ns
    40.0
    """

    probability: float
    delay_ns: float | None = None
    delays: tuple[float, ...] | None = None
    bin_ns: float | None = None
    generations: int | None = None

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        probability = checks.real("probability of afterpulsing", self.probability, low=0.0, strict_low=True)
        if probability >= 1.0:
            raise ValueError(
                "probability of afterpulsing must be below 1, or one photon could be followed by avalanches for ever, "
                f"got {self.probability!r}"
            )
        set_field(self, "probability", probability)
        if (self.delay_ns is None) == (self.delays is None):
            raise ValueError("afterpulsing must have one of delay_ns (exponential) and delays (sampled, with bin_ns)")
        if (self.delays is None) != (self.bin_ns is None):
            raise ValueError("delays and bin_ns of afterpulsing belong together: both, or neither")
        if self.delay_ns is not None:
            set_field(self, "delay_ns", checks.real("delay_ns", self.delay_ns, low=0.0, strict_low=True))
        else:
            density = checks.weights(
                "delays of afterpulsing", self.delays, most=TOL.samples, what="samples of a density"
            )
            set_field(self, "delays", tuple(density.tolist()))
            set_field(self, "bin_ns", checks.real("bin_ns", self.bin_ns, low=0.0, strict_low=True))
        if self.generations is not None:
            number = checks.integer("generations", self.generations, low=1, high=TOL.generations)
            set_field(self, "generations", number)

    def __repr__(self) -> str:
        delays = f"delay_ns={self.delay_ns}"
        if self.delays is not None:
            delays = f"delays=<{len(self.delays)} samples>, bin_ns={self.bin_ns:g}"
        limit = "" if self.generations is None else f", generations={self.generations}"
        return f"Afterpulsing(probability={self.probability:g}, {delays}{limit})"

    @classmethod
    def after_dead_time(
        cls, *, probability: float, delay_ns: float, dead_time_ns: float, generations: int | None = None
    ) -> Afterpulsing:
        """Exponential delays with `probability` afterpulses per avalanche after its dead time.

        `delay_ns` is the mean delay, `dead_time_ns` that of the detector, `generations` as for `Afterpulsing`.
        """
        after_dead = checks.real("probability", probability, low=0.0, high=1.0, strict_low=True)
        delay = checks.real("delay_ns", delay_ns, low=0.0, strict_low=True)
        dead = checks.real("dead_time_ns", dead_time_ns, low=0.0)
        return cls(
            probability=min(after_dead * math.exp(min(dead / delay, 700.0)), 1e300),
            delay_ns=delay,
            generations=generations,
        )

    @property
    def mean_delay_ns(self) -> float:
        """Mean delay, ns."""
        if self.delay_ns is not None:
            return self.delay_ns
        density, width = np.array(self.delays), self.bin_ns or 0.0
        return float(density @ (np.arange(density.size) + 0.5) * width / density.sum())

    def cumulative(self, t_ns: Any) -> NDArray[np.float64]:
        """P(delay <= t) (...) for `t_ns` (...)."""
        t = np.maximum(np.asarray(t_ns, dtype=np.float64), 0.0)
        if self.delay_ns is not None:
            return np.asarray(-np.expm1(-t / self.delay_ns))
        below, width = self.edges_below, self.bin_ns or 0.0
        return np.asarray(np.interp(t, np.arange(below.size) * width, below))

    @property
    def edges_below(self) -> NDArray[np.float64]:
        """Distribution function (n + 1,) of sampled delays at the edges of the samples."""
        below = np.concatenate([[0.0], np.cumsum(np.array(self.delays or ()))])
        return np.asarray(below / below[-1] if below[-1] > 0 else below)

    def check(self, period_ns: float) -> None:
        """Raise ValueError for delays too short or too long for the laser period `period_ns`."""
        most = TOL.delay_periods * period_ns
        if self.mean_delay_ns > most:
            raise ValueError(
                f"delays of afterpulsing must be at most {most:g} ns in the mean (1e6 periods), "
                f"got {self.mean_delay_ns:g}"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `Afterpulsing.from_dict` makes an equal object."""
        data: dict[str, Any] = {"probability": self.probability}
        if self.delay_ns is not None:
            data["delay_ns"] = self.delay_ns
        else:
            data |= {"delays": list(self.delays or ()), "bin_ns": self.bin_ns}
        return data if self.generations is None else data | {"generations": self.generations}

    @classmethod
    def from_dict(cls, data: Any) -> Afterpulsing:
        """The afterpulsing that `to_dict` described."""
        names = ("probability", "delay_ns", "delays", "bin_ns", "generations")
        return cls(**checks.known_keys("afterpulsing", data, names, needed=names[:1]))


@constructed_by_name
@dataclass(frozen=True, kw_only=True)
class Crosstalk:
    """Optical crosstalk: an avalanche triggers neighbouring pixels at the same time, where they are armed.

    Each neighbour is triggered independently of the others; these avalanches trigger their own neighbours, and so on.
    Pixels at the border of the image have fewer neighbours. Since the pixels influence each other, the image is
    simulated as a whole.

    Parameters
    ----------
    probability
        Mean number of neighbours that an avalanche triggers if all are armed, in (0, 1]: the sum of the probabilities
        of the neighbours.
    kernel
        ``"4"`` (the pixels above, below, left and right) or ``"8"`` (also the diagonal ones), with equal probabilities;
        or relative weights (3, 3) of the neighbours, 0 in the middle.

    Raises
    ------
    TypeError
        A probability that is not a number; a kernel of another type.
    ValueError
        A probability outside (0, 1], or weights that are not (3, 3), finite, non-negative and 0 in the middle.

    See Also
    --------
    Afterpulsing, Detector

    Examples
    --------
    >>> import mars_lidar as ml
    >>> ml.Detector(dead_time_ns=30.0, crosstalk=ml.Crosstalk(probability=0.01)).crosstalk.probability
    0.01
    """

    probability: float
    kernel: str | tuple[tuple[float, ...], ...] = "8"

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        probability = checks.real("probability of crosstalk", self.probability, low=0.0, high=1.0, strict_low=True)
        set_field(self, "probability", probability)
        if isinstance(self.kernel, str):
            checks.choice("kernel of crosstalk", self.kernel, tuple(_KERNELS))
            return
        weights = np.asarray(checks.numbers("kernel of crosstalk", self.kernel))
        if weights.shape != (3, 3) or weights.dtype.kind not in "fiu":
            raise ValueError(
                f"kernel of crosstalk must be '4', '8' or 3 x 3 weights, got shape {weights.shape} of {weights.dtype}"
            )
        weights = weights.astype(np.float64)
        bad = ~np.isfinite(weights) | (weights < 0.0)
        if bad.any() or weights[1, 1] != 0.0 or not weights.sum() > 0.0:
            raise ValueError(
                "kernel of crosstalk must be finite and non-negative, 0 in the middle and not all 0, "
                f"got {weights.tolist()}"
            )
        set_field(self, "kernel", tuple(map(tuple, weights.tolist())))

    @property
    def probabilities(self) -> NDArray[np.float64]:
        """Probability (3, 3) that an avalanche in the middle triggers each neighbour that is armed."""
        weights = np.array(_KERNELS[self.kernel] if isinstance(self.kernel, str) else self.kernel)
        return np.asarray(self.probability * weights / weights.sum())

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `Crosstalk.from_dict` makes an equal object."""
        kernel = self.kernel if isinstance(self.kernel, str) else [list(row) for row in self.kernel]
        return {"probability": self.probability, "kernel": kernel}

    @classmethod
    def from_dict(cls, data: Any) -> Crosstalk:
        """The crosstalk that `to_dict` described by `data`; ``kernel: 4`` without quotes is accepted."""
        known = dict(checks.known_keys("crosstalk", data, ("probability", "kernel"), needed=("probability",)))
        if isinstance(known.get("kernel"), int):
            known["kernel"] = str(known["kernel"])
        return cls(**known)
