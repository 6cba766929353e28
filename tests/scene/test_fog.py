"""Returns in fog: the lidar equation, by brute force; limits."""

import numpy as np
import pytest
from harness import make_system, refused
from scipy import integrate, special

import mars_lidar as ml

C = 0.299792458
SYSTEM = make_system(30.0, 100, 200, sigma_ns=0.4)


@pytest.mark.parametrize(("alpha", "first", "delay"), [(0.05, 0.5, 60.0), (1.0, 2.0, 33.3), (0.02, 1.0, 140.0)])
def test_lidar_equation(alpha: float, first: float, delay: float):
    flux = ml.Flux(0.7, 0.1, delay).in_fog(SYSTEM, extinction_per_m=alpha, backscatter=1.3, nearest_m=first, parts=1000)
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
    target_energy = 0.7 * np.exp(-2 * alpha * target) * SYSTEM.pulse.bin_energy(delay, 100.0, 50)
    assert flux.waveform.reshape(50, 20).sum(-1) == pytest.approx(
        cloud + target_energy, abs=5e-3 * 1.3 * observed / total
    )


def test_limits():
    clear = ml.Flux.multi(ml.Flux([[1.0, 0.0]], 0.2, [[30.0, np.nan]]), ml.Flux([[0.3, 0.0]], 0.0, [[50.0, np.nan]]))
    thin = clear.in_fog(SYSTEM, extinction_per_m=1e-9, backscatter=0.0)
    expected = SYSTEM.pulse.bin_energy(30.0, 100.0, 800) + 0.3 * SYSTEM.pulse.bin_energy(50.0, 100.0, 800)
    assert thin.waveform.shape == (1, 2, 800)
    assert thin.waveform[0, 0] == pytest.approx(expected, abs=1e-8)
    assert not thin.waveform[0, 1].any()
    thick = clear.in_fog(SYSTEM, extinction_per_m=3.0, backscatter=0.8)
    assert thick.signal == pytest.approx(np.full((1, 2), 0.8), rel=1e-6)  # all of it comes from the fog
    assert thick.info["extinction_per_m"] == 3.0
    near = ml.Flux(1.0, 0.0, 3.0).in_fog(SYSTEM, extinction_per_m=0.1, backscatter=5.0)  # before the fog begins
    assert near.signal == pytest.approx(np.exp(-0.2 * 1.5 * C), rel=1e-6)


def test_light_that_comes_many_periods_late():
    """Thin fog without a target: light from 50 km on 15 m of range, in a memory that does not grow with it."""
    quick = SYSTEM.replace(pulse=ml.GaussianPulse(sigma_ns=0.001))
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
        refused(message, light.in_fog, SYSTEM, **{"extinction_per_m": 0.1, "backscatter": 1.0} | changes)
