"""Cubes in memory as xarray has them: the variables, units and attributes of our stores, without a file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base.arguments import checked_with_masks
from mars_lidar._base.imports import needed
from mars_lidar.instrument.system import System
from mars_lidar.io import layout
from mars_lidar.io.cube import Cube
from mars_lidar.io.measured import in_order
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.light.flux import Flux

if TYPE_CHECKING:
    import xarray

_OF_A_RUN = ("engine", "engine_settings", "seed", "first_realization", "source")


@checked_with_masks
def to_xarray(
    cube: Cube | ArrayLike,
    system: System | None = None,
    flux: Flux | None = None,
    *,
    depth_m: ArrayLike | None = None,
    reflectivity: ArrayLike | None = None,
) -> xarray.Dataset:
    """Counts with named dimensions, coordinates and units, as ``xarray.open_zarr`` gives them of our stores.

    Parameters
    ----------
    cube
        A `mars_lidar.io.Cube`, or counts of `mars_lidar.simulate`: (realizations, H, W, bins), or fewer dimensions as
        `mars_lidar.io.from_histograms` takes them.
    system
        How they were recorded; of a `Cube` its own.
    flux
        The light behind counts, if it is known, (H, W).
    depth_m, reflectivity
        Maps (H, W) of the scene, beside a flux; depth is c tau / 2 by default.

    Returns
    -------
    xarray.Dataset
        ``histogram`` (realization, y, x, time), and what is known of the light.

    Raises
    ------
    TypeError
        Counts without the system that recorded them, or a cube beside a system of its own.
    ValueError
        Shapes that do not fit.
    MissingLibraryError
        xarray (extra ``io``) is not installed.

    See Also
    --------
    simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> ml.to_xarray(ml.simulate(ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system), system).dims
    FrozenMappingWarningOnValuesAccess({'realization': 1, 'y': 1, 'x': 2, 'time': 128})
    """
    xarray = needed("xarray", "a labelled cube")
    if isinstance(cube, Cube):
        if (system, flux, depth_m, reflectivity) != (None, None, None, None):
            raise TypeError("system, flux, depth_m and reflectivity are for arrays: a Cube has its own")
        recipe, counts = cube.recipe, cube.histogram
    else:
        if not isinstance(system, System):
            raise TypeError(f"system must be a System beside an array of counts, got {type(system).__name__}")
        counts = in_order(cube, None, None)
        recipe = _recipe(counts.shape, system, flux, depth_m, reflectivity)
        if counts.shape != recipe.shape:
            raise ValueError(f"cube must be {recipe.shape} (realizations, H, W, bins), got {counts.shape}")
    variables: dict[str, Any] = {"histogram": (layout.DIMS, np.asarray(counts), dict(layout.HISTOGRAM_LABELS))}
    coordinates: dict[str, Any] = {}
    for variable in layout.variables(recipe):
        entry = (variable.dims, np.asarray(variable.data), variable.labels)
        (coordinates if variable.dims == (variable.name,) else variables)[variable.name] = entry
    attributes: dict[str, Any] = {**layout.attributes(recipe), "complete": True}
    if not isinstance(cube, Cube):  # nobody says how an array was made
        attributes = {name: value for name, value in attributes.items() if name not in _OF_A_RUN}
    return xarray.Dataset(variables, coordinates, attributes)  # type: ignore[no-any-return]


def _recipe(
    shape: tuple[int, ...], system: System, flux: Flux | None, depth_m: Any, reflectivity: Any
) -> Recipe | Recording:
    realizations, height, width, _ = shape
    if flux is None:
        if depth_m is not None or reflectivity is not None:
            raise TypeError("depth_m and reflectivity stand beside a flux, which is not given")
        return Recording(system=system, pixels=(height, width), realizations=realizations)
    pixels = math.prod(flux.shape)
    if pixels != height * width:
        raise ValueError(f"flux must have the pixels of the cube, {height} x {width}, got {flux.shape}")
    return Recipe(
        system=system, flux=flux, realizations=realizations, engine="", depth_m=depth_m, reflectivity=reflectivity
    )
