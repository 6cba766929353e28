"""Scenes, and the radiometry that turns them into a flux: every mean and every count is checked."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from harness import make_system, refused
from scipy import integrate, special

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS, System
from mars_lidar.io.rgbd import read_layers
from mars_lidar.light.fog import Fog
from mars_lidar.light.transient import Transient
from mars_lidar.scene.rooms import Box, Camera, Sphere, cast
from mars_lidar.scene.scene import LayeredScene, Scene
from studies.compare.command import compare_app
from studies.compare.command import main as compare_main
from tests.harness.command import command_line, fails, ok, options_of, run

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


# --- radiometry --------------------------------------------------------------------------------------------


def test_resize_of_white_stays_white():
    assert (Scene(np.ones((997, 3)), 1.0).resize((101, 7)).reflectivity == 1.0).all()


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


# Options that commands share, and scene files: what a YAML file names is what the options mean.


SMALL = ["--period-ns", "20", "--cycles", "30", "--bins", "64", "--dead-time-ns", "5"]


def simulated(path, *arguments: object):
    ok("simulate", *arguments, *SMALL, "--no-picture", "--overwrite", "-o", path)
    with io.load(path) as cube:
        return np.asarray(cube.histogram), cube.recipe.source


@pytest.fixture
def transient(tmp_path):
    values = np.random.default_rng(1).random((3, 4, 40, 2)) ** 4
    np.save(tmp_path / "t.npy", values)
    return tmp_path


def compared(*arguments: object):
    return command_line([str(each) for each in arguments], main=compare_main)


def test_the_commands_that_take_a_system_take_the_same_options():
    every = options_of("simulate"), options_of("table", "build"), options_of(app=compare_app())
    simulate, table, compare = ({name: each.parameter.help for name, each in options.items()} for options in every)
    system = list(simulate)[list(simulate).index("--system") : list(simulate).index("--max-events-per-exposure") + 1]
    assert len(system) > 30
    assert {"--detector", "--mode", "--jitter-fwhm-ns", "--electronics-dead-time-ns", "--crosstalk"} < set(system)
    for name in system:
        assert compare[name] == table[name] == simulate[name]
    shared = {name for name in simulate if name.startswith(("--transient", "--scene", "--depth", "--light"))}
    assert shared <= set(compare)


def test_effects_reach_compare():
    effects = ["--detector", "excelitas-spcm-aqrh", "--jitter-fwhm-ns", "0.4", "--electronics-dead-time-ns", "90"]
    room = ["--scene", "room", "--size", 8, "--cycles", 20, "--bins", 64, "--engines", "exact"]
    done = compared(*room, "--realizations", 50, "--repeats", 1, *effects)
    assert done.exit_code == 0, done.output
    detector = ml.Detector.preset("excelitas-spcm-aqrh")
    detector = replace(detector, jitter=ml.Jitter.from_fwhm(fwhm_ns=0.4), electronics_dead_time_ns=90.0)
    for effect in detector.effects:
        assert effect.removesuffix("_ns").removesuffix("_hz").replace("_", " ") in " ".join(done.stdout.split())
    refused = compared("--scene", "room", "--crosstalk", 0.1, "--against", "sequential")
    assert refused.exit_code == 2
    assert "compare draws single pixels" in refused.stderr


@pytest.mark.full
def test_a_scene_file_of_a_transient_is_its_options(transient):
    (transient / "scene.yaml").write_text(
        "transient: t.npy\nbin_ns: 0.5\nstart_ns: 1\nchannel: 1\npulse: false\n"
        "light: {photons_per_unit: 2e-2, sbr: 4}\n"
    )
    out = transient / "a.npz"
    times = "--transient-bin-ns 0.5 --transient-start-ns 1 --transient-channel 1 --no-transient-pulse"
    options = ["--transient", transient / "t.npy", *times.split()]
    by_options, source = simulated(out, *options, "--photons-per-unit", 0.02, "--sbr", 4)
    by_file, same = simulated(out, "--scene", transient / "scene.yaml")
    assert np.array_equal(by_file, by_options)
    assert source == same
    # single options replace what the file says; the level is one of two
    by_options, _ = simulated(out, *options, "--transient-start-ns", 3, "--signal", 2, "--sbr", 4)
    by_file, _ = simulated(out, "--scene", transient / "scene.yaml", "--transient-start-ns", 3, "--signal", 2)
    assert np.array_equal(by_file, by_options)
    few = ["--engines", "exact,poisson", "--realizations", 50, "--repeats", 1]
    done = compared("--scene", transient / "scene.yaml", *SMALL, *few)
    assert done.exit_code == 0, done.output


def test_scene_files_of_depth_and_of_a_built_in_scene(tmp_path):
    np.save(tmp_path / "depth.npy", np.linspace(1.0, 2.5, 48).reshape(6, 8))
    (tmp_path / "depth.yml").write_text(
        "depth: depth.npy\ndepth_unit_m: 0.5\nlight:\n  signal: 0.7\n  sbr: inf\n  attenuation: inverse_square\n"
    )
    (tmp_path / "room.yaml").write_text("example: room\nsize: 9\nseed: 4\n")
    out = tmp_path / "a.npz"
    light = ["--signal", 0.7, "--sbr", "inf", "--attenuation", "inverse_square"]
    by_options, _ = simulated(out, "--depth", tmp_path / "depth.npy", "--depth-unit-m", 0.5, *light)
    assert np.array_equal(simulated(out, "--scene", tmp_path / "depth.yml")[0], by_options)
    by_options, _ = simulated(out, "--scene", "room", "--size", 9, "--scene-seed", 4)
    assert np.array_equal(simulated(out, "--scene", tmp_path / "room.yaml")[0], by_options)


@pytest.mark.parametrize(
    ("text", "more", "words"),
    [
        ("example: room\nsiz: 9\n", [], "scene.yaml:2: a scene file has unknown key 'siz'"),
        ("example: room\nsize: 0\n", [], "scene.yaml:2: size must be an integer in [1, "),
        ("size: 9\n", [], "a scene file must give one of example, depth (or path) and transient, got none of them"),
        ("example: room\ndepth: a.png\n", [], "got example and depth"),
        ("transient: t.npy\npulse: 3\n", [], "scene.yaml:2: pulse must be true or false, got 3"),
        ("transient: t.npy\nlight:\n  sbr: x\n", [], "scene.yaml:3: light.sbr must be a number in (0, inf]"),
        ("transient: t.npy\nlight: {signal: 1, photons_per_unit: 1}\n", [], "one of signal and photons_per_unit"),
        ("transient: t.npy\nlight: {glow: 1}\n", [], "light has unknown key 'glow'"),
        ("transient: t.npy\n", [], "give bin_ns"),
        ("transient: nowhere.npy\nbin_ns: 1\n", [], "no such file"),
        ("- a\n- b\n", [], "a scene file must give one of"),
        ("example: [room\n", [], "scene.yaml:"),
        ("example: room\n", ["--depth", "d.npy"], "got --scene and --depth"),
    ],
)
def test_bad_scene_files_are_one_clear_line(transient, text, more, words):
    (transient / "scene.yaml").write_text(text)
    done = fails(words, "simulate", "--scene", transient / "scene.yaml", *more, *SMALL, "-o", transient / "a.npz")
    assert len(done.stderr.splitlines()) == 1
    missing = run("simulate", "--scene", transient / "other.yaml", *SMALL, "-o", transient / "a.npz")
    assert (missing.exit_code, "other.yaml: no such file" in missing.stderr) == (2, True)


# Scenes of several surfaces: panes, files of layers, and what cannot be; parts of transients that stay on disk.


SYSTEM = make_system(30.0, 50, 32)


def test_a_pane_hides_behind_what_is_nearer():
    scene = ml.Scene([[1.0, 4.0, np.nan]], 0.5, [[1.0, 2.0, 3.0]])
    visible = LayeredScene.behind_pane(scene, 2.0, 0.1, 0.8)
    np.testing.assert_array_equal(visible.layers[1].depth_m, [[np.nan, 2.0, 2.0]])
    np.testing.assert_allclose(visible.reflectivity, [[0.5, 0.4, 0.4]])
    assert visible.valid.all()
    flux = visible.flux(SYSTEM, signal=2.0, sbr=4.0)
    assert flux.returns_signal.shape == (2, 1, 3)
    assert flux.signal.mean() == pytest.approx(2.0)
    np.testing.assert_allclose(flux.returns_signal[:, 0, 1] / flux.signal[0, 0], [0.8, 0.2])
    np.testing.assert_allclose(flux.background, 0.5 * np.array([[0.5, 1.0, 1.5]]))  # the map of the first layer
    near = visible.flux(SYSTEM, signal=2.0, sbr=4.0, attenuation="inverse_square", ambient="reflectivity")
    np.testing.assert_allclose(near.returns_signal[:, 0, 1] / near.signal[0, 0], [0.4 / 16 / 0.5, 0.1 / 4 / 0.5])
    np.testing.assert_allclose(near.background / near.background[0, 0], [[1.0, 1.0, 0.2]])  # the last: the pane alone
    twice = LayeredScene.behind_pane(visible, 1.5, 0.2)
    assert len(twice.layers) == 3
    assert twice[:, 1:].shape == (1, 2)
    assert twice.resize((2, 6)).shape == (2, 6)


@pytest.mark.filterwarnings("ignore:.* have no return")
def test_ambient_light_of_layers_in_any_order():
    nan, rng = np.nan, np.random.default_rng(5)
    depths = [[[1.0, nan, nan, 3.0, nan]], [[2.0, 2.0, nan, nan, nan]], [[4.0, nan, 4.0, nan, nan]]]
    layers = [ml.Scene(depth, rng.uniform(0.1, 0.9, (1, 5))) for depth in depths]
    share = [item.reflectivity[0] for item in layers]
    sums = [share[0][0] + share[1][0] + share[2][0], share[1][1], share[2][2], share[0][3], max(s[4] for s in share)]
    for order in itertools.permutations(range(3)):
        flux = LayeredScene([layers[k] for k in order]).flux(SYSTEM, signal=2.0, sbr=4.0, ambient="reflectivity")
        np.testing.assert_allclose(flux.background[0] / flux.background[0, 1], np.array(sums) / sums[1], rtol=1e-12)
        assert flux.background[0, :4].mean() == pytest.approx(0.5)  # over the pixels with a return
    alone = layers[0].flux(SYSTEM, signal=2.0, sbr=4.0, ambient="reflectivity")
    item = LayeredScene(layers[:1]).flux(SYSTEM, signal=2.0, sbr=4.0, ambient="reflectivity")
    np.testing.assert_array_equal(alone.background, item.background)


def test_bad_layers(tmp_path):
    item = ml.Scene(np.ones((2, 2)), 1.0)
    for layers, message in (([], "1 to 16"), ([item] * 17, "1 to 16"), ([item, ml.Scene([[1.0]], 1.0)], "one shape")):
        refused(message, LayeredScene, layers)
    for arguments, name in (((0.0, 0.1), "depth_m"), ((1.0, 2.0), "reflectivity"), ((1.0, 0.1, 0.0), "transmission")):
        refused(f"{name} must be", LayeredScene.behind_pane, item, *arguments)
    path = tmp_path / "s.npz"
    depth = np.ones((2, 3, 4))
    for arrays, message in (
        ({"depth": depth[0]}, r"must be an \.npz with a depth of \(layers, H, W\)"),
        ({"depth": depth, "image": depth}, "give reflectivity, not image"),
        ({"depth": depth, "reflectivity": depth[0]}, "reflectivity must have the shape of depth"),
        ({"depth": depth, "reflectivity": 2 * depth}, r"reflectivity must lie in \[0, 1\]"),
        ({"depth": depth, "background": depth}, r"background must be real numbers \(H, W\)"),
        ({"depth": -depth}, "depth must not be negative"),
        ({"depth": depth.astype(np.uint16)}, "give depth_unit_m"),
        ({"depth": np.ones((17, 3, 4))}, "layers must be 1 to 16"),
    ):
        np.savez(path, **arrays)
        refused(message, read_layers, path)
    np.savez(path, depth=(1000 * depth).astype(np.uint16))
    np.testing.assert_array_equal(read_layers(path, depth_unit_m=0.001).layers[1].depth_m, depth[1])


def test_fog_made_by_rows_is_that_of_the_flux():
    rng = np.random.default_rng(0)
    clear = ml.Scene(rng.uniform(1.0, 12.0, (5, 4)), rng.uniform(0.1, 0.9, (5, 4))).flux(SYSTEM, signal=0.7, sbr=2.0)
    stored = Fog(extinction_per_m=0.1, backscatter=0.5).before(clear, SYSTEM, 0.7)
    whole = clear.in_fog(SYSTEM, extinction_per_m=0.1, backscatter=0.35)
    np.testing.assert_array_equal(stored[1:4].waveform, whole.waveform[1:4])
    np.testing.assert_allclose(stored.signal, whole.signal, rtol=1e-12)
    assert np.array_equal(ml.simulate(stored, SYSTEM, seed=1), ml.simulate(whole, SYSTEM, seed=1))
    refused("backscatter must be", Fog, extinction_per_m=0.1, backscatter=-1.0)


def test_parts_of_a_transient():
    values = np.random.default_rng(0).exponential(1.0, (6, 8, 5))
    transient = Transient(values, 0.5)
    crop = transient[4:1:-1, 1:7:2]
    np.testing.assert_array_equal(crop.rows(slice(0, 3)), values[4:1:-1, 1:7:2])
    np.testing.assert_array_equal(crop.rows(slice(1, 3)), values[3:1:-1, 1:7:2])
    np.testing.assert_allclose(transient.resize((3, 4)).rows(slice(0, 3)), values.reshape(3, 2, 4, 2, 5).mean((1, 3)))
    odd = transient.resize((4, 8))
    rows = [values[0] + 0.5 * values[1], 0.5 * values[1] + values[2], values[3] + 0.5 * values[4]]
    np.testing.assert_allclose(odd.rows(slice(0, 3)), np.stack(rows) / 1.5)
    np.testing.assert_allclose(odd.totals.sum() / 4, values.sum() / 6)
    assert Transient(values, 0.5, totals=values.sum(-1)).totals.shape == (6, 8)
    refused("totals must have shape", Transient, values, 0.5, totals=[1.0])
    with pytest.raises(IndexError, match="selects no pixel"):
        transient[6:]


# Returns in fog: the lidar equation, by brute force; limits.


C = 0.299792458
FOG_SYSTEM = make_system(30.0, 100, 200, sigma_ns=0.4)


@pytest.mark.parametrize(("alpha", "first", "delay"), [(0.05, 0.5, 60.0), (1.0, 2.0, 33.3), (0.02, 1.0, 140.0)])
def test_lidar_equation(alpha: float, first: float, delay: float):
    flux = ml.Flux(0.7, 0.1, delay).in_fog(
        FOG_SYSTEM, extinction_per_m=alpha, backscatter=1.3, nearest_m=first, parts=1000
    )
    assert (flux.background == 0.1).all()
    target = 0.5 * C * delay
    total = integrate.quad(lambda z: np.exp(-2 * alpha * z) / z**2, first, np.inf)[0]
    observed = integrate.quad(lambda z: np.exp(-2 * alpha * z) / z**2, first, target)[0]
    assert flux.signal == pytest.approx(0.7 * np.exp(-2 * alpha * target) + 1.3 * observed / total, rel=1e-6)
    # the cloud through the pulse, point by point
    z = np.linspace(first, target, 400_001)
    density = np.exp(-2 * alpha * z) / z**2
    weight = np.diff(z) * 0.5 * (density[1:] + density[:-1])
    tau = (z[1:] + z[:-1]) / C
    place = (tau[:, None] + 0.4 * np.random.default_rng(1).standard_normal((tau.size, 4))) % 100.0
    cloud = np.histogram(place, 50, (0.0, 100.0), weights=np.repeat(weight[:, None], 4, 1))[0] * 1.3 / total / 4
    target_energy = 0.7 * np.exp(-2 * alpha * target) * FOG_SYSTEM.pulse.bin_energy(delay, 100.0, 50)
    assert flux.waveform.reshape(50, 20).sum(-1) == pytest.approx(
        cloud + target_energy, abs=5e-3 * 1.3 * observed / total
    )


def test_limits():
    clear = ml.Flux.multi(ml.Flux([[1.0, 0.0]], 0.2, [[30.0, np.nan]]), ml.Flux([[0.3, 0.0]], 0.0, [[50.0, np.nan]]))
    thin = clear.in_fog(FOG_SYSTEM, extinction_per_m=1e-9, backscatter=0.0)
    expected = FOG_SYSTEM.pulse.bin_energy(30.0, 100.0, 800) + 0.3 * FOG_SYSTEM.pulse.bin_energy(50.0, 100.0, 800)
    assert thin.waveform.shape == (1, 2, 800)
    assert thin.waveform[0, 0] == pytest.approx(expected, abs=1e-8)
    assert not thin.waveform[0, 1].any()
    thick = clear.in_fog(FOG_SYSTEM, extinction_per_m=3.0, backscatter=0.8)
    assert thick.signal == pytest.approx(np.full((1, 2), 0.8), rel=1e-6)  # all of it comes from the fog
    assert thick.info["extinction_per_m"] == 3.0
    near = ml.Flux(1.0, 0.0, 3.0).in_fog(FOG_SYSTEM, extinction_per_m=0.1, backscatter=5.0)  # before the fog begins
    assert near.signal == pytest.approx(np.exp(-0.2 * 1.5 * C), rel=1e-6)


def test_light_that_comes_many_periods_late():
    """Thin fog without a target: light from 50 km on 15 m of range, in a memory that does not grow with it."""
    quick = FOG_SYSTEM.replace(pulse=ml.GaussianPulse(sigma_ns=0.001))
    flux = ml.Flux([[0.0, 1.0]], 0.0, [[np.nan, 3e5]]).in_fog(
        quick, extinction_per_m=1e-5, backscatter=1.0, nearest_m=0.5, parts=16
    )

    def share(z):
        z = np.maximum(z, 0.5)
        return 1.0 - special.expn(2, 2e-5 * z) / z * 0.5 / special.expn(2, 1e-5)

    edges = np.arange(16 * 20_000 + 1) * (0.5 * C * 100.0 / 16)
    for pixel, end in ((0, np.inf), (1, 0.5 * C * 3e5)):
        expected = np.diff(share(np.minimum(edges, end))).reshape(-1, 16).sum(0)
        expected += np.exp(-2e-5 * end) * quick.pulse.bin_energy(3e5, 100.0, 16) if pixel else 0.0
        assert flux.waveform[0, pixel] == pytest.approx(expected, abs=1e-6)


def test_bad_input():
    flux = ml.Flux(1.0, 0.0, 30.0)
    for light, changes, message in (
        (flux, {"extinction_per_m": 0.0}, "extinction_per_m must be"),
        (flux, {"backscatter": -1.0}, "backscatter must be"),
        (flux, {"nearest_m": 0.0}, "nearest_m must be"),
        (flux, {"parts": 0}, "parts must be"),
        (ml.Flux(1.0, 0.0, -3.0), {}, "delay_ns must be >= 0 in fog"),
        (ml.Flux(waveform=[1.0]), {}, "needs the delays of returns"),
    ):
        refused(message, light.in_fog, FOG_SYSTEM, **{"extinction_per_m": 0.1, "backscatter": 1.0} | changes)


# The ray-caster against analytic geometry, and the built-in room.


def white(u, v):
    return np.ones_like(u)


def directions(size, field_of_view_deg=60.0):
    height, width = size
    focal = 0.5 * max(size) / math.tan(math.radians(field_of_view_deg) / 2)
    x = (np.arange(width) - (width - 1) / 2) / focal
    y = ((height - 1) / 2 - np.arange(height)) / focal
    d = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0))
    return d / np.linalg.norm(d, axis=0)


def test_wall_range_and_lambert_cosine():
    d = directions((9, 15))
    wall = Box((0.0, 0.0, 6.0), (50.0, 50.0, 1.0), (white,) * 6)
    depth, light = cast([wall], Camera((0.0, 0.0, 0.0)), (9, 15))
    np.testing.assert_allclose(depth, 5.0 / d[2], rtol=1e-13)  # the range along the ray, not z
    # Neighbours are close on a wall seen so: one ray each, so the cosine is that of the centre.
    even = np.abs(light - d[2]) < 1e-13
    assert even.mean() > 0.5
    np.testing.assert_allclose(light, d[2], atol=2e-3)  # the rest: mean over the pixel


def test_sphere_range_and_cosine():
    size = (33, 33)
    d = directions(size)
    depth, _ = cast([Sphere((0.0, 0.0, 4.0), 1.0, white)], Camera((0.0, 0.0, 0.0)), size)
    b = 4.0 * d[2]
    hit = b**2 > 15.0
    np.testing.assert_array_equal(np.isfinite(depth), hit)
    root = np.sqrt(np.where(hit, b**2 - 15.0, 0.0))
    np.testing.assert_allclose(depth[hit], (b - root)[hit], rtol=1e-12)
    narrow = Camera((0.0, 0.0, 0.0), field_of_view_deg=1e-3)
    _, middle = cast([Sphere((0.0, 0.0, 4.0), 1.0, white)], narrow, (1, 1))
    assert middle[0, 0] == pytest.approx(1.0, abs=1e-9)


def test_turned_box_shows_its_edge():
    # A cube turned by 45 degrees: the nearest point is the vertical edge, sqrt(2) before its centre.
    cube = Box((0.0, 0.0, 5.0), (1.0, 1.0, 1.0), (white,) * 6, yaw_deg=45.0)
    depth, light = cast([cube], Camera((0.0, 0.0, 0.0), field_of_view_deg=10.0), (1, 101))
    middle = 5.0 - math.sqrt(2.0)
    assert depth[0, 50] == pytest.approx(middle, rel=1e-12)
    assert depth.argmin() == 50
    x = directions((1, 101), 10.0)[0, 0] / directions((1, 101), 10.0)[2, 0]
    z = middle / (1.0 - np.abs(x))  # |x| = z - middle on the two faces
    np.testing.assert_allclose(depth[0], np.hypot(z, z * x), rtol=1e-12)
    np.testing.assert_allclose(light[0, 50], math.cos(math.pi / 4), atol=0.01)


def test_faces_and_texture_coordinates():
    def face(k):
        return lambda u, v: np.full_like(u, (k + 1) / 10)

    inside = Box((0.0, 0.0, 0.0), (2.0, 3.0, 4.0), tuple(face(k) for k in range(6)), inside=True)
    looks = {0: (-90.0, 0.0), 1: (90.0, 0.0), 2: (0.0, -90.0), 3: (0.0, 90.0), 4: (180.0, 0.0), 5: (0.0, 0.0)}
    for k, (yaw, pitch) in looks.items():
        depth, light = cast([inside], Camera((0.0, 0.0, 0.0), yaw, pitch, 0.01), (1, 1))
        assert depth[0, 0] == pytest.approx((2.0, 3.0, 4.0)[k // 2], rel=1e-12)
        assert light[0, 0] == pytest.approx((k + 1) / 10, rel=1e-6)
    slope = (white,) * 4 + (lambda u, v: 0.5 + 0.25 * u + 0.125 * v, white)
    front = Box((0.0, 0.0, 5.0), (1.0, 1.0, 1.0), slope)
    _, light = cast([front], Camera((0.5, -0.25, 0.0), field_of_view_deg=0.01), (1, 1))
    assert light[0, 0] == pytest.approx(0.5 + 0.125 - 0.03125, rel=1e-4)


def test_the_nearest_surface_wins_whatever_the_order():
    ball = Sphere((0.0, 0.0, 3.0), 0.5, white)
    wall = Box((0.0, 0.0, 5.0), (9.0, 9.0, 0.5), (lambda u, v: np.full_like(u, 0.25),) * 6)
    camera = Camera((0.0, 0.0, 0.0))
    first, two = cast([ball, wall], camera, (20, 20)), cast([wall, ball], camera, (20, 20))
    for a, b in zip(first, two, strict=True):
        np.testing.assert_array_equal(a, b)
    assert first[0].min() == pytest.approx(2.5, abs=0.02)


def test_what_is_behind_the_camera_is_not_seen():
    things = [Sphere((0.0, 0.0, -3.0), 0.5, white), Box((0.0, 0.0, -6.0), (1.0, 1.0, 1.0), (white,) * 6)]
    depth, light = cast(things, Camera((0.0, 0.0, 0.0)), (8, 8))
    assert np.isinf(depth).all()
    assert (light == 0.0).all()


def test_edges_of_the_image_are_smoothed_but_depth_is_not():
    near = Box((0.0, 0.0, 2.0), (0.5, 0.5, 0.1), (white,) * 6, yaw_deg=0.0)
    wall = Box((0.0, 0.0, 5.0), (9.0, 9.0, 0.5), (lambda u, v: np.zeros_like(u),) * 6)
    depth, light = cast([near, wall], Camera((0.03, 0.02, 0.0)), (31, 31))
    d = directions((31, 31))
    both = np.stack((1.9 / d[2], 4.5 / d[2]))
    assert np.abs(depth - both).min(0).max() < 1e-12  # one surface or the other, never between
    cosine = light / d[2]
    assert ((cosine > 0.15) & (cosine < 0.85)).sum() > 10  # part covered


# --- the room ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (1, 200), (200, 1), (2, 3), (90, 160), (128, 128)])
@pytest.mark.parametrize("seed", [0, 1])
def test_room_at_any_size(size, seed):
    room = Scene.example("room", size=size, seed=seed)
    assert room.shape == size
    assert room.valid.all()
    assert room.depth_m.min() > 2.3
    assert room.depth_m.max() < 9.0
    assert room.reflectivity.min() >= 0.0
    assert room.reflectivity.max() <= 1.0


@pytest.mark.parametrize("seed", range(12))
def test_every_seed_gives_a_scene_with_depth_and_contrast(seed):
    room = Scene.example(size=48, seed=seed)
    assert room.depth_m.min() < 3.0
    assert room.depth_m.max() > 8.0
    assert room.reflectivity.std() > 0.1
    assert 0.2 < room.reflectivity.mean() < 0.5
    steps = np.abs(np.diff(room.depth_m, axis=1)) > 0.5
    assert steps.sum() > 60  # outlines


def test_same_seed_same_room_other_seed_other_room():
    a, b, c = (Scene.example(size=32, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(a.depth_m, b.depth_m)
    np.testing.assert_array_equal(a.reflectivity, b.reflectivity)
    assert (a.depth_m != c.depth_m).mean() > 0.05
    assert (a.reflectivity != c.reflectivity).mean() > 0.9


def test_room_is_the_same_at_every_size():
    # Threefold size: the middle of every third pixel is the ray of the small image.
    small, large = Scene.example(size=(20, 31)), Scene.example(size=(60, 93))
    np.testing.assert_allclose(large.depth_m[1::3, 1::3], small.depth_m, rtol=1e-12)
    mean = large.reflectivity.reshape(20, 3, 31, 3).mean((1, 3))
    assert np.sqrt(np.mean((mean - small.reflectivity) ** 2)) < 0.05


def test_room_does_not_touch_the_global_random_state():
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    Scene.example(size=8)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
