"""A transient larger than memory: its waveforms stay on disk from the file to the cube, and its bits are the same."""

import subprocess
import sys

import h5py
import numpy as np
import pytest
from harness import make_system, refused
from scipy.io import savemat

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.light.flux import StoredFlux
from mars_lidar.light.tolerances import TOL
from tests.harness.command import fails, ok

SYSTEM = make_system(30.0, 200, 200, sigma_ns=0.8)


@pytest.fixture
def transient(tmp_path) -> io.Transient:
    values = np.random.default_rng(0).exponential(1.0, (5, 3, 200)).astype(np.float32)
    values[1, 2] = 0.0
    np.save(tmp_path / "t.npy", values)
    return io.read_transient(tmp_path / "t.npy", bin_ns=0.5)


@pytest.fixture
def small_bands(monkeypatch):
    """What is larger than two rows counts as large."""
    monkeypatch.setitem(vars(TOL), "band_bytes", 2 * 8 * 3 * 200)


def test_parts_are_those_of_the_flux_in_memory(transient):
    stored = transient.stored_flux(SYSTEM, signal=1.0, sbr=2.0)
    whole = transient.flux(SYSTEM, signal=1.0, sbr=2.0)
    assert stored.shape == whole.shape
    assert stored.waveform.shape == whole.waveform.shape
    assert stored.signal == pytest.approx(whole.signal, rel=1e-12)
    assert np.array_equal(stored.background, whole.background)
    for key in (slice(1, 3), (slice(None), 1), (-1, 2), slice(None, None, 2), slice(None, None, -1), 3):
        assert np.array_equal(stored[key].waveform, whole[key].waveform)
    for key in ((2, 1), slice(1, 4), (slice(None, None, 2), 0), -1):
        assert np.array_equal(stored.waveform[key], whole.waveform[key])
    assert np.array_equal(np.asarray(stored.waveform), whole.waveform)
    assert np.array_equal(ml.simulate(stored, SYSTEM, seed=3), ml.simulate(whole, SYSTEM, seed=3))
    for key in (7, slice(5, 5), "a", (0, 0, 0)):
        with pytest.raises(IndexError):
            stored[key]


@pytest.mark.usefixtures("small_bands")
def test_effects_of_a_detector(transient, tmp_path):
    """Efficiency and dark counts of a flux on disk are those of the same in memory, and files hold what is recorded."""
    detector = ml.Detector(
        dead_time_ns=30.0,
        detection_efficiency=0.4,
        dark_count_hz=1e6,
        jitter=ml.Jitter(sigma_ns=0.5),
        max_events_per_period=1,
    )
    system = SYSTEM.replace(detector=detector)
    stored, whole = transient.stored_flux(system, signal=1.0, sbr=2.0), transient.flux(system, signal=1.0, sbr=2.0)
    rate = np.linspace(0.0, 1e6, 15).reshape(5, 3)
    for item, other in (
        (stored.detected(system), whole.detected(system)),
        (stored.with_dark_counts(rate, system), whole.with_dark_counts(rate, system)),
    ):
        assert isinstance(item, StoredFlux)
        assert np.array_equal(item.background, other.background)
        assert np.array_equal(np.asarray(item.waveform), other.waveform)
        assert np.array_equal(item[1:4:2].background, other[1:4:2].background)
    io.simulate_to(tmp_path / "cube.h5", stored, system, seed=3)
    with io.load(tmp_path / "cube.h5") as cube:
        assert np.array_equal(np.asarray(cube.histogram), ml.simulate(whole, system, seed=3))


@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
@pytest.mark.usefixtures("small_bands")
def test_cubes_are_those_of_the_flux_in_memory(transient, tmp_path, suffix):
    stored = transient.stored_flux(SYSTEM, photons_per_unit=0.01, dark_count_hz=1e5)
    whole = transient.flux(SYSTEM, photons_per_unit=0.01, dark_count_hz=1e5)
    out = tmp_path / f"cube{suffix}"
    io.simulate_to(out, stored, SYSTEM, realizations=2, seed=4)
    with io.load(out) as cube:
        assert isinstance(cube.flux, StoredFlux) == (suffix != ".npz")
        assert np.array_equal(np.asarray(cube.histogram), ml.simulate(whole, SYSTEM, realizations=2, seed=4))
        assert np.array_equal(np.asarray(cube.flux.waveform), whole.waveform)
        assert np.array_equal(cube.flux[1:3, 2].waveform, whole[1:3, 2].waveform)
        assert io.verify(cube)


@pytest.mark.full
def test_the_command_goes_from_a_file_to_a_cube_and_a_picture(transient, tmp_path):
    out = tmp_path / "cube.zarr"
    common = ["simulate", "--transient", tmp_path / "t.npy", "--period-ns", 100, "--cycles", 50, "-o", out]

    ok(*common, "--transient-bin-ns", 0.5, "--bins", 200, "--signal", 0.5, "--sbr", 4, "--no-transient-pulse")
    assert (tmp_path / "cube.png").read_bytes().startswith(b"\x89PNG")
    with io.load(out) as cube:
        flux = transient.flux(cube.system, signal=0.5, sbr=4.0, pulse=False)
        assert np.array_equal(np.asarray(cube.histogram), ml.simulate(flux, cube.system))
    message = ok("info", out).output
    for word in ("waveform of 200 parts", "t.npy", "pulse_convolved False"):
        assert word in message
    twice = "light must give one of signal and photons_per_unit, got both"
    for more, error in (
        ([], "give bin_ns"),
        (["--scene", "room"], "got --scene and --transient"),
        (["--transient-bin-ns", 1, "--attenuation", "inverse_square"], "attenuation is for surfaces"),
        (["--transient-bin-ns", 1, "--signal", 1, "--photons-per-unit", 1], twice),
        (["--transient-bin-ns", 1, "--size", 9], "--size belongs to --scene"),
    ):
        fails(error, *common, "--overwrite", *more)


def test_matlab_files(transient, tmp_path):
    values = transient.values[:]
    savemat(tmp_path / "old.mat", {"transient": values, "bin_ns": 0.5, "start_ns": 3.0})
    with h5py.File(tmp_path / "new.mat", "w") as file:  # version 7.3 turns the axes round
        file["transient"] = values.transpose(2, 1, 0)
        file["bin_ns"], file["start_ns"] = [[0.5]], [[3.0]]
    for name in ("old.mat", "new.mat"):
        result = io.read_transient(tmp_path / name)
        assert (result.shape, result.bin_ns, result.start_ns) == ((5, 3), 0.5, 3.0)
        assert np.array_equal(np.asarray(result.values[1:3]), values[1:3])
        refused(rf"{name}: .*no array 'light'.*transient", io.read_transient, tmp_path / name, name="light")


_CHILD = """
import resource, sys
import mars_lidar as ml
from mars_lidar import io
from mars_lidar.light.tolerances import TOL
from mars_lidar.io import recipe
vars(TOL)["band_bytes"] = recipe.BLOCK_BYTES = 8 * 2**20
transient = io.read_transient(sys.argv[1])
system = ml.System(period_ns=100.0, cycles=5, bins=64, pulse=ml.GaussianPulse(sigma_ns=1.0),
                   detector=ml.Detector(dead_time_ns=30.0))
io.simulate_to(sys.argv[2], transient.stored_flux(system, signal=0.1, parts=1024), system, threads=1)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux only")
def test_memory_does_not_grow_with_the_transient(tmp_path):
    """In bands of 8 MiB, images with 16 and 96 MiB of waveforms."""
    peaks = []
    for height in (16, 96):
        path = tmp_path / f"{height}.h5"
        with h5py.File(path, "w") as file:
            data = file.create_dataset("transient", (height, 128, 32), "f4", chunks=(16, 128, 32), fillvalue=1.0)
            data.attrs["bin_ns"] = 3.0
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, str(path), str(tmp_path / f"{height}.zarr")],
            capture_output=True,
            text=True,
            check=True,
        )
        peaks.append(float(done.stdout))
    assert peaks[1] < peaks[0] + 24, f"peaks of {peaks[0]:.0f} and {peaks[1]:.0f} MiB"
