"""Cubes of other programs: every layout and format gives the counts back, and what does not fit is refused by name."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from harness import make_system, refused
from harness.files import write_h5
from PIL import Image
from scipy import sparse
from scipy.io import savemat

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.foreign import read_counts
from mars_lidar.plot.views import fitted

SYSTEM = make_system(30.0, 2000, 250, sigma_ns=0.4, period_ns=50.0)
DELAY = np.linspace(8.0, 40.0, 12).reshape(3, 4)
FLUX = ml.Flux(np.linspace(0.2, 2.0, 12).reshape(3, 4), 0.3, DELAY)


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    return ml.simulate(FLUX, SYSTEM, seed=3)[0]


def by_column(counts: np.ndarray) -> sparse.csc_matrix:
    """Pixels column by column, as MATLAB counts them."""
    return sparse.csc_matrix(counts.transpose(1, 0, 2).reshape(12, -1).astype(float))


def cells_of(counts: np.ndarray) -> np.ndarray:
    """Times of the photons of each pixel, in bins."""
    times = np.empty(counts.shape[:2], object)
    for place in np.ndindex(times.shape):
        times[place] = np.repeat(np.arange(SYSTEM.bins), counts[place]).astype(np.uint16)[:, None]
    return times


def sparse_73(path: Path, counts: np.ndarray) -> None:
    matrix = by_column(counts)
    write_h5(path, {"spad/data": matrix.data, "spad/ir": matrix.indices, "spad/jc": matrix.indptr})
    with h5py.File(path, "a") as file:
        file["spad"].attrs["MATLAB_sparse"] = np.uint64(12)


def stack(path: Path, counts: np.ndarray) -> None:
    first, *others = (Image.fromarray(page.astype(np.uint16)) for page in counts.transpose(2, 0, 1))
    first.save(path, save_all=True, append_images=others)


# how another program writes them, and the arguments that reading them takes
FORMATS: dict[str, tuple[Callable[[Path, np.ndarray], object], dict[str, Any]]] = {
    "yxt.npy": (np.save, {}),
    "tyx.npy": (lambda path, counts: np.save(path, counts.transpose(2, 0, 1)), {}),
    "named.npz": (lambda path, counts: np.savez(path, spad=counts, mask=np.ones((3, 4))), {}),
    "sparse.npz": (
        lambda path, counts: sparse.save_npz(path, sparse.csr_matrix(counts.reshape(12, -1))),
        {"image": (3, 4)},
    ),
    "dense.mat": (lambda path, counts: savemat(path, {"cube": counts.astype(float), "rate": 7.5}), {}),
    "sparse.mat": (lambda path, counts: savemat(path, {"spad": by_column(counts)}), {"image": (3, 4)}),
    "cells.mat": (lambda path, counts: savemat(path, {"times": cells_of(counts), "bin_ns": 0.2}), {"unit_ns": 0.2}),
    "dense73.mat": (lambda path, counts: write_h5(path, {"cube": counts.transpose(2, 1, 0)}), {}),  # axes turned round
    "sparse73.mat": (sparse_73, {"image": (3, 4)}),
    "deep.h5": (lambda path, counts: write_h5(path, {"run/1/histograms": counts, "run/1/gain": 2.0}), {}),
    "stack.tif": (stack, {}),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_every_count(tmp_path: Path, counts: np.ndarray, kind: str) -> None:
    path = tmp_path / kind
    write, arguments = FORMATS[kind]
    write(path, counts)
    cube = io.foreign_cube(path, SYSTEM, **arguments)
    assert cube.measured
    assert cube.engine == "measured"
    np.testing.assert_array_equal(np.asarray(cube.histogram)[0], counts)
    assert str(path) in cube.recipe.source


def test_one_histogram_as_text(tmp_path: Path, counts: np.ndarray) -> None:
    path = tmp_path / "pixel.csv"
    rows = [f"{t:.3f}, {n}" for t, n in zip(SYSTEM.time_ns, counts[1, 2], strict=True)]
    path.write_text("time (ns), counts\n" + "\n".join(rows) + "\n")
    cube = io.foreign_cube(path, SYSTEM)
    assert cube.shape == (1, 1, 1, 250)
    np.testing.assert_array_equal(np.asarray(cube.histogram)[0, 0, 0], counts[1, 2])


@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
def test_saved_and_loaded_it_stays_a_measured_cube(tmp_path: Path, counts: np.ndarray, suffix: str) -> None:
    cube = io.from_histograms(counts, SYSTEM, source="bench")
    io.save(tmp_path / f"lab{suffix}", cube)
    with io.load(tmp_path / f"lab{suffix}") as again:
        assert again.measured
        assert again.recipe.source == "bench"
        assert again.system.to_json() == SYSTEM.to_json()
        np.testing.assert_array_equal(np.asarray(again.histogram)[0], counts)
        refused("measured, not simulated", io.verify, again)
        refused("measured, not simulated", io.photons, again)


def test_formats_that_keep_the_light_refuse_measured_counts(tmp_path: Path, counts: np.ndarray) -> None:
    cube = io.from_histograms(counts, SYSTEM)
    refused(r"a \.mat stores the light", io.save, tmp_path / "lab.mat", cube)
    assert not list(tmp_path.iterdir())


def test_a_window_of_the_period_is_a_gate(counts: np.ndarray) -> None:
    """Histograms of a gated camera that begin 4 ns after the pulse: the truth lies within five standard errors."""
    start, bins = 20, 200
    gated = SYSTEM.replace(
        detector=ml.Detector(
            dead_time_ns=30.0, mode="gated", gate_start_ns=start * SYSTEM.bin_ns, gate_width_ns=bins * SYSTEM.bin_ns
        )
    )
    observed = ml.simulate(FLUX, gated, seed=4)[0, ..., start : start + bins]
    cube = io.from_histograms(observed, SYSTEM, start_ns=start * SYSTEM.bin_ns)
    assert cube.system.to_json() == gated.to_json()
    estimate = ml.reconstruct(cube.histogram[0], cube.system)
    assert estimate.delay_error_ns is not None
    assert estimate.signal_error is not None
    assert (np.abs(estimate.delay_ns - DELAY) < 5 * estimate.delay_error_ns).all()
    assert (np.abs(estimate.signal - FLUX.signal) < 5 * estimate.signal_error).all()


def test_photon_times_of_a_clock_and_of_a_gate(counts: np.ndarray) -> None:
    cells = [[np.repeat(SYSTEM.time_ns, row) + 50.0 * np.arange(row.sum()) for row in line] for line in counts]
    cube = io.from_photon_times(cells, SYSTEM)  # absolute times
    np.testing.assert_array_equal(np.asarray(cube.histogram)[0], counts)
    later = [[np.repeat(SYSTEM.time_ns, row) - 0.1 for row in line] for line in counts]
    with pytest.warns(UserWarning, match=r"start_ns=2.1 is added .*--window-ns"):  # the gate crosses the period's end
        cube = io.from_photon_times(later, SYSTEM, start_ns=2.1)
    np.testing.assert_array_equal(np.asarray(cube.histogram)[0], np.roll(counts, 10, axis=-1))
    single = io.from_photon_times(np.repeat(SYSTEM.time_ns, counts[0, 0]), SYSTEM)
    np.testing.assert_array_equal(np.asarray(single.histogram)[0, 0, 0], counts[0, 0])


def test_exposures_and_brackets(counts: np.ndarray) -> None:
    two = np.stack([counts, counts[::-1]])
    cube = io.from_histograms(two.transpose(3, 0, 2, 1), SYSTEM, axes="tnxy")
    np.testing.assert_array_equal(np.asarray(cube.histogram), two)
    by_column = two.transpose(0, 2, 1, 3).reshape(2, 12, 250)
    cube = io.from_histograms(by_column, SYSTEM, axes="n(xy)t", image=(3, 4))
    np.testing.assert_array_equal(np.asarray(cube.histogram), two)


def test_the_law_is_drawn_on_measured_counts(counts: np.ndarray) -> None:
    """What `view` draws: the fitted light stands in for the true one, which it meets within its errors."""
    cube = io.from_histograms(counts, SYSTEM)
    with pytest.raises(ValueError, match="measured, not simulated"):
        _ = cube.flux
    curves = fitted(cube, 0)
    assert np.abs(curves.flux.delay_ns - DELAY).max() < 0.2
    figure = ml.plot.overview(cube, pixels=[(1, 1)])
    assert "measured" in figure.texts[0].get_text()
    legends = [axes.get_legend() for axes in figure.axes if axes.get_legend() is not None]
    assert "fitted delay" in [text.get_text() for text in legends[0].get_texts()]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"counts": np.full((2, 2, 250), 0.5)}, "whole numbers"),
        ({"counts": np.full((2, 2, 250), -1)}, "at least 0"),
        ({"counts": np.full((2, 2, 250), np.nan)}, "whole numbers"),
        ({"counts": np.full((2, 2, 250), 3000)}, "cycles must be"),
        ({"counts": np.zeros((2, 2, 251), int)}, "has 250 bins"),
        ({"counts": np.zeros((2, 0, 250), int)}, "not be empty"),
        ({"counts": np.zeros((2, 2, 250), bool)}, "array of numbers"),
        ({"counts": np.ma.zeros((2, 2, 250))}, "masked"),
        ({"axes": "yxz"}, "axes must be made of"),
        ({"axes": "yxx"}, "axes must be made of"),
        ({"axes": "yt"}, "must have the axes yt"),
        ({"image": (1, 4)}, "in brackets"),
        ({"counts": np.zeros((5, 250), int), "image": (2, 2)}, "must have 5 pixels"),
        ({"counts": np.zeros((2, 2, 100), int), "start_ns": 0.3}, "0.2 or 0.4"),
        ({"start_ns": np.inf}, "start_ns"),
    ],
)
def test_what_is_no_cube_is_refused(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"counts": np.zeros((2, 2, 250), int), "system": SYSTEM} | change
    with pytest.raises((ValueError, TypeError), match=message):
        io.from_histograms(**arguments)  # type: ignore[arg-type]


def test_a_window_needs_a_detector_with_a_gate() -> None:
    paralyzable = SYSTEM.replace(detector=ml.Detector(dead_time_ns=30.0, mode="paralyzable"))
    refused("paralyzable", io.from_histograms, np.zeros((2, 2, 100), int), paralyzable)


def test_files_that_cannot_be_read_name_themselves(tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_text("1\n2\nthree\n")
    refused(r"b\.csv.*three", io.foreign_cube, tmp_path / "b.csv", SYSTEM)
    np.savez(tmp_path / "two.npz", a=np.zeros((2, 2, 250)), b=np.zeros((2, 2, 250)))
    refused("give variable: a", io.foreign_cube, tmp_path / "two.npz", SYSTEM)
    refused("variable must be one of a", io.foreign_cube, tmp_path / "two.npz", SYSTEM, variable="c")
    refused("", io.foreign_cube, tmp_path / "none.npy", SYSTEM, error=FileNotFoundError)
    refused("are read from", io.foreign_cube, tmp_path / "none.doc", SYSTEM)


@pytest.mark.parametrize(
    ("shape", "warned"),
    [
        ((1024, 80, 48), True),
        ((512, 64, 64), True),
        ((96, 96, 512), False),
        ((80, 48, 1024), False),
        ((64, 64, 16), False),
    ],
)
def test_time_that_may_be_first_is_told(tmp_path: Path, shape: tuple[int, ...], warned: bool) -> None:
    """Without the number of bins the last dimension is time; an image far from even is likely none."""
    np.save(tmp_path / "a.npy", np.ones(shape, np.uint8))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        counts = read_counts(tmp_path / "a.npy").counts
    assert counts is not None
    assert counts.shape[1:] == shape
    assert [("axes (--axes) is 'tyx'" in str(w.message)) for w in caught] == [True] * warned
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_counts(tmp_path / "a.npy", axes="yxt")
        read_counts(tmp_path / "a.npy", bins=shape[0] if warned else shape[-1])


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e-9])
def test_times_beside_the_counts_are_those_of_the_bins(tmp_path, unit):
    """They were not looked at: a histogram that began 20 ns late was 3 m too near."""
    system = make_system(50.0, 1000, 100, sigma_ns=1.0)
    path, times = tmp_path / "lab.csv", np.arange(100.0)

    def write(part, first=0.0):
        np.savetxt(path, np.c_[(times[part] + first) * unit, np.ones(times[part].size)], delimiter=",")
        return path

    for first in (0.0, 0.5):  # edges of bins, and their middles
        assert ml.io.foreign_cube(write(slice(None), first), system).shape == (1, 1, 1, 100)
    refused(r"begin at 20 ns: give the laser period and start_ns", ml.io.foreign_cube, write(slice(20, 90)), system)
    assert ml.io.foreign_cube(write(slice(20, 90)), system, start_ns=20.0).histogram[0, 0, 0, 20:90].sum() == 70
    refused(r"which is not the bin width of 0\.5 ns", ml.io.foreign_cube, write(slice(None)), system.replace(bins=200))


def test_counts_that_the_detector_cannot_register_are_refused():
    """More than the dead time allows in all, and counts in bins that the gate never opens."""
    plain = make_system(75.0, 1000, 50)
    refused(r"a pixel holds 1,500 counts.*at most 1,334", ml.io.from_histograms, np.full((1, 50), 30), plain)
    matched = ml.reconstruct(np.full((1, 50), 30), plain, method="matched_filter")
    assert (matched.flags & ml.reconstruction.Flags.SATURATED).all()

    gated = plain.replace(detector=ml.Detector(dead_time_ns=75.0, mode="gated", gate_start_ns=85.0, gate_width_ns=45.0))
    assert np.flatnonzero(~gated.closed_bins).tolist() == [*range(15), *range(42, 50)]
    counts = np.zeros((1, 50), int)
    counts[0, [3, 14, 42, 49]] = 5  # bins at both edges are open in part
    assert ml.io.from_histograms(counts, gated).registrations == 20
    counts[0, 20] = 2
    for take in (ml.io.from_histograms, ml.reconstruct):
        refused(r"2 of 22 counts lie in bins that the gate, open from 85 to 130 ns", take, counts, gated)


@pytest.mark.parametrize(
    ("shape", "readings", "axes", "image"),
    [((64, 3, 64), "'tyx' or 'yxt'", "tyx", None), ((64, 64), r"'t\(yx\)' or '\(yx\)t'", "t(yx)", (8, 8))],
)
def test_two_dimensions_that_could_be_time_need_axes(tmp_path, shape, readings, axes, image):
    system = make_system(30.0, 50, 64)
    np.save(tmp_path / "counts.npy", np.ones(shape, np.uint16))
    with pytest.raises(ValueError, match=rf"2 dimensions of 64 bins: give axes \(--axes\), {readings}"):
        ml.io.foreign_cube(tmp_path / "counts.npy", system)
    assert ml.io.foreign_cube(tmp_path / "counts.npy", system, axes=axes, image=image).shape[-1] == 64


def test_time_behind_an_image_as_wide_needs_none(tmp_path):
    np.save(tmp_path / "counts.npy", np.ones((10, 64, 64), np.uint16))
    assert ml.io.foreign_cube(tmp_path / "counts.npy", make_system(30.0, 50, 64)).shape == (1, 10, 64, 64)
