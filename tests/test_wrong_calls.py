"""Wrong calls: every argument of every public function, by its signature, is refused by its name.

A value that does no harm, or that means something, stands in `ACCEPTED` with the reason. The good calls are below; what
is wrong for an argument follows from its annotation.
"""

import fnmatch
import functools
import inspect
import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, get_args

import h5py
import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml
from mars_lidar import io, plot, reconstruction, statistics
from mars_lidar.dataset import DatasetRecipe, Light, estimate, export, open_dataset, read_sparse, read_view, verify
from mars_lidar.io.maps import load_maps, save_maps
from tests.harness.command import command_line, ok, options_of

SYSTEM = make_system(30.0, 20, 16, sigma_ns=2.0)
System = type(SYSTEM)
FLUX = ml.Flux(np.full((2, 3), 0.5), 0.1, 40.0)
PIXEL = ml.Flux(0.5, 0.1, 40.0)
SYNCHRONOUS = SYSTEM.replace(detector=ml.Detector(dead_time_ns=30.0, mode="synchronous"))
SCENE = ml.Scene(np.full((2, 3), 2.0), np.full((2, 3), 0.5))
NUMBERS = itertools.count()
RECIPE = {"scenes": {"example": "room", "size": [3, 4]}, "systems": [SYSTEM], "light": {"signal": 0.5}}


@functools.cache
def times() -> ml.Timestamps:
    return ml.simulate_timestamps(ml.Flux(0.05, 0.02, 40.0), SYSTEM.replace(cycles=100_000))


@functools.cache
def counts() -> np.ndarray:
    return ml.simulate(FLUX, SYSTEM)


@functools.cache
def table() -> ml.Table:
    return ml.Table.build(SYSTEM, signal=(0.1, 1, 2), background=(0.1, 1, 2))


@functools.cache
def chain() -> statistics.PhaseChain:
    return statistics.PhaseChain(np.full(8, 0.1), 0.3)


def cube() -> io.Cube:
    return io.from_histograms(counts(), SYSTEM)


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    return make(tmp_path_factory.mktemp("wrong"))


def make(folder: Path) -> Path:
    io.simulate_to(folder / "cube.zarr", FLUX, SYSTEM)
    ml.generate(RECIPE, folder / "set.zarr")
    times().save(folder / "photons.npz")
    table().save(folder / "table.h5")
    np.save(folder / "light.npy", np.random.default_rng(1).random((2, 3, 50)))
    np.save(folder / "counts.npy", counts()[0])
    io.save_mat(folder / "a.mat", io.load(folder / "cube.zarr"))
    np.save(folder / "depth.npy", np.full((2, 3), 2.0))
    with h5py.File(folder / "capture.h5", "w") as file:  # of tal: T x y
        file["H"], file["H_format"], file["delta_t"] = np.ones((16, 3, 2)), 1, 0.299792458 * SYSTEM.bin_ns
    SYSTEM.save(folder / "system.yaml")
    save_maps(folder / "maps.npz", {"peak": ml.reconstruct(counts(), SYSTEM, "peak")})
    (folder / "scene.yaml").write_text("depth: depth.npy\nlight: {signal: 1, sbr: 2}\n")
    return folder


def transient() -> io.Transient:
    return io.Transient(np.ones((2, 3, 8)), 5.0)


# name: a good call, with those arguments by name that it needs; others have their defaults
CALLS: dict[str, Callable[[Path], partial[Any]]] = {
    "System": lambda _: partial(
        ml.System, period_ns=100.0, cycles=5, bins=8, pulse=SYSTEM.pulse, detector=SYSTEM.detector
    ),
    "System.from_dict": lambda _: partial(ml.System.from_dict, data=SYSTEM.to_dict()),
    "System.from_json": lambda _: partial(ml.System.from_json, text=SYSTEM.to_json()),
    "System.load": lambda at: partial(ml.System.load, path=at / "system.yaml"),
    "System.save": lambda at: partial(SYSTEM.save, path=at / "a.yaml"),
    "System.delay_ns": lambda _: partial(SYSTEM.delay_ns, depth_m=1.0),
    "System.depth_m": lambda _: partial(SYSTEM.depth_m, delay_ns=1.0),
    "Detector": lambda _: partial(ml.Detector, dead_time_ns=5.0),
    "Detector.preset": lambda _: partial(ml.Detector.preset, name="excelitas-spcm-aqrh"),
    "Detector.from_dict": lambda _: partial(ml.Detector.from_dict, data={"dead_time_ns": 5.0}),
    "GaussianPulse": lambda _: partial(ml.GaussianPulse, sigma_ns=1.0),
    "GaussianPulse.from_fwhm": lambda _: partial(ml.GaussianPulse.from_fwhm, fwhm_ns=1.0),
    "SampledPulse": lambda _: partial(ml.SampledPulse, values=[1.0, 2.0, 1.0], bin_ns=0.5),
    "Jitter": lambda _: partial(ml.Jitter, sigma_ns=0.1),
    "Jitter.from_fwhm": lambda _: partial(ml.Jitter.from_fwhm, fwhm_ns=0.1),
    "SampledJitter": lambda _: partial(ml.SampledJitter, values=(1.0, 2.0, 1.0), bin_ns=0.5),
    "Afterpulsing": lambda _: partial(ml.Afterpulsing, probability=0.01, delay_ns=50.0),
    "Crosstalk": lambda _: partial(ml.Crosstalk, probability=0.01),
    "dark_count_map": lambda _: partial(ml.dark_count_map, shape=(2, 3), median_hz=100.0),
    "Flux": lambda _: partial(ml.Flux, signal=0.5, background=0.1, delay_ns=40.0),
    "Flux waveform": lambda _: partial(ml.Flux, waveform=np.full(8, 0.1)),
    "Flux.from_transient": lambda _: partial(
        ml.Flux.from_transient, values=np.ones((2, 3, 8)), system=SYSTEM, bin_ns=5.0, signal=0.5
    ),
    "Flux.detected": lambda _: partial(FLUX.detected, system=SYSTEM),
    "Flux.with_dark_counts": lambda _: partial(FLUX.with_dark_counts, rate_hz=100.0, system=SYSTEM),
    "Flux.in_fog": lambda _: partial(FLUX.in_fog, system=SYSTEM, extinction_per_m=0.01, backscatter=0.01),
    "Scene": lambda _: partial(ml.Scene, depth_m=np.ones((2, 3)), reflectivity=0.5 * np.ones((2, 3))),
    "Scene.resize": lambda _: partial(SCENE.resize, size=(4, 6)),
    "Scene.example": lambda _: partial(ml.Scene.example, size=4),
    "Scene.flux": lambda _: partial(SCENE.flux, system=SYSTEM, signal=0.5, sbr=2.0),
    "Scene.from_rgbd": lambda at: partial(ml.Scene.from_rgbd, depth_path=at / "depth.npy"),
    "simulate": lambda _: partial(ml.simulate, flux=FLUX, system=SYSTEM),
    "simulate_timestamps": lambda _: partial(ml.simulate_timestamps, flux=FLUX, system=SYSTEM),
    "reconstruct": lambda _: partial(ml.reconstruct, cube=counts(), system=SYSTEM),
    "Cube": lambda _: partial(ml.Cube, counts=counts(), system=SYSTEM, flux=FLUX),
    "cramer_rao": lambda _: partial(ml.cramer_rao, flux=PIXEL, system=SYSTEM),
    **{
        call.__name__: lambda _, call=call: partial(call, flux=PIXEL, system=SYSTEM)
        for call in (ml.count_law, ml.mean_histogram, ml.registration_pdf, ml.joint_law)
    },
    "holding_time_covariance": lambda _: partial(ml.holding_time_covariance, flux=PIXEL, system=SYSTEM),
    "Table.build": lambda _: partial(ml.Table.build, system=SYSTEM, signal=(0.1, 1, 2), background=(0.1, 1, 2)),
    "Table.quantisation_error": lambda _: partial(table().quantisation_error, samples=3),
    "Table.save": lambda at: partial(table().save, path=at / "b.h5", overwrite=True),
    "Table.load": lambda at: partial(ml.Table.load, path=at / "table.h5"),
    "calibrate": lambda _: partial(ml.calibrate, times=times()),
    "Timestamps.save": lambda at: partial(times().save, path=at / "b.npz", overwrite=True),
    "Timestamps.load": lambda at: partial(ml.Timestamps.load, path=at / "photons.npz"),
    "Timestamps.pixel": lambda _: partial(times().pixel, y=0, x=0),
    "to_xarray": lambda _: partial(ml.to_xarray, cube=counts(), system=SYSTEM, flux=FLUX),
    "generate": lambda at: partial(ml.generate, recipe=RECIPE, out=at / f"g{next(NUMBERS)}.zarr"),
    "estimate": lambda _: partial(estimate, recipe=RECIPE),
    "export": lambda at: partial(export, dataset=at / "set.zarr", out=at / f"exported{next(NUMBERS)}", layout="sun"),
    "open_dataset": lambda at: partial(open_dataset, path=at / "set.zarr"),
    "dataset.verify": lambda at: partial(verify, path=at / "set.zarr"),
    "read_sparse": lambda at: partial(read_sparse, dataset=at / "set.zarr", sample=0),
    "read_view": lambda at: partial(read_view, scene=at / "scene.yaml", system=SYSTEM),
    "DatasetRecipe.from_dict": lambda _: partial(DatasetRecipe.from_dict, data=RECIPE),
    "io.load": lambda at: partial(io.load, path=at / "cube.zarr"),
    "io.save": lambda at: partial(io.save, path=at / "c.npz", cube=cube(), overwrite=True),
    "io.simulate_to": lambda at: partial(io.simulate_to, path=at / "d.npz", flux=FLUX, system=SYSTEM, overwrite=True),
    "io.from_histograms": lambda _: partial(io.from_histograms, counts=counts(), system=SYSTEM),
    "io.from_photon_times": lambda _: partial(
        io.from_photon_times, cells=[[np.array([1.0, 2.0]), np.array([3.0])]], system=SYSTEM
    ),
    "io.convert": lambda at: partial(io.convert, source=at / "cube.zarr", target=at / "e.npz", overwrite=True),
    "io.foreign_cube": lambda at: partial(io.foreign_cube, path=at / "counts.npy", system=SYSTEM),
    "io.points": lambda _: partial(io.points, depth_m=np.ones((2, 3)), focal_px=100.0),
    "io.save_cloud": lambda at: partial(
        io.save_cloud, path=at / "a.ply", depth_m=np.ones((2, 3)), focal_px=100.0, overwrite=True
    ),
    "io.save_capture": lambda at: partial(
        io.save_capture, path=at / "b.h5", cube=io.load(at / "cube.zarr"), like=at / "capture.h5", overwrite=True
    ),
    "io.read_transient": lambda at: partial(io.read_transient, path=at / "light.npy", bin_ns=1.0),
    "io.save_mat": lambda at: partial(io.save_mat, path=at / "a.mat", cube=io.load(at / "cube.zarr"), overwrite=True),
    "io.scan": lambda at: partial(io.scan, folder=at),
    "io.photons": lambda at: partial(io.photons, cube=io.load(at / "cube.zarr")),
    "io.regenerate": lambda at: partial(io.regenerate, cube=io.load(at / "cube.zarr")),
    "io.verify": lambda at: partial(io.verify, cube=io.load(at / "cube.zarr")),
    "io.Transient": lambda _: partial(io.Transient, values=np.ones((2, 3, 8)), bin_ns=5.0),
    "io.Transient.flux": lambda _: partial(transient().flux, system=SYSTEM, signal=0.5),
    "io.Transient.resize": lambda _: partial(transient().resize, size=(4, 6)),
    "io.Recipe": lambda _: partial(io.Recipe, system=SYSTEM, flux=FLUX),
    "io.Recording": lambda _: partial(io.Recording, system=SYSTEM, pixels=(2, 3)),
    "io.SceneFile.load": lambda at: partial(io.SceneFile(depth=at / "depth.npy").load),
    **{
        f"statistics.{call.__name__}": lambda _, call=call: partial(call, flux=PIXEL, system=SYSTEM)
        for call in (
            statistics.electronics_moments,
            statistics.exposure_moments,
            statistics.mean_histogram,
            statistics.photons_per_bin,
        )
    },
    "statistics.PhaseChain": lambda _: partial(statistics.PhaseChain, photons=np.full(8, 0.1), dead_time=0.3),
    "statistics.holding_times": lambda _: partial(statistics.holding_times, chain=chain()),
    "statistics.constant_light_rate": lambda _: partial(
        statistics.constant_light_rate, rate_hz=1e6, detector=SYSTEM.detector
    ),
    "Coates.rates": lambda _: partial(reconstruction.Coates().rates, cube=np.minimum(counts(), 1), system=SYNCHRONOUS),
    "GeneralisedCoates.rates": lambda _: partial(
        reconstruction.GeneralisedCoates().rates, cube=counts(), system=SYSTEM
    ),
    "ChainCorrection.rates": lambda _: partial(reconstruction.ChainCorrection().rates, cube=counts(), system=SYSTEM),
    "reconstruct.log_likelihood": lambda _: partial(
        reconstruction.log_likelihood, histogram=counts()[0, 0, 0], flux=PIXEL, system=SYSTEM
    ),
    "reconstruct.returns_bound": lambda _: partial(
        reconstruction.returns_bound, flux=ml.Flux.multi(PIXEL, ml.Flux(0.2, 0.0, 60.0)), system=SYSTEM
    ),
    "reconstruct.systematic_error": lambda _: partial(reconstruction.systematic_error, flux=PIXEL, system=SYSTEM),
    "reconstruct.window_weights": lambda _: partial(reconstruction.window_weights, system=SYSTEM, delay_ns=40.0),
    "reconstruct.window_error": lambda _: partial(
        reconstruction.window_error, weights=np.ones(16), flux=PIXEL, system=SYSTEM
    ),
    "plot.count_maps": lambda at: partial(plot.count_maps, cube=io.load(at / "cube.zarr")),
    "plot.depth_error_m": lambda at: partial(
        plot.depth_error_m, cube=io.load(at / "cube.zarr"), estimate_m=np.full((2, 3), 6.0)
    ),
    "plot.example_pixels": lambda _: partial(plot.example_pixels, flux=FLUX, depth_m=np.full((2, 3), 6.0)),
    "plot.incident_rate": lambda _: partial(plot.incident_rate, flux=FLUX, system=SYSTEM, y=0, x=0),
    "plot.map_image": lambda _: partial(plot.map_image, values=np.ones((2, 3)), label="depth"),
    "plot.overview": lambda at: partial(plot.overview, cube=io.load(at / "cube.zarr")),
    "plot.pixel_histogram": lambda at: partial(plot.pixel_histogram, cube=io.load(at / "cube.zarr"), y=0, x=0),
    "Table.lookup": lambda _: partial(table().lookup, flux=PIXEL),
    "dataset.Light": lambda _: partial(Light),
    "load_maps": lambda at: partial(load_maps, path=at / "maps.npz"),
}

NAN, INF = math.nan, math.inf
MASKED = np.ma.MaskedArray([1.0, 2.0], mask=[True, False])
NUMBER = {"text": "1 ns", "None": None, "bool": True, "complex": 1j, "nan": NAN, "-inf": -INF, "empty": [], "-1": -1}
NUMBER |= {"inf": INF}
INTEGER = {"text": "3", "None": None, "bool": True, "complex": 1j, "nan": NAN, "half": 1.5, "empty": [], "-1": -1}
INTEGER |= {"huge": 2**70}
ARRAY = {"text": "abc", "complex": 1j, "nan": NAN, "-inf": -INF, "empty": np.empty((0, 3)), "masked": MASKED}
ARRAY |= {"dates": np.array(["2026-11-23"], "datetime64[D]"), "complexes": np.full((2, 3), 1j), "None": None}
ARRAY |= {"system": SYSTEM, "class": System, "dict": {"a": 1}}
ARRAY |= {"objects": np.array([object()]), "shape": np.ones((1, 2, 3, 4, 5)), "-1": -1.0, "ragged": [[1.0], [1.0, 2.0]]}
TEXT = {"other": "no such thing", "None": None, "number": 3, "empty": "", "list": ["a"]}
PATH = {"None": None, "number": 3.5, "missing": "/no such folder/a.xyz", "null": "a\0b.npz", "list": [], "empty": ""}
OBJECT = {"class": System, "array": np.ones((2, 3)), "None": None, "number": 3.5, "text": "abc", "dict": {"a": 1}}
OBJECT |= {"list": []}
SIZES = {
    "text": "4x6",
    "None": None,
    "negative": (-1, 2),
    "three": (1, 2, 3),
    "nan": (NAN, 2),
    "zero": 0,
    "huge": 2**40,
}
PROGRESS = {"number": 5, "text": "yes"}


def wrong(annotation: str) -> dict[str, Any]:
    """Values that an argument of this annotation cannot take, by what they are."""
    optional = "None" in annotation
    kinds = [
        (r"bool'?$", {}),  # flags are taken by their truth, as everywhere in Python
        (r"^Progress", PROGRESS),
        (r"Path", PATH),
        (r"int \| tuple|tuple\[int", SIZES),
        (r"ArrayLike|NDArray|tuple\[float|Grid|Any", ARRAY),
        (r"^float", NUMBER),
        (r"^int", INTEGER),
        (r"^str|^Literal|Method|Rearm|Interpolation|Mode|axes", TEXT),
    ]
    values = next((values for pattern, values in kinds if re.search(pattern, annotation)), OBJECT)
    return {label: value for label, value in values.items() if not (optional and value is None)}


# (call, argument, what is wrong): why it is taken. A star stands for any.
ACCEPTED: dict[tuple[str, str, str], str] = {
    ("System.*", "d*", "*"): "a unit is converted, of an array of any shape; NaN is no return",
    ("*", "delay_ns", "-1"): "light that comes before the pulse comes in the period before: delays are cyclic",
    ("*", "start_ns", "-1"): "times may begin before the pulse",
    ("*", "sbr", "inf"): "no background",
    ("calibrate", "given", "system"): "a system is what is known of the instrument",
    ("*", "report", "dict"): "a dictionary is what it should be",
    ("*", "info", "dict"): "a dictionary is what it should be",
    ("io.Recipe", "options", "dict"): "a dictionary is what it should be",
    ("io.Recipe", "settings", "dict"): "a dictionary is what it should be",
    ("*", "out", "None"): "as if it were not given",
    ("io.Recipe", "depth_m", "None"): "as if it were not given",
    ("statistics.PhaseChain", "cell", "*"): "free text, for messages",
    ("plot.map_image", "label", "*"): "free text",
    ("plot.overview", "title", "*"): "free text",
    ("Timestamps.pixel", "*", "-1"): "from the end, as everywhere in Python",
    ("DatasetRecipe.from_dict", "folder", "missing"): "only looked into for files that the recipe names",
    ("*", "source", "other"): "free text",
    ("*", "source", "empty"): "free text",
    ("io.Recipe", "engine", "*"): "engines of others are found by their names when the recipe is simulated",
    ("io.foreign_cube", "variable", "empty"): "the array of a .npy has no name",
    ("io.points", "depth_m", "empty"): "no pixel, no point",
    ("io.save_cloud", "depth_m", "empty"): "no pixel, no point",
    ("io.scan", "pattern", "other"): "matches no file, and no scene is found",
}
# What the error calls an argument that has another name in the signature.
SAYS = {
    ("System.from_dict", "data"): "system",
    ("Detector.from_dict", "data"): "detector",
    ("DatasetRecipe.from_dict", "data"): "recipe",
    ("Detector.preset", "name"): "preset",
    ("to_xarray", "cube"): "counts",
}
# Public names that hold results or are raised: people get them, and do not call them.
RESULTS = {
    *("Calibration", "CountLaw", "Generated", "JointLaw", "Lookup", "Pulse", "QuantisationError", "Reconstruction"),
    *("Table", "Timestamps", "UnitWarning", "__version__", "to_xarray"),  # the last is io's too
    *("io.Converted", "io.Cube", "io.IncompleteFileError", "io.Interrupted", "io.MissingLibraryError", "io.Problem"),
    *("io.SUFFIXES", "io.SceneFile", "io.WriteError", "io.Written"),
}


# Classes of errors that a documented parent covers; and functions whose sections Raises are not complete yet.
ANCESTORS = {
    **dict.fromkeys(("FileNotFoundError", "FileExistsError", "IsADirectoryError", "NotADirectoryError"), ("OSError",)),
    **dict.fromkeys(("RecipeError", "FileError", "IncompleteFileError", "UnicodeDecodeError"), ("ValueError",)),
}


def accepted(call: str, argument: str, label: str) -> bool:
    return any(
        all(fnmatch.fnmatch(got, want) for want, got in zip(entry, (call, argument, label), strict=True))
        for entry in ACCEPTED
    )


# What a message says that does not quote the value: what is wrong with it as a whole, or what it goes together with.
AS_A_WHOLE = re.compile(
    "equal lengths|equally many|must not (be|have) (a )?masked|unknown key|must have one of|belong together|replaces|"
    "(is|are) for|no such f|does not exist|must be finite and positive|must be one of|of other programs|Unacceptable"
)


def names(error: BaseException, argument: str, value: Any) -> bool:
    """Whether an error is one that a caller expects, and says which argument is wrong and what it got, or quotes it."""
    if not isinstance(error, TypeError | ValueError | OSError | MemoryError | IndexError):
        return False
    text = str(error)
    if isinstance(value, str) and value != "" and repr(value)[1:-1] in text:
        return True
    return bool(re.search(rf"\b{re.escape(argument)}\b", text) and ("got " in text or AS_A_WHOLE.search(text)))


@functools.cache
def outcomes(name: str, here: Path) -> list[tuple[str, str, str]]:
    """(argument and what is wrong with it, outcome, what was told) for each wrong call of one function."""
    results = []
    for argument, parameter in inspect.signature(CALLS[name](here).func).parameters.items():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        for label, value in wrong(str(parameter.annotation)).items():
            good = CALLS[name](here)
            where, kind, text = f"{argument}: {label}", "taken", ""
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    good(**{argument: value})
            except Exception as error:
                said = {argument, SAYS.get((name, argument), argument)}
                kind = "refused" if any(names(error, word, value) for word in said) else "unnamed"
                text = f"{type(error).__name__}: {error}"
            if kind == "taken" and accepted(name, argument, label):
                kind = "documented"
            results.append((where, kind, text))
    return results


@pytest.mark.full
@pytest.mark.parametrize("name", CALLS)
def test_wrong_arguments_are_refused_by_name(here, name):
    CALLS[name](here)()  # what is refused below is refused for the one argument
    result = outcomes(name, here)
    assert result
    assert not [item for item in result if item[1] in ("taken", "unnamed")]


@pytest.mark.full
@pytest.mark.parametrize("name", CALLS)
def test_errors_of_wrong_arguments_are_documented(here, name):
    """Each class of error above stands in the section Raises of the function or class that raises it."""
    docscrape = pytest.importorskip("numpydoc.docscrape")
    call = CALLS[name](here).func
    home = inspect.unwrap(call)
    if not (inspect.isclass(call) or "." not in home.__qualname__):
        pytest.skip("a method, which its class describes")
    sections = docscrape.NumpyDocString(inspect.getdoc(call) or "")
    documented = {word.split(".")[-1] for entry in sections["Raises"] for word in entry.type.split(", ")}
    raised = {message.split(":")[0] for _, kind, message in outcomes(name, here) if kind == "refused"}
    missing = {each for each in raised if documented.isdisjoint({each, *ANCESTORS.get(each, ())})}
    assert not missing, f"{name} raises {missing}, and documents {documented}"


def test_every_public_name_is_called():
    public = {*ml.__all__, *(f"io.{name}" for name in io.__all__)}
    called = {name.split(" ")[0] for name in CALLS} | {"io.to_xarray"}
    assert public - called == RESULTS - called


@pytest.mark.full
def test_what_is_documented_as_taken_is_taken(here):
    """An entry that nothing needs any more is removed."""
    results = [(name, where) for name in CALLS for where, kind, _ in outcomes(name, here) if kind == "documented"]
    for call, argument, label in ACCEPTED:
        wanted = (call, f"{argument}: {label}")
        assert any(all(map(fnmatch.fnmatch, item, wanted)) for item in results), wanted


# The command line: arguments that make each command do something small, by the files of `here`.
COMMANDS: dict[str, Callable[[Path], list[Any]]] = {
    "simulate": lambda at: ["--scene", "room", "--size", 3, "-o", at / f"cli{next(NUMBERS)}.npz"],
    "generate": lambda at: ["room", "--size", 3, "-o", at / f"cli{next(NUMBERS)}.zarr"],
    "verify": lambda at: [at / "set.zarr"],
    "export": lambda at: [at / "set.zarr", "--layout", "sun", "-o", at / f"cli{next(NUMBERS)}"],
    "view": lambda at: [at / "cube.zarr", "-o", at / f"cli{next(NUMBERS)}.png"],
    "convert": lambda at: [at / "cube.zarr", at / f"cli{next(NUMBERS)}.npz"],
    "timestamps": lambda at: [at / "cube.zarr", "-o", at / f"cli{next(NUMBERS)}.npz"],
    "calibrate": lambda at: [at / "photons.npz"],
    "reconstruct": lambda at: [at / "cube.zarr", "-o", at / f"cli{next(NUMBERS)}.npz"],
    "init": lambda at: [at / f"cli{next(NUMBERS)}.yaml"],
    "schema": lambda _: [],
    "table build": lambda at: ["-o", at / f"cli{next(NUMBERS)}.h5", "--signal", "0.1,1,2", "--background", "0.1,1,2"],
}
WORDS = {
    int: ("three", "1.5", "nan", "-99999999999", "99999999999999999999", ""),
    float: ("wide", "nan", "-inf", "1j", "", "-1e9"),
    Path: ("/no such folder/a.xyz", ""),
    str: ("no such thing", "", "nan"),
}
# (command, option, word): why it is taken.
TAKEN: dict[tuple[str, str, str], str] = {}


def options(command: str) -> Iterator[tuple[str, type]]:
    """(name, type) of the options of a command that take a value."""
    for name, argument in options_of(*command.split()).items():
        if not argument.is_flag():
            hints = {argument.hint, *get_args(argument.hint)}
            yield name, next((kind for kind in WORDS if kind in hints), str)


def command_outcomes(command: str, here: Path, observed: set[str]) -> Iterator[tuple[str, str, str, str]]:
    """(option, word, outcome, what was told) for options that no command before had."""
    for option, kind in options(command):
        if option in observed:
            continue
        observed.add(option)
        for word in WORDS[kind]:
            arguments = [*command.split(), *map(str, COMMANDS[command](here)), f"{option}={word}"]
            done = command_line(arguments)
            printed = " ".join(done.output.split())
            if done.exit_code == 0:
                given = (command, option, word)
                took = any(all(map(fnmatch.fnmatch, given, entry)) for entry in TAKEN)
                yield option, word, "documented" if took else "taken", printed
            else:
                ours = done.exit_code in (1, 2)
                named = option in printed or option[2:].replace("-", "_") in printed or (word != "" and word in printed)
                yield option, word, "refused" if ours and named else "unnamed", printed


@pytest.mark.full(seconds=20)
def test_wrong_options_are_refused_by_name(here):
    recorded: set[str] = set()
    for command, make in COMMANDS.items():
        ok(*command.split(), *make(here))
        result = list(command_outcomes(command, here, recorded))
        assert not [item for item in result if item[2] in ("taken", "unnamed")], command
    assert len(recorded) > 90
