"""Options that commands share, and scene files: what a YAML file names is what the options mean."""

from dataclasses import replace

import numpy as np
import pytest

import mars_lidar as ml
from mars_lidar import io
from studies.compare.command import compare_app
from studies.compare.command import main as compare_main
from tests.harness.command import command_line, fails, ok, options_of, run

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
        ("transient: t.npy\nlight:\n  sbr: x\n", [], "scene.yaml:3: light.sbr must be a finite number"),
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
