"""Rendered transients: onto the laser period, through the pulse, to photons; and their files."""

import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
from harness import ledger, make_system, refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.light.transient import Transient

C = 0.299792458
SYSTEM = make_system(30.0, 200, 200, sigma_ns=0.8)


@pytest.fixture
def light() -> np.ndarray:
    values = np.random.default_rng(0).exponential(1.0, (5, 3, 200)).astype(np.float32)
    values[1, 2] = 0.0
    return values


def test_bins_that_fit_the_period_are_taken_over(light):
    flux = ml.Flux.from_transient(light, SYSTEM, bin_ns=0.5, photons_per_unit=0.01, pulse=False)
    # differences of a running sum: the error is that of the sum
    np.testing.assert_allclose(flux.waveform, 0.01 * light.astype(np.float64), rtol=0, atol=1e-15)
    assert (flux.background == 0.0).all()


def test_levels_are_means_over_the_pixels_with_light(light):
    flux = ml.Flux.from_transient(light, SYSTEM, bin_ns=0.5, signal=1.5, sbr=3.0, dark_count_hz=1e6)
    lit = np.ones((5, 3), bool)
    lit[1, 2] = False
    assert flux.signal[lit].mean() == pytest.approx(1.5, rel=1e-12)
    assert flux.signal[1, 2] == 0.0
    np.testing.assert_allclose(flux.background, 1.5 / 3.0 + 1e6 * 100e-9, rtol=1e-14)
    assert flux.info["mean_signal"] == pytest.approx(1.5)
    blind = SYSTEM.replace(detector=replace(SYSTEM.detector, detection_efficiency=0.25))
    flux = ml.Flux.from_transient(light, blind, bin_ns=0.5, signal=1.5, sbr=3.0, dark_count_hz=1e6)
    np.testing.assert_allclose(flux.detected(blind).background, 0.25 * 1.5 / 3.0 + 1e6 * 100e-9, rtol=1e-14)


@pytest.mark.parametrize("start", [0.0, 40.0, -10.0, 1234.5])
def test_light_is_folded_with_the_period(start):
    """An oracle by brute force: every source bin spread over 1000 points in time."""
    rng = np.random.default_rng(1)
    values = rng.exponential(1.0, (1, 1, 330))
    flux = ml.Flux.from_transient(
        values, SYSTEM, bin_ns=0.7, start_ns=start, photons_per_unit=1.0, pulse=False, parts=50
    )
    points = (np.arange(330_000) + 0.5) / 1000
    part = np.floor(((start + 0.7 * points) % 100.0) / 2.0).astype(int)
    expected = np.bincount(part, weights=np.repeat(values[0, 0], 1000) / 1000, minlength=50)
    np.testing.assert_allclose(flux.waveform[0, 0], expected, atol=2e-3 * values.max())
    assert flux.signal[0, 0] == pytest.approx(values.sum(), rel=1e-13)


def test_the_pulse_is_that_of_a_return():
    """A flash in one fine bin is a return with that delay."""
    values = np.zeros((1, 1, 10_000))
    values[0, 0, 3333] = 2.0
    flux = ml.Flux.from_transient(values, SYSTEM, bin_ns=0.01, signal=1.0)
    expected = SYSTEM.pulse.bin_energy(33.335, 100.0, 10_000)
    # light spread over 0.01 ns instead of a flash: second order, (0.01 / 0.8)^2 / 24 = 6.5e-6
    assert np.abs(flux.waveform[0, 0] - expected).max() < 1e-5 * expected.max()
    law = ml.count_law(ml.Flux(1.0, 0.5, 33.335), SYSTEM)
    counts = ml.simulate(ml.Flux(waveform=flux.waveform, background=0.5), SYSTEM, realizations=4000, seed=1).sum(
        (1, 2, 3)
    )
    z = (counts.mean() - law.mean) / np.sqrt(law.variance / counts.size)
    ledger.require({"mean count": math.erfc(abs(z) / math.sqrt(2))}, "transient of one flash")


def test_parts_of_the_image_are_those_of_the_whole(light, tmp_path):
    np.save(tmp_path / "t.npy", light)
    transient = io.read_transient(tmp_path / "t.npy", bin_ns=0.5)
    whole = transient.flux(SYSTEM, signal=1.0, sbr=2.0)
    cube = ml.simulate(whole, SYSTEM, seed=3)
    for rows in transient.bands(band_bytes=2 * 8 * 3 * 200):
        assert rows.stop - rows.start <= 2
        part = transient.flux(SYSTEM, signal=1.0, sbr=2.0, rows=rows)
        assert np.array_equal(part.waveform, whole.waveform[rows])
        assert np.array_equal(part.background, whole.background[rows])
        index = np.arange(light[..., 0].size).reshape(light.shape[:2])[rows]
        counts = ml.simulate(part, SYSTEM, seed=3, pixel_index=index)
        assert np.array_equal(counts, cube[:, rows])


def tal_capture(path, light, form=1, **more):
    with h5py.File(path, "w") as file:
        file["H"] = light.transpose(2, 1, 0)  # T, x, y
        names = {"UNKNOWN": 0, "T_Sx_Sy": 1, "T_Lx_Ly_Sx_Sy": 2, "T_Si": 3, "T_Li_Si": 4}
        file.create_dataset("H_format", (1,), dtype=h5py.enum_dtype(names, basetype="i"))[0] = form
        file["delta_t"] = 0.5 * C
        file["t_start"] = h5py.Empty(float)
        for name, value in more.items():
            del file[name]
            file[name] = value
    return path


def test_files(light, tmp_path):
    want = Transient(light, 0.5).flux(SYSTEM, signal=1.0)
    np.save(tmp_path / "t.npy", light)
    np.savez(tmp_path / "t.npz", transient=light, bin_ns=0.5)
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["transient"] = light
        file["transient"].attrs["bin_ns"] = 0.5
    np.save(tmp_path / "rgb.npy", np.stack([light, 2 * light, 3 * light], axis=-1))
    for name, options in (
        ("t.npy", {"bin_ns": 0.5}),
        ("t.npz", {}),
        ("t.h5", {}),
        ("t.h5", {"name": "transient"}),
        ("rgb.npy", {"bin_ns": 0.5, "channel": 0}),
    ):
        transient = io.read_transient(tmp_path / name, **options)
        assert (transient.shape, transient.bin_ns, transient.start_ns) == ((5, 3), 0.5, 0.0)
        assert np.array_equal(transient.flux(SYSTEM, signal=1.0).waveform, want.waveform)


def test_a_capture_of_tal(light, tmp_path):
    transient = io.read_transient(tal_capture(tmp_path / "a.hdf5", light))
    assert transient.bin_ns == pytest.approx(0.5, rel=1e-12)
    assert transient.start_ns == 0.0
    assert np.array_equal(transient.totals, Transient(light, 0.5).totals)
    assert np.array_equal(np.asarray(transient.values[2:4]), light[2:4])
    late = io.read_transient(tal_capture(tmp_path / "b.hdf5", light, t_start=3.0))
    assert late.start_ns == pytest.approx(3.0 / C)
    for form, name in ((2, "T_Lx_Ly_Sx_Sy"), (3, "T_Si"), (0, "UNKNOWN")):
        path = tal_capture(tmp_path / "c.hdf5", light, form=form)
        refused(rf"c\.hdf5: .*H must be one of T_Sx_Sy.*got {name} and shape", io.read_transient, path)


def test_bad_input(light, tmp_path):
    np.save(tmp_path / "t.npy", light)
    np.save(tmp_path / "rgb.npy", np.stack([light] * 3, axis=-1))
    for call, message in (
        (lambda: io.read_transient(tmp_path / "t.npy"), "does not state the width of a time bin"),
        (lambda: io.read_transient(tmp_path / "no.npy"), "no such file"),
        (lambda: io.read_transient(tmp_path / "t.npy", bin_ns=1.0, channel=0), "channel is for"),
        (lambda: io.read_transient(tmp_path / "rgb.npy", bin_ns=1.0), "has 3 channels: give channel"),
        (lambda: io.read_transient(tmp_path / "t.npy", bin_ns=1.0, name="a"), "has one array without a name"),
        (lambda: io.read_transient(tmp_path / "t.npy", bin_ns=-1.0), "bin_ns must be"),
        (lambda: Transient(light[0], 1.0), r"values must be \(H, W, T\)"),
        (lambda: Transient(-light, 1.0).flux(SYSTEM, signal=1.0), "values must be finite and >= 0"),
        (lambda: Transient(0 * light, 1.0).flux(SYSTEM, signal=1.0), "must have light"),
        (lambda: Transient(light, 1.0).flux(SYSTEM), "one of signal and photons_per_unit"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=0.0), "signal must be"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=1.0, sbr=0.0), "sbr must be"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=1.0, rows=slice(0, 4, 2)), "rows must select"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=1.0, parts=0), "parts must be"),
    ):
        refused(message, call)
