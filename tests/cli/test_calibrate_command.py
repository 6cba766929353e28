"""`mars-lidar calibrate`: what is refused, and what it prints, writes and returns for streams and cubes."""

from pathlib import Path

import numpy as np
import pytest
from harness import make_system
from harness.command import command_line, ok

import mars_lidar as ml
from mars_lidar import io

SYSTEM = make_system(50.0, 10_000, 200, sigma_ns=0.5)


@pytest.fixture(scope="module")
def at(tmp_path_factory) -> Path:
    """A stream of some 5,000 photons, a cube of 16 pixels with the same detector, and their system."""
    folder = tmp_path_factory.mktemp("calibrate")
    ml.simulate_timestamps(ml.Flux(0.4, 0.3, 30.0), SYSTEM, seed=2).save(folder / "lab.npz")
    flux = ml.Flux(np.full((4, 4), 0.4), 0.3, 30.0)
    io.simulate_to(folder / "cube.zarr", flux, SYSTEM.replace(cycles=2000), seed=3)
    SYSTEM.save(folder / "spad.yaml")
    np.save(folder / "face.npy", np.ones((2, 2, 200), np.uint16))
    return folder


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("lab.npz --given dead_time=50", "--given must be NAME=VALUE with a NAME of"),
        ("lab.npz --given dead_time_ns=long", "--given dead_time_ns must be a number, got 'long'"),
        ("lab.npz --given dead_time_ns=50 --system spad.yaml", "give the detector once: --system or --given"),
        ("lab.npz --free --pulse-sigma-ns 0.5", "give the shape of the light once"),
        ("lab.npz -o lab.txt", "--out must end in one of .yaml, .yml, .json"),
        ("lab.npz --look -o lab.yaml", "--out needs a fitted pulse"),
        ("lab.npz --cycles 0", "--cycles must be"),
        ("lab.npz --pixel 3,3", "--pixel must lie in y 0 to 0, x 0 to 0, got (3, 3)"),
        ("cube.zarr --look", "a cube takes --system, --free, --out and --picture"),
        ("face.npy", "needs --system"),
        ("face.npy --system spad.yaml", "1000 registrations"),
    ],
)
def test_what_cannot_be_is_refused(at: Path, monkeypatch: pytest.MonkeyPatch, words: str, message: str):
    monkeypatch.chdir(at)
    done = command_line(["calibrate", *words.split()])
    assert done.exit_code in (1, 2)
    assert message in " ".join(done.output.split())


def test_a_look_describes_the_file(at: Path):
    done = ok("calibrate", at / "lab.npz", "--look")
    assert "5,100 photons of 1 × 1 pixels" in done.stdout
    assert "intervals" in done.stdout


@pytest.mark.full
def test_a_stream_becomes_a_system_and_a_picture(at: Path, tmp_path: Path):
    out, picture = tmp_path / "lab.yaml", tmp_path / "lab.png"
    words = [at / "lab.npz", "--given", "jitter_ns=0", "--cycles", 100, "-o", out, "--picture", picture]
    done = ok("calibrate", *words)
    for word in ("signal", "dead_time_ns", "verdict", "counts", "not in result"):
        assert word in done.stdout
    assert ml.System.load(out).detector.dead_time_ns == pytest.approx(50.0, abs=0.5)
    assert picture.stat().st_size > 10_000


@pytest.mark.full
def test_a_model_that_does_not_fit_ends_with_3(at: Path):
    done = command_line(["calibrate", str(at / "lab.npz"), "--given", "dead_time_ns=40", "--given", "jitter_ns=0"])
    assert done.exit_code == 3, done.output
    assert "given dead_time_ns = 40" in done.stdout


@pytest.mark.full
def test_a_cube_tells_what_its_pixels_share(at: Path, tmp_path: Path):
    out, picture = tmp_path / "cube.yaml", tmp_path / "cube.png"
    done = ok("calibrate", at / "cube.zarr", "-o", out, "--picture", picture)
    assert ml.System.load(out).detector.dead_time_ns == pytest.approx(50.0, abs=4.5 * 0.6)
    assert "16 histograms of 200 bins" in done.stdout
    assert picture.stat().st_size > 10_000
