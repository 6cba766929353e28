"""Which pixels of an image tell most about an engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _validate
from mars_lidar.flux import Flux
from mars_lidar.plot.data import example_pixels


def telling_pixels(flux: Flux, depth_m: NDArray[np.float64], number: int) -> dict[str, tuple[int, int]]:
    """Up to `number` (1 to 6) pixels (y, x) by name.

    A bright, a dim and an edge pixel (see `example_pixels`); one of median signal; the most photons of all,
    where dead time bends most; the least, where laws are far from Gaussian. Fewer where they coincide.
    """
    count = _validate.integer("pixels", number, low=1, high=6)
    named = example_pixels(flux, depth_m)
    inside = np.zeros(flux.shape, bool)
    rim = [n // 16 for n in flux.shape]  # as `example_pixels` leaves it out
    inside[rim[0] : flux.shape[0] - rim[0], rim[1] : flux.shape[1] - rim[1]] = True
    lit = np.flatnonzero((flux.signal > 0) & inside)
    some = lit if lit.size else np.flatnonzero(inside)
    by_signal = some[np.argsort(flux.signal.ravel()[some], kind="stable")]
    by_total = some[np.argsort(flux.total.ravel()[some], kind="stable")]
    more = {"median": by_signal[(by_signal.size - 1) // 2], "most": by_total[-1], "least": by_total[0]}
    for name, flat in more.items():
        pixel = (int(flat) // flux.shape[1], int(flat) % flux.shape[1])
        if pixel not in named.values():
            named[name] = pixel
    return dict(list(named.items())[:count])
