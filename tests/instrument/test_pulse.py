"""Pulses: energy, origin, wrapping, and that the sampler's tables agree with the distribution function."""

import pickle

import numpy as np
import pytest
from harness import make_system, measured_pulse, refused, two_lobes
from scipy import integrate, stats

import mars_lidar as ml
from mars_lidar.instrument.pulse import pulse_from_dict

RECORD = np.array([0.0, 3.0, 9.0, 4.0, 0.0, 0.0, 1.0, 2.0, 0.0])
PULSES = {
    "gaussian": ml.GaussianPulse(sigma_ns=1.7),
    "wide": ml.GaussianPulse(sigma_ns=30.0),
    "peak": ml.SampledPulse(RECORD, 2.0),
    "centroid": ml.SampledPulse(RECORD, 2.0, "centroid"),
    "first": ml.SampledPulse(RECORD, 2.0, "first"),
    "whole period": ml.SampledPulse(np.arange(1.0, 51.0), 2.0, "first"),
    "one sample": ml.SampledPulse([5.0], 3.0),
    "lobes": ml.SampledPulse(two_lobes(), 0.4, "centroid"),
}


@pytest.mark.parametrize("name", PULSES)
def test_serialises_hashes_compares(name: str):
    pulse = PULSES[name]
    same = pulse_from_dict(pulse.to_dict())
    assert same == pulse
    assert hash(same) == hash(pulse)
    assert pickle.loads(pickle.dumps(pulse)) == pulse
    assert pulse != ml.GaussianPulse(sigma_ns=0.123)
    assert pulse != "pulse"
    assert "Pulse(" in repr(pulse)


def test_frozen():
    sampled, gaussian = PULSES["peak"], PULSES["gaussian"]
    with pytest.raises(AttributeError):
        gaussian.sigma_ns = 2.0
    with pytest.raises(AttributeError, match="frozen"):
        sampled.bin_ns = 2.0
    with pytest.raises(AttributeError, match="frozen"):
        del sampled.values
    with pytest.raises(ValueError, match="read-only"):
        sampled.values[0] = 5.0
    source = RECORD.copy()
    copy = ml.SampledPulse(source, 2.0)
    source[:] = 1.0
    assert copy == sampled  # the caller's array is the caller's


def test_full_width_at_half_maximum():
    pulse = ml.GaussianPulse.from_fwhm(fwhm_ns=2.0)
    assert pulse.fwhm_ns == pytest.approx(2.0)
    assert pulse.sigma_ns == pytest.approx(2.0 / 2.354820045)
    density = stats.norm(scale=pulse.sigma_ns).pdf
    assert density(1.0) == pytest.approx(0.5 * density(0.0))


@pytest.mark.parametrize("name", PULSES)
def test_cumulative_energy(name: str):
    pulse = PULSES[name]
    low, high = pulse.support_ns()
    t = np.linspace(low - 1.0, high + 1.0, 4001)
    energy = pulse.cumulative(t)
    assert np.all(np.diff(energy) >= 0)
    assert energy[0] == pytest.approx(0.0, abs=1e-16)
    assert energy[-1] == pytest.approx(1.0, abs=1e-15)
    assert pulse.cumulative(low) == pytest.approx(0.0, abs=1e-16)
    assert pulse.cumulative(high) == pytest.approx(1.0, abs=1e-15)
    assert pulse.cumulative(low + 1e-3) > 0


@pytest.mark.parametrize("name", PULSES)
@pytest.mark.parametrize("delay", [0.0, 0.3, 50.0, 99.9, 250.0, -1e4])
def test_bin_energies(name: str, delay: float):
    """They sum to one and wrap: checked against a sum over neighbouring periods."""
    pulse = PULSES[name]
    energy = pulse.bin_energy(delay, 100.0, 64)
    assert energy.shape == (64,)
    assert energy.min() >= -1e-15
    assert energy.sum() == pytest.approx(1.0, abs=1e-12)
    edges = np.linspace(0.0, 100.0, 65) - delay % 100.0
    direct = sum(np.diff(pulse.cumulative(edges + 100.0 * k)) for k in range(-5, 6))
    assert energy == pytest.approx(direct, abs=1e-11)


def test_bin_energies_of_many_delays():
    pulse = PULSES["lobes"]
    delays = np.array([[1.0, 20.0, 99.0], [5.0, 6.0, 7.0]])
    energy = pulse.bin_energy(delays, 100.0, 32)
    assert energy.shape == (2, 3, 32)
    assert np.array_equal(energy[1, 0], pulse.bin_energy(5.0, 100.0, 32))


def test_gaussian_energy_is_that_of_the_density():
    energy = ml.GaussianPulse(sigma_ns=1.7).bin_energy(20.0, 100.0, 50)
    for k in (0, 8, 9, 10, 14):
        exact = integrate.quad(stats.norm(20.0, 1.7).pdf, 2.0 * k, 2.0 * k + 2, epsabs=1e-14)[0]
        assert energy[k] == pytest.approx(exact, abs=1e-12)


def test_lower_tail_is_relatively_accurate():
    assert ml.GaussianPulse(sigma_ns=2.0).cumulative(-16.0) == pytest.approx(stats.norm.cdf(-8.0), rel=1e-9)


@pytest.mark.parametrize(("origin", "first_edge"), [("peak", -2.5), ("first", 0.0)])
def test_origin(origin: str, first_edge: float):
    """What a return at delay 0 does: with "peak" the centre of the largest sample is at 0."""
    pulse = ml.SampledPulse(RECORD, 1.0, origin)
    energy = pulse.bin_energy(-first_edge, 100.0, 100)
    assert energy[:9] * RECORD.sum() == pytest.approx(RECORD, abs=1e-9)


def test_cyclic_record_is_put_together_again():
    """A rising edge stored at the end of the array: the same pulse, however the record was rotated."""
    smooth = np.exp(-0.5 * ((np.arange(40) - 20) / 3.0) ** 2) * (1 + 0.3 * (np.arange(40) > 20))
    for origin in ("peak", "centroid"):
        expected = ml.SampledPulse(smooth, 0.5, origin).bin_energy(30.0, 100.0, 1000)
        for rotation in (1, 17, 20, 39):
            rolled = ml.SampledPulse(np.roll(smooth, rotation), 0.5, origin)
            assert rolled.bin_energy(30.0, 100.0, 1000) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("floor", [0.0, 1e-3])
def test_decay_longer_than_half_of_its_record_stays_behind_its_peak(floor: float):
    """Cut opposite its peak, a third of this response would come before it."""
    decay = np.where(np.arange(200) < 20, 0.0, np.exp(-(np.arange(200) - 20.0) / 60.0))
    record = decay + floor * np.random.default_rng(5).random(200)
    given = ml.SampledPulse(record, 0.1, "first").bin_energy(30.0 - 2.05, 100.0, 1000)
    assert ml.SampledPulse(record, 0.1).bin_energy(30.0, 100.0, 1000) == pytest.approx(given, abs=1e-12)


def test_centroid_is_the_mean_of_a_compact_pulse():
    record = np.zeros(200)
    record[80:87] = [1, 4, 9, 5, 3, 1, 1]
    pulse = ml.SampledPulse(record, 0.1, "centroid")
    t = np.linspace(-5, 5, 200_001)
    mean = np.sum(0.5 * (t[1:] + t[:-1]) * np.diff(pulse.cumulative(t)))
    assert mean == pytest.approx(0.0, abs=2e-3)  # circular, so not to the last digit


@pytest.mark.parametrize(
    "values", [np.float32(RECORD), RECORD.astype(int), RECORD.tolist(), 1e200 * RECORD, 1e-200 * RECORD]
)
def test_scale_and_type_of_the_record_do_not_matter(values):
    expected = PULSES["peak"].bin_energy(20.0, 100.0, 50)
    assert ml.SampledPulse(values, 2.0).bin_energy(20.0, 100.0, 50) == pytest.approx(expected, abs=1e-12)


def test_bool_records_are_taken_as_numbers():
    assert ml.SampledPulse([False, True], 1.0).support_ns() == (-0.5, 0.5)


def test_empty_ends_are_left_out():
    pulse = ml.SampledPulse([0, 0, 1, 2, 0, 1, 0], 1.0, "first")
    assert pulse.support_ns() == (2.0, 6.0)
    assert pulse.cumulative([1.9, 2.0, 3.0, 4.5, 6.0]) == pytest.approx([0, 0, 0.25, 0.75, 1.0])


def test_record_as_long_as_the_period_is_taken():
    """To rounding: 3 x 0.1 is more than 0.3."""
    system = make_system(0.0, 1, 3, pulse=ml.SampledPulse([1, 2, 3], 0.1), period_ns=0.3)
    assert ml.simulate(ml.Flux(5.0, 0.0, 0.1), system, seed=1).sum() > 0


@pytest.mark.parametrize("name", ["face_free_8ps", "face_free_unimodal_8ps"])
def test_measured_records(name: str):
    for origin in ("peak", "centroid", "first"):
        pulse = measured_pulse(name, 10.0, origin)
        assert pulse.bin_energy(3.3, 100.0, 5000).sum() == pytest.approx(1.0, abs=1e-12)
        assert pulse_from_dict(pulse.to_dict()) == pulse
    low, high = measured_pulse(name, 10.0).support_ns()
    assert -5.0 <= low < 0 < high <= 5.0


def test_only_the_abstract_pulse_is_abstract():
    refused("", ml.Pulse, error=TypeError)


@pytest.mark.parametrize("share", [0.3, 0.5, 1.0])
def test_wide_trains_by_frequency_are_those_by_pulses(share: float):
    """The Fourier series of a wide Gaussian's train against the sum over its pulses, the same origin included."""
    pulse, period = ml.GaussianPulse(sigma_ns=10.0 * share), 10.0
    t = np.linspace(-25.0, 25.0, 1001)
    by_pulses = ml.Pulse.wrapped_cumulative(pulse, t, period)
    np.testing.assert_allclose(
        pulse.wrapped_cumulative(t, period), by_pulses, atol=2e-14, rtol=0.0
    )  # 19 pulses round more
    assert pulse.wrapped_cumulative(t + period, period) - pulse.wrapped_cumulative(t, period) == pytest.approx(1.0)
