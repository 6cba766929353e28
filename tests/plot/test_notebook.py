"""What a notebook shows of objects, and the tutorial."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml
from mars_lidar import io

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SYSTEM = make_system(50.0, 50, 64, sigma_ns=0.5)


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> dict[str, object]:
    scene = ml.Scene.example("room", size=(8, 12))
    flux = scene.flux(SYSTEM, signal=1.0, sbr=1.0)
    path = tmp_path_factory.mktemp("cubes") / "a.zarr"
    io.simulate_to(path, flux, SYSTEM)
    cube = io.load(path)
    return {
        "scene": scene,
        "flux": flux,
        "dark flux": ml.Flux(0.0, 0.5),
        "waveform": ml.Flux(waveform=np.ones((2, 3, 5)) * 0.01),
        "system": SYSTEM,
        "cube": cube,
        "timestamps": ml.simulate_timestamps(flux, SYSTEM),
        "law": ml.count_law(ml.Flux(0.5, 0.1, 50.0), SYSTEM),
        "laws": ml.count_law(ml.Flux(flux.signal, flux.background, 50.0), SYSTEM),
        "several laws": ml.count_law(ml.Flux([0.5, 0.6], 0.1, 50.0), SYSTEM),
        "joint law": ml.joint_law(ml.Flux(0.5, 0.1, 50.0), SYSTEM),
        "reconstruction": ml.reconstruct(cube),
        "bound": ml.cramer_rao(flux, SYSTEM),
        "one pixel": ml.reconstruct(cube.histogram[0, 4, 5], SYSTEM),
    }


@pytest.mark.full
def test_a_notebook_shows_text_and_a_small_picture(objects):
    without = {"several laws", "one pixel", "dark flux"}  # no map, no curve
    for name, example in objects.items():
        text = example._repr_html_()
        assert text.startswith("<code>"), name
        assert type(example).__name__.removeprefix("Drawn") in re.sub("<.*?>", "", text)[:40], name
        assert ("data:image/png;base64," in text) == (name not in without), name
        assert len(text) < 60_000, name


@pytest.mark.full
def test_the_tutorial_runs_and_is_the_notebook(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import make_notebook

    try:
        made, selected = make_notebook.notebook(), json.loads((EXAMPLES / "tutorial.ipynb").read_text())
    finally:
        sys.modules.pop("make_notebook")
    assert [item["source"] for item in made["cells"]] == [item["source"] for item in selected["cells"]]
    examples = [output for item in made["cells"] for output in item.get("outputs", ())]
    assert sum("text/html" in item.get("data", {}) for item in examples) >= 6
    assert sum("image/png" in item.get("data", {}) for item in examples) == 1
