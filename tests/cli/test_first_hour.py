"""What a new user meets in the first quarter of an hour: own images, numbers as people write them, whole objects."""

import re
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray
from harness import make_system, refused
from PIL import Image

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base import progress as bars
from mars_lidar._base.tolerances import TOL
from mars_lidar.io.simulated_file import _Probe, advice
from studies.compare.comparison import compare
from tests.harness.command import ok, run

SYSTEM = make_system(50.0, 50, 64, sigma_ns=0.5)
RECIPE = "scenes: {path: .}\nsystems: {file: spad.yaml}\nlight: {signal: 1, sbr: 1}\n"


def write_depth(path, side: int = 8) -> None:
    Image.fromarray(np.full((side, side), 3000, np.uint16)).save(path)


@pytest.mark.parametrize("name", ["s00.jpg", "s00.jpeg", "s00.png", "s00.webp", "s00.JPG", "s00_rgb.webp"])
def test_an_image_beside_its_depth_becomes_the_reflectivity(tmp_path, name):
    write_depth(tmp_path / "s00_depth.png")
    ramp = np.tile(np.linspace(0, 255, 8).astype(np.uint8), (8, 1))
    Image.fromarray(np.repeat(ramp[..., None], 3, axis=2)).save(tmp_path / name)
    SYSTEM.save(tmp_path / "spad.yaml")
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    ml.generate(tmp_path / "recipe.yaml", tmp_path / "set.zarr")
    with xarray.open_zarr(tmp_path / "set.zarr") as data:
        share = data.reflectivity.values[0]
        assert share[:, -1].mean() > 10 * share[:, 0].mean()
        assert data.scene_name.values.tolist() == ["s00_depth.png"]
    with xarray.open_zarr(tmp_path / "set.zarr", group="scenes") as data:
        assert data["name"].values.tolist() == ["s00_depth.png"]


def test_a_folder_without_any_image_says_so(tmp_path):
    for k in range(3):
        write_depth(tmp_path / f"s{k}_depth.png")
    with pytest.warns(UserWarning, match=r"no image was found to any of 3 depth files.*s0_depth\.png"):
        scenes, _ = io.scan(tmp_path)
    assert [scene.image for scene in scenes] == [None] * 3
    Image.fromarray(np.full((8, 8), 200, np.uint8)).save(tmp_path / "s1.jpg")
    scenes, _ = io.scan(tmp_path)  # some have none, which is nothing odd
    assert [scene.image and scene.image.name for scene in scenes] == [None, "s1.jpg", None]


def test_whole_floats_are_integers_everywhere(tmp_path):
    assert SYSTEM.replace(cycles=1e6).cycles == 1_000_000
    assert isinstance(SYSTEM.replace(cycles=np.float64(1e3)).cycles, int)
    flux = ml.Flux(0.5, 0.1, 20.0)
    assert np.array_equal(
        ml.simulate(flux, SYSTEM, realizations=2.0, seed=3.0), ml.simulate(flux, SYSTEM, realizations=2, seed=3)
    )
    ok("simulate", "--scene", "room", "--size", "1e1", "--cycles", "1e2", "--no-picture", "-o", tmp_path / "a.zarr")
    with io.load(tmp_path / "a.zarr") as cube:
        assert (cube.system.cycles, cube.shape[1]) == (100, 10)
    done = run("simulate", "--scene", "room", "--cycles", "1.5e0", "-o", tmp_path / "b.zarr")
    assert done.exit_code == 2
    assert "--cycles must be an integer, got '1.5e0'" in done.output


def test_words_that_are_nearly_right_are_guessed():
    refused(r"unknown key 'dead_time' \(did you mean 'dead_time_ns'\?\)", ml.Detector.from_dict, {"dead_time": 5.0})
    refused(r"got 'exat' \(did you mean 'exact'\?\)", ml.simulate, ml.Flux(0.5, 0.1, 20.0), SYSTEM, engine="exat")


def test_progress_true_is_a_bar_and_a_log_gets_a_line_every_half_minute(monkeypatch, capsys):
    flux = ml.Flux(0.5, 0.1, 20.0)
    assert np.array_equal(ml.simulate(flux, SYSTEM, progress=True), ml.simulate(flux, SYSTEM, progress=False))
    assert len(ml.simulate_timestamps(flux, SYSTEM, progress=True)) > 0
    assert capsys.readouterr().err == ""  # too short to speak of
    with pytest.raises(TypeError, match="progress must be a callable or a bool, got 5"):
        ml.simulate(flux, SYSTEM, progress=5)  # type: ignore[arg-type]
    now = [0.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: now[0])
    bar = bars.Bar("simulating")
    for second in range(1, 101):
        now[0] = float(second)
        bar(second, 100)
    output = capsys.readouterr().err.splitlines()
    assert output[0] == "mars-lidar: simulating: 5 % after 5 s, about 95 s left"  # before a long run
    assert [int(re.search(r"(\d+) %", line)[1]) for line in output] == [5, 36, 67, 98]
    brief = bars.Bar("simulating")
    for second in range(101, 106):
        now[0] = float(second)
        brief(second - 100, 6)
    assert capsys.readouterr().err == ""


def test_several_returns_go_into_a_flux():
    signal, delay = np.full((2, 3, 4), 0.25), np.stack([np.full((3, 4), 10.0), np.full((3, 4), 60.0)])
    flux = ml.Flux(signal, 0.1, delay)
    same = ml.Flux.multi(ml.Flux(signal[0], 0.1, delay[0]), ml.Flux(signal[1], 0.0, delay[1]))
    assert np.array_equal(ml.simulate(flux, SYSTEM), ml.simulate(same, SYSTEM))
    assert flux.returns_signal.shape == (2, 3, 4)
    assert ml.Flux(
        np.full((16, 1, 1), 0.1), 0.0, np.linspace(0, 90, 16).reshape(16, 1, 1)
    ).signal.item() == pytest.approx(1.6)
    refused("1 to 16 returns", ml.Flux, np.ones((17, 1, 1)), 0.0, np.ones((17, 1, 1)))
    refused(r"delay_ns must be \(R, H, W\)", ml.Flux, np.ones((2, 3, 4)), 0.0, 5.0)


def test_depth_is_judged_in_the_table_as_in_the_picture(tmp_path):
    """Pixels without a detection have a depth that is a guess: the table counted it, the picture did not."""
    from mars_lidar.plot.views import depth_error_m
    from mars_lidar.reconstruction.map_errors import errors_against

    flux = ml.Scene.example("room", size=12).flux(SYSTEM, signal=0.02, sbr=0.5)
    io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM)
    with io.load(tmp_path / "a.zarr") as cube:
        estimate = ml.reconstruct(cube)
        assert 0.0 < estimate.detected.mean() < 1.0
        drawn = depth_error_m(cube, np.where(estimate.detected[0], estimate.depth_m[0], np.nan))
        text = errors_against(cube, estimate)["depth"]
    assert text.rmse == pytest.approx(float(np.sqrt(np.nanmean(drawn**2))))
    assert text.missing == pytest.approx(1.0 - float(estimate.detected.mean()))


def test_what_an_earlier_run_did_is_no_part_of_the_speed(monkeypatch, capsys):
    """`generate --resume`: 90 of 100 parts were there, 5 more took 40 s, so that 5 take another 40 s."""
    now = [0.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: now[0])
    bar = bars.Bar("generating")
    bar(90, 100)
    now[0] = 40.0
    bar(95, 100)
    assert "95 % after 40 s, about 40 s left" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ml.Detector(dead_time=50), r"Detector has no argument 'dead_time' \(did you mean 'dead_time_ns'\?\)"),
        (lambda: ml.Detector(50), r"by name: Detector\(dead_time_ns=\.\.\.\)"),
        (lambda: ml.GaussianPulse(0.3), r"by name: GaussianPulse\(sigma_ns=\.\.\.\)"),
        (lambda: ml.GaussianPulse.from_fwhm(0.3), r"by name: GaussianPulse\.from_fwhm\(fwhm_ns=\.\.\.\)"),
        (lambda: ml.System(period=100), "did you mean 'period_ns'"),
        (lambda: ml.Flux(signals=1.0), "did you mean 'signal'"),
        (lambda: ml.Scene(depth=np.ones((2, 2))), "did you mean 'depth_m'"),
        (
            lambda: ml.Detector(),
            r"missing a required (keyword-only )?argument: 'dead_time_ns'",
        ),  # the second by Python 3.12
        (
            lambda: ml.count_law(ml.Flux(1.0, 0.1, 5.0), SYSTEM, metod="mars"),
            r"count_law has no argument 'metod' .*'method'",
        ),
        (lambda: ml.reconstruct([1], SYSTEM, return_=2), r"reconstruct has no argument 'return_' .*'returns'"),
        (
            lambda: ml.simulate(ml.Flux(0.0, 1.0), SYSTEM, "exact"),
            "simulate takes flux, system by position and all other",
        ),
        (lambda: ml.count_law(ml.Flux(0.0, 1.0)), "count_law: missing a required argument: 'system'"),
    ],
)
def test_a_wrong_keyword_names_the_argument_that_was_meant(call, message):
    refused(message, call, error=TypeError)


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "mars_lidar", "--version"], capture_output=True, text=True)
    assert done.stdout.strip() == f"mars-lidar {ml.__version__}"


LONG = SYSTEM.replace(cycles=10_000_000)


@pytest.fixture
def own_time(monkeypatch):
    """The time of a processor, which other work on the machine does not change."""
    monkeypatch.setattr("mars_lidar.io.simulated_file.time.perf_counter", time.process_time)


@pytest.mark.usefixtures("own_time")
def test_a_long_run_is_told_before_with_what_is_faster():
    flux = ml.Scene.example("room", size=32).flux(LONG, signal=1.0, sbr=1.0)
    text = advice(flux, LONG)
    assert 10.0 < text.seconds < 10_000.0
    assert text.auto_s < text.seconds / 3
    assert re.fullmatch(r"about .* on this machine; --engine auto: about .*, same law", str(text))
    assert str(advice(flux, SYSTEM)) == ""
    gated = LONG.replace(detector=ml.Detector(dead_time_ns=50.0, max_events_per_period=1))
    assert "auto" not in str(advice(flux, gated))  # which cannot do it


@pytest.mark.usefixtures("own_time")
def test_the_time_told_is_about_the_time_taken():
    system = SYSTEM.replace(cycles=40_000)
    flux = ml.Scene.example("room", size=48).flux(system, signal=1.0, sbr=1.0)
    began = time.process_time()
    ml.simulate(flux, system, realizations=4, threads=1)
    spent = time.process_time() - began
    assert spent / 2 < advice(flux, system, realizations=4, threads=1).seconds < 2 * spent


def test_commands_say_how_long_they_take(tmp_path, monkeypatch):
    monkeypatch.setitem(vars(TOL), "long_s", 1e-9)
    monkeypatch.setattr("mars_lidar.io.simulated_file._PROBE", _Probe(event_s=1.0))
    small = ["--size", "8", "--cycles", "50", "--bins", "64"]
    words = "on this machine"
    assert words in ok("simulate", "--scene", "room", *small, "--no-picture", "-o", tmp_path / "a.zarr").stderr
    assert words in ok("timestamps", tmp_path / "a.zarr", "-o", tmp_path / "a.npz").stderr
    assert words in ok("generate", "room", *small, "-o", tmp_path / "set.zarr").stderr


@pytest.mark.usefixtures("own_time")
def test_mars_takes_a_table_over_the_range_of_an_image(tmp_path, monkeypatch):
    monkeypatch.setenv("MARS_LIDAR_CACHE", str(tmp_path / "cache"))
    given = ["simulate", "--scene", "room", "--size", "24", "--cycles", "50", "--bins", "64", "--no-picture"]
    done = ok(*given, "--engine", "mars", "-o", tmp_path / "a.zarr")
    assert "mars: a table" in done.stderr
    assert len(list((tmp_path / "cache").iterdir())) == 1
    with io.load(tmp_path / "a.zarr") as cube:
        assert io.verify(cube)  # with the table of the cache
        law = [ml.count_law(cube.flux[9, 9], cube.system)]
        assert abs(cube.histogram[0, 9, 9].sum() - law[0].mean) < 6 * law[0].variance ** 0.5
    done = run(*given, "--engine", "mars", "--table", "none", "-o", tmp_path / "b.zarr")
    assert (done.exit_code, done.stderr) == (0, "")
    result = compare(cube.flux, cube.system, ["mars"], realizations=50, repeats=1)
    assert "by a table" in result.table
    (next((tmp_path / "cache").iterdir())).unlink()
    with io.load(tmp_path / "a.zarr") as cube, pytest.raises(ValueError, match="table must be the one"):
        io.verify(cube)


def gated(**times: float) -> ml.Detector:
    """A gate of 5 ns."""
    return ml.Detector(dead_time_ns=75.0, mode="gated", **{"gate_start_ns": 10.0, "gate_width_ns": 5.0, **times})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pulse": ml.GaussianPulse(sigma_ns=100.0)}, r"sigma_ns=100 .* in picoseconds, give 0\.1, in ns"),
        ({"pulse": ml.GaussianPulse.from_fwhm(fwhm_ns=100.0)}, r"sigma_ns=42.* in picoseconds"),
        ({"detector": ml.Detector(dead_time_ns=75_000.0)}, r"dead_time_ns=75000 .* in picoseconds, give 75, in ns"),
        ({"detector": ml.Detector(dead_time_ns=75e-9)}, r"dead_time_ns=7\.5e-08 .* in seconds, give 75, in ns"),
        (
            {"detector": ml.Detector(dead_time_ns=75.0, electronics_dead_time_ns=80_000.0)},
            r"electronics_dead_time_ns=80000 .* give 80",
        ),
        ({"detector": gated(gate_start_ns=20_000.0)}, r"gate_start_ns=20000 .* in picoseconds, give 20, in ns"),
        ({"detector": gated(gate_step_ns=18e-12)}, r"gate_step_ns=1\.8e-11 .* in seconds, give 0\.018, in ns"),
        (
            {"period_ns": 133e-9, "pulse": ml.GaussianPulse(sigma_ns=5e-10), "detector": ml.Detector(dead_time_ns=0.0)},
            r"133 ns, if it was given in seconds",
        ),
    ],
)
def test_a_time_in_another_unit_is_told(change, message):
    with pytest.warns(ml.UnitWarning, match=message):
        SYSTEM.replace(**{"period_ns": 133.0, **change})


def test_delays_in_another_unit_are_told():
    with pytest.warns(ml.UnitWarning, match=r"delay_ns has a median of 20000, 200 laser periods.*divide it by 1000"):
        ml.simulate(ml.Flux(0.5, 0.1, 20_000.0), SYSTEM)
    ml.simulate(ml.Flux(0.5, 0.1, 1_900.0), SYSTEM)


def test_a_period_in_seconds_is_blamed_and_not_the_pulse():
    refused(r"^period_ns=1\.33e-07 .* 133 ns, if it was given in seconds; sigma_ns", SYSTEM.replace, period_ns=133e-9)


def test_every_published_detector_and_extreme_system_of_use_is_quiet(recwarn):
    from mars_lidar.instrument.presets import PRESETS

    for name in PRESETS:
        ml.System(period_ns=50.0, cycles=50, bins=64, pulse=SYSTEM.pulse, detector=ml.Detector.preset(name))
    for dead_ns in (0.0, 0.02, 1e4, 19_999.0, 1e6, 1e8):
        SYSTEM.replace(detector=ml.Detector(dead_time_ns=dead_ns))
    SYSTEM.replace(pulse=ml.GaussianPulse(sigma_ns=30.0))
    assert not recwarn.list


def test_the_command_line_says_a_warning_once(tmp_path):
    small = ["--size", "8", "--cycles", "50", "--bins", "64", "--no-picture"]
    done = ok("simulate", "--scene", "room", *small, "--dead-time-ns", "75000", "-o", tmp_path / "a.zarr")
    assert done.stderr.count("in picoseconds, give 75, in ns") == 1
