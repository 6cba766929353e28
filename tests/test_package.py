"""The package as a whole: version, what an import loads, documentation of every public name."""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from harness import make_system

import mars_lidar as ml
from mars_lidar.engines import EngineOptions

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


def test_import_is_light():
    """`import mars_lidar` needs NumPy and the native core only, so that the command line answers at once."""
    code = f"import sys, mars_lidar; print(*[name for name in {HEAVY!r} if name in sys.modules])"
    assert printed(code) == []


def test_simulation_is_light():
    """Neither does a simulation load anything heavier."""
    code = (
        "import sys, mars_lidar as ml\n"
        "s = ml.System(period_ns=100.0, cycles=10, bins=8, pulse=ml.GaussianPulse(sigma_ns=1.0),"
        " detector=ml.Detector(dead_time_ns=50.0))\n"
        "ml.simulate(ml.Flux(1.0, 1.0, 50.0), s)\n"
        f"print(*[name for name in {HEAVY!r} if name in sys.modules])"
    )
    assert printed(code) == []


def test_public_names_exist_and_are_sorted():
    assert len(set(ml.__all__)) == len(ml.__all__)
    assert all(hasattr(ml, name) for name in ml.__all__)
    assert [n for n in ml.__all__ if not n.startswith("_")] == sorted(n for n in ml.__all__ if not n.startswith("_"))


@pytest.mark.parametrize("name", [n for n in ml.__all__ if n != "__version__"])
def test_public_names_are_documented(name: str):
    thing = getattr(ml, name)
    assert inspect.getdoc(thing)
    if inspect.isclass(thing):
        for member, value in vars(thing).items():
            is_method = inspect.isfunction(value) or isinstance(value, (property, classmethod, staticmethod))
            if not member.startswith("_") and is_method:
                assert inspect.getdoc(getattr(thing, member)), f"{name}.{member}"


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
        "light/timestamps.py: io.streams.files:load",
        "light/timestamps.py: io.streams.files:save",
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


def test_nothing_native_is_left_when_the_interpreter_ends():
    script = (
        "import mars_lidar as ml; d = ml.Detector(dead_time_ns=1.0, jitter=ml.Jitter(sigma_ns=0.3)); "
        "s = ml.System(period_ns=100.0, cycles=10, bins=8, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=d); "
        "ml.simulate(ml.Flux(1.0, 1.0, 5.0), s)"
    )
    assert printed(script) == []


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
