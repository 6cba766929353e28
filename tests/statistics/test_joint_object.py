"""The object that `joint_law` makes: its ways to a covariance agree, its inputs are checked, hard pixels work."""

from functools import partial

import numpy as np
import pytest
from harness import refused, system_of

import mars_lidar as ml
from mars_lidar.statistics import ConvergenceError, exposure_moments, joint_law

PERIOD = 100.0
system = partial(system_of, sigma=0.02)


@pytest.fixture(scope="module")
def law() -> ml.JointLaw:
    return ml.joint_law(ml.Flux(3.0, 1.0, 31.0), system(0.64, bins=50))


def test_all_ways_to_a_covariance_agree(law: ml.JointLaw):
    other = ml.joint_law(ml.Flux(3.0, 1.0, 31.0), law.system)  # makes its matrix first
    matrix = other.covariance()
    w, v = np.random.default_rng(1).normal(size=(2, 3, 50))
    size = np.diag(matrix).max()
    assert matrix == pytest.approx(matrix.T, abs=1e-12 * size)
    assert np.linalg.eigvalsh(matrix).min() > 0
    assert law.variance == pytest.approx(np.diag(matrix), rel=1e-9)
    assert law.lag(1) == pytest.approx([matrix[j, (j + 1) % 50] for j in range(50)], abs=1e-8 * size)
    assert other.lag(-7) == pytest.approx(law.lag(-7), abs=1e-8 * size)
    assert law.window(w)[1] == pytest.approx(np.einsum("ki,ij,kj->k", w, matrix, w), rel=1e-8)
    assert law.covariance_of(w, v) == pytest.approx(np.einsum("ki,ij,kj->k", w, matrix, v), abs=1e-7 * size)
    assert law.covariance_of(w[0], v) == pytest.approx(w[0] @ matrix @ v.T, abs=1e-7 * size)
    assert law.count_variance == pytest.approx(matrix.sum(), rel=1e-8)
    assert law.count_mean == pytest.approx(law.mean.sum(), rel=1e-12)
    assert np.ndim(law.window(w[0])[1]) == 0
    matrix[0, 0] = -1.0
    assert other.covariance()[0, 0] > 0, "a copy"


def test_short_exposures_have_the_same_interface():
    law = joint_law(ml.Flux(3.0, 1.0, 50.0), system(0.64, cycles=2, bins=20))
    assert law.settled == -1
    matrix = law.covariance()
    w = np.random.default_rng(2).normal(size=20)
    assert law.window(w)[1] == pytest.approx(w @ matrix @ w, rel=1e-9)
    assert law.lag(1)[3] == pytest.approx(matrix[3, 4], rel=1e-9)
    assert law.variance == pytest.approx(np.diag(matrix), rel=1e-9)


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "background", "dead"), [(1.0, 30.0, 0.6375), (0.0, 300.0, 0.9), (2.0, 100.0, 1.45), (1000.0, 0.1, 0.3)]
)
def test_slow_sweeps_are_solved_all_the_same(signal: float, background: float, dead: float):
    """Where sweeps hardly contract (many background photons in a dead time), a factorisation takes over."""
    at = system(dead, cycles=3000, bins=32)
    law = joint_law(ml.Flux(signal, background, 50.0), at)
    exact = exposure_moments(ml.Flux(signal, background, 50.0), at)
    assert law.residual < 1e-9
    assert law.count_mean == pytest.approx(float(exact.mean), rel=1e-6)
    assert law.count_variance == pytest.approx(float(exact.variance), rel=2e-3)


def test_dark_pixel():
    law = joint_law(ml.Flux(0.0, 0.0, float("nan")), system(0.5))
    assert law.count_mean == 0
    assert law.count_variance == 0
    assert not law.covariance().any()


def test_bad_input(law: ml.JointLaw):
    at = law.system
    with pytest.raises(ValueError, match=r"flux must be one pixel, such as flux\[0, 0\], got pixels of shape \(2,\)"):
        joint_law(ml.Flux([1.0, 2.0], 1.0, 50.0), at)
    refused(r"flux must be one pixel.* shape \(2,\)", joint_law, ml.Flux(waveform=np.ones((2, 3)), background=1.0), at)
    refused(r"weights must be \(\.\.\., 50\), one for each bin, got shape \(3,\)", law.window, np.ones(3))
    refused("weights must be finite, got nan", law.window, np.full(50, np.nan))
    refused("weights must be real numbers, got dtype complex128", law.window, np.ones(50, complex), error=TypeError)
    with pytest.raises(ValueError, match=r"first and second must broadcast, got shapes \(2, 50\) and \(3, 50\)"):
        law.covariance_of(np.ones((2, 50)), np.ones((3, 50)))
    refused(r"lag must be an integer in \[-50, 50\], got 51", law.lag, 51)
    with pytest.raises(
        ConvergenceError, match=r"S = 20, B = 0 .* t_d = 1\.5 .* start-up transient does not end .* 300000"
    ):
        joint_law(ml.Flux(20.0, 0.0, 50.0), system(1.5, cycles=300_000))  # locked to every second pulse
