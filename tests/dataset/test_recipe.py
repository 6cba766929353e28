"""Recipes: what they make, and errors that point at the line."""

import math

import pytest
import yaml
from dataset.conftest import SYSTEM
from harness import refused

from mars_lidar._base.yaml import read_yaml
from mars_lidar.dataset import DatasetRecipe
from mars_lidar.dataset.arrays import count_samples, fitting, sample_parts

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
        ("sbr: [inf, 2]", "sbr: [0]", 13, r"light\.sbr\[0\] must be a finite number in"),
        ("sbr: [inf, 2]", "sbr: [2, 2.0]", 12, "levels that differ"),
        ("sbr:", "levels: [[1, 1]]\n  sbr:", 13, "give them, or signal and sbr"),
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


def test_blocks_are_runs_of_the_array():
    whole = (10, 3, 64, 64, 1024)
    assert fitting(whole, (1, 1, 1, 1, 1024), 2, 8 * 2**20) == (1, 1, 64, 64, 1024)
    assert fitting(whole, (1, 1, 64, 64, 1024), 2, 64 * 2**20) == (2, 3, 64, 64, 1024)
    assert fitting(whole, (1, 1, 1, 1, 1024), 2, 3 * 2**20) == (1, 1, 22, 64, 1024)
    assert fitting(whole, (1, 1, 1, 1, 1024), 2, 1000) == (1, 1, 1, 1, 1024)
    assert fitting((1, 1, 4, 100, 1024), (1, 1, 1, 1, 1024), 2, 60_000) == (1, 1, 1, 25, 1024)


def test_scalars_are_those_of_yaml_1_2(tmp_path):
    """PyYAML alone reads 1:30 as 90, 010 as eight, yes as true, a date as an object, and 1e-3 as a text."""
    path = tmp_path / "a.yaml"
    path.write_text("a: 1:30\nb: 010\nc: 0x1f\nd: 1e-3\ne: yes\nf: true\ng: 2026-11-23\nh: ~\ni: .5\nj: -.inf\nk:\n")
    values = {"a": "1:30", "b": 10, "c": 31, "d": 1e-3, "e": "yes", "f": True, "g": "2026-11-23", "h": None, "i": 0.5}
    assert read_yaml(path)[0] == values | {"j": -math.inf, "k": None}
