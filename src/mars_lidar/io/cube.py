"""A histogram cube with its system and light: written, read, and as an xarray data set."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import MISSING, dataclass, field, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks, files
from mars_lidar._base.arguments import checked, checked_with_masks
from mars_lidar._base.buckets import in_bucket, place_of, url_of
from mars_lidar._base.display import as_html, brief
from mars_lidar._base.imports import late, needed
from mars_lidar._base.resources import check_memory
from mars_lidar.instrument.system import System
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.io.store import CountArray, OpenedStore, Writer
from mars_lidar.light.flux import Flux

if TYPE_CHECKING:
    import xarray

_MODULES = {".zarr": "zarr_store", ".h5": "hdf5", ".hdf5": "hdf5", ".npz": "npz", ".mat": "mat", ".ptu": "streams.ptu"}
SUFFIXES = tuple(_MODULES)


@dataclass(frozen=True, eq=False, init=False)
class Cube:
    """A histogram cube: counts, the system that recorded them, and the light, if known.

    Returned by `io.load`, `io.foreign_cube` and `io.from_histograms`; input of `reconstruct`, `plot` and `io.save`.

    Parameters
    ----------
    counts
        (realizations, H, W, bins) whole numbers, as `simulate` returns them; leading axes of length 1 may be omitted
        (one exposure, one row of pixels, one pixel).
    system
        Laser, detector and histogram.
    flux
        The light of the pixels, if known.
    depth_m, reflectivity
        Maps (H, W) of the scene, together with a flux; default depth: c tau / 2.

    Attributes
    ----------
    histogram
        (realizations, H, W, bins) uint16 or uint32. From a ``.zarr`` or ``.h5`` it is read from disk when
        indexed: ``cube.histogram[0, y, x]`` reads one chunk. ``np.asarray(cube.histogram)`` reads it all.
    recipe
        Arguments of the simulation, or the `Recording` of measured counts, which have no flux, engine and seed.
    complete
        False for the file of an unfinished run (see `load`).
    registrations
        Total counts; None if they were not counted.
    version
        Version of mars-lidar that wrote the file.
    path
        The file, or None for a cube in memory or at a `url`.
    url
        Address of a remote cube; "" for others.

    Raises
    ------
    ValueError, TypeError
        Shapes of counts, light or maps that do not fit the system or each other; counts that are not whole numbers >=
        0.

    See Also
    --------
    simulate, reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> cube = ml.Cube(ml.simulate(flux, system), system, flux)
    >>> cube.shape
    (1, 1, 2, 128)
    """

    histogram: CountArray
    recipe: Recipe | Recording
    complete: bool = True
    registrations: int | None = None
    version: str = ""
    path: Path | None = None
    url: str = ""
    progress: str = ""
    _close: Callable[[], None] | None = field(default=None, repr=False)
    _identity: str = field(default="", repr=False)  # of the content of the file

    __repr__ = brief

    @checked_with_masks
    def __init__(
        self,
        counts: ArrayLike,
        system: System,
        flux: Flux | None = None,
        *,
        depth_m: ArrayLike | None = None,
        reflectivity: ArrayLike | None = None,
    ) -> None:
        array = _whole_numbers(counts, system)
        realizations, height, width, _ = array.shape
        recipe: Recipe | Recording
        if flux is None:
            if depth_m is not None or reflectivity is not None:
                raise TypeError("depth_m and reflectivity need a flux, which is not given")
            recipe = Recording(system=system, pixels=(height, width), realizations=realizations)
        else:
            if flux.image.shape != (height, width):
                raise ValueError(f"flux must have the pixels of the counts, {height} x {width}, got {flux.shape}")
            maps: Any = {"depth_m": depth_m, "reflectivity": reflectivity}
            recipe = Recipe(system=system, flux=flux, realizations=realizations, engine="", **maps)
        vars(self).update(vars(Cube.of(array, recipe)))

    @classmethod
    def of(cls, histogram: CountArray, recipe: Recipe | Recording, **known: Any) -> Cube:
        """A cube with the recipe that made it or the recording; `known` are further attributes."""
        if tuple(histogram.shape) != recipe.shape:
            raise ValueError(
                f"histogram must have the shape {recipe.shape} of its recipe "
                f"(realizations, H, W, bins), got {tuple(histogram.shape)}"
            )
        cube = cls.__new__(cls)
        default = {each.name: each.default for each in fields(cls) if each.default is not MISSING}
        vars(cube).update(default | known | {"histogram": histogram, "recipe": recipe})
        return cube

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the cube to a file, as `io.save` does; `overwrite` replaces an existing one."""
        save(path, self, overwrite=overwrite)

    def plot(self, **options: Any) -> Any:
        """A figure of maps and of the histograms of a few pixels: `plot.overview`, whose options it takes."""
        return late("plot.figures:overview")(self, **options)

    def _repr_html_(self) -> str:
        y, x = self.shape[1] // 2, self.shape[2] // 2
        counts = self.system.time_ns, np.asarray(self.histogram[0, y, x])
        return as_html(self, {"depth (m)": self.depth_m, f"counts of pixel ({y}, {x}), over time (ns)": counts})

    @property
    def system(self) -> System:
        """Laser, detector and histogram."""
        return self.recipe.system

    @property
    def measured(self) -> bool:
        """Whether the counts were measured, so that flux, engine and seed are not known."""
        return isinstance(self.recipe, Recording)

    def simulation(self, what: str = "this") -> Recipe:
        """The recipe of a simulated cube; ValueError, naming `what` needs it, for a measured one."""
        if isinstance(self.recipe, Recording):
            raise ValueError(f"{self.path or 'the cube'} was measured, not simulated, and {what} needs its light")
        return self.recipe

    @property
    def flux(self) -> Flux:
        """Photons per period at each pixel."""
        return self.simulation("flux").flux

    @property
    def engine(self) -> str:
        """Name of the engine; "measured" for measured counts."""
        return self.recipe.engine

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the engine that the counts depend on; empty for most engines."""
        return self.recipe.settings

    @property
    def seed(self) -> int:
        """Seed of the random streams."""
        return self.simulation("seed").seed

    @property
    def depth_m(self) -> NDArray[np.float64]:
        """True depth (H, W), m; NaN without a return, or if unknown."""
        return self.recipe.depth_m

    @property
    def reflectivity(self) -> NDArray[np.float64] | None:
        """Reflectivity (H, W), or None if the flux was not made from a scene."""
        return self.recipe.reflectivity

    @property
    def time_ns(self) -> NDArray[np.float64]:
        """Bin centres (bins,), ns."""
        return self.system.time_ns

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(realizations, H, W, bins)."""
        return self.recipe.shape

    def __reduce__(self) -> Any:
        """Pickled as its path, for another process to open; without one, with its counts."""
        if self.path is None and not self.url:
            return super().__reduce__()
        path = self.url or Path(self.path or "").absolute()
        return _load_again, (path, not self.complete, self._identity)

    def close(self) -> None:
        """Close the file; the histogram cannot be read from it afterwards."""
        if self._close is not None:
            self._close()

    def __enter__(self) -> Cube:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _whole_numbers(counts: ArrayLike, system: System) -> NDArray[Any]:
    """Counts (realizations, H, W, bins) of the type of the system's histograms."""
    array = np.asarray(checks.numbers("counts", checks.unmasked("counts", counts)))
    if not 1 <= array.ndim <= 4 or array.size == 0 or array.shape[-1] != system.bins:
        raise ValueError(f"counts must be (realizations, H, W, {system.bins}), got shape {array.shape}")
    largest = np.iinfo(system.histogram_dtype).max
    if array.dtype.kind == "f" and not (array == np.floor(array)).all():
        raise ValueError("counts must be whole numbers")
    if array.min() < 0 or array.max() > largest:
        raise ValueError(f"counts must lie in [0, {largest}], got {array.min():g} to {array.max():g}")
    whole = array.astype(system.histogram_dtype, copy=False)
    return whole.reshape((1,) * (4 - whole.ndim) + whole.shape)


def as_cube(cube: Cube | ArrayLike, system: System | None, flux: Flux | None = None) -> Cube:
    """The cube, or a new cube of an array of counts and the system that recorded them."""
    if isinstance(cube, Cube):
        if system is not None or flux is not None:
            raise TypeError("system and flux are for an array of counts: a Cube has its own")
        return cube
    if system is None:
        raise TypeError(
            "cube must be a Cube, or an array of counts beside the system that recorded them (system=...), "
            f"got {type(cube).__name__} alone"
        )
    return Cube(cube, system, flux)


@checked
def save(
    path: str | Path,
    cube: Cube | ArrayLike,
    system: System | None = None,
    flux: Flux | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a cube to a ``.zarr``, ``.h5``, ``.hdf5``, ``.npz``, ``.mat`` or ``.ptu``.

    An array of counts is written as a cube with the `system` that recorded them and, if known, its light.

    Parameters
    ----------
    path
        The file; its suffix chooses the format.
    cube
        A `Cube`, or counts as `mars_lidar.simulate` returns them.
    system, flux
        With counts: the system that recorded them, and the light, if known.
    overwrite
        Replace an existing file.

    Raises
    ------
    ValueError
        Another suffix, or a cube that the format cannot contain.
    TypeError
        Neither a cube nor counts, or counts without a system.
    OSError
        `path` exists and `overwrite` is false, or cannot be written.

    See Also
    --------
    load, Cube, simulate_to

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> cube = ml.Cube(ml.simulate(flux, system), system, flux)
    >>> ml.io.save(folder / "pair.npz", cube)
    >>> ml.io.load(folder / "pair.npz").shape
    (1, 1, 2, 128)
    """
    cube = as_cube(cube, system, flux)
    check_output(path, cube.recipe, overwrite=overwrite)
    with open_writer(path, cube.recipe) as writer:
        copy_counts(cube, writer)


def copy_counts(cube: Cube, writer: Writer) -> None:
    """Write the counts of a cube, block by block."""
    for realizations, rows in cube.recipe.blocks(writer.chunks):
        block = np.asarray(cube.histogram[realizations, rows])
        if block.dtype != cube.recipe.dtype:
            raise TypeError(f"histogram must be {cube.recipe.dtype} for this system, got {block.dtype}")
        writer.write(realizations, rows, block)


def one_exposure(cube: Cube, realization: int) -> Cube:
    """Exposure `realization` of a cube, in memory."""
    k = checks.integer("realization", realization, low=0, high=cube.shape[0] - 1)
    recipe = cube.recipe.replace(realizations=1, first_realization=cube.recipe.first_realization + k)
    return Cube.of(np.asarray(cube.histogram[k : k + 1]), recipe, version=cube.version)


def _load_again(path: str | Path, allow_incomplete: bool, identity: str) -> Cube:
    """Open the file of a pickled cube; FileError if it was replaced in the meantime."""
    cube = load(path, allow_incomplete=allow_incomplete)
    if cube._identity != identity:
        cube.close()
        raise files.FileError(f"{path} was replaced after it was opened: open it again")
    return cube


@checked
def load(path: str | Path, *, allow_incomplete: bool = False) -> Cube:
    """Open a cube; its counts stay on disk until they are indexed.

    Parameters
    ----------
    path
        ``.zarr``, ``.h5``, ``.hdf5``, ``.npz``, ``.mat`` or ``.ptu`` written by mars-lidar; or the URL of a ``.zarr``
        (``https://``, ``s3://``, ...: extra ``remote``), which is fetched in parts when indexed.
    allow_incomplete
        Open the file of an unfinished run; missing parts are read as zeros.

    Raises
    ------
    FileNotFoundError
        No such file.
    IncompleteFileError
        The file of an unfinished run (a ValueError).
    FileError
        Not a cube of mars-lidar, or damaged (a ValueError that names the file); a store that lacks a part.
    TypeError, ValueError
        A path that is neither text nor Path, or an invalid address.

    See Also
    --------
    save, foreign_cube, Cube

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> cube = ml.Cube(ml.simulate(flux, system), system, flux)
    >>> cube.save(folder / "pair.h5")
    >>> with ml.io.load(folder / "pair.h5") as stored:
    ...     stored.shape
    (1, 1, 2, 128)
    """
    source = place_of(path)
    plain = files.finished_name(source)
    if in_bucket(source) and plain.suffix != ".zarr":
        raise files.FileError(f"{source}: only a .zarr is opened from a URL; fetch other files first")
    form = format_of(plain, "path")
    if not in_bucket(source):
        files.check_finished(source)
    if plain != source and plain.suffix in (".mat", ".ptu"):  # formats of which a part cannot be read
        raise files.IncompleteFileError(f"{source} is incomplete: a stopped run left it")
    try:
        with files.reading(source, "a cube of mars-lidar"):
            return _opened(form.open_store(source), source, allow_incomplete, url_of(path) or "")
    except files.FileError as error:
        if source.name.endswith(files.INCOMPLETE_SUFFIX) and not isinstance(error, files.IncompleteFileError):
            raise files.IncompleteFileError(f"{source} is incomplete: a stopped run left it") from error
        raise


def _opened(store: OpenedStore, source: Path, allow_incomplete: bool, url: str = "") -> Cube:
    try:
        complete = store.complete and not source.name.endswith(files.INCOMPLETE_SUFFIX)
        if not (complete or allow_incomplete):
            progress = f" ({store.progress})" if store.progress else ""
            raise files.IncompleteFileError(f"{url or source} is incomplete: its simulation did not finish{progress}")
        histogram = store.arrays.get("histogram")
        if histogram is None:
            raise ValueError(f"{url or source} has no variable 'histogram': its writing stopped before the first count")
        recipe = layout.recipe_from(store.attrs, store.arrays, int(histogram.shape[0]))
        if tuple(histogram.shape) != recipe.shape or histogram.dtype != recipe.dtype:
            raise ValueError(
                f"{url or source} is damaged: its histogram must be {recipe.dtype} {recipe.shape}, "
                f"got {histogram.dtype} {tuple(histogram.shape)}"
            )
        total = store.attrs.get("registrations")
        return Cube.of(
            histogram,
            recipe,
            complete=complete,
            registrations=None if total is None else int(total),
            version=store.attrs["version"],
            path=None if url else source,
            url=url,
            progress=store.progress,
            _close=store.close,
            _identity=store.identity,
        )
    except BaseException:
        store.close()
        raise


def check_output(path: str | Path, recipe: Recipe | Recording, *, overwrite: bool = False) -> None:
    """Raise the errors of writing the cube there, without writing."""
    target = Path(path)
    form = format_of(target, "out")
    files.check_target(target, folder=target.suffix == ".zarr", overwrite=overwrite)
    if target.suffix == ".npz":  # it could be written, but never read back here
        what = f"the counts of {target}, which NumPy reads whole,"
        check_memory(recipe.nbytes, what, "a .zarr or .h5 is read in parts")
    if target.suffix in (".mat", ".ptu"):  # formats with limits of their own
        if isinstance(recipe, Recording):
            raise ValueError(
                f"a {target.suffix} stores the light of a cube, which is unknown for measured counts; use .h5"
            )
        form.check(recipe)


def open_writer(path: str | Path, recipe: Recipe | Recording) -> AbstractContextManager[Writer]:
    """A writer for the format of the suffix, after `check_output`."""
    opened: AbstractContextManager[Writer] = format_of(Path(path), "out").open_writer(Path(path), recipe)
    return opened


def format_of(path: Path, argument: str) -> Any:
    """The module for files of this suffix."""
    checks.suffix(argument, path, SUFFIXES)
    return import_module(f"mars_lidar.io.{_MODULES[path.suffix]}")


_OF_A_RUN = ("engine", "engine_settings", "seed", "first_realization", "source")


@checked_with_masks
def to_xarray(cube: Cube | ArrayLike, system: System | None = None, flux: Flux | None = None) -> xarray.Dataset:
    """Counts with named dimensions, coordinates and units, as ``xarray.open_zarr`` returns them for our stores.

    Parameters
    ----------
    cube
        A `mars_lidar.io.Cube`, or counts of `mars_lidar.simulate`: (realizations, H, W, bins), or fewer dimensions as
        `mars_lidar.io.from_histograms` takes them.
    system
        The system that recorded them; not for a `Cube`, which contains it.
    flux
        The light of counts, if known, (H, W).

    Returns
    -------
    xarray.Dataset
        ``histogram`` (realization, y, x, time), and the light, if known.

    Raises
    ------
    TypeError
        Counts without the system that recorded them, or a cube together with a system.
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
    cube = as_cube(cube, system, flux)
    variables: dict[str, Any] = {"histogram": (layout.DIMS, np.asarray(cube.histogram), dict(layout.HISTOGRAM_LABELS))}
    coordinates: dict[str, Any] = {}
    for variable in layout.variables(cube.recipe):
        entry = (variable.dims, np.asarray(variable.data), variable.labels)
        (coordinates if variable.dims == (variable.name,) else variables)[variable.name] = entry
    attributes: dict[str, Any] = {**layout.attributes(cube.recipe), "complete": True}
    if not cube.version:  # how an array was made is not known
        attributes = {name: value for name, value in attributes.items() if name not in _OF_A_RUN}
    return xarray.Dataset(variables, coordinates, attributes)  # type: ignore[no-any-return]
