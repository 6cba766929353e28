"""How a neural map is trained."""

from __future__ import annotations

from dataclasses import dataclass, field

from mars_lidar._base import checks
from mars_lidar.learn.neural.pairs import FluxRange


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
        for name, most in (
            ("pairs", 10**7),
            ("held_out", 10**6),
            ("steps", 10**7),
            ("batch", 10**5),
            ("every", 10**7),
            ("width", 256),
            ("code", 4096),
        ):
            checks.integer(name, getattr(self, name), low=1, high=most)
        checks.integer("seed", self.seed, low=0, high=2**63 - 1)
