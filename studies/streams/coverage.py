"""How well stated errors hold: differences from the truth in stated errors, against the law that they should have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from studies.streams.cases import ESTIMATES, Outcome

Law = Literal["normal", "exponential"]


def tail(pull: float, law: Law) -> float:
    """Probability of a pull of more than this size."""
    return math.exp(-pull) if law == "exponential" else math.erfc(pull / math.sqrt(2.0))


@dataclass(frozen=True, eq=False)
class Coverage:
    """Pulls of an estimate in `streams` streams: `sizes` (stated,) of those whose error is finite.

    `law` of the pulls: normal, or exponential for a dead time that no interval has shown to be less.
    """

    name: str
    law: Law
    streams: int
    sizes: NDArray[np.float64]

    @classmethod
    def of(cls, name: str, pulls: list[float], law: Law = "normal") -> Coverage:
        """From the pulls of many streams, NaN where no error is stated."""
        sizes = np.abs(pulls)
        return cls(name, law, len(pulls), sizes[np.isfinite(sizes)])

    @property
    def stated(self) -> int:
        """Number of finite errors."""
        return int(self.sizes.size)

    @property
    def largest(self) -> float:
        """The largest pull, 0 where there is none."""
        return float(self.sizes.max(initial=0.0))

    def within(self, limit: float) -> int:
        """How many are off by less than `limit` stated errors."""
        return int((self.sizes < limit).sum())

    def share(self, limit: float) -> float:
        """Their share of those stated, 0 where none is."""
        return self.within(limit) / max(self.stated, 1)

    def beyond(self, limit: float) -> int:
        """How many are off by more than `limit` stated errors."""
        return int((self.sizes > limit).sum())

    @property
    def p(self) -> dict[str, float]:
        """p-values of as few within 1 and 2, and of one as large, if errors are at least what they are stated to be."""
        few = {
            f"{self.name}, within {limit:g}": float(
                binom.cdf(self.within(limit), self.stated, 1.0 - tail(limit, self.law))
            )
            for limit in (1.0, 2.0)
        }
        return few | {f"{self.name}, largest": min(1.0, self.stated * tail(self.largest, self.law))}


def coverage(found: list[Outcome]) -> list[Coverage]:
    """Of all estimates; of dead times by the way they were found, which have errors of another law."""
    ways: dict[str, Law] = {"edge": "normal", "smallest interval": "exponential"}
    return [
        Coverage.of(f"dead time, by the {way}", [one.pulls["dead time"] for one in found if one.by == way], law)
        for way, law in ways.items()
    ] + [Coverage.of(name, [one.pulls[name] for one in found]) for name in ESTIMATES if name != "dead time"]
