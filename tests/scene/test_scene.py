"""Scenes, and the radiometry that turns them into a flux: every mean and every count is checked."""

import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from harness import make_system, refused

from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS, System
from mars_lidar.scene.scene import Scene

NAN = math.nan


@pytest.fixture
def system() -> System:
    return make_system(20.0, 100)  # unambiguous range 14.99 m


@pytest.fixture
def scene() -> Scene:
    rng = np.random.default_rng(1)
    return Scene(rng.uniform(1.0, 9.0, (7, 5)), rng.uniform(0.1, 1.0, (7, 5)))


# --- the scene ---------------------------------------------------------------------------------------------


def test_maps_are_read_only_double_copies():
    depth = np.ones((2, 3), dtype=np.float32)
    scene = Scene(depth, 0.5)
    depth[:] = 7.0
    assert scene.shape == (2, 3)
    assert scene.depth_m.dtype == np.float64
    assert (scene.depth_m == 1.0).all()
    assert (scene.reflectivity == 0.5).all()
    assert scene.background is None
    with pytest.raises(ValueError, match="read-only"):
        scene.depth_m[0, 0] = 2.0
    with pytest.raises(ValueError, match="read-only"):
        scene.reflectivity[0, 0] = 0.0
    with pytest.raises(AttributeError):
        scene.depth_m = depth


def test_masked_depth_is_no_return():
    depth = np.ma.masked_array([[1, 2], [3, 4]], mask=[[False, True], [False, False]])
    np.testing.assert_array_equal(Scene(depth, 1.0).depth_m, [[1.0, NAN], [3.0, 4.0]])
    refused("reflectivity must not have masked", Scene, np.ones((2, 2)), depth / 10.0)


def test_repr_tells_size_depth_and_gaps():
    text = repr(Scene([[1.5, NAN, 4.0]], [[0.1, 0.2, 0.9]], np.ones((1, 3))))
    for part in ("1 x 3", "1.5 to 4 m", "1 pixels without return", "0.1 to 0.9", "background map"):
        assert part in text
    assert "no return anywhere" in repr(Scene([[NAN]], 1.0))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([1.0, 2.0], 1.0), ValueError, r"depth_m must be \(H, W\).*\(2,\)"),
        ((np.empty((0, 3)), 1.0), ValueError, "at least one pixel"),
        (([[0.0]], 1.0), ValueError, r"depth_m must be in \(0, 1e\+09\] m.*got 0.0 at pixel \(0, 0\)"),
        (([[1.0, -2.0]], 1.0), ValueError, r"got -2.0 at pixel \(0, 1\)"),
        (([[1.0]], 1.5), ValueError, r"reflectivity must be in \[0, 1\], got 1.5"),
        (([[1.0]], [[-0.1]]), ValueError, r"reflectivity must be in \[0, 1\], got -0.1"),
        (([[1.0, 2.0]], [[1.0]]), ValueError, r"reflectivity must have the shape of depth_m, \(1, 2\)"),
        (([[1.0]], 1.0, -1.0), ValueError, "background must be finite and >= 0, got -1.0"),
        (([[1.0]], 1.0, [1.0, 2.0]), ValueError, "background must have the shape"),
    ],
)
def test_bad_maps_are_refused(arguments, error, message):
    refused(message, Scene, *arguments, error=error)


def test_crop():
    depth = np.arange(1.0, 13.0).reshape(3, 4)
    scene = Scene(depth, depth / 16.0, 3.0 * depth)[1:, ::2]
    for field, factor in (("depth_m", 1.0), ("reflectivity", 1 / 16.0), ("background", 3.0)):
        np.testing.assert_array_equal(getattr(scene, field), depth[1:, ::2] * factor)
    assert Scene(depth, 1.0)[:2].shape == (2, 4)
    with pytest.raises(IndexError, match="slices"):
        scene[0]
    with pytest.raises(IndexError, match="no pixel"):
        scene[5:]


# --- another size ------------------------------------------------------------------------------------------


def test_depth_is_never_blended_and_reflectivity_is_area_mean():
    depth = np.array([[1.0, 1.0, 9.0, NAN], [1.0, 1.0, 9.0, NAN]])
    share = np.array([[0.0, 0.4, 0.2, 0.6], [0.8, 0.4, 0.2, 1.0]])
    half = Scene(depth, share, 10 * share).resize((1, 2))
    np.testing.assert_array_equal(half.depth_m, [[1.0, NAN]])
    np.testing.assert_allclose(half.reflectivity, [[0.4, 0.5]], rtol=1e-15)
    np.testing.assert_allclose(half.background, [[4.0, 5.0]], rtol=1e-15)


@pytest.mark.parametrize("shape", [(1, 1), (3, 4), (5, 7), (11, 13), (40, 9)])
def test_area_mean_keeps_the_mean_and_matches_overlaps(shape):
    share = np.random.default_rng(2).uniform(size=(8, 9))
    new = Scene(np.ones((8, 9)), share).resize(shape).reflectivity
    assert new.shape == shape
    assert new.mean() == pytest.approx(share.mean(), rel=1e-13)

    def overlaps(old: int, count: int) -> np.ndarray:
        low, high = np.arange(count)[:, None] / count, (np.arange(count)[:, None] + 1) / count
        a, b = np.arange(old) / old, (np.arange(old) + 1) / old
        return np.clip(np.minimum(high, b) - np.maximum(low, a), 0.0, None) * count

    np.testing.assert_allclose(new, overlaps(8, shape[0]) @ share @ overlaps(9, shape[1]).T, rtol=1e-12)


def test_resize_by_the_longer_side_keeps_the_aspect():
    assert Scene(np.ones((480, 640)), 1.0).resize(128).shape == (96, 128)
    assert Scene(np.ones((640, 480)), 1.0).resize(128).shape == (128, 96)
    assert Scene(np.ones((1, 300)), 1.0).resize(10).shape == (1, 10)


def test_resize_to_the_same_size_changes_nothing(scene):
    same = scene.resize(scene.shape)
    np.testing.assert_array_equal(same.depth_m, scene.depth_m)
    np.testing.assert_array_equal(same.reflectivity, scene.reflectivity)


def test_resize_of_white_stays_white():
    assert (Scene(np.ones((997, 3)), 1.0).resize((101, 7)).reflectivity == 1.0).all()


# --- radiometry --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("attenuation", ["none", "inverse_square"])
@pytest.mark.parametrize("ambient", ["uniform", "reflectivity", "map"])
@pytest.mark.parametrize(("signal", "sbr"), [(1.0, 1.0), (0.037, 0.02), (12.5, 80.0), (1e-6, 0.6)])
def test_levels_are_reached(scene, system, attenuation, ambient, signal, sbr):
    light = np.random.default_rng(4).uniform(0.0, 3.0, scene.shape)
    mapped = Scene(scene.depth_m, scene.reflectivity, light)
    flux = mapped.flux(system, signal=signal, sbr=sbr, attenuation=attenuation, ambient=ambient)
    assert flux.signal.mean() == pytest.approx(signal, rel=1e-12)
    assert flux.signal.mean() / flux.background.mean() == pytest.approx(sbr, rel=1e-12)
    weight = scene.reflectivity / (scene.depth_m**2 if attenuation == "inverse_square" else 1.0)
    np.testing.assert_allclose(flux.signal, signal * weight / weight.mean(), rtol=1e-12)
    shape = {"uniform": np.ones(scene.shape), "reflectivity": scene.reflectivity, "map": light}[ambient]
    np.testing.assert_allclose(flux.background, signal / sbr * shape / shape.mean(), rtol=1e-12)
    np.testing.assert_allclose(flux.delay_ns, 2.0 * scene.depth_m / SPEED_OF_LIGHT_M_PER_NS, rtol=1e-15)


def test_ambient_is_the_map_where_there_is_one(scene, system):
    assert scene.flux(system, signal=1.0, sbr=1.0).info["ambient"] == "uniform"
    light = np.arange(35.0).reshape(7, 5)
    flux = Scene(scene.depth_m, scene.reflectivity, light).flux(system, signal=1.0, sbr=1.0)
    assert flux.info["ambient"] == "map"
    np.testing.assert_allclose(flux.background, light / light.mean(), rtol=1e-12)


def test_dark_counts_come_on_top(scene, system):
    flux = scene.flux(system, signal=2.0, sbr=4.0, dark_count_hz=1e5)
    assert flux.background.mean() == pytest.approx(0.5 + 0.01, rel=1e-12)  # 1e5 /s in 100 ns
    assert flux.info["achieved_sbr"] == pytest.approx(4.0, rel=1e-12)
    assert flux.info["achieved_sbr_with_dark"] == pytest.approx(2.0 / 0.51, rel=1e-12)


def test_dark_counts_are_counts_whatever_the_efficiency(scene, system):
    """The same by the argument, by the detector and by a map."""
    blind = system.replace(detector=replace(system.detector, detection_efficiency=0.25))
    noisy = system.replace(detector=replace(blind.detector, dark_count_hz=1e5))
    light = scene.flux(blind, signal=2.0, sbr=4.0)
    given = scene.flux(blind, signal=2.0, sbr=4.0, dark_count_hz=1e5)
    expected = 0.25 * light.background + 0.01
    for flux in (given.detected(blind), light.detected(noisy), light.with_dark_counts(1e5, blind).detected(blind)):
        np.testing.assert_allclose(flux.background, expected, rtol=1e-12)
    assert given.info["achieved_sbr_with_dark"] == pytest.approx(2.0 * 0.25 / (0.5 * 0.25 + 0.01), rel=1e-12)


def test_no_ambient_light(scene, system):
    flux = scene.flux(system, signal=2.0, sbr=math.inf)
    assert (flux.background == 0.0).all()
    assert flux.info["sbr"] is None
    assert flux.info["achieved_sbr"] is None
    dark = scene.flux(system, signal=2.0, sbr=math.inf, dark_count_hz=1e3)
    np.testing.assert_allclose(dark.background, 1e-4, rtol=1e-15)
    assert dark.info["achieved_sbr_with_dark"] == pytest.approx(2e4, rel=1e-12)


def test_pixels_without_return_do_not_count(system):
    scene = Scene([[NAN, 2.0, 4.0, NAN]], [[1.0, 0.2, 0.6, 0.9]], [[5.0, 1.0, 3.0, 0.0]])
    with pytest.warns(UserWarning, match="2 of 4 pixels have no return") as caught:
        flux = scene.flux(system, signal=1.0, sbr=0.5, attenuation="inverse_square")
    assert len(caught) == 1
    assert caught[0].filename == __file__
    np.testing.assert_allclose(flux.signal, [[0.0, 8 / 7, 6 / 7, 0.0]], rtol=1e-12)  # 0.2 / 4 to 0.6 / 16
    np.testing.assert_allclose(flux.background, [[5.0, 1.0, 3.0, 0.0]], rtol=1e-12)  # mean over two: 2
    np.testing.assert_array_equal(np.isnan(flux.delay_ns), [[True, False, False, True]])
    assert flux.info["n_valid"] == 2
    assert flux.info["n_pixels"] == 4
    assert flux.info["mean_signal"] == pytest.approx(1.0, rel=1e-12)
    assert flux.info["mean_ambient"] == pytest.approx(2.0, rel=1e-12)


def test_depth_beyond_the_unambiguous_range_wraps_with_one_warning(system):
    reach = system.unambiguous_range_m
    scene = Scene([[np.nextafter(reach, 0.0), reach, 1.5 * reach, 7 * reach, 1.0]], 0.5)
    with pytest.warns(UserWarning, match="unambiguous range") as caught:
        flux = scene.flux(system, signal=1.0, sbr=1.0)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    text = str(caught[0].message)
    for part in ("3 of 5 pixels", f"{reach:.6g} m", "wrap"):
        assert part in text
    assert flux.info["n_wrapped"] == 3
    assert flux.info["unambiguous_range_m"] == reach
    np.testing.assert_allclose(flux.delay_ns[0, 2:4], [150.0, 700.0], rtol=1e-14)  # kept unwrapped


def test_no_warning_where_nothing_is_lost(scene, system):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.flux(system, signal=1.0, sbr=1.0)


def test_info_is_plain_json_and_repeats_the_request(scene, system):
    flux = scene.flux(system, signal=1.5, sbr=3.0, attenuation="inverse_square", dark_count_hz=50.0)
    info = json.loads(json.dumps(flux.info, allow_nan=False))
    assert info == flux.info
    expected = {
        "signal": 1.5,
        "sbr": 3.0,
        "attenuation": "inverse_square",
        "ambient": "uniform",
        "dark_count_hz": 50.0,
        "n_pixels": 35,
        "n_valid": 35,
        "n_wrapped": 0,
    }
    assert {key: info[key] for key in expected} == expected
    assert info["mean_dark"] == pytest.approx(5e-6, rel=1e-14)
    assert info["mean_background"] == pytest.approx(0.5 + 5e-6, rel=1e-12)
    assert "no dark counts" in info["sbr_definition"]


def test_extreme_depths_and_maps_do_not_overflow(system):
    scene = Scene([[1e-9, 1.0, 1e8]], [[1e-300, 1.0, 1.0]], [[1e300, 1e300, 1e300]])
    with pytest.warns(UserWarning, match="1 of 3 pixels lie beyond"):
        flux = scene.flux(system, signal=1.0, sbr=1.0, attenuation="inverse_square")
    assert flux.signal.mean() == pytest.approx(1.0, rel=1e-12)
    assert flux.background.mean() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"signal": 0.0}, ValueError, r"signal must be a finite number in \(0, inf\), got 0.0"),
        ({"sbr": 0.0}, ValueError, r"sbr must be a number in \(0, inf\].*got 0.0"),
        ({"attenuation": "1/z2"}, ValueError, "attenuation must be one of 'none', 'inverse_square', got"),
        ({"ambient": "dark"}, ValueError, "ambient must be one of 'uniform', 'reflectivity', 'map', got"),
        ({"ambient": "map"}, ValueError, "ambient='map' needs a scene with a background map"),
        ({"signal": 1e7}, ValueError, r"signal must lie in \[0, 1e\+06\]"),
    ],
)
def test_bad_arguments_are_refused(scene, system, changes, error, message):
    arguments = {"system": system, "signal": 1.0, "sbr": 1.0, **changes}
    refused(message, scene.flux, **arguments, error=error)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (Scene([[NAN, NAN]], 1.0), "depth_m is NaN at every pixel"),
        (Scene([[1.0, 2.0]], 0.0), "reflectivity is zero at every pixel with a return: signal=1"),
        (Scene([[1.0, NAN]], [[0.0, 1.0]]), "reflectivity is zero at every pixel with a return"),
        (Scene([[1.0, NAN]], 1.0, [[0.0, 1.0]]), "ambient light is zero at every pixel with a return: sbr=1"),
    ],
)
def test_levels_that_cannot_be_reached_are_refused(scene, system, message):
    refused(message, scene.flux, system, signal=1.0, sbr=1.0)


# --- built-in scenes ---------------------------------------------------------------------------------------


def test_example_names_and_the_error_that_lists_them():
    assert Scene.example_names() == ("room", "random")
    for name in Scene.example_names():
        assert Scene.example(name, size=4).shape == (4, 4)
    refused("name must be one of 'room', 'random', got 'kitchen'", Scene.example, "kitchen")


@pytest.mark.parametrize("seed", range(3))
def test_random_scenes_are_whole_and_different(seed):
    first, again, other = (Scene.example("random", 24, k) for k in (seed, seed, seed + 100))
    np.testing.assert_array_equal(first.depth_m, again.depth_m)
    assert not np.array_equal(first.depth_m, other.depth_m)
    assert first.valid.all()
    assert 0.3 < first.depth_m.min() < first.depth_m.max() < 17.5
    assert first.reflectivity.max() > 0.02
