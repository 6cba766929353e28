"""What every public object owes its user: a repr that fits on a screen, and a way to another process."""

import pickle
from typing import Any

import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml
from mars_lidar import io, statistics
from mars_lidar._base.display import brief
from mars_lidar.engines import MarsEngine
from mars_lidar.reconstruction import HistogramBound

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
