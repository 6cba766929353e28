"""Recipes: what they make, and errors that point at the line."""

import json
import math

import numpy as np
import pytest
import scipy.io
import xarray
import yaml
from dataset.conftest import SYSTEM
from harness import make_system, refused
from harness.files import write_h5

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.yaml import read_yaml
from mars_lidar.dataset import DatasetRecipe, json_schema, read_view
from mars_lidar.dataset.arrays import count_samples, sample_parts
from mars_lidar.dataset.recipe import KINDS
from tests.harness.command import ok, run

TEXT = """\
seed: 3
scenes:
  - example: room
    size: 16
    seeds: {first: 2, count: 3}
  - path: nyu
    pattern: "*_depth.png"
crop: {size: 8, count: 2}
systems:
  file: system.yaml
light:
  signal: [1e-1, 1]
  sbr: [inf, 2]
store: {layout: dense}
"""


@pytest.fixture
def write(tmp_path):
    SYSTEM.save(tmp_path / "system.yaml")

    def written(text: str):
        path = tmp_path / "recipe.yaml"
        path.write_text(text)
        return path

    return written


def test_a_recipe_of_all_kinds_of_keys(write):
    recipe = DatasetRecipe.load(write(TEXT))
    assert recipe.systems == (SYSTEM,)
    assert recipe.light.levels == ((0.1, math.inf), (0.1, 2.0), (1.0, math.inf), (1.0, 2.0))
    assert (recipe.crop, recipe.crops, recipe.layout, recipe.seed) == ((8, 8), 2, "dense", 3)
    assert DatasetRecipe.from_dict(recipe.to_dict()) == recipe
    assert DatasetRecipe.from_dict(yaml.safe_load(yaml.safe_dump(recipe.to_dict()))) == recipe
    assert count_samples(recipe, 5) == 20
    assert [sample_parts(recipe, k)[0] for k in (0, 3, 4, 19)] == [0, 0, 1, 4]


def test_options_replace_values(write):
    recipe = DatasetRecipe.load(write(TEXT), seed=9, light={"sbr": [4.0]})
    assert recipe.seed == 9
    assert recipe.light.levels == ((0.1, 4.0), (1.0, 4.0))


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("seed: 3", "seed: -3", 1, "seed must be an integer in"),
        ("seed: 3", "sead: 3", 1, "unknown key 'sead'"),
        ("seed: 3", "seed: 3\nseed: 4", 2, "seed is given twice"),
        ("example: room", "example: rome", 3, "must be one of 'room', 'random', got 'rome'"),
        ("size: 16", "size: [1, 2, 3]", 4, r"scenes\[0\].size must be an integer or \[height, width\]"),
        ("count: 3}", "count: x}", 5, r"scenes\[0\].seeds.count must be an integer"),
        ("path: nyu", "paths: nyu", 6, r"must give one of example, depth \(or path\)"),
        ('pattern: "*_depth.png"', "pattern: 4", 7, "pattern must be a text"),
        ("size: 8,", "size: 0,", 8, r"crop.size must be an integer in \[1, 8192\], got 0"),
        ("system.yaml", "other.yaml", 10, "does not exist"),
        ("1e-1, 1]", "1e-1, -1]", 12, r"light\.signal\[1\] must be a finite number"),
        ("sbr: [inf, 2]", "sbr: [0]", 13, r"light\.sbr\[0\] must be a number in"),
        ("sbr: [inf, 2]", "sbr: [2, 2.0]", 12, "levels that differ"),
        ("sbr:", "levels: [[1, 1]]\n  sbr:", 13, "give levels, or signal and sbr"),
        ("layout: dense", "layout: thick", 14, "store.layout must be one of 'sparse', 'dense', got 'thick'"),
        ("layout: dense", "chunk_mib: 8, shard_mib: 4", 14, "shard_mib must be at least chunk_mib"),
        ("store: {", "engine: fast\nstore: {", 14, "engine must be one of"),
        ("light:", "light: [", 13, "expected"),
    ],
)
def test_errors_point_at_the_line(write, old, new, line, message):
    assert old in TEXT
    refused(rf"recipe\.yaml:{line}: .*{message}", DatasetRecipe.load, write(TEXT.replace(old, new, 1)))


def test_errors_inside_of_a_system(write):
    lines = yaml.safe_dump(SYSTEM.to_dict()).splitlines()
    inline = TEXT.replace("  file: system.yaml\n", "".join(f"  {line}\n" for line in lines))
    assert DatasetRecipe.load(write(inline)).systems == (SYSTEM,)
    bad = inline.replace("cycles: 50", "cycles: 0")
    line = bad.splitlines().index("  cycles: 0") + 1
    refused(rf"recipe\.yaml:{line}: cycles must be an integer", DatasetRecipe.load, write(bad))


def test_systems_must_agree_on_their_bins(recipe):
    recipe["systems"] = [SYSTEM, SYSTEM.replace(bins=64)]
    refused("same number of bins, got 32 and 64", DatasetRecipe.from_dict, recipe)
    recipe["systems"] = [SYSTEM, SYSTEM]
    refused("same as an earlier system", DatasetRecipe.from_dict, recipe)


def test_scalars_are_those_of_yaml_1_2(tmp_path):
    """PyYAML alone reads 1:30 as 90, 010 as eight, yes as true, a date as an object, and 1e-3 as a text."""
    path = tmp_path / "a.yaml"
    path.write_text("a: 1:30\nb: 010\nc: 0x1f\nd: 1e-3\ne: yes\nf: true\ng: 2026-11-23\nh: ~\ni: .5\nj: -.inf\nk:\n")
    values = {"a": "1:30", "b": 10, "c": 31, "d": 1e-3, "e": "yes", "f": True, "g": "2026-11-23", "h": None, "i": 0.5}
    assert read_yaml(path)[0] == values | {"j": -math.inf, "k": None}


# One description of scene and light for recipes, scene files, the command line and Python; and its JSON Schema.


SCENE_SYSTEM = make_system(50.0, 30, 32, sigma_ns=0.5)
FOG = {"extinction_per_m": 0.1, "backscatter": 0.3}
PANE = {"depth_m": 1.5, "reflectivity": 0.2, "transmission": 0.8}
LIGHT = {"signal": 0.7, "sbr": 2.0}


@pytest.mark.full
@pytest.mark.parametrize("before", [{}, {"fog": FOG}, {"pane": PANE}, {"fog": FOG, "pane": PANE}])
def test_a_scene_means_the_same_in_a_recipe_a_scene_file_and_python(tmp_path, before):
    scene = {"example": "room", "size": 8, "seed": 2, **before}
    view = read_view({**scene, "light": LIGHT}, SCENE_SYSTEM)
    SCENE_SYSTEM.save(tmp_path / "spad.yaml")
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({**scene, "light": LIGHT}))
    out = tmp_path / "a.zarr"
    ok("simulate", "--scene", tmp_path / "scene.yaml", "--system", tmp_path / "spad.yaml", "-o", out)
    with io.load(out) as cube:
        assert np.array_equal(cube.histogram[:], ml.simulate(view.flux, SCENE_SYSTEM))
        assert np.array_equal(cube.depth_m, view.depth_m, equal_nan=True)
        source = cube.recipe.source
    assert source == view.source
    assert all(name in source for name in ["example room, size 8, seed 2", *before])
    ml.generate({"scenes": scene, "systems": SCENE_SYSTEM, "light": LIGHT}, tmp_path / "set.zarr")
    with xarray.open_zarr(tmp_path / "set.zarr") as data:
        again = ml.simulate(view.flux, SCENE_SYSTEM, seed=int(data.seed[0]))
        assert np.array_equal(data.histogram[0], again)


def test_layers_of_a_file_are_simulated_too(tmp_path):
    depth = np.stack([np.full((4, 5), 1.0), np.full((4, 5), 3.0)])
    np.savez(tmp_path / "stack.npz", depth=depth, reflectivity=np.full((2, 4, 5), 0.5))
    ok("simulate", "--depth", tmp_path / "stack.npz", "--no-picture", "-o", tmp_path / "a.zarr")
    with io.load(tmp_path / "a.zarr") as cube:
        assert len(cube.flux.returns_signal) == 2


def test_keys_of_one_scene_stand_for_those_of_many():
    single = {"systems": SCENE_SYSTEM, "scenes": {"example": "room", "seed": 3}}
    assert DatasetRecipe.from_dict(single).scenes == ({"example": "room", "size": 128, "seeds": [3]},)
    refused("seed is short for seeds", read_view, {"example": "room", "seed": 3, "seeds": [3]}, SCENE_SYSTEM)
    refused(
        "there must be one scene: 2 are named", read_view, {"example": "room", "size": 8, "seeds": [3, 4]}, SCENE_SYSTEM
    )
    with pytest.raises(ValueError, match="one level of one scene, got 2"):
        read_view({"example": "room", "size": 8, "light": {"signal": [1, 2]}}, SCENE_SYSTEM)
    with pytest.raises(ValueError, match="photons_per_unit belongs to a transient"):
        read_view({"example": "room", "size": 8, "light": {"photons_per_unit": 1}}, SCENE_SYSTEM)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("example: room\nfogg: {}\n", r"scene\.yaml:2: .*unknown key 'fogg' \(did you mean 'fog'\?\)"),
        (
            "example: room\nfog:\n  backscatter: 1\n  extinction_per_m: -1\n",
            r"scene\.yaml:4: fog\.extinction_per_m must be",
        ),
        ("example: room\nlight:\n  signal: 1\n  atenuation: none\n", r"scene\.yaml:4: .*did you mean 'attenuation'"),
    ],
)
def test_a_scene_file_names_line_and_word(tmp_path, text, message):
    (tmp_path / "scene.yaml").write_text(text)
    refused(message, read_view, tmp_path / "scene.yaml", SCENE_SYSTEM)


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_a_system_file_names_line_and_word(tmp_path, suffix):
    file = tmp_path / f"spad{suffix}"
    SCENE_SYSTEM.save(file)
    lines = file.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if "dead_time_ns" in line)
    file.write_text("\n".join(line.replace("dead_time_ns", "deadtime_ns") for line in lines))
    refused(rf"spad\{suffix}:{at + 1}: .*'deadtime_ns' \(did you mean 'dead_time_ns'\?\)", ml.System.load, file)
    file.write_text("\n".join(line.replace("50.0", "-50.0") for line in lines))
    refused(rf"spad\{suffix}:{at + 1}: dead_time_ns must be", ml.System.load, file)


def properties(schema: dict, of: str) -> set[str]:
    kinds = [kind for kind in schema["anyOf"] if of in kind["properties"]]
    assert len(kinds) == 1
    return set(kinds[0]["properties"])


def test_the_schema_is_that_of_what_is_read(tmp_path):
    scene = json_schema("scene")
    assert properties(scene, "depth") >= {*KINDS["path"], "depth", "index", "light"}
    assert properties(scene, "transient") == {*KINDS["transient"], "light"}
    system = json_schema("system")["properties"]
    assert {*system} == {*SCENE_SYSTEM.to_dict()}
    assert {"dead_time_ns", "jitter", "preset", "crosstalk"} < {*system["detector"]["properties"]}
    recipe = json_schema()
    assert {*recipe["properties"]} == {
        *DatasetRecipe.from_dict({"scenes": {"example": "room"}, "systems": SCENE_SYSTEM}).to_dict()
    }
    assert recipe["required"] == ["scenes", "systems"]
    ok("schema", "scene", "-o", tmp_path / "scene.json")
    assert json.loads((tmp_path / "scene.json").read_text()) == scene
    assert json.loads(run("schema", "system").stdout) == json_schema("system")
    assert "did you mean 'recipe'" in run("schema", "recipes").stderr


@pytest.mark.parametrize("version", [5, 7.3])
def test_a_mat_of_another_laboratory_is_a_depth(tmp_path, version):
    """Not every .mat is NYUv2's."""
    depth = np.linspace(2.0, 5.0, 48).reshape(6, 8)
    path = tmp_path / "d.mat"
    if version == 5:
        scipy.io.savemat(path, {"depth": depth})
    else:
        write_h5(path, {"depth": depth.T})
    np.testing.assert_allclose(read_view({"depth": str(path), "light": LIGHT}, SCENE_SYSTEM).depth_m, depth)
    ok("generate", path, "--dry-run", "-o", tmp_path / "a.zarr", "--bins", 32)
