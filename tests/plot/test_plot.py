"""Pictures: the numbers behind them are right, every kind of cube can be drawn, nothing global is touched."""

import json
import re
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.style
import numpy as np
import pytest
from harness import make_system, mean_vector, refused, rejected, require
from matplotlib.figure import Figure

import mars_lidar as ml
from mars_lidar import io, plot
from mars_lidar.plot import views
from mars_lidar.plot.colours import COLOURS

SYSTEM = make_system(30.0, 300, 128)


def cube_of(flux: ml.Flux, system: ml.System = SYSTEM, engine: str = "exact", realizations: int = 1) -> io.Cube:
    counts = ml.simulate(flux, system, engine=engine, realizations=realizations)
    return io.Cube.of(counts, io.Recipe(system=system, flux=flux, engine=engine, realizations=realizations))


def step(height: int = 9, width: int = 12) -> ml.Flux:
    """Two planes, the right one farther and darker; one pixel without return."""
    right = np.arange(width) >= width // 2
    s = np.tile(np.where(right, 0.5, 2.0), (height, 1))
    tau = np.tile(np.where(right, 60.0, 20.0), (height, 1))
    s[0, 0], tau[0, 0] = 0.0, np.nan
    return ml.Flux(s, 0.2, tau)


FLUXES = {
    "one return": step(),
    "several returns": ml.Flux.multi(step(), ml.Flux(0.4, 0.0, 99.5)),
    "waveform": ml.Flux(waveform=np.random.default_rng(0).gamma(0.3, 0.05, (9, 12, 40)), background=0.1),
    "no signal": ml.Flux(np.zeros((4, 5)), 0.3, np.nan),
    "nothing at all": ml.Flux(0.0, 0.0, np.nan),
    "one pixel": ml.Flux(2.0, 0.5, 99.9),
    "few photons": ml.Flux(np.full((3, 3), 1e-3), 1e-3, 50.0),
}


@pytest.mark.full
@pytest.mark.parametrize("name", FLUXES)
def test_every_kind_of_cube_can_be_drawn(tmp_path, name):
    cube = cube_of(FLUXES[name])
    figure = plot.overview(cube)
    assert isinstance(figure, Figure)
    figure.savefig(tmp_path / "overview.png", dpi=40)
    plot.pixel_histogram(cube, 0, 0).savefig(tmp_path / "pixel.png", dpi=40)
    assert (tmp_path / "overview.png").stat().st_size > 2000
    labels = [ax.get_xlabel() for ax in figure.axes]
    assert "time in the laser period (ns)" in labels
    assert "counts per bin" in [ax.get_ylabel() for ax in figure.axes]


def test_a_map_has_a_colour_bar_with_its_unit(tmp_path):
    figure = plot.map_image(np.array([[1.0, np.nan], [2.0, 3.0]]), "depth (m)")
    figure.savefig(tmp_path / "map.png", dpi=40)
    assert figure.axes[0].child_axes[0].get_ylabel() == "depth (m)"
    refused(r"values must be a map \(H, W\), got shape \(3,\)", plot.map_image, np.zeros(3), "depth (m)")


def test_the_style_sheet_serves_programs_of_users():
    with matplotlib.style.context("mars_lidar.plot.mars"):
        cycle = mpl.rcParams["axes.prop_cycle"].by_key()["color"]
    assert cycle == list(COLOURS)


def test_the_users_settings_and_pyplot_are_left_alone():
    before = dict(mpl.rcParams)
    plot.overview(cube_of(FLUXES["one return"]))
    assert dict(mpl.rcParams) == before
    code = "import sys, mars_lidar.plot.figures; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_only_the_realization_asked_for_is_drawn():
    cube = cube_of(step(), realizations=3)
    totals, _ = plot.count_maps(cube, 2)
    assert np.array_equal(totals, np.asarray(cube.histogram)[2].sum(-1))
    assert "realization 2" in plot.overview(cube, realization=2).texts[0].get_text()
    refused(r"realization must be an integer in \[0, 2\], got 3", plot.overview, cube, realization=3)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [([(9, 0)], r"y of pixels must be an integer in \[0, 8\], got 9"), ([], "pixels must be 1 to 6 pairs")],
)
def test_pixels_outside_are_named(pixels, message):
    refused(message, plot.overview, cube_of(step()), pixels=pixels)


def test_maps_are_read_in_bands(monkeypatch):
    cube = cube_of(step())
    whole = plot.count_maps(cube)
    monkeypatch.setattr(views, "_READ_BYTES", 1)
    for a, b in zip(whole, plot.count_maps(cube), strict=True):
        assert np.array_equal(a, b, equal_nan=True)


@pytest.mark.parametrize("origin", ["peak", "centroid", "first"])
def test_peak_depth_knows_what_the_delay_of_a_measured_pulse_refers_to(origin):
    values = np.concatenate([np.zeros(30), [1.0, 4.0, 9.0, 4.0], np.exp(-np.arange(40) / 12.0)])
    system = SYSTEM.replace(pulse=ml.SampledPulse(values, 0.5, origin), bins=400, cycles=3000)
    flux = ml.Flux(np.full((4, 4), 0.5), 0.05, np.linspace(1.0, 99.0, 16).reshape(4, 4))
    cube = cube_of(flux, system, engine="poisson")
    _, estimate = plot.count_maps(cube)
    # the sample of the peak is two bins wide: either of them may hold most counts
    assert np.abs(plot.depth_error_m(cube, estimate)).max() < system.depth_m(0.6)
    counts = np.asarray(cube.histogram)
    assert np.array_equal(plot.count_maps(counts, system=cube.system)[1], estimate)
    error = plot.depth_error_m(counts, estimate, system=cube.system, flux=cube.flux)
    assert np.allclose(error, plot.depth_error_m(cube, estimate))


def test_depth_is_missing_where_nothing_was_counted():
    _, estimate = plot.count_maps(cube_of(FLUXES["nothing at all"]))
    assert np.isnan(estimate).all()


def test_depth_errors_are_modulo_the_range():
    cube = cube_of(ml.Flux(1.0, 0.0, 250.3))  # two periods and a half away
    span = SYSTEM.unambiguous_range_m
    error = plot.depth_error_m(cube, SYSTEM.depth_m(np.array([[50.5]])))
    assert error == pytest.approx(SYSTEM.depth_m(0.2), abs=1e-9)
    assert abs(plot.depth_error_m(cube, np.array([[0.0]])))[0, 0] <= span / 2


def test_incident_rates_add_up_to_all_photons():
    for name, flux in FLUXES.items():
        rate = plot.incident_rate(flux, SYSTEM, 0, 0)
        assert rate.shape == (SYSTEM.bins,), name
        assert rate.sum() == pytest.approx(flux.image.total[0, 0], abs=1e-12), name
    # Poisson histograms have this mean: chi-square of 128 bins, false alarm 1e-6
    flux = ml.Flux(waveform=np.linspace(0.0, 0.2, 40), background=0.5)
    counts = ml.simulate(flux, SYSTEM, engine="poisson", realizations=200)[:, 0, 0].sum(0)
    mean = plot.incident_rate(flux, SYSTEM, 0, 0) * SYSTEM.cycles * 200
    assert ((counts - mean) ** 2 / mean).sum() < 220.0


def test_example_pixels_are_bright_dim_and_at_the_edge():
    flux = step()
    chosen = plot.example_pixels(flux, SYSTEM.depth_m(flux.delay_ns))
    assert flux.signal[chosen["bright"]] == 2.0
    assert flux.signal[chosen["dim"]] == 0.5
    assert chosen["edge"][1] in (5, 6)
    assert plot.example_pixels(ml.Flux(0.0, 1.0, 0.0), np.zeros((1, 1))) == {"first": (0, 0)}
    assert plot.example_pixels(ml.Flux(1.0, 1.0, 0.0), np.zeros((1, 1))) == {"bright": (0, 0)}


LIT = {
    "one return": ml.Flux(np.full((1, 2), 1.5), 0.3, 20.0),
    "two returns": ml.Flux.multi(ml.Flux(np.full((1, 2), 1.0), 0.3, 20.0), ml.Flux(0.7, 0.0, 99.5)),
    "waveform": FLUXES["waveform"][:1, :2],
}


@pytest.mark.parametrize("engine", ["exact", "poisson"])
@pytest.mark.parametrize("name", LIT)
def test_the_predicted_histogram_is_the_mean_of_many(name, engine):
    cube = cube_of(LIT[name], engine=engine, realizations=4000)
    for x in (0, 1):
        predicted = views.predicted_counts(cube, 0, x)
        drawn = cube.histogram[:, 0, x].astype(float)
        require({"mean": mean_vector(drawn, predicted)}, f"predicted counts: {engine}, {name}, pixel {x}")
        wrong = drawn @ np.eye(SYSTEM.bins)[:, ::-1]  # the test can tell: bins in the wrong order
        assert rejected({"mean": mean_vector(wrong, predicted)})


def test_no_prediction_where_it_would_take_too_long():
    """Of a pixel that keeps to every third pulse for all of the exposure; long exposures of others have their mean."""
    detector, pulse = ml.Detector(dead_time_ns=235.0), ml.GaussianPulse(sigma_ns=0.5)
    locked = ml.System(period_ns=100.0, cycles=1e8, bins=64, pulse=pulse, detector=detector)
    for signal, is_predicted in ((10.0, False), (0.5, True)):
        flux = ml.Flux(signal, 0.01, 40.0)
        cube = ml.Cube(np.zeros((1, 1, 1, 64), np.uint32), locked, flux)
        assert (views.predicted_counts(cube, 0, 0) is not None) == is_predicted


def test_a_headline_names_what_is_not_plain():
    plain = make_system(50.0, 1, 1)
    assert views.instrument(plain) == "1 bin of 100 ns; 1 laser period of 100 ns; dead time 50 ns"
    odd = plain.replace(
        bins=1000,
        cycles=2000,
        detector=ml.Detector(dead_time_ns=0.0, mode="synchronous", dark_count_hz=5.0, max_events_per_exposure=4),
    )
    assert views.instrument(odd) == (
        "1,000 bins of 100 ps; 2,000 laser periods of 100 ns; dead time 0 ns, synchronous, dark count, "
        "max events per exposure"
    )


def test_an_array_of_counts_is_drawn_and_saved_with_its_system(tmp_path):
    """With its light as the cube of it; without, as counts that were measured; alone, it is said what to give."""
    flux = step()
    counts = ml.simulate(flux, SYSTEM, realizations=2, seed=4)
    cube = ml.Cube(counts, SYSTEM, flux)
    assert (cube.shape, cube.measured, cube.engine) == (counts.shape, False, "")
    assert np.array_equal(cube.flux.signal, flux.signal)
    assert ml.Cube(counts[0], SYSTEM).measured
    assert ml.Cube(counts[0, 0, 0].astype(float), SYSTEM).shape == (1, 1, 1, SYSTEM.bins)
    assert np.array_equal(ml.reconstruct(cube).depth_m, ml.reconstruct(counts, SYSTEM).depth_m, equal_nan=True)
    plot.pixel_histogram(counts, 3, 4, system=SYSTEM, flux=flux).savefig(tmp_path / "a.png")
    plot.pixel_histogram(cube, 3, 4).savefig(tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert "simulated, realization 1" in cube.plot(realization=1).texts[-1].get_text()
    plot.overview(counts, SYSTEM)  # measured: with the light that is fitted
    for name, save in (("a.zarr", lambda at: io.save(at, counts, SYSTEM, flux)), ("b.h5", cube.save)):
        save(tmp_path / name)
        with io.load(tmp_path / name) as back:
            assert np.array_equal(back.histogram[...], counts)
            assert np.array_equal(back.flux.signal, flux.signal)
    text = r"cube must be a Cube, or an array of counts beside the system that recorded them .*got ndarray alone"
    for call in (lambda: plot.pixel_histogram(counts, 0, 0), lambda: io.save(tmp_path / "c.h5", counts)):
        refused(text, call, error=TypeError)
    refused("a Cube has its own", io.save, tmp_path / "c.h5", cube, SYSTEM, error=TypeError)
    for wrong, message in (
        (counts - 0.5, "whole numbers"),
        (counts.astype(int) - 10**6, r"counts must lie in \[0, 65535\]"),
        (counts[..., 1:], r"counts must be \(realizations, H, W, 128\)"),
    ):
        refused(message, ml.Cube, wrong, SYSTEM)
    refused("flux must have the pixels of the counts, 9 x 12, got", ml.Cube, counts, SYSTEM, ml.Flux(1.0, 0.1, 3.0))


# What a notebook shows of objects, and the tutorial.


EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ROOM_SYSTEM = make_system(50.0, 50, 64, sigma_ns=0.5)


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> dict[str, object]:
    scene = ml.Scene.example("room", size=(8, 12))
    flux = scene.flux(ROOM_SYSTEM, signal=1.0, sbr=1.0)
    path = tmp_path_factory.mktemp("cubes") / "a.zarr"
    io.simulate_to(path, flux, ROOM_SYSTEM)
    cube = io.load(path)
    return {
        "scene": scene,
        "flux": flux,
        "dark flux": ml.Flux(0.0, 0.5),
        "waveform": ml.Flux(waveform=np.ones((2, 3, 5)) * 0.01),
        "system": ROOM_SYSTEM,
        "cube": cube,
        "timestamps": ml.simulate_timestamps(flux, ROOM_SYSTEM),
        "law": ml.count_law(ml.Flux(0.5, 0.1, 50.0), ROOM_SYSTEM),
        "laws": ml.count_law(ml.Flux(flux.signal, flux.background, 50.0), ROOM_SYSTEM),
        "several laws": ml.count_law(ml.Flux([0.5, 0.6], 0.1, 50.0), ROOM_SYSTEM),
        "joint law": ml.joint_law(ml.Flux(0.5, 0.1, 50.0), ROOM_SYSTEM),
        "reconstruction": ml.reconstruct(cube),
        "bound": ml.cramer_rao(flux, ROOM_SYSTEM),
        "one pixel": ml.reconstruct(cube.histogram[0, 4, 5], ROOM_SYSTEM),
    }


@pytest.mark.full
def test_a_notebook_shows_text_and_a_small_picture(objects):
    without = {"several laws", "one pixel", "dark flux"}  # no map, no curve
    for name, example in objects.items():
        text = example._repr_html_()
        assert text.startswith("<code>"), name
        assert type(example).__name__.removeprefix("Drawn") in re.sub("<.*?>", "", text)[:40], name
        assert ("data:image/png;base64," in text) == (name not in without), name
        assert len(text) < 60_000, name


@pytest.mark.full
def test_the_tutorial_runs_and_is_the_notebook(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import make_notebook

    try:
        made, selected = make_notebook.notebook(), json.loads((EXAMPLES / "tutorial.ipynb").read_text())
    finally:
        sys.modules.pop("make_notebook")
    assert [item["source"] for item in made["cells"]] == [item["source"] for item in selected["cells"]]
    examples = [output for item in made["cells"] for output in item.get("outputs", ())]
    assert sum("text/html" in item.get("data", {}) for item in examples) >= 6
    assert sum("image/png" in item.get("data", {}) for item in examples) == 1
