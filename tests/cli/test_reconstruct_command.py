"""`mars-lidar reconstruct`, its files, its errors against the truth, and the study."""

import itertools
import re
import sys

import numpy as np
import pytest
import xarray
from harness import make_system
from PIL import Image

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io import recipe as recipes
from mars_lidar.io.maps import load_maps
from mars_lidar.reconstruction import METHODS
from mars_lidar.reconstruction import stored as stored_module
from mars_lidar.reconstruction.map_errors import errors_against, map_error
from mars_lidar.reconstruction.stored import reconstruct_stored
from tests.harness.command import fails, ok, run
from tests.harness.study import quick_study

SMALL = ("--size", 12, "--cycles", 300, "--bins", 256, "--signal", 2)


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    path = tmp_path_factory.mktemp("cube") / "room.zarr"
    ok("simulate", "--scene", "room", *SMALL, "--realizations", 2, "--no-picture", "-o", path)
    return path


def test_reflectivity_is_right_behind_a_detection_efficiency(tmp_path):
    """The truth's light falls on the pixel, the estimate's is detected: a level between them takes off the factor."""
    out, share = tmp_path / "a.zarr", 0.25
    words = (*SMALL[:-1], 8, "--detection-efficiency", share, "--cycles", 3000, "--no-picture", "-o", out)
    ok("simulate", "--scene", "room", *words)
    with io.load(out) as stored:
        outcome = reconstruct_stored(stored, ["maximum_likelihood"])["maximum_likelihood"].result
        ratio = outcome.reflectivity[0] / stored.reflectivity
        np.testing.assert_allclose(outcome.signal[0] / stored.flux.signal, share, rtol=0.15)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)


def test_signal_is_judged_behind_a_detection_efficiency(tmp_path):
    """The true signal falls on the pixel, the estimate is detectable: with an efficiency of 1/4 the error was 3/4 S."""
    signal = np.linspace(0.5, 2.0, 16).reshape(4, 4)
    detector = ml.Detector(dead_time_ns=50.0, detection_efficiency=0.25)
    system = make_system(50.0, 20_000, 128).replace(detector=detector)
    io.simulate_to(tmp_path / "a.zarr", ml.Flux(signal, 0.2, 40.0), system)
    with io.load(tmp_path / "a.zarr") as stored:
        maps = reconstruct_stored(stored)["maximum_likelihood"].result
        error = errors_against(stored, maps)["signal"].rmse
    assert error == pytest.approx(float(np.sqrt(np.mean((maps.signal - 0.25 * signal) ** 2))))
    assert error < 0.02


@pytest.mark.filterwarnings("ignore:the bins of")
@pytest.mark.parametrize("method", ["peak", "maximum_likelihood", "image"])
def test_impossible_counts_are_flagged_as_by_reconstruct(tmp_path, method):
    """More counts than the dead time allows: flagged in an array, they were not flagged in a file."""
    system = make_system(75.0, 100, 128)
    io.simulate_to(tmp_path / "a.zarr", ml.Flux(np.full((4, 4), 2.0), 3.0, 40.0), system, engine="poisson")
    with io.load(tmp_path / "a.zarr") as stored:
        whole = ml.reconstruct(np.asarray(stored.histogram[:]), system, method)
        parts = reconstruct_stored(stored, [method])[method].result
    assert (whole.flags & ml.reconstruction.Flags.SATURATED).all()
    np.testing.assert_array_equal(parts.flags, whole.flags)


LIGHT = ml.Flux(0.3, 0.3, 40.0)
RECORDED = make_system(50.0, 20_000, 1000, pulse=ml.GaussianPulse.from_fwhm(fwhm_ns=0.3))
OPTIONS = {"--bin-ps": 100, "--cycles": 20_000, "--dead-time-ns": 50, "--pulse-fwhm-ns": 0.3}


def test_a_single_pixel_is_told_in_numbers_and_drawn_as_a_histogram(tmp_path):
    np.save(tmp_path / "hist.npy", ml.simulate(LIGHT, RECORDED, seed=1)[0, 0, 0])
    words = itertools.chain(*OPTIONS.items())
    done = ok("reconstruct", tmp_path / "hist.npy", *words, "-o", tmp_path / "maps.npz")
    rows = [line for line in done.stdout.splitlines() if "±" in line]
    assert len(rows) == 1
    numbers = [float(number) for number in re.findall(r"[\d.]+", rows[0])]
    _, depth, depth_error, signal, signal_error, background, background_error, p_value = numbers
    for value, error, truth in (
        (depth, depth_error, RECORDED.depth_m(40.0)),
        (signal, signal_error, 0.3),
        (background, background_error, 0.3),
    ):
        assert abs(value - truth) < 4.0 * error  # a false alarm in 6e-5 of the seeds
        assert error < 0.03 * truth
    assert p_value > 1e-3
    assert "warning" not in done.stderr
    maps, _ = load_maps(tmp_path / "maps.npz")
    assert depth == pytest.approx(maps["depth"].item(), abs=depth_error / 10)
    with Image.open(tmp_path / "maps.png") as picture:
        assert picture.width > 2 * picture.height  # a period and its return, side by side; maps would be squares


@pytest.mark.parametrize("wrong", [("--dead-time-ns", 5), ("--pulse-fwhm-ns", 0.03)])
def test_a_single_pixel_of_a_wrong_system_is_warned_of(tmp_path, wrong):
    np.save(tmp_path / "hist.npy", ml.simulate(LIGHT, RECORDED, seed=1)[0, 0, 0])
    words = itertools.chain(*(OPTIONS | dict([wrong])).items())
    done = ok("reconstruct", tmp_path / "hist.npy", *words, "--no-picture", "-o", tmp_path / "maps.npz")
    assert "warning: maximum_likelihood: the histogram does not fit the estimate" in done.stderr


@pytest.mark.full
@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
def test_maps_read_back(cube, tmp_path, suffix):
    out = tmp_path / f"maps{suffix}"
    picture = suffix == ".h5"
    words = () if picture else ("--no-picture",)
    ok("reconstruct", cube, "--method", "maximum_likelihood,peak", *words, "-o", out)
    assert (tmp_path / "maps.png").exists() == picture
    assert not picture or (tmp_path / "maps.png").stat().st_size > 10_000
    assert not list(tmp_path.glob("*.incomplete"))
    result, attrs = load_maps(out)
    assert list(result["method"]) == ["maximum_likelihood", "peak"]
    with io.load(cube) as stored:
        direct = ml.reconstruct(np.asarray(stored.histogram), stored.system)
        assert np.array_equal(result["depth"][0], direct.depth_m, equal_nan=True)
        assert np.array_equal(result["signal_error"][0], direct.signal_error, equal_nan=True)
        assert ml.System.from_json(attrs["system"]) == stored.system
    assert np.isnan(result["signal_error"][1]).all()  # peak gives none
    if suffix == ".zarr":
        opened = xarray.open_zarr(out)
        assert opened.depth.dims == ("method", "realization", "y", "x")
        assert opened.depth.attrs["units"] == "m"


@pytest.mark.full
@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
def test_several_returns_read_back(tmp_path, suffix):
    """A pane before a wall: table, maps with an axis of returns, and every return a point of the cloud."""
    system = make_system(30.0, 2000, 256, sigma_ns=0.4, period_ns=50.0)
    pane = np.zeros((6, 8))
    pane[:, 4:] = 0.3
    io.simulate_to(
        tmp_path / "g.zarr", ml.Flux.multi(ml.Flux(0.5 + 0 * pane, 0.2, 30.0), ml.Flux(pane, 0.0, 12.0)), system
    )
    out, cloud = tmp_path / f"maps{suffix}", tmp_path / "g.ply"
    words = ("--returns", 3, "--method", "maximum_likelihood", "--cloud", cloud, "--focal-px", 9)
    done = ok("reconstruct", tmp_path / "g.zarr", *words, "-o", out)
    assert (tmp_path / "maps.png").stat().st_size > 10_000
    head, line = done.stdout.splitlines()[1:3]
    assert "2 returns %" in head
    result, _ = load_maps(out)
    count = result["returns"][0, 0]
    assert result["return_depth"].shape == (1, 1, 6, 8, 3)
    assert (count[:, 4:] >= 2).all()
    assert (count[:, :4] >= 1).all()
    assert f"{100.0 * (count == 2).mean():.4g}" in line
    assert np.array_equal(np.isfinite(result["return_depth"]).sum(-1)[0, 0], count)
    near = result["return_depth"][0, 0, :, 4:, 0]
    assert near == pytest.approx(np.full((6, 4), system.depth_m(12.0)), abs=0.05)
    points = int(next(row for row in cloud.read_bytes().split(b"\n") if row.startswith(b"element vertex")).split()[2])
    assert points == count.sum()
    if suffix == ".zarr":
        opened = xarray.open_zarr(out)
        assert opened.return_depth.dims == ("method", "realization", "y", "x", "return")
    refused = run("reconstruct", tmp_path / "g.zarr", "--returns", 2, "--method", "peak", "-o", tmp_path / "x.npz")
    assert refused.exit_code == 2
    assert "returns=2 needs method 'maximum_likelihood' or 'image' or 'image_untrained', got 'peak'" in refused.stderr


@pytest.mark.full
def test_an_image_of_a_dim_cube(tmp_path, monkeypatch):
    """Rows are read in parts, the image is reconstructed whole; its maps are those of the array."""
    dim = ("--size", 24, "--cycles", 300, "--bins", 256, "--signal", 0.005, "--realizations", 2, "--no-picture")
    ok("simulate", "--scene", "room", *dim, "-o", tmp_path / "dim.zarr")
    monkeypatch.setattr(recipes, "BLOCK_BYTES", 3 * 24 * 256 * 2)  # three rows at a time
    monkeypatch.setattr(stored_module, "_CHUNK_BYTES", 3 * 24 * 256 * 2)
    ok("reconstruct", tmp_path / "dim.zarr", "--method", "image,peak", "-o", tmp_path / "m.zarr")
    result, _ = load_maps(tmp_path / "m.zarr")
    with io.load(tmp_path / "dim.zarr") as stored:
        direct = ml.reconstruct(stored, method="image")
    for name in ("depth", "depth_error", "depth_half_width", "outlier", "flags"):
        values = getattr(direct, {"flags": "flags", "outlier": "outlier"}.get(name, f"{name}_m"))
        assert np.array_equal(result[name][0], values, equal_nan=True), name
    assert np.isnan(result["outlier"][1]).all()


def test_all_methods_and_errors_in_the_table(cube, tmp_path):
    done = ok("reconstruct", cube, "--method", "all", "--no-picture", "-o", tmp_path / "m.npz")
    lines = {line.split()[0]: line.split() for line in done.stdout.splitlines()}
    free = [name for name, method in METHODS.items() if "nonparalyzable" in method.modes]
    assert set(free) <= set(lines)
    assert float(lines["maximum_likelihood"][5]) < 0.5 * float(lines["matched_filter"][5])  # depth RMSE, mm
    assert not (tmp_path / "m.png").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--method", "coates", "-o", "m.npz"), "'coates' is not for detectors of mode 'nonparalyzable'"),
        (("--method", "magic", "-o", "m.npz"), "--method must be one of"),
        (("-o", "m.txt"), "out must end in one of"),
        (("-o", "nowhere/m.npz"), "existing folder"),
        (("--attenuation", "cubic", "-o", "m.npz"), "--attenuation must be one of"),
        (("--level", "-1", "-o", "m.npz"), "level must be"),
    ],
)
def test_bad_input(cube, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    fails(message, "reconstruct", cube, *words)
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_unasked(cube, tmp_path):
    out = tmp_path / "m.h5"
    out.write_text("mine")
    assert run("reconstruct", cube, "-o", out).exit_code == 2
    assert out.read_text() == "mine"
    ok("reconstruct", cube, "--no-picture", "--overwrite", "-o", out)
    assert load_maps(out)[0]["depth"].shape == (1, 2, 12, 12)


def test_without_scikit_image_only_ssim_is_missing(cube, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage", None)
    monkeypatch.setitem(sys.modules, "skimage.metrics", None)  # where another test has imported it
    done = ok("reconstruct", cube, "--no-picture", "-o", tmp_path / "m.npz")
    assert "mars-lidar[estimate]" in done.stderr
    assert "RMSE mm" in done.stdout
    assert "PSNR dB" in done.stdout
    assert "SSIM" not in done.stdout
    assert (tmp_path / "m.npz").exists()


def test_parts_make_the_whole(cube, monkeypatch):
    with io.load(cube) as stored:
        whole = reconstruct_stored(stored, ["generalised_coates"])["generalised_coates"].result
        for module, name in ((recipes, "BLOCK_BYTES"), (stored_module, "_CHUNK_BYTES")):
            monkeypatch.setattr(module, name, 3 * 12 * 256 * 2)  # three rows at a time
        recorded = []
        parts = reconstruct_stored(stored, ["generalised_coates"], progress=lambda *at: recorded.append(at))
    for name, values in whole.maps().items():
        assert np.array_equal(values, getattr(parts["generalised_coates"].result, name), equal_nan=True)
    assert len(recorded) == 8
    assert recorded[-1] == (288, 288)


def test_errors_of_a_map():
    truth = np.add.outer(np.arange(16.0), np.arange(16.0))
    same = map_error(truth, truth)
    assert (same.rmse, same.psnr, same.ssim, same.missing) == (0.0, np.inf, pytest.approx(1.0), 0.0)
    off = truth.copy()
    off[0, 0] = np.nan
    off[1:] += 3.0
    result = map_error(truth, off)
    assert result.missing == pytest.approx(1 / 256)
    assert result.rmse == pytest.approx(3.0 * np.sqrt(240 / 255))
    assert result.psnr == pytest.approx(20 * np.log10(30.0 / result.rmse))
    assert result.ssim < 0.99


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:the bins of:UserWarning")  # half a standard error, of bins that the study states
def test_study(tmp_path):
    rows = quick_study("reconstruction", tmp_path).rows
    assert {row["method"] for row in rows} == {name for name, method in METHODS.items() if not method.of_images}
    bright = {row["method"]: row for row in rows if float(row["signal"]) == 3.0 and row["detector"] != "synchronous"}
    likely = bright["maximum_likelihood"]
    assert float(likely["depth RMSE mm"]) < 1.3 * float(likely["depth bound mm"])
    assert float(bright["matched_filter"]["depth bias mm"]) < -10 * float(likely["depth bound mm"])


@pytest.mark.full
def test_study_of_returns(tmp_path):
    study = quick_study("returns", tmp_path)
    assert "Quick run" in study.text
    assert study.figures == ["returns.png"]
    assert len(study.rows) > 10
