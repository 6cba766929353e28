"""How close the count law that a table leads to is to the exact one: measured pixel by pixel."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar.statistics.distance import Pmf, total_variation
from mars_lidar.table.error import random_pixels
from mars_lidar.table.nodes import Nodes


@dataclass(frozen=True)
class LawError:
    """Total variation between count laws at random pixels: that with the table's four cumulants, and the exact one.

    Interpolation, start-phase correction and the law itself (`statistics.matched.matched_pmf`) err together here.

    Attributes
    ----------
    samples, cycles
        Pixels, and periods of the exposure.
    mean, largest
        Of the total variation.
    within
        Share of pixels within 0.002.
    trusted
        Share of pixels that `statistics.matched.trusted` holds to be within 0.002.
    largest_trusted
        Largest total variation among those.
    worst_signal, worst_background, worst_delay_ns
        The pixel of `largest`.
    """

    samples: int
    cycles: int
    mean: float
    largest: float
    within: float
    trusted: float
    largest_trusted: float
    worst_signal: float
    worst_background: float
    worst_delay_ns: float

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self)


def law_error(table: Nodes, samples: int, seed: int, cycles: int | None, threads: int | None) -> LawError:
    """Total variation on random pixels between a table's count law and the exact one: `Table.law_error`."""
    from mars_lidar.statistics.law import count_law
    from mars_lidar.statistics.matched import matched_pmf

    samples = checks.integer("samples", samples, low=1, high=100_000)
    rng = np.random.default_rng(checks.integer("seed", seed, low=0, high=2**64 - 1))
    system = table.system if cycles is None else table.system.replace(cycles=cycles)
    signal, background = (random_pixels(rng, axis, samples, True) for axis in (table.signal, table.background))
    delay = rng.uniform(0.0, system.period_ns, samples)
    found = table.lookup(signal, background, delay_ns=delay, cycles=system.cycles)
    exact = count_law(signal, background, system, delay_ns=delay, tolerance=table.tolerance, threads=threads)
    matched = matched_pmf(found.cumulants, threads=threads)
    off = np.array([total_variation(w, Pmf(int(exact.support[k, 0]), exact.pmf[k])) for k, w in enumerate(matched)])
    good = found.trusted()
    worst = int(off.argmax())
    return LawError(
        samples=samples,
        cycles=system.cycles,
        mean=float(off.mean()),
        largest=float(off[worst]),
        within=float(np.mean(off <= 0.002)),
        trusted=float(good.mean()),
        largest_trusted=float(off[good].max()) if good.any() else 0.0,
        worst_signal=float(signal[worst]),
        worst_background=float(background[worst]),
        worst_delay_ns=float(delay[worst]),
    )
