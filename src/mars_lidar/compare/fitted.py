"""A measured cube beside the light that was fitted to it, so that what is drawn and predicted of a cube is of both."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from mars_lidar.io.cube import Cube
from mars_lidar.io.layout import MEASURED
from mars_lidar.io.recipe import Recipe
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruct import METHODS, reconstruct


def fitted(cube: Cube, realization: int) -> Cube:
    """One exposure of a measured cube with the flux that maximum likelihood finds in it; a simulated one as it is.

    The flux is that of detectable photons, so the system is `System.detected`. Depth is NaN where no return is seen.
    Detectors that maximum likelihood does not hold for are fitted by the first of the other methods that does.
    """
    if not cube.measured:
        return cube
    system = cube.system
    counts = np.asarray(cube.histogram[realization])
    names = ("maximum_likelihood", *(name for name in METHODS if name != "maximum_likelihood"))
    for name in names:
        with suppress(ValueError):
            METHODS[name].check(system)
            break
    found = reconstruct(counts, system, name)
    seen = found.seen & np.isfinite(found.signal)
    flux = Flux(
        np.where(seen, found.signal, 0.0),
        np.where(np.isfinite(found.background), found.background, 0.0),
        np.where(seen, found.delay_ns, 0.0),
    )
    recipe = Recipe(
        system=system.detected(),
        flux=flux,
        engine=MEASURED,
        depth_m=np.where(seen, found.depth_m, np.nan),
        source=cube.recipe.source,
    )
    return Cube(histogram=counts[None], recipe=recipe, version=cube.version)
