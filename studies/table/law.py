"""Total variation between the count laws of a lookup table and the exact ones, on random pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar import Flux, Table, count_law
from mars_lidar.statistics.count_pmf import Pmf, total_variation
from mars_lidar.statistics.matched import matched_pmf
from mars_lidar.table.error import random_pixels


@dataclass(frozen=True)
class LawError:
    """Total variation between count laws at random pixels: that with the table's four cumulants, and the exact one.

    It includes the errors of interpolation, of the correction for the start phase and of the law
    (`statistics.matched.matched_pmf`).

    Attributes
    ----------
    samples
        Pixels.
    mean, largest
        Of the total variation.
    within
        Share of pixels within 0.002.
    trusted
        Share of pixels whose law `statistics.matched.trusted` accepts (total variation below 0.002).
    largest_trusted
        Largest total variation among those.
    worst_signal, worst_background
        The pixel of `largest`.
    """

    samples: int
    mean: float
    largest: float
    within: float
    trusted: float
    largest_trusted: float
    worst_signal: float
    worst_background: float


def law_error(table: Table, samples: int, seed: int) -> LawError:
    """The error of the count law at `samples` random pixels of the table; some 10 to 20 ms a pixel."""
    rng = np.random.default_rng(seed)
    signal, background = (random_pixels(rng, axis, samples, True) for axis in (table.signal, table.background))
    delay = rng.uniform(0.0, table.system.period_ns, samples)
    law = table.at(signal, background, delay)
    exact = count_law(Flux(signal, background, delay), table.system, tolerance=table.tolerance)
    matched = matched_pmf(law.cumulants)
    off = np.array([total_variation(w, Pmf(int(exact.support[k, 0]), exact.pmf[k])) for k, w in enumerate(matched)])
    good = law.trusted()
    worst = int(off.argmax())
    return LawError(
        samples=samples,
        mean=float(off.mean()),
        largest=float(off[worst]),
        within=float(np.mean(off <= 0.002)),
        trusted=float(good.mean()),
        largest_trusted=float(off[good].max()) if good.any() else 0.0,
        worst_signal=float(signal[worst]),
        worst_background=float(background[worst]),
    )
