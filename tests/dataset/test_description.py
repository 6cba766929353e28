"""One description of scene and light for recipes, scene files, the command line and Python; and its JSON Schema."""

import json

import numpy as np
import pytest
import scipy.io
import xarray
import yaml
from harness import make_system, refused
from harness.files import write_h5

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import DatasetRecipe, json_schema, read_view
from mars_lidar.dataset.recipe import KINDS
from tests.harness.command import ok, run

SYSTEM = make_system(50.0, 30, 32, sigma_ns=0.5)
FOG = {"extinction_per_m": 0.1, "backscatter": 0.3}
PANE = {"depth_m": 1.5, "reflectivity": 0.2, "transmission": 0.8}
LIGHT = {"signal": 0.7, "sbr": 2.0}


@pytest.mark.full
@pytest.mark.parametrize("before", [{}, {"fog": FOG}, {"pane": PANE}, {"fog": FOG, "pane": PANE}])
def test_a_scene_means_the_same_in_a_recipe_a_scene_file_and_python(tmp_path, before):
    scene = {"example": "room", "size": 8, "seed": 2, **before}
    view = read_view({**scene, "light": LIGHT}, SYSTEM)
    SYSTEM.save(tmp_path / "spad.yaml")
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({**scene, "light": LIGHT}))
    out = tmp_path / "a.zarr"
    ok("simulate", "--scene", tmp_path / "scene.yaml", "--system", tmp_path / "spad.yaml", "-o", out)
    with io.load(out) as cube:
        assert np.array_equal(cube.histogram[:], ml.simulate(view.flux, SYSTEM))
        assert np.array_equal(cube.depth_m, view.depth_m, equal_nan=True)
        source = cube.recipe.source
    assert source == view.source
    assert all(name in source for name in ["example room, size 8, seed 2", *before])
    ml.generate({"scenes": scene, "systems": SYSTEM, "light": LIGHT}, tmp_path / "set.zarr")
    with xarray.open_zarr(tmp_path / "set.zarr") as data:
        again = ml.simulate(view.flux, SYSTEM, seed=int(data.seed[0]))
        assert np.array_equal(data.histogram[0], again)


def test_layers_of_a_file_are_simulated_too(tmp_path):
    depth = np.stack([np.full((4, 5), 1.0), np.full((4, 5), 3.0)])
    np.savez(tmp_path / "stack.npz", depth=depth, reflectivity=np.full((2, 4, 5), 0.5))
    ok("simulate", "--depth", tmp_path / "stack.npz", "--no-picture", "-o", tmp_path / "a.zarr")
    with io.load(tmp_path / "a.zarr") as cube:
        assert len(cube.flux.returns_signal) == 2


def test_keys_of_one_scene_stand_for_those_of_many():
    single = {"systems": SYSTEM, "scenes": {"example": "room", "seed": 3}}
    assert DatasetRecipe.from_dict(single).scenes == ({"example": "room", "size": 128, "seeds": [3]},)
    refused("seed stands for seeds of one", read_view, {"example": "room", "seed": 3, "seeds": [3]}, SYSTEM)
    refused("there must be one scene: 2 are named", read_view, {"example": "room", "size": 8, "seeds": [3, 4]}, SYSTEM)
    with pytest.raises(ValueError, match="one level of one scene, got 2"):
        read_view({"example": "room", "size": 8, "light": {"signal": [1, 2]}}, SYSTEM)
    with pytest.raises(ValueError, match="photons_per_unit belongs to a transient"):
        read_view({"example": "room", "size": 8, "light": {"photons_per_unit": 1}}, SYSTEM)


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
    refused(message, read_view, tmp_path / "scene.yaml", SYSTEM)


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_a_system_file_names_line_and_word(tmp_path, suffix):
    file = tmp_path / f"spad{suffix}"
    SYSTEM.save(file)
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
    assert {*system} == {*SYSTEM.to_dict()}
    assert {"dead_time_ns", "jitter", "preset", "crosstalk"} < {*system["detector"]["properties"]}
    recipe = json_schema()
    assert {*recipe["properties"]} == {
        *DatasetRecipe.from_dict({"scenes": {"example": "room"}, "systems": SYSTEM}).to_dict()
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
    np.testing.assert_allclose(read_view({"depth": str(path), "light": LIGHT}, SYSTEM).depth_m, depth)
    ok("generate", path, "--dry-run", "-o", tmp_path / "a.zarr", "--bins", 32)
