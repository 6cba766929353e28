"""The package as a whole: version, what an import loads, documentation of every public name."""

import importlib
import inspect
import multiprocessing
import os
import pickle
import pkgutil
import re
import subprocess
import sys
import threading
import tomllib
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from harness import make_system

import mars_lidar as ml
from mars_lidar import io, statistics
from mars_lidar._base.arguments import _rules
from mars_lidar._base.cached import cached_property
from mars_lidar._base.display import brief
from mars_lidar.engines import EngineOptions, MarsEngine
from mars_lidar.reconstruction import HistogramBound

ROOT = Path(__file__).parents[1]
HEAVY = ("scipy", "matplotlib", "zarr", "xarray", "h5py", "PIL", "cyclopts", "rich", "yaml", "torch", "pandas")


def test_a_name_of_a_package_is_named_with_its_place():
    with pytest.raises(AttributeError, match=r"it is mars_lidar\.statistics\.exposure_moments$"):
        ml.exposure_moments  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'histogram'$"):
        ml.histogram  # noqa: B018
    assert set(ml.__all__) <= set(dir(ml))


def test_version_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert ml.__version__ == project["version"]
    try:
        installed = metadata.version("mars-lidar")
    except metadata.PackageNotFoundError:
        return  # run from the source tree
    assert ml.__version__ == installed


def printed(code: str) -> list[str]:
    """Words that a program prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""  # nanobind tells of instances that were never freed
    return done.stdout.split()


SIMULATION = """
detector = ml.Detector(dead_time_ns=50.0, jitter=ml.Jitter(sigma_ns=0.3))
pulse = ml.GaussianPulse(sigma_ns=1.0)
ml.simulate(ml.Flux(1.0, 1.0, 50.0), ml.System(period_ns=100.0, cycles=10, bins=8, pulse=pulse, detector=detector))
"""


@pytest.mark.parametrize("code", ["", SIMULATION], ids=["import", "simulation"])
def test_imports_and_simulations_are_light(code: str):
    """They need NumPy and the native core only, so that the command line answers at once; nothing native remains."""
    loaded = f"print(*[name for name in {HEAVY!r} if name in sys.modules])"
    assert printed(f"import sys, mars_lidar as ml\n{code}{loaded}") == []


def test_public_names_exist_and_are_sorted():
    assert len(set(ml.__all__)) == len(ml.__all__)
    assert all(hasattr(ml, name) for name in ml.__all__)
    assert [n for n in ml.__all__ if not n.startswith("_")] == sorted(n for n in ml.__all__ if not n.startswith("_"))


def test_every_option_of_an_engine_is_documented_where_it_is_given():
    text = inspect.getdoc(ml.simulate)
    for name in EngineOptions.__annotations__:
        assert f"`{name}`" in text
        assert f"\n{name}\n" in inspect.getdoc(EngineOptions)
    system = make_system(1.0, 1, 8, sigma_ns=0.5, period_ns=10.0)
    with pytest.raises(TypeError, match="'tabel' is no argument of this function, nor an option of an engine"):
        ml.simulate(ml.Flux(1.0, 1.0, 5.0), system, engine="mars", tabel=None)  # type: ignore[call-arg]


def test_where_a_module_calls_one_above_it():
    """The only uses of `late`: docs/architecture.md lists them."""
    package = Path(ml.__file__).parent
    used = [
        f"{path.relative_to(package)}: {name}"
        for path in package.rglob("*.py")
        for name in re.findall(r'late\("([^"]+)"\)', path.read_text())
    ]
    assert sorted(used) == [
        "io/cube.py: plot.figures:overview",
        "light/flux.py: light.fog:in_fog",
        "light/flux.py: light.transient:Transient",
        "light/timestamps.py: io.streams.formats:load",
        "light/timestamps.py: io.streams.formats:save",
        "scene/scene.py: io.rgbd:read_rgbd",
    ]


def test_package_is_marked_as_typed():
    assert (Path(ml.__file__).parent / "py.typed").exists()


def test_packages_of_formats_and_learning_are_there_when_they_are_asked_for():
    code = (
        "import sys, mars_lidar as ml\n"
        "assert 'h5py' not in sys.modules and {'io', 'learn', 'plot'} <= set(dir(ml))\n"
        "ml.io.load, ml.learn, ml.plot\n"
        "print(hasattr(ml, 'lern'), 'torch' in sys.modules)"
    )
    assert printed(code) == ["False", "False"]


def test_wheels_and_recipe_follow_the_project():
    """Every wheel has to give the golden bits; conda-forge's recipe has the project's version and dependencies."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for file in re.findall(r"\{project\}/(\S+)", settings["tool"]["cibuildwheel"]["test-command"]):
        assert "def test_golden_bits" in (ROOT / file).read_text()
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == settings["project"]["version"]
    conda_names = {"matplotlib-base": "matplotlib", "python-xxhash": "xxhash"}
    run = {" ".join(conda_names.get(word, word) for word in line.split()) for line in recipe["requirements"]["run"]}
    python = "python" + settings["project"]["requires-python"]
    assert {line.replace(" ", "") for line in run} == {*settings["project"]["dependencies"], python}
    host = {line.replace(" ", "") for line in recipe["requirements"]["host"]}
    assert set(settings["build-system"]["requires"]) <= host


def test_no_function_hides_a_module():
    """`ml.reconstruct` is a function, and no module of the package has its name."""
    for each in pkgutil.iter_modules(ml.__path__):
        if not each.name.startswith("_"):
            module = importlib.import_module(f"mars_lidar.{each.name}")
            assert getattr(ml, each.name) is module, each.name


def test_names_in_annotations_of_checked_functions_are_known():
    """One that is imported for types only would be an error at the first call."""
    functions = set()
    for each in pkgutil.walk_packages(ml.__path__, "mars_lidar."):
        if each.name.startswith(("mars_lidar.learn", "mars_lidar.__main__")):
            continue
        for thing in vars(importlib.import_module(each.name)).values():
            members = [thing, *(vars(thing).values() if inspect.isclass(thing) else ())]
            wrapped = [getattr(member, "__func__", member) for member in members]
            functions |= {f for f in wrapped if inspect.isfunction(f) and hasattr(f, "__wrapped__")}
    ours = [f for f in functions if f.__module__.startswith("mars_lidar.")]
    assert len(ours) > 200
    for function in ours:
        _rules(function, inspect.signature(function))


# What every public object owes its user: a repr that fits on a screen, and a way to another process.


SYSTEM = make_system(40.0, 200, 64, sigma_ns=0.5)
LONG = SYSTEM.replace(cycles=50_000)
LINE = 800  # characters: a few lines of a notebook


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> dict[str, Any]:
    flux = ml.Scene.example("room", size=4).flux(SYSTEM, signal=0.5, sbr=1.0)
    cube = ml.simulate(flux, SYSTEM, realizations=2)
    times = ml.simulate_timestamps(ml.Flux(1.0, 0.5, 20.0), LONG)
    light = ml.calibrate(times, {"dead_time_ns": 40.0})
    table = ml.Table.build(SYSTEM, signal=(0.01, 1, 4), background=(0.01, 1, 4))
    stored = tmp_path_factory.mktemp("objects") / "a.zarr"
    io.simulate_to(stored, flux, SYSTEM)
    system = SYSTEM.replace(
        detector=ml.Detector(
            dead_time_ns=40.0,
            afterpulsing=ml.Afterpulsing(probability=0.01, delays=np.ones(100), bin_ns=1.0),
            jitter=ml.SampledJitter(tuple(range(1, 300)), 0.001),
            code_density=tuple(np.linspace(0.5, 1.5, 64)),
        )
    )
    return {
        "system": SYSTEM,
        "every effect": system,
        "flux": flux,
        "scene": ml.Scene.example("room", size=4),
        "timestamps": times,
        "law": ml.count_law(ml.Flux(0.5, 0.5, 3.0), SYSTEM),
        "laws": ml.count_law(ml.Flux(np.ones((2, 3)), 0.5, 50.0), SYSTEM, "mars"),
        "joint law": ml.joint_law(ml.Flux(0.5, 0.5, 3.0), SYSTEM),
        "exposure": statistics.exposure_moments(ml.Flux(0.5, 0.5, 3.0), SYSTEM),
        "covariance": ml.holding_time_covariance(ml.Flux(0.5, 0.5, 50.0), SYSTEM),
        "bound": ml.cramer_rao(ml.Flux(0.5, 0.5, 3.0), SYSTEM),
        "reconstruction": ml.reconstruct(cube, SYSTEM),
        "calibration": light,
        "look": light.look,
        "estimate": light.estimates["signal"],
        "table": table,
        "lookup": table.at(np.array([0.5]), np.array([0.5])),
        "engine": MarsEngine(table=table, count="matched"),
        "stored cube": io.load(stored),
        "cube": io.Cube.of(cube, io.Recipe(system=SYSTEM, flux=flux, realizations=2)),
    }


@pytest.mark.full
def test_every_object_shows_itself_in_a_few_lines(objects):
    for name, each in objects.items():
        text = repr(each)
        assert len(text) < LINE, name
        assert " object at " not in text, name
        assert type(each).__name__.removeprefix("Drawn") in text, name


def test_only_what_was_set_is_shown():
    assert repr(ml.Detector(dead_time_ns=40.0)) == "Detector(dead_time_ns=40.0)"
    assert repr(ml.Detector(dead_time_ns=40.0, dark_count_hz=5.0)) == "Detector(dead_time_ns=40.0, dark_count_hz=5.0)"
    assert eval(repr(SYSTEM), vars(ml)) == SYSTEM  # a system can be copied from a notebook
    bound = HistogramBound(np.zeros((3, 3)), np.float64(1.0), np.ones(2), np.ones(5), np.ones(0))
    assert brief(bound) == (
        "HistogramBound(information=<float64 (3, 3)>, signal=1.0, background=[1., 1.], "
        "delay_ns=<float64 (5,)>, depth_m=[])"
    )


def test_every_object_goes_to_another_process(objects):
    for name, each in objects.items():
        again = pickle.loads(pickle.dumps(each))
        assert type(again) is type(each), name
        assert repr(again).replace("/private", "") == repr(each), name


def test_what_arrives_there_is_whole(objects):
    for name in ("law", "laws"):
        there = pickle.loads(pickle.dumps(objects[name]))
        np.testing.assert_array_equal(there.pmf, objects[name].pmf)
        np.testing.assert_array_equal(there.support, objects[name].support)
    for name in ("cube", "stored cube"):
        there = pickle.loads(pickle.dumps(objects[name]))
        np.testing.assert_array_equal(there.histogram[0], objects[name].histogram[0])


# Properties that are computed once: a process forked while another thread computes one can compute its own.


class Slow:
    """Waits in its property until it is told to go on, but in a forked process."""

    parent = os.getpid()

    def __init__(self) -> None:
        self.entered, self.go_on = threading.Event(), threading.Event()

    @cached_property
    def value(self) -> int:
        if os.getpid() == self.parent:
            self.entered.set()
            assert self.go_on.wait(60.0)
        return 7


def answer(slow: Slow, queue: "multiprocessing.SimpleQueue[int]") -> None:
    queue.put(slow.value)


@pytest.mark.skipif(sys.platform == "win32", reason="no fork on Windows")
def test_a_forked_process_does_not_wait_for_a_thread_of_its_parent():
    slow, context = Slow(), multiprocessing.get_context("fork")
    computing = threading.Thread(target=lambda: slow.value)
    computing.start()
    assert slow.entered.wait(60.0)
    queue = context.SimpleQueue()
    child = context.Process(target=answer, args=(Slow(), queue))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, from Python 3.12 on
        child.start()
    child.join(30.0)
    hangs = child.is_alive()
    child.kill()
    slow.go_on.set()
    computing.join()
    assert not hangs
    assert queue.get() == 7
    assert slow.value == 7


def test_it_is_computed_once_and_belongs_to_the_object():
    class Counted:
        calls = 0

        @cached_property
        def value(self) -> int:
            """Some text."""
            self.calls += 1
            return self.calls

    counted = Counted()
    assert (counted.value, counted.value, counted.calls) == (1, 1, 1)
    assert vars(counted)["value"] == 1
    assert Counted.value.__doc__ == "Some text."
