"""Every prediction is of (flux, system): a pixel, a row, an image; one return, several, a waveform."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from harness import make_system, require
from scipy import stats
from scipy.special import ndtr

import mars_lidar as ml
from mars_lidar import reconstruction, statistics

SYSTEM = make_system(60.0, 200, 32, sigma_ns=2.0)
IMAGE = ml.Flux(np.array([[0.5, 2.0, 0.0], [1.0, 0.1, 3.0]]), 0.3, np.array([[20.0, 40.0, np.nan], [60.0, 80.0, 10.0]]))
PIXEL = IMAGE[0, 1]
OTHERS = {
    "paralyzable": make_system(70.0, 40, 32, sigma_ns=2.0, mode="paralyzable"),
    "synchronous": make_system(70.0, 40, 32, sigma_ns=2.0, mode="synchronous"),
    "gated": make_system(70.0, 40, 32, sigma_ns=2.0, mode="gated", gate_start_ns=30.3, gate_width_ns=61.0),
}
OF_PIXELS: dict[str, Callable[[ml.Flux], Any]] = {
    "count_law": lambda flux: ml.count_law(flux, SYSTEM).cumulants,
    "mars": lambda flux: ml.count_law(flux, SYSTEM, "mars").mean,
    "renewal": lambda flux: ml.count_law(flux, SYSTEM, "renewal").mean,
    "poisson": lambda flux: ml.count_law(flux, SYSTEM, "poisson").mean,
    "mean_histogram": lambda flux: statistics.mean_histogram(flux, SYSTEM),
    "registration_pdf": lambda flux: ml.registration_pdf(flux, SYSTEM),
    "stationary": lambda flux: ml.registration_pdf(flux, SYSTEM, "stationary"),
    "chain": lambda flux: ml.registration_pdf(flux, SYSTEM, "chain"),
    "exposure_moments": lambda flux: statistics.exposure_moments(flux, SYSTEM).histogram,
    "photons_per_bin": lambda flux: statistics.photons_per_bin(flux, SYSTEM, bins=256),
    **{mode: lambda flux, system=system: statistics.mean_histogram(flux, system) for mode, system in OTHERS.items()},
}
OF_ONE: dict[str, Callable[[ml.Flux], Any]] = {
    "joint_law": lambda flux: ml.joint_law(flux, SYSTEM).variance,
    "holding_time_covariance": lambda flux: ml.holding_time_covariance(flux, SYSTEM).sigma2,
}


@pytest.mark.parametrize("name", OF_PIXELS)
def test_axes_are_those_of_the_flux(name: str) -> None:
    """A pixel has none, a row one, an image two, and each pixel of an image is what it is alone."""
    of = OF_PIXELS[name]
    image, row, pixel = of(IMAGE), of(IMAGE[0]), of(PIXEL)
    rest = np.shape(pixel)
    assert np.shape(image) == (2, 3, *rest)
    assert np.shape(row) == (3, *rest)
    np.testing.assert_allclose(image[0], row, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(row[1], pixel, rtol=1e-9, atol=1e-12)
    broadcast = of(ml.Flux(np.array([[0.0], [2.0]]), np.array([0.3, 0.1, 0.0]), 40.0))
    np.testing.assert_allclose(broadcast[1, 0], pixel, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", OF_PIXELS | OF_ONE)
def test_a_waveform_of_a_return_is_the_return(name: str) -> None:
    of = (OF_PIXELS | OF_ONE)[name]
    wave = 2.0 * SYSTEM.pulse.bin_energy(40.0, 100.0, 2048)
    by_wave, by_return = of(ml.Flux(waveform=wave, background=0.3)), of(ml.Flux(2.0, 0.3, 40.0))
    np.testing.assert_allclose(by_wave, by_return, rtol=2e-4, atol=1e-5 * np.max(np.abs(by_return)))


@pytest.mark.parametrize("name", ["joint_law", "holding_time_covariance"])
def test_laws_of_one_pixel_ask_for_one(name: str) -> None:
    getattr(ml, name)(PIXEL, SYSTEM)
    getattr(ml, name)(IMAGE[0:1, 1:2], SYSTEM)
    with pytest.raises(ValueError, match=r"flux must be one pixel, such as flux\[0, 0\], got pixels of shape \(2, 3\)"):
        getattr(ml, name)(IMAGE, SYSTEM)


def test_every_prediction_takes_flux_and_system_first() -> None:
    """By their signatures; laws of given numbers (`matched_pmf`, cumulants) and of given rates have no light."""
    results = {}
    for home in (statistics, reconstruction):
        for name in home.__all__:
            thing = getattr(home, name)
            if inspect.isfunction(thing):
                results[name] = list(inspect.signature(thing).parameters)
    light = {name: names for name, names in results.items() if "flux" in names}
    assert len(light) >= 13, sorted(light)
    for name, names in light.items():
        first = names.index("flux")
        assert names[first + 1] == "system", name
    for name, names in results.items():
        assert not {"signal", "background", "delay_ns", "waveform"} <= set(names), name
        assert not ({"signal", "background"} <= set(names)), name


def test_several_returns_are_those_of_the_exact_engine() -> None:
    """Count and mean histogram of a pane and a wall, by 4,000 exposures."""
    flux = ml.Flux.multi(ml.Flux(0.6, 0.2, 20.0), ml.Flux(1.5, 0.1, 71.0))
    exposures = 4000
    drawn = ml.simulate(flux, SYSTEM, realizations=exposures, seed=5)[:, 0, 0].astype(np.float64)
    law, joint = ml.count_law(flux, SYSTEM), ml.joint_law(flux, SYSTEM)
    mean = statistics.mean_histogram(flux, SYSTEM)
    assert mean.sum() == pytest.approx(float(law.mean), rel=1e-4)
    counts = drawn.sum(-1)
    z = (drawn.mean(0) - mean) / np.sqrt(joint.variance / exposures)
    ratio = counts.var() / float(law.variance) * exposures
    require(
        {
            "mean": 2.0 * stats.norm.sf(abs(counts.mean() - law.mean) / np.sqrt(law.variance / exposures)),
            "variance": 2.0 * min(stats.chi2.cdf(ratio, exposures - 1), stats.chi2.sf(ratio, exposures - 1)),
            "bins": len(z) * 2.0 * stats.norm.sf(np.abs(z).max()),
        },
        "two returns",
    )


def test_a_dark_return_changes_nothing() -> None:
    """Of several returns with one lit the law is exactly that of the lit one, not that of a waveform."""
    more = ml.Flux.multi(ml.Flux(0.0, 0.3, 10.0), ml.Flux(2.0, 0.0, 40.0))
    np.testing.assert_array_equal(ml.count_law(more, SYSTEM).cumulants, ml.count_law(PIXEL, SYSTEM).cumulants)


def test_photons_are_the_integral_of_the_light() -> None:
    """Returns, a waveform finer and coarser than the bins, efficiency and dark counts."""
    dim = SYSTEM.replace(detector=ml.Detector(dead_time_ns=60.0, detection_efficiency=0.4, dark_count_hz=1e6))
    for flux in (
        IMAGE,
        ml.Flux.multi(IMAGE, ml.Flux(0.3, 0.1, 50.0)),
        ml.Flux(waveform=np.arange(7.0), background=0.5),
    ):
        total = statistics.photons_per_bin(flux, dim, bins=96).sum(-1)
        np.testing.assert_allclose(total, flux.total * 0.4 + 0.1, rtol=1e-12)
    wave = np.array([1.0, 0.0, 3.0])
    photons = statistics.photons_per_bin(ml.Flux(waveform=wave, background=0.6), SYSTEM, bins=6)
    np.testing.assert_allclose(photons, np.repeat(wave, 2) / 2 + 0.1, rtol=1e-12)


def test_simulate_makes_an_image_of_every_flux() -> None:
    assert ml.simulate(PIXEL, SYSTEM).shape == (1, 1, 1, 32)
    assert ml.simulate(IMAGE[1], SYSTEM, realizations=2).shape == (2, 1, 3, 32)
    np.testing.assert_array_equal(
        ml.simulate(IMAGE[1], SYSTEM, pixel_index=[3, 4, 5])[0, 0], ml.simulate(IMAGE, SYSTEM)[0, 1]
    )
    assert ml.simulate_timestamps(PIXEL, SYSTEM).histogram().shape == (1, 1, 32)


@pytest.mark.parametrize("dead_ns", [0.15, 49.9, 50.13, 149.97])
def test_two_returns_half_a_period_apart_are_one_of_half_the_period(dead_ns: float):
    """Where pixels re-arm within a pulse, samples of 50 in a standard deviation had an error of 6e-4 of the mean."""
    two = make_system(dead_ns, 40, 50, sigma_ns=0.1)
    halved = two.replace(period_ns=50.0, cycles=80, bins=25)
    a = ml.statistics.exposure_moments(ml.Flux.multi(*(ml.Flux(3.0, 0.1, d) for d in (8.0, 58.0))), two, tolerance=1e-6)
    b = ml.statistics.exposure_moments(ml.Flux(3.0, 0.1, 8.0), halved, tolerance=1e-6)
    assert float(a.mean) == pytest.approx(float(b.mean), rel=3e-6)
    assert float(a.variance) == pytest.approx(float(b.variance), rel=3e-5)
    np.testing.assert_allclose(a.histogram[:25] + a.histogram[25:], b.histogram, atol=1e-5 * float(b.mean))


@pytest.mark.parametrize("light", ["pulse", "waveform"])
def test_jitter_behind_an_edge_of_a_gate(light: str):
    """Registrations in 8000 bins, convolved with the jitter; bins outside of the gate had up to nine times too many."""
    wave = np.random.default_rng(1).random(20) ** 3
    flux = ml.Flux(1.0, 0.3, 80.0) if light == "pulse" else ml.Flux(waveform=wave / wave.sum(), background=0.05)
    gate = {"mode": "gated", "gate_start_ns": 76.6953, "gate_width_ns": 21.5735}
    plain = make_system(7.9371, 10, 8000, sigma_ns=3.0, **gate)
    fine = ml.mean_histogram(flux, plain, tolerance=1e-6)
    for sigma in (0.1, 1.0):
        blurred = np.fft.rfft(fine) * np.exp(-2.0 * (np.pi * np.arange(4001) * sigma / 100.0) ** 2)
        expected = np.maximum(np.fft.irfft(blurred, 8000), 0.0).reshape(200, -1).sum(-1)
        jittered = make_system(7.9371, 10, 200, sigma_ns=3.0, jitter=ml.Jitter(sigma_ns=sigma), **gate)
        mean = ml.mean_histogram(flux, jittered)
        assert np.abs(mean - expected).sum() < 2e-4 * expected.sum()
        assert (np.abs(mean - expected) < 0.05 * np.sqrt(expected / 100) + 1e-9).all()  # of 1000 cycles


@pytest.mark.parametrize("signal", [0.5, 3.0])
@pytest.mark.parametrize("gate", [{}, {"mode": "gated", "gate_start_ns": 30.0, "gate_width_ns": 50.0}])
def test_wide_jitter_of_a_narrow_pulse(gate: dict[str, Any], signal: float):
    """Means behind electronics, and variances of bins, moved light by up to half a part: 1e-3 of it into other bins.

    Here the law without jitter, on narrow bins, is convolved with a normal law from their centres.
    """
    system = make_system(75.0, 500, 32, sigma_ns=0.02, jitter=ml.Jitter(sigma_ns=2.0), **gate)
    light, fine = ml.Flux(signal, 0.3, 40.4), make_system(75.0, 500, 4096, sigma_ns=0.02, **gate)
    centre, edges = (np.arange(4096) + 0.5) * 100.0 / 4096, np.arange(33)[:, None] * 100.0 / 32
    recorded = np.diff(sum(ndtr((edges + shift - centre) / 2.0) for shift in (-100.0, 0.0, 100.0)), axis=0)
    mean = ml.mean_histogram(light, fine)
    for each in (ml.mean_histogram(light, system), statistics.electronics_moments(light, system).histogram):
        assert np.abs(each - recorded @ mean).sum() < 1e-4 * mean.sum()
    if gate or signal < 1.0:
        return
    share = mean.reshape(256, 16) / mean.reshape(256, 16).sum(-1, keepdims=True)  # where registrations of a bin lie
    narrow, law = (recorded.reshape(32, 256, 16) * share).sum(-1), ml.joint_law(light, fine.replace(bins=256))
    variance = np.diag(narrow @ (law.covariance() - np.diag(law.mean)) @ narrow.T) + narrow @ law.mean
    assert np.abs(ml.joint_law(light, system).variance - variance).max() < 2e-4 * variance.max()


@pytest.mark.parametrize("delay_ns", [99.98, 100.0])
def test_jitter_far_wider_than_the_pulse(delay_ns: float):
    """First photons of each period, convolved with the Gaussian: 0.3 % in total variation at any tolerance before."""
    pulse, jitter, edges = 0.2, 4.69, np.linspace(0.0, 100.0, 200_001)
    photons = sum(6.0 * ndtr((edges + shift - delay_ns) / pulse) for shift in (0.0, 100.0)) + 1e-4 * edges
    first, middle = -np.diff(np.exp(photons[0] - photons)), 0.5 * (edges[1:] + edges[:-1])
    first, middle = first[first > 1e-12], middle[first > 1e-12]
    ends = np.linspace(0.0, 100.0, 9)[:, None] - middle
    expected = 100.0 * sum(np.diff(ndtr((ends + shift) / jitter), axis=0) @ first for shift in (-100.0, 0.0, 100.0))
    timed = {"mode": "synchronous", "jitter": ml.Jitter(sigma_ns=jitter)}
    system = make_system(0.0, 100, 8, sigma_ns=pulse, **timed)
    flux = ml.Flux(6.0, 0.01, delay_ns)
    for tolerance in (1e-4, 1e-6):
        mean = ml.mean_histogram(flux, system, tolerance=tolerance)
        assert np.abs(mean - expected).sum() < 2.0 * tolerance * expected.sum()
    np.testing.assert_allclose(ml.registration_pdf(flux, system), expected / expected.sum(), atol=1e-4)


@pytest.mark.parametrize("jitter_ns", [0.0, 0.12, 2.0])
@pytest.mark.parametrize("light", ["waveform", "samples", "returns of samples", "pulse"])
def test_codes_divide_light_in_steps(light: str, jitter_ns: float):
    """Registrations in 8000 bins, of which codes take what lies before their edges; bins were up to 42 % off."""
    density = tuple(np.random.default_rng(1).uniform(0.3, 2.0, 5))
    wave = np.random.default_rng(1).random(64) ** 3
    flux = ml.Flux(waveform=wave / wave.sum(), background=0.3) if light == "waveform" else ml.Flux(0.7, 0.3, 31.3)
    samples = ml.SampledPulse(np.random.default_rng(1).random(7) ** 2, bin_ns=1.7, origin="first")
    if light == "returns of samples":
        flux = ml.Flux.multi(ml.Flux(0.4, 0.3, 31.3), ml.Flux(0.3, 0.0, 70.9))
    pulse = {"pulse": samples} if "samples" in light else {}
    fine = ml.mean_histogram(flux, make_system(30.0, 20, 8000).replace(**pulse), tolerance=1e-6)
    if jitter_ns:
        fine = np.fft.irfft(np.fft.rfft(fine) * np.exp(-2.0 * (np.pi * np.arange(4001) * jitter_ns / 100.0) ** 2), 8000)
    edges = (5.0 * np.arange(40)[:, None] + 5.0 * np.r_[0.0, np.cumsum(density)[:-1]] / sum(density)).ravel()
    before = np.interp(np.append(edges, 200.0) * 40.0, np.arange(8001), np.append(0.0, np.cumsum(fine)))
    system = make_system(
        30.0, 20, 200, code_density=density, **({"jitter": ml.Jitter(sigma_ns=jitter_ns)} if jitter_ns else {})
    )
    mean = ml.mean_histogram(flux, system.replace(**pulse))
    expected = np.diff(before)
    assert np.abs(mean - expected).sum() < 4e-4 * expected.sum()
    assert (np.abs(mean - expected) < 0.02 * np.sqrt(expected / 50)).all()  # of 1000 cycles
    law = ml.joint_law(flux, system.replace(**pulse))
    np.testing.assert_allclose(law.mean, mean, rtol=2e-3)
