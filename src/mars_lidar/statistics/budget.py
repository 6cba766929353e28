"""What a statistic of one pixel may cost before it is refused, and what the refusal advises instead.

Costs are counted, not timed: what is refused does not depend on the machine. Seconds are those of one core at 3 GHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Largest costs of one statistic of one pixel.

    Attributes
    ----------
    recursion, one_pass
        Bins x periods of the exposure recursion, on all grids together and on one of them; 80 ns each.
    transform
        Bins x periods x batches of eight points of the generating function of the count; 12 ns each.
    forgetting
        Bins x periods within which an exposure forgets its start, for the closed form of the joint law; 12 ns each.
    run_through
        Bins x periods of an exposure that does not forget its start: the joint law runs through it for every window.
    record_kernel
        Probabilities from record to record behind electronics with a dead time; 8 bytes each.
    record_moments, record_points
        Multiplications for the moments of the number of these records, and for the points of its law.
    synchronous_terms, synchronous_points
        Terms of the sums for a count law of mode synchronous, and points x counts of its transform.
    history
        Bytes, in each thread, of the registrations of one dead time.
    """

    recursion: float
    one_pass: float
    transform: float = 8e7
    forgetting: int = 40_000_000
    run_through: int = 2**22
    record_kernel: int
    record_moments: float
    record_points: float = 2e10
    synchronous_terms: int = 2**23
    synchronous_points: int = 30_000_000
    history: int = 2**30

    def refusal(self, steps: float) -> str:
        """Why `steps` bins x periods of the exposure recursion are refused, in seconds of 80 ns a step."""
        return f"it would take about {8e-8 * steps:.2g} s, and the limit of a law is {8e-8 * self.recursion:.1g} s"


LAW = Budget(recursion=2.6e7, one_pass=2.6e7, record_kernel=2**24, record_moments=1.2e9)
"""Count laws, mean histograms and joint laws: about two seconds."""

MOMENTS = Budget(recursion=math.inf, one_pass=4e9, record_kernel=2**27, record_moments=4e10)
"""`exposure_moments` and `electronics_moments`: minutes, and a kernel of 1 GiB."""


def advice(*names: str) -> str:
    """The end of a refusal: what to use instead, one of `names` or the exact engine."""
    simulate = "simulate it with engine 'exact'"
    return f"use {', '.join(names)}, or {simulate}" if names else simulate
