"""Files of reconstructed maps: .zarr, .h5 or .npz with named dimensions, units and their source.

Variables (method, realization, y, x): ``depth``, ``reflectivity``, ``signal``, ``background``, ``delay``, standard
errors (NaN for methods without them), ``significance`` and ``flags``; for image methods half widths of 90 % intervals
and ``outlier``. With several returns:
``returns`` (their number), and for each (method, realization, y, x, return) ``return_depth``, ``return_signal``,
``return_delay``, their errors, and ``return_false_alarm``, nearest first, NaN beyond the last. Attributes: ``format`` =
"mars-lidar maps", ``format_version``, ``system`` (JSON), ``level``, ``source`` (the cube), ``version``.
"""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks, manifest
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import beside, check_finished, check_target, reading
from mars_lidar._base.hdf5 import ForgivingFile, seal
from mars_lidar._version import __version__
from mars_lidar.instrument.system import System
from mars_lidar.io import hdf5, npz, zarr_store
from mars_lidar.io.cube import format_of
from mars_lidar.io.layout import Variable
from mars_lidar.io.store import values

FORMAT, FORMAT_VERSION = "mars-lidar maps", 1
SUFFIXES = (".zarr", ".h5", ".hdf5", ".npz")
DIMS = ("method", "realization", "y", "x")
RETURN = "return"
_UNITS, _WORDS = ("1", "pixel", "pixel"), ("number in the cube", "image row", "image column")  # of `DIMS[1:]`
_PHOTONS = "photons per laser period"
_VARIABLES = {  # name in the file: attribute, unit, in words
    "depth": ("depth_m", "m", "depth"),
    "reflectivity": ("reflectivity", "1", "reflectivity, signal over level"),
    "signal": ("signal", _PHOTONS, "signal"),
    "background": ("background", _PHOTONS, "background"),
    "delay": ("delay_ns", "ns", "delay"),
    "depth_error": ("depth_error_m", "m", "standard error of the depth"),
    "delay_error": ("delay_error_ns", "ns", "standard error of the delay"),
    "signal_error": ("signal_error", _PHOTONS, "standard error of the signal"),
    "background_error": ("background_error", _PHOTONS, "standard error of the background"),
    "significance": ("significance", "1", "significance of the signal, standard deviations"),
    "p_value": ("p_value", "1", "probability of a histogram as far from the law of its estimate"),
    "flags": ("flags", "1", "1 empty, 2 no signal, 4 saturated, 8 unconverged, 16 more returns, 32 filled, 64 misfit"),
    "depth_half_width": ("depth_half_width_m", "m", "half width of the 90 % interval of the depth"),
    "delay_half_width": ("delay_half_width_ns", "ns", "half width of the 90 % interval of the delay"),
    "outlier": ("outlier", "1", "probability that the depth is that of another surface"),
    "returns": ("returns.count", "1", "number of returns"),
}
_OF_EACH = ("depth", "signal", "delay", "depth_error", "signal_error", "delay_error")
_OF_RETURNS = {f"return_{name}": (*_VARIABLES[name][:2], f"{_VARIABLES[name][2]} of each return") for name in _OF_EACH}
_OF_RETURNS["return_false_alarm"] = ("false_alarm", "1", "chance of so much likelihood by a return that is not there")


def check_maps_output(path: str | Path, *, overwrite: bool = False) -> None:
    """Raise what `save_maps` would raise for this path, without touching anything."""
    target = Path(path)
    checks.suffix("out", target, SUFFIXES)
    check_target(target, folder=target.suffix == ".zarr", overwrite=overwrite)


@checked
def save_maps(path: str | Path, results: Mapping[str, Any], *, source: str = "", overwrite: bool = False) -> Path:
    """Write each `mars_lidar.Reconstruction` (realizations, H, W) of a cube by method, completely or not at all."""
    target = Path(path)
    check_maps_output(target, overwrite=overwrite)
    variables, attrs = _contents(results, source)
    with beside(target, folder=target.suffix == ".zarr") as unfinished:
        if target.suffix == ".zarr":
            import zarr

            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "The data type")  # of the methods' names: fixed-length text
                group = zarr.create_group(unfinished, zarr_format=3)
                zarr_store.add(group, variables)
                zarr_store.consolidated(group)
                manifest.seal(unfinished, attrs)
        elif target.suffix == ".npz":
            with npz.archive(unfinished) as archive:
                npz.add_attributes(archive, {**attrs, "variables": npz.add(archive, variables)})
        else:
            with ForgivingFile(unfinished).hdf5() as file:
                file.attrs.update(attrs)
                hdf5.add(file, variables, compression="gzip", shuffle=True)
                hdf5.name_axes(file, {v.name: v.dims for v in variables})
                seal(file)
    return target


@checked
def load_maps(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Variables by name, and attributes, of a file of `save_maps`. ``xarray.open_zarr`` opens a .zarr as well.

    Raises
    ------
    FileNotFoundError, ValueError
        A file that is missing, damaged, or not written by `save_maps`.
    TypeError
        A path that is neither text nor Path.
    """
    source = Path(path)
    check_finished(source)
    with reading(source, "maps of mars-lidar"):
        checks.suffix("path", source, SUFFIXES)
        with contextlib.closing(format_of(source, "path").open_store(source, _check_format)) as store:
            variables = {name: values(array) for name, array in store.arrays.items()}
        if variables.get("method", np.empty(0)).dtype.kind == "S":
            variables["method"] = variables["method"].astype(str)
        _check(variables, store.attrs)
        return variables, dict(store.attrs)


def _check_format(path: Path, attrs: Mapping[str, Any]) -> None:
    if attrs.get("format") != FORMAT:
        raise ValueError(f"{path} is not a file of maps of mars-lidar (no attribute format = {FORMAT!r})")
    if attrs.get("complete", True) is not True:  # mars-lidar writes maps as a whole
        raise ValueError(f"{path} is damaged: its attribute complete is {attrs['complete']!r}")


def _check(variables: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any]) -> None:
    """Raise ValueError unless these are the maps that `save_maps` writes."""
    version = int(attrs.get("format_version", 0))
    if version != FORMAT_VERSION:
        raise ValueError(f"has layout version {version}; version {FORMAT_VERSION} can be read")
    System.from_json(str(attrs["system"]))
    missing = [name for name in (*DIMS, "depth", "flags") if name not in variables]
    if missing:
        raise ValueError(f"has no variable {missing[0]!r}")
    shape = tuple(variables[dim].size for dim in DIMS)
    for dim, size in zip(DIMS[1:], shape[1:], strict=True):
        if not (variables[dim].dtype.kind in "iu" and np.array_equal(variables[dim], np.arange(size))):
            raise ValueError(
                f"the coordinate {dim} must be 0 to {size - 1}, got {variables[dim].dtype} {variables[dim].shape}"
            )
    methods = variables["method"]
    if methods.ndim != 1 or methods.dtype.kind not in "UT" or len(set(methods.tolist())) != len(methods):
        raise ValueError(f"method must be names, each once, got {methods.dtype} {methods.shape}")
    levels = json.loads(attrs["level"])
    if not isinstance(levels, dict) or {*levels} != {*methods.tolist()}:
        raise ValueError(f"the attribute level must have a number for each method, got {attrs['level']!r}")
    for method, level in levels.items():
        if not isinstance(level, int | float) or isinstance(level, bool) or level < 0.0:
            raise ValueError(f"the level of {method} must be a number >= 0, got {level!r}")
    for name in ("source", "version"):
        if not isinstance(attrs[name], str):
            raise ValueError(f"the attribute {name} must be a text, got {attrs[name]!r}")
    for name in (*_VARIABLES, *_OF_RETURNS):
        values = variables.get(name)
        if name in _OF_RETURNS and values is not None:
            values = values[..., 0] if values.ndim == len(DIMS) + 1 and values.shape[-1] else values
        if values is not None and (values.shape != shape or values.dtype.kind not in "fiu"):
            raise ValueError(f"{name} must be numbers {shape} {DIMS}, got {values.dtype} {values.shape}")
        if name.endswith("_error") and values is not None and (values < 0).any():
            raise ValueError(f"{name} must not be negative, got {np.nanmin(values):g}")


def _contents(results: Mapping[str, Any], source: str) -> tuple[list[Variable], dict[str, Any]]:
    first = next(iter(results.values()))
    shape: tuple[int, ...] = first.depth_m.shape
    if len(shape) != 3:
        raise ValueError(f"maps must be (realizations, H, W), got shape {shape}")
    variables = [Variable("method", ("method",), np.array(list(results)), "1", "reconstruction method")]
    for dim, size, unit, words in zip(DIMS[1:], shape, _UNITS, _WORDS, strict=True):
        variables.append(Variable(dim, (dim,), np.arange(size), unit, words))
    for name, (attribute, unit, words) in _VARIABLES.items():
        given = [_find(each, attribute) for each in results.values()]
        if any(values is not None for values in given):
            variables.append(Variable(name, DIMS, _stacked(given, shape), unit, words))
    most = max((each.returns.depth_m.shape[-1] for each in results.values() if each.returns is not None), default=0)
    if most:
        variables.append(Variable(RETURN, (RETURN,), np.arange(most), "1", "return, nearest first"))
        for name, (attribute, unit, words) in _OF_RETURNS.items():
            given = [_find(each, f"returns.{attribute}") for each in results.values()]
            variables.append(Variable(name, (*DIMS, RETURN), _stacked(given, (*shape, most)), unit, words))
    attrs = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "system": first.system.to_json(),
        "level": json.dumps({name: each.level for name, each in results.items()}),
        "source": source,
        "version": __version__,
    }
    return variables, attrs


def _find(of: Any, attribute: str) -> NDArray[Any] | None:
    value = of
    for name in attribute.split("."):
        value = None if value is None else getattr(value, name)
    return None if value is None else np.asarray(value)


def _stacked(given: list[NDArray[Any] | None], shape: tuple[int, ...]) -> NDArray[Any]:
    """The maps of all methods; NaN for those that give none, 0 of a number of returns."""
    whole_numbers = all(values is None or values.dtype.kind == "u" for values in given)
    blank = np.zeros(shape, np.uint8) if whole_numbers else np.full(shape, np.nan)
    return np.stack([blank if values is None else values for values in given])
