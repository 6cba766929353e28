"""The layout common to all formats: variables with dimensions and units, and attributes.

Version 1 of the layout:

==================  ===========================  =====================================================
variable            dimensions                   holds
==================  ===========================  =====================================================
histogram           realization, y, x, time      registrations, uint16 or uint32
time                time                         bin centres, ns
realization, y, x   themselves                   realization number of the random streams; pixel
depth               y, x                         m
reflectivity        y, x                         where the flux was made from a scene
signal, background  y, x                         detectable photons per laser period
delay               y, x                         ns; the strongest return
returns_signal,     return, y, x                 where there are several returns
returns_delay
waveform            y, x, waveform_time          photons per period and part, where the flux is one
pixel_index         y, x                         where the cube is a part of a larger image
==================  ===========================  =====================================================

Attributes: ``format``, ``format_version``, ``complete``, ``system`` (JSON), ``engine``, ``engine_settings``
(JSON: further settings that determine the counts, such as the hash and grid of a table), ``seed``,
``first_realization``, ``flux`` (JSON: origin of the flux), ``source``, ``version`` (of this package) and,
once complete, ``registrations``. Measured counts have ``engine`` "measured", and no variables of a flux.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._version import __version__
from mars_lidar.instrument.system import System
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.io.store import OnDisk, values
from mars_lidar.light.flux import Flux, StoredFlux, Waveforms
from mars_lidar.light.tolerances import TOL

Check = Callable[[Path, Mapping[str, Any]], None]  # of the attributes of a file, before anything else of it is read
FORMAT = "mars-lidar cube"
MEASURED = Recording.engine  # attribute of counts that no engine drew
_OTHERS = {  # attribute `format` of what is no cube, `kind` of a table: what it is, what reads it
    "mars-lidar maps": "reconstructed maps, not a cube: mars_lidar.io.maps.load_maps reads them",
    "mars-lidar dataset": "a dataset, not a cube: mars_lidar.dataset.open_dataset reads it",
    "mars-lidar timestamps": "a photon stream, not a cube: mars_lidar.Timestamps.load reads it, mars-lidar calibrate "
    "shows it",
    "mars-lidar table": "a lookup table, not a cube: mars_lidar.Table.load reads it, mars-lidar table info shows it",
}
FORMAT_VERSION = 1
DIMS = ("realization", "y", "x", "time")
HISTOGRAM_LABELS = {"long_name": "registrations per bin", "units": "count"}
_IMAGE = ("y", "x")
_PHOTONS = "photons per laser period"


@dataclass(frozen=True, eq=False)
class Variable:
    """A named array with named dimensions, a unit and a long name."""

    name: str
    dims: tuple[str, ...]
    data: Any  # an array, or `Waveforms`, which are read by `bands`
    units: str  # empty of texts
    long_name: str

    @property
    def labels(self) -> dict[str, str]:
        """Attributes of the variable."""
        return {"long_name": self.long_name} | ({"units": self.units} if self.units else {})

    def bands(self) -> Iterator[slice]:
        """Parts along the first axis that fit in memory."""
        if isinstance(self.data, Waveforms):
            yield from self.data.bands()
        elif self.data.size:
            yield slice(0, self.data.shape[0])


def variables(recipe: Recipe | Recording) -> list[Variable]:
    """All variables but the histogram; coordinates first."""
    system = recipe.system
    height, width = recipe.image
    numbers = recipe.first_realization + np.arange(recipe.realizations, dtype=np.int64)
    out = [
        Variable("realization", ("realization",), numbers, "1", "realization number"),
        Variable("y", ("y",), np.arange(height), "pixel", "image row"),
        Variable("x", ("x",), np.arange(width), "pixel", "image column"),
        Variable("time", ("time",), system.time_ns, "ns", "time in the period, bin centre"),
    ]
    if isinstance(recipe, Recording):
        return out
    flux = recipe.flux
    out.append(Variable("depth", _IMAGE, recipe.depth_m, "m", "depth"))
    if recipe.reflectivity is not None:
        out.append(Variable("reflectivity", _IMAGE, recipe.reflectivity, "1", "reflectivity"))
    out += [
        Variable("signal", _IMAGE, flux.signal, _PHOTONS, "signal"),
        Variable("background", _IMAGE, flux.background, _PHOTONS, "background"),
        Variable("delay", _IMAGE, flux.delay_ns, "ns", "delay of the strongest return"),
    ]
    if len(flux.returns_signal) > 1:
        dims = ("return", *_IMAGE)
        out += [
            Variable("returns_signal", dims, flux.returns_signal, _PHOTONS, "signal of each return"),
            Variable("returns_delay", dims, flux.returns_delay_ns, "ns", "delay of each return"),
        ]
    if flux.waveform is not None:
        parts = flux.waveform.shape[-1]
        centres = (np.arange(parts) + 0.5) * (system.period_ns / parts)
        wave_dims = (*_IMAGE, "waveform_time")
        out += [
            Variable("waveform_time", ("waveform_time",), centres, "ns", "time in the period, part centre"),
            Variable("waveform", wave_dims, flux.waveform, _PHOTONS + " and part", "incident waveform"),
        ]
    if recipe.pixel_index is not None:
        index = recipe.pixel_index.reshape(height, width)
        out.append(Variable("pixel_index", _IMAGE, index, "1", "pixel number of the random streams"))
    return out


def attributes(recipe: Recipe | Recording) -> dict[str, str | int]:
    """Attributes of the file as plain strings and integers; ``complete`` is the writer's own."""
    both: dict[str, str | int] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "system": recipe.system.to_json(),
        "source": recipe.source,
        "version": __version__,
        "engine": recipe.engine,
    }
    if isinstance(recipe, Recording):
        return both
    return {
        **both,
        "engine_settings": json.dumps(recipe.settings),
        "seed": recipe.seed,
        "first_realization": recipe.first_realization,
        "flux": json.dumps(recipe.flux.info, default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v)),
    }


def recipe_from(attrs: Mapping[str, Any], arrays: Mapping[str, Any], realizations: int) -> Recipe | Recording:
    """The recipe or recording from the variables of a file by name and its attributes.

    Waveforms larger than TOL.band_bytes stay on disk.
    """

    def read(name: str) -> NDArray[Any]:
        return values(arrays[name])

    for name in ("system", "engine", "source", "version"):
        if not isinstance(attrs[name], str):
            raise ValueError(f"the attribute {name} must be a text, got {attrs[name]!r}: it is damaged")
    if attrs["engine"] == MEASURED:
        return Recording(
            system=System.from_json(attrs["system"]),
            pixels=(len(read("y")), len(read("x"))),
            realizations=realizations,
            source=attrs["source"],
        )
    flux: Flux
    system = System.from_json(attrs["system"])
    background, info = read("background"), json.loads(attrs["flux"])
    if "waveform" in arrays:
        stored = arrays["waveform"]
        if isinstance(stored, OnDisk) and 8 * math.prod(stored.shape) > TOL.band_bytes:

            def make(rows: slice) -> Flux:
                return Flux(waveform=np.asarray(stored[rows]), background=background[rows], info=info)

            flux = StoredFlux(read("signal"), background, int(stored.shape[-1]), make, info)
        else:
            flux = Flux(waveform=read("waveform"), background=background, info=info)
    elif "returns_signal" in arrays:
        flux = Flux(read("returns_signal"), background, read("returns_delay"), info=info)
    else:
        flux = Flux(read("signal"), background, read("delay"), info=info)
    recipe = Recipe(
        system=system,
        flux=flux,
        engine=attrs["engine"],
        seed=int(attrs["seed"]),
        realizations=realizations,
        first_realization=int(attrs["first_realization"]),
        pixel_index=read("pixel_index").ravel() if "pixel_index" in arrays else None,
        depth_m=read("depth"),
        reflectivity=read("reflectivity") if "reflectivity" in arrays else None,
        source=attrs["source"],
        settings=json.loads(attrs.get("engine_settings", "{}")),
    )
    for variable in variables(recipe):
        if variable.name in arrays:
            _check_variable(variable, arrays[variable.name])
    return recipe


def _check_variable(expected: Variable, stored: Any) -> None:
    """Raise ValueError unless the file has the variable as `variables` gives it for the recipe that was read of it."""
    name, shape, dtype = expected.name, tuple(expected.data.shape), np.dtype(expected.data.dtype)
    if tuple(stored.shape) != shape or stored.dtype != dtype:
        raise ValueError(f"{name} must be {dtype} {shape}, got {stored.dtype} {tuple(stored.shape)}: it is damaged")
    if expected.dims == (name,) and not np.array_equal(values(stored), expected.data):
        raise ValueError(f"the coordinate {name} is not that of its system and flux: it is damaged")
    if name in ("depth", "reflectivity") and np.isinf(expected.data).any():
        raise ValueError(f"{name} must be finite, or NaN where there is no return, got inf: it is damaged")


def check_format(path: Path, attrs: Mapping[str, Any]) -> None:
    """Raise ValueError unless these are the attributes of a cube that this version can read."""
    kind = attrs.get("kind", attrs.get("format"))
    if isinstance(kind, str) and kind in _OTHERS:
        raise ValueError(f"{path} holds {_OTHERS[kind]}")
    if attrs.get("format") != FORMAT:
        raise ValueError(f"{path} is not a cube written by mars-lidar (no attribute format = {FORMAT!r})")
    version = int(attrs.get("format_version", 0))
    if version != FORMAT_VERSION:
        raise ValueError(f"{path} has layout version {version}; version {FORMAT_VERSION} can be read")
