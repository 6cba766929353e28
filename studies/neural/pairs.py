"""What a neural map learns from: ranges of fluxes, the plan of a training, pairs (flux, registration PDF)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mars_lidar import System
from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import PhaseChain
from mars_lidar.statistics.renewal import row_moments

_SMALLEST = 1e-6


@dataclass(frozen=True, kw_only=True)
class FluxRange:
    """The fluxes of the pairs: signal S and background B log-uniform over their ranges, photons per period.

    Parameters
    ----------
    signal, background
        (low, high), photons per period, 0 < low < high. S is the sum over the returns. A signal below `low` is still
        in range: there the PDF is hardly more than that of the background.
    returns
        Most returns of a flux: 1, or 2, which a third of the pairs then have.
    """

    signal: tuple[float, float] = (0.002, 12.0)
    background: tuple[float, float] = (0.002, 12.0)
    returns: int = 2

    def __post_init__(self) -> None:
        for name in ("signal", "background"):
            pair = getattr(self, name)
            if not isinstance(pair, tuple | list) or len(pair) != 2:
                raise TypeError(f"{name} must be (low, high) photons per period, got {pair!r}")
            low = checks.real(name, pair[0], low=_SMALLEST, high=1e3)
            high = checks.real(name, pair[1], low=low, high=1e3, strict_low=True)
            object.__setattr__(self, name, (low, high))
        checks.integer("returns", self.returns, low=1, high=2)

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}

    def draw(self, system: System, number: int, random: np.random.Generator) -> FloatArray:
        """Fluxes (number, bins), photons per bin and period; the largest return lies near the middle of the period."""
        signal, background = (
            np.exp(random.uniform(np.log(low), np.log(high), number)) for low, high in (self.signal, self.background)
        )
        period = system.period_ns
        # the frame of the network: only the place within a bin is left to learn
        delay = (0.5 + random.uniform(-0.5, 0.5, number) / system.bins) * period
        second = (random.random(number) < 1.0 / 3.0) & (self.returns == 2)
        share = np.where(second, random.uniform(0.5, 1.0, number), 1.0)
        other = random.uniform(0.0, period, number)
        photons = (signal * share)[:, None] * system.pulse.bin_energy(delay, period, system.bins)
        photons += (signal * (1.0 - share))[:, None] * system.pulse.bin_energy(other, period, system.bins)
        return np.asarray(np.maximum(photons, 0.0) + background[:, None] / system.bins)


@dataclass(frozen=True, kw_only=True)
class Training:
    """How a map is trained.

    Parameters
    ----------
    fluxes
        Range of the fluxes.
    pairs, held_out
        Pairs to learn from, and pairs of other random fluxes to validate on.
    steps, batch
        Steps of AdamW, and pairs of each.
    every
        Steps between validations.
    width, code
        Channels of the finest level, and numbers of the bottleneck.
    seed
        Of pairs, weights and order.
    """

    fluxes: FluxRange = field(default_factory=FluxRange)
    pairs: int = 6000
    held_out: int = 500
    steps: int = 1750
    batch: int = 32
    every: int = 125
    width: int = 16
    code: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.fluxes, FluxRange):
            raise TypeError(f"fluxes must be a FluxRange, got {self.fluxes!r}")
        for name in ("pairs", "held_out", "steps", "batch", "every", "width", "code"):
            checks.integer(name, getattr(self, name), low=1, high=10**7)
        checks.integer("seed", self.seed, low=0, high=2**63 - 1)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Fluxes (P, bins), PDFs (P, bins), mean waits after a registration in each bin (P, bins), their means (P,)."""

    photons: FloatArray
    pdf: FloatArray
    wait: FloatArray
    mean_wait: FloatArray

    @classmethod
    def of(cls, photons: FloatArray, system: System) -> Pairs:
        """The chain's answer to each flux (P, bins)."""
        pdf, wait = np.empty_like(photons), np.empty_like(photons)
        for k, row in enumerate(photons):
            chain = PhaseChain(row, system.dead_time_periods)
            pdf[k], wait[k] = chain.stationary().pdf, row_moments(chain)[0]
        return cls(photons, pdf, wait, (pdf * wait).sum(-1))
