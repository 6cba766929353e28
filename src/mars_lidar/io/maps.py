"""Files of reconstructed maps: .zarr, .h5 or .npz with named dimensions, units and what they were made of.

Variables (method, realization, y, x): ``depth``, ``reflectivity``, ``signal``, ``background``, ``delay``, errors of the
methods that give them (NaN for the others), ``significance`` and ``flags``. Where several returns were looked for:
``returns`` (their number), and of each (method, realization, y, x, return) ``return_depth``, ``return_signal``,
``return_delay``, their errors, and ``return_false_alarm``, nearest first, NaN beyond the last. Attributes: ``format`` =
"mars-lidar maps", ``format_version``, ``system`` (JSON), ``level``, ``source`` (the cube), ``version``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import manifest
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import TemporarySibling, check_target, open_npz, reading, whole
from mars_lidar._base.hdf5 import new_file, open_hdf5, seal, with_checksums
from mars_lidar.instrument.system import System

FORMAT, FORMAT_VERSION = "mars-lidar maps", 1
SUFFIXES = (".zarr", ".h5", ".hdf5", ".npz")
DIMS = ("method", "realization", "y", "x")
RETURN = "return"
_PHOTONS = "photons per laser period"
_VARIABLES = {  # name in the file: attribute, unit, in words
    "depth": ("depth_m", "m", "depth"),
    "reflectivity": ("reflectivity", "1", "reflectivity, signal over level"),
    "signal": ("signal", _PHOTONS, "signal"),
    "background": ("background", _PHOTONS, "background"),
    "delay": ("delay_ns", "ns", "delay of the return"),
    "depth_error": ("depth_error_m", "m", "standard error of the depth"),
    "delay_error": ("delay_error_ns", "ns", "standard error of the delay"),
    "signal_error": ("signal_error", _PHOTONS, "standard error of the signal"),
    "background_error": ("background_error", _PHOTONS, "standard error of the background"),
    "significance": ("significance", "1", "significance of the signal, standard deviations"),
    "flags": ("flags", "1", "1 empty, 2 no signal, 4 saturated, 8 unconverged, 16 more returns"),
    "returns": ("returns.count", "1", "number of returns"),
    "radius": ("radius", "pixel", "radius of the window whose photons were taken together"),
}
_OF_RETURNS = {  # the same of each return
    "return_depth": ("depth_m", "m", "depth of each return"),
    "return_signal": ("signal", _PHOTONS, "signal of each return"),
    "return_delay": ("delay_ns", "ns", "delay of each return"),
    "return_depth_error": ("depth_error_m", "m", "standard error of the depth of each return"),
    "return_signal_error": ("signal_error", _PHOTONS, "standard error of the signal of each return"),
    "return_delay_error": ("delay_error_ns", "ns", "standard error of the delay of each return"),
    "return_false_alarm": ("false_alarm", "1", "chance of so much likelihood by a return that is not there"),
}


class Maps(Protocol):
    """What is written of a `mars_lidar.Reconstruction`: its maps (realizations, H, W) and its system."""

    @property
    def depth_m(self) -> NDArray[np.float64]:
        """Depth, m."""

    @property
    def system(self) -> System:
        """The system that the cube was recorded with."""

    @property
    def returns(self) -> Any:
        """Every return, or None where one was looked for."""

    @property
    def level(self) -> float:
        """Signal, photons per period, of a surface of reflectivity 1."""


def check_maps_output(path: str | Path, *, overwrite: bool = False) -> None:
    """Raise what `save_maps` would raise for this path, without touching anything."""
    target = Path(path)
    if target.suffix not in SUFFIXES:
        raise ValueError(f"out must end in one of {', '.join(SUFFIXES)}, got {str(path)!r}")
    check_target(target, folder=target.suffix == ".zarr", overwrite=overwrite)


@checked
def save_maps(path: str | Path, results: Mapping[str, Maps], *, source: str = "", overwrite: bool = False) -> Path:
    """Write reconstructions (realizations, H, W) of one cube, by method; the file is whole or not there at all."""
    target = Path(path)
    check_maps_output(target, overwrite=overwrite)
    variables, attrs = _contents(results, source)
    with TemporarySibling(target).writing() as unfinished:
        if target.suffix == ".zarr":
            shutil.rmtree(unfinished, ignore_errors=True)
            _write_zarr(unfinished, variables)
            manifest.seal(unfinished, dict(attrs))
            if target.exists():
                (target / "zarr.json").unlink(missing_ok=True)
                shutil.rmtree(target)
        elif target.suffix == ".npz":
            _write_npz(unfinished, variables, attrs)
        else:
            _write_hdf5(unfinished, variables, attrs)
    return target


@checked
def load_maps(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Variables by name, and attributes, of a file of `save_maps`. ``xarray.open_zarr`` opens a .zarr as well."""
    source = Path(path)
    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist")
    with reading(source, "maps of mars-lidar"):
        found, attrs = _read(source)
        if attrs.get("format") != FORMAT:
            raise ValueError(f"{source} is not a file of maps of mars-lidar (no attribute format = {FORMAT!r})")
        _check(found, attrs)
        return found, attrs


def _read(source: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    if source.suffix == ".zarr":
        import zarr

        manifest.require(source)
        group: Any = zarr.open_group(source, mode="r")
        return {name: whole(group[name]) for name in group.array_keys()}, dict(group.attrs)
    if source.suffix == ".npz":
        with open_npz(source) as archive:
            attrs = json.loads(archive["attributes"].item()) if "attributes" in archive.files else {}
            return {name: archive[name] for name in archive.files if name != "attributes"}, attrs
    with open_hdf5(source) as file:
        found = {name: whole(file[name]) for name in file}
        found["method"] = found["method"].astype(str) if "method" in found else np.empty(0)
        return found, dict(file.attrs)


def _check(found: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any]) -> None:
    """Raise ValueError unless these are the maps that `save_maps` writes."""
    version = int(attrs.get("format_version", 0))
    if version != FORMAT_VERSION:
        raise ValueError(f"has layout version {version}; version {FORMAT_VERSION} can be read")
    System.from_json(str(attrs["system"]))
    missing = [name for name in (*DIMS, "depth", "flags") if name not in found]
    if missing:
        raise ValueError(f"has no variable {missing[0]!r}")
    shape = tuple(found[dim].size for dim in DIMS)
    for name in (*_VARIABLES, *_OF_RETURNS):
        values = found.get(name)
        if name in _OF_RETURNS and values is not None:
            values = values[..., 0] if values.ndim == len(DIMS) + 1 and values.shape[-1] else values
        if values is not None and (values.shape != shape or values.dtype.kind not in "fiu"):
            raise ValueError(f"{name} must be numbers {shape} {DIMS}, got {values.dtype} {values.shape}")
        if name.endswith("_error") and values is not None and (values < 0).any():
            raise ValueError(f"{name} must not be negative, got {np.nanmin(values):g}")


def _contents(
    results: Mapping[str, Maps], source: str
) -> tuple[dict[str, tuple[tuple[str, ...], NDArray[Any], dict[str, str]]], dict[str, Any]]:
    from mars_lidar._version import __version__

    first = next(iter(results.values()))
    if first.depth_m.ndim != 3:
        raise ValueError(f"maps must be (realizations, H, W), got shape {first.depth_m.shape}")
    variables: dict[str, tuple[tuple[str, ...], NDArray[Any], dict[str, str]]] = {
        "method": (("method",), np.array(list(results)), {"long_name": "reconstruction method"})
    }
    for dim, size in zip(DIMS[1:], first.depth_m.shape, strict=True):
        variables[dim] = ((dim,), np.arange(size), {"units": "1" if dim == "realization" else "pixel"})
    for name, (attribute, unit, words) in _VARIABLES.items():
        given = [_find(each, attribute) for each in results.values()]
        if any(values is not None for values in given):
            variables[name] = (DIMS, _stacked(given, first.depth_m.shape), {"units": unit, "long_name": words})
    most = max((each.returns.depth_m.shape[-1] for each in results.values() if each.returns is not None), default=0)
    if most:
        variables[RETURN] = ((RETURN,), np.arange(most), {"units": "1", "long_name": "return, nearest first"})
        for name, (attribute, unit, words) in _OF_RETURNS.items():
            given = [_find(each, f"returns.{attribute}") for each in results.values()]
            stack = _stacked(given, (*first.depth_m.shape, most))
            variables[name] = ((*DIMS, RETURN), stack, {"units": unit, "long_name": words})
    attrs = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "system": first.system.to_json(),
        "level": json.dumps({name: each.level for name, each in results.items()}),
        "source": source,
        "version": __version__,
    }
    return variables, attrs


def _find(of: Maps, attribute: str) -> NDArray[Any] | None:
    value: Any = of
    for name in attribute.split("."):
        value = None if value is None else getattr(value, name)
    return None if value is None else np.asarray(value)


def _stacked(given: list[NDArray[Any] | None], shape: tuple[int, ...]) -> NDArray[Any]:
    """The maps of all methods; NaN for those that give none, 0 of a number of returns."""
    whole_numbers = all(values is None or values.dtype.kind == "u" for values in given)
    blank = np.zeros(shape, np.uint8) if whole_numbers else np.full(shape, np.nan)
    return np.stack([blank if values is None else values for values in given])


def _write_zarr(path: Path, variables: Mapping[str, Any]) -> None:
    import warnings

    import xarray
    from zarr.codecs import Crc32cCodec, ZstdCodec

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata", category=UserWarning)
        warnings.filterwarnings("ignore", "The data type")  # of the methods' names: fixed-length text
        xarray.Dataset(
            {name: value for name, value in variables.items() if name not in (*DIMS, RETURN)},
            coords={name: variables[name] for name in (*DIMS, RETURN) if name in variables},
        ).to_zarr(
            path,
            mode="w",
            zarr_format=3,
            encoding={name: {"compressors": (ZstdCodec(), Crc32cCodec())} for name in variables},
        )


def _write_npz(path: Path, variables: Mapping[str, Any], attrs: Mapping[str, Any]) -> None:
    labels = {name: {"dims": dims, **more} for name, (dims, _, more) in variables.items()}
    text = np.asarray(json.dumps({**attrs, "variables": labels}))
    with path.open("wb") as file:
        np.savez_compressed(file, attributes=text, **{name: data for name, (_, data, _) in variables.items()})


def _write_hdf5(path: Path, variables: Mapping[str, Any], attrs: Mapping[str, Any]) -> None:
    with new_file(path) as file:
        file.attrs.update(attrs)
        for name, (dims, data, more) in variables.items():
            if data.dtype.kind == "U":
                data = np.char.encode(data)
            packed = {"compression": "gzip", "shuffle": True} if data.ndim > 1 else {}
            packed |= with_checksums(data.shape, data.dtype)
            stored = file.create_dataset(name, data=data, **packed)
            stored.attrs.update(more)
            for k, dim in enumerate(dims):
                stored.dims[k].label = dim
        scales = [dim for dim in (*DIMS, RETURN) if dim in variables]
        for dim in scales:
            file[dim].make_scale(dim)
        for name, (dims, _, _) in variables.items():
            if name not in scales:
                for k, dim in enumerate(dims):
                    file[name].dims[k].attach_scale(file[dim])
        seal(file)
