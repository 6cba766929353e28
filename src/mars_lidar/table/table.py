"""The lookup table over (S, B) at a canonical delay: built once for a system, it answers for any pixel.

The paper's table (arXiv 2512.04924): 256 x 100 entries on [0.01, 10]^2; delay invariance replaces a third axis. Here
with the exact law of the finite exposure, its dependence on the delay, any number of cycles, and interpolation. What
is stored, and the errors, are described in docs/table.md.
"""

from __future__ import annotations

from mars_lidar.table.cache import Cached
from mars_lidar.table.error import law_error, quantisation_error


class Table(Cached):
    """Count law and histogram shape over a grid of (S, B); made by `build`, `load` or `cached`.

    Attributes
    ----------
    system
        Laser, detector and histogram; its `cycles` are those of ``cycles=None``.
    method
        ``"exposure"`` or ``"mars"``.
    signal, background
        (nS,), (nB,) axes, photons per period, ascending. The first may be 0: pixels without a return.
    rearm
        Of the chain, for ``"mars"``.
    tolerance
        Of the exposure statistics.
    provenance
        How the table came to be: version, request, axes in words, seconds, and the error measured at the end.
    laws
        Exact laws of the count at those entries whose four cumulants do not fix it (`statistics.matched.trusted`).
    """

    quantisation_error = quantisation_error
    law_error = law_error
