"""Afterpulses, twilight pulses and crosstalk: engines against each other and closed forms, bits, what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import GATE, PERIOD_NS, WAVE, Case, case, draw, make_system, refused, require, two_lobes, two_mean_vectors
from instrument.effect_checks import exact_against_sequential, mean_is
from scipy import stats
from test_reproducibility import image

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.engines import ENGINES
from mars_lidar.statistics import constant_light_rate
from tests.harness.command import fails, ok

BOTH = ["exact", "sequential"]
EXPONENTIAL = ml.Afterpulsing(probability=0.3, delay_ns=60.0)
SAMPLED = ml.Afterpulsing(probability=0.5, delays=(0.0, 3.0, 0.0, 1.0), bin_ns=37.0, generations=2)


# delays of hundreds of periods, whose fraction is drawn apart
LATE = {"dead_time_ns": 30.0, "afterpulsing": ml.Afterpulsing(probability=0.8, delay_ns=40_000.0)}
RECORDED = {"dead_time_ns": 100.0, "afterpulsing": SAMPLED, "electronics_dead_time_ns": 170.0, **GATE}
RECORDED |= {"jitter": ml.Jitter(sigma_ns=1.5), "max_events_per_exposure": 31}
CASES = [
    case(2.0, 1.0, dead_time_ns=75.0, afterpulsing=EXPONENTIAL),
    case(8.0, 0.3, "stationary", dead_time_ns=99.0, afterpulsing=SAMPLED, twilight_ns=9.0),
    case(0.3, 0.1, dead_time_ns=0.0, afterpulsing=ml.Afterpulsing(probability=0.9, delay_ns=900.0)),
    case(
        [1.0, 0.5],
        0.2,
        "stationary",
        dead_time_ns=220.0,
        afterpulsing=EXPONENTIAL,
        twilight_ns=130.0,
        delay=[0.1, 0.93],
    ),
    case(0.02, 0.01, cycles=3000, items=1500, pulse=ml.GaussianPulse(sigma_ns=0.3), **LATE),
    case(1.0, 1.0, dead_time_ns=200.0, twilight_ns=20.0, pulse=ml.SampledPulse(two_lobes(), 0.5)),
    case(2.0, 0.5, "stationary", dead_time_ns=30.0, mode="paralyzable", afterpulsing=EXPONENTIAL),
    case(2.0, 0.5, dead_time_ns=130.0, mode="synchronous", afterpulsing=SAMPLED),
    case(3.0, 0.5, dead_time_ns=40.0, afterpulsing=EXPONENTIAL, gate_step_ns=7.0, **GATE),
    case(3.0, 0.5, "stationary", **RECORDED),
    case(WAVE, 0.3, dead_time_ns=75.0, afterpulsing=EXPONENTIAL, twilight_ns=31.0),
    case(WAVE, 0.3, "stationary", dead_time_ns=220.0, afterpulsing=SAMPLED, twilight_ns=130.0),
    case(WAVE, 0.3, "stationary", dead_time_ns=30.0, mode="paralyzable", afterpulsing=EXPONENTIAL),
    case(WAVE, 0.0, dead_time_ns=0.0, afterpulsing=ml.Afterpulsing(probability=0.9, delay_ns=900.0), cycles=20),
    case(WAVE, 0.3, dead_time_ns=130.0, mode="synchronous", afterpulsing=SAMPLED, bins=50),
    case(WAVE, 0.5, "stationary", **RECORDED),
]


@pytest.mark.full
@pytest.mark.parametrize("made", CASES, ids=lambda made: made.name)
def test_exact_against_sequential(made: Case):
    exact_against_sequential(made)
    if made.system.detector.twilight_ns > 0.0:
        shares = []
        for k, engine in enumerate(BOTH):
            item, length = draw(ENGINES[engine], made, 7 + k, times=True).intervals()
            pulses = np.abs(length - made.system.dead_time_periods) < 1e-5
            shares.append(np.bincount(item[pulses], minlength=made.items).astype(float))
        require({"twilight pulses": two_mean_vectors(*shares)}, made.name)


@pytest.mark.full
@pytest.mark.parametrize("engine", BOTH)
def test_without_a_dead_time_it_is_a_hawkes_process(engine: str):
    """Its rate solves r = lambda + p f * r: in each harmonic of the period r_k = lambda_k / (1 - p F_k)."""
    p, tau = 0.4, 0.37  # periods
    traps = ml.Afterpulsing(probability=p, delay_ns=tau * PERIOD_NS)
    made = case(2.0, 0.5, "stationary", items=8000, cycles=20, bins=32, afterpulsing=traps)
    sample, fine = draw(ENGINES[engine], made, 3), 32
    k = np.fft.fftfreq(32 * fine, 1 / (32 * fine))
    photons = 2.0 * made.system.pulse.bin_energy(37.0, PERIOD_NS, 32 * fine) + 0.5 / (32 * fine)
    rate = np.fft.ifft(np.fft.fft(photons) / (1 - p / (1 + 2j * np.pi * k * tau))).real
    mean_is(sample.counts, 20 * 2.5 / (1 - p), f"{engine}: counts")
    part = sample.cube.reshape(-1, 8, 4).sum(-1)
    expected = 20 * rate.reshape(8, -1).sum(1)
    for j in range(8):
        mean_is(part[:, j].astype(float), expected[j], f"{engine}: bin {j}")
    # armed at the start: the mean relaxes from lambda to lambda / (1 - p) at the rate (1 - p) / tau
    armed = case(0.0, 2.0, items=20_000, cycles=2, bins=4, delay=0.0, afterpulsing=traps)
    decay = (1 - p) / tau
    mean = 2.0 / (1 - p) * (2 - p * -np.expm1(-decay * 2) / decay)
    mean_is(draw(ENGINES[engine], armed, 4).counts, mean, f"{engine}: armed")


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize(("probability", "twilight"), [(0.0, 15.0), (0.03, 3.0)])
def test_rate_under_constant_light(engine: str, probability: float, twilight: float):
    """Straka et al. 2020; of first order in the probability, which must be small beside the error of the mean."""
    traps = ml.Afterpulsing(probability=probability, delay_ns=30.0) if probability else None
    made = case(0.0, 3.0, "stationary", dead_time_ns=24.0, afterpulsing=traps, twilight_ns=twilight, cycles=300)
    rate = constant_light_rate(3.0e9 / PERIOD_NS, made.system.detector)
    mean_is(draw(ENGINES[engine], made, 5).counts, rate * 1e-9 * made.system.exposure_ns, engine)


def test_constant_light_rate_of_sampled_and_exponential_delays():
    exponential = ml.Detector(
        dead_time_ns=24.0,
        twilight_ns=3.0,
        dark_count_hz=1e5,
        detection_efficiency=0.5,
        afterpulsing=ml.Afterpulsing.after_dead_time(probability=0.05, delay_ns=40.0, dead_time_ns=24.0),
    )
    cells = tuple(np.diff(exponential.afterpulsing.cumulative(np.arange(1401) * 0.5)))
    sampled = replace(
        exponential,
        afterpulsing=ml.Afterpulsing(probability=exponential.afterpulsing.probability, delays=cells, bin_ns=0.5),
    )
    for rate in (0.0, 1e6, 3e7, 4e8):
        assert constant_light_rate(rate, sampled) == pytest.approx(constant_light_rate(rate, exponential), rel=1e-5)
    # dim light and few afterpulses: each photon is followed by those that outlive the dead time but for its twilight
    few = ml.Afterpulsing.after_dead_time(probability=1e-4, delay_ns=40.0, dead_time_ns=21.0)
    dim = replace(exponential, dark_count_hz=0.0, afterpulsing=few)
    assert constant_light_rate(0.02, dim) == pytest.approx(0.01 * 1.0001, rel=1e-7)
    refused("generations", constant_light_rate, 1e6, replace(exponential, afterpulsing=SAMPLED))
    with pytest.raises(ValueError, match=r"crosstalk.*sequential"):
        constant_light_rate(1e6, ml.Detector(dead_time_ns=1.0, crosstalk=ml.Crosstalk(probability=0.1)))


@pytest.mark.parametrize("kind", ["gaussian", "waveform"])
def test_afterpulses_take_no_random_numbers_of_the_photons(kind: str):
    """As good as never: the bits are those of the plain pixel."""
    flux, system = image(kind)
    never = ml.Afterpulsing(probability=1e-300, delay_ns=50.0)
    assert system.dead_time_periods % 1.0  # with whole periods the photons' times are found by another way
    on = system.replace(detector=replace(system.detector, afterpulsing=never))
    assert np.array_equal(ml.simulate(flux, on), ml.simulate(flux, system))


@pytest.mark.parametrize("mode", ["nonparalyzable", "synchronous", "gated"])
@pytest.mark.parametrize("kind", ["gaussian", "waveform"])
def test_releases_within_the_dead_time_change_no_bit(kind: str, mode: str):
    """They find the pixel blind; a paralyzable one would stay so for longer."""
    flux, system = image(kind)  # t_d = 63.75 ns
    gate = {"gate_start_ns": 10.0, "gate_width_ns": 70.0} if mode == "gated" else {}
    plain = system.replace(detector=ml.Detector(dead_time_ns=63.75, mode=mode, **gate))
    within = ml.Afterpulsing(probability=0.9, delays=(2.0, 0.0, 1.0), bin_ns=21.25)
    expected = ml.simulate(flux, plain, seed=3)
    result = ml.simulate(flux, plain.replace(detector=replace(plain.detector, afterpulsing=within)), seed=3)
    assert np.array_equal(result, expected)
    beyond = replace(within, delays=(2.0, 0.0, 1.0, 0.5))
    result = ml.simulate(flux, plain.replace(detector=replace(plain.detector, afterpulsing=beyond)), seed=3)
    assert not np.array_equal(result, expected)


ONE_WAY = [(r, c) for r in range(3) for c in range(3) if (r, c) != (1, 1)]


def line(shape: tuple[int, int], lit: tuple[int, int], **crosstalk: Any) -> tuple[ml.Flux, ml.System]:
    """An image in which one pixel is lit."""
    signal = np.zeros(shape)
    signal[lit] = 1.5
    system = make_system(45.0, 40, 50, sigma_ns=2.0, crosstalk=ml.Crosstalk(**crosstalk))
    return ml.Flux(signal, 0.0, 37.0), system


@pytest.mark.parametrize("towards", ONE_WAY)
def test_crosstalk_goes_where_the_kernel_says(towards: tuple[int, int]):
    kernel = np.zeros((3, 3))
    kernel[towards] = 7.0
    flux, system = line((5, 5), (2, 2), probability=1.0, kernel=kernel)
    cube = ml.simulate(flux, system, engine="sequential")[0]
    step = np.subtract(towards, 1)
    for k in range(3):  # along a line to the border of the image, at the same times
        assert np.array_equal(cube[tuple(2 + k * step)], cube[2, 2])
    assert cube.sum() == 3 * cube[2, 2].sum() > 0


def test_crosstalk_thins():
    """Next to a lit pixel a dark one, armed whenever that fires: Binomial(N, p), also as the lit one's echo."""
    flux, system = line((1, 2), (0, 0), probability=0.6, kernel=[[0, 0, 0], [1, 0, 1], [0, 0, 0]])
    cube = ml.simulate(flux, system, engine="sequential", realizations=4000, seed=2)
    lit, dark = cube.sum(-1)[:, 0].T.astype(float)
    mean_is(dark - 0.3 * lit, 0.0, "thinned")
    require({"variance": float(stats.chi2.sf(np.sum((dark - 0.3 * lit) ** 2 / (0.21 * lit)), 4000))}, "thinned")
    plain = system.replace(detector=system.detector.without("crosstalk"))
    alone = ml.simulate(flux, plain, engine="sequential", realizations=4000, seed=3).sum(-1)[:, 0, 0].astype(float)
    z = (lit.mean() - alone.mean()) / np.sqrt((lit.var() + alone.var()) / 4000)
    require({"lit": float(2 * stats.norm.sf(abs(z)))}, "thinned")


def test_crosstalk_bits_and_whole_images():
    random = np.random.default_rng(5)
    flux = ml.Flux(random.uniform(0, 2, (9, 7)), random.uniform(0, 1, (9, 7)), 37.0)
    effects = {"crosstalk": ml.Crosstalk(probability=0.2), "afterpulsing": SAMPLED}
    system = make_system(45.0, 30, 50, sigma_ns=2.0, start="stationary", **effects)
    whole = ml.simulate(flux, system, engine="sequential", realizations=3)
    single = ml.simulate(flux, system, engine="sequential", first_realization=1, threads=1)
    assert np.array_equal(single[0], whole[1])
    assert np.array_equal(
        ml.simulate_timestamps(flux, system, engine="sequential", realization=2).histogram(), whole[2]
    )
    with pytest.raises(ValueError, match="pixel_index must be that of a whole image"):
        ml.simulate(flux[2:4], system, engine="sequential", pixel_index=np.arange(14, 28))
    refused(r"engine 'exact' does not do crosstalk.*use 'sequential'", ml.simulate, flux, system)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ml.Afterpulsing(probability=1.0, delay_ns=1.0), "below 1.*got 1.0"),
        (lambda: ml.Afterpulsing(probability=0.0, delay_ns=1.0), "probability of afterpulsing must be"),
        (lambda: ml.Afterpulsing(probability=0.1), "one of delay_ns"),
        (lambda: ml.Afterpulsing(probability=0.1, delay_ns=1.0, bin_ns=1.0), "belong together"),
        (lambda: ml.Afterpulsing(probability=0.1, delays=(), bin_ns=1.0), "delays of afterpulsing"),
        (lambda: ml.Afterpulsing(probability=0.1, delays=(1.0, float("nan")), bin_ns=1.0), "finite and non-negative"),
        (lambda: ml.Afterpulsing(probability=0.1, delays=(0.0,), bin_ns=1.0), "positive and finite sum"),
        (lambda: ml.Afterpulsing(probability=0.1, delay_ns=1.0, generations=0), "generations must be"),
        (lambda: ml.Crosstalk(probability=1.5), "probability of crosstalk must be"),
        (lambda: ml.Crosstalk(probability=0.1, kernel="6"), "kernel of crosstalk"),
        (lambda: ml.Crosstalk(probability=0.1, kernel=np.ones((3, 3))), "0 in the middle"),
        (lambda: ml.Crosstalk(probability=0.1, kernel=np.ones((5, 5))), "3 x 3"),
        (lambda: ml.Detector(dead_time_ns=0.0, crosstalk=ml.Crosstalk(probability=0.1)), "dead_time_ns > 0"),
        (lambda: ml.Detector(dead_time_ns=10.0, twilight_ns=11.0), r"twilight_ns must lie in \[0, 10\]"),
        (lambda: ml.Detector(dead_time_ns=10.0, twilight_ns=1.0, mode="synchronous"), "mode 'nonparalyzable'"),
        (lambda: ml.Detector(dead_time_ns=10.0, afterpulsing=0.1), "must be of type Afterpulsing"),  # type: ignore[arg-type]
        (lambda: ml.Detector.preset("spad"), "excelitas-spcm-aqrh"),
        (lambda: case(1, 1, dead_time_ns=1.0, afterpulsing=replace(EXPONENTIAL, delay_ns=1e9)), "1e6 periods"),
    ],
)
def test_refused(make: Any, message: str):
    refused(message, make, error=(ValueError, TypeError))


def test_presets():
    assert ml.Crosstalk.from_dict({"probability": 0.1, "kernel": 4}) == ml.Crosstalk(probability=0.1, kernel="4")
    module = ml.Detector.preset("excelitas-spcm-aqrh")
    assert ml.Detector.from_dict(module.to_dict()) == module
    assert ml.Detector.from_dict({"preset": "excelitas-spcm-aqrh", "dead_time_ns": 30.0}).dead_time_ns == 30.0
    for name, dead, dark in (("thorlabs-spcm20a", 35.0, 25.0), ("thorlabs-spcm50a", 45.0, 150.0)):
        assert ml.Detector.preset(name) == ml.Detector(dead_time_ns=dead, dark_count_hz=dark)
    # all of its afterpulses outlive the recovery
    assert module.afterpulsing.cumulative(module.dead_time_ns) == pytest.approx(0.0, abs=1e-12)


def test_command_line(tmp_path: Path):
    room = ("simulate", "--scene", "room", "--size", "4", "--no-picture", "-o")
    file = tmp_path / "module.npz"
    ok(*room, file, "--detector", "excelitas-spcm-aqrh", "--twilight-ns", "1.5")
    detector = io.load(file).system.detector
    assert detector == replace(ml.Detector.preset("excelitas-spcm-aqrh"), twilight_ns=1.5)
    file = tmp_path / "crosstalk.npz"
    ok(*room, file, "--crosstalk", "0.1", "--crosstalk-kernel", "4", "--engine", "sequential")
    cube = io.load(file)
    assert cube.system.detector.crosstalk == ml.Crosstalk(probability=0.1, kernel="4")
    assert np.array_equal(io.regenerate(cube), cube.histogram)
    refused("rows must be all 4 rows with crosstalk", io.regenerate, cube, rows=slice(1, 2))
    for options, message in (
        (("--afterpulse-delay-ns", "3"), "belong together"),
        (("--crosstalk-kernel", "4"), "belongs to --crosstalk"),
        (("--crosstalk", "0.1"), "use 'sequential'"),
        (("--detector", "spad"), "excelitas-spcm-aqrh"),
    ):
        fails(message, *room, tmp_path / "not.npz", *options)


@pytest.mark.parametrize("engine", ["exact", "sequential"])
@pytest.mark.parametrize(
    ("signal", "background", "dead", "twilight"),
    [(8.0, 0.023, 105.567, 31.16), (8.0, 0.023, 130.2, 31.16), (1.9, 0.63, 357.0, 344.0)],
)
def test_ticking_pixels_have_no_stationary_start(
    engine: str, signal: float, background: float, dead: float, twilight: float
):
    """The mean count of the first periods was up to 4 % off in `exact`, and drifted in `sequential`."""
    system = make_system(dead, 100, 50, sigma_ns=0.22, start="stationary", twilight_ns=twilight)
    flux = ml.Flux(signal, background, 99.99)
    with pytest.raises(ValueError, match=r"start must be 'armed' where more than 5 photons .* got 'stationary' with"):
        ml.simulate(flux, system, engine=engine)
    ml.simulate(flux, system.replace(start="armed"), engine=engine)
    dim = ml.Flux(0.1 * signal, background, 99.99)
    ml.simulate(dim, system, engine=engine)


@pytest.mark.parametrize("dead", [100.0, 200.0])
def test_stationary_start_forgets_sequences_of_twilight_pulses(dead: float):
    """Of a pixel of 4.7 photons within the twilight, against the mean of long exposures: 10 standard errors off before.

    The mean of two periods is that of any two. Whatever the start, 40,000 periods forget it: a wrong start moves their
    mean by less than a tenth of the standard error. False alarms: 1e-6.
    """
    flux, items = ml.Flux(4.5, 0.386, 50.0), 40_000
    system = make_system(dead, 2, 4, sigma_ns=0.9, start="stationary", twilight_ns=64.65)
    drawn = ml.simulate(flux, system, engine="exact", realizations=items, seed=21)[:, 0, 0].astype(float)
    many = system.replace(cycles=40_000)
    long = ml.simulate(flux, many, engine="exact", realizations=400, seed=9)[:, 0, 0] / 20_000.0
    error = np.sqrt(drawn.var(0) / items + long.var(0, ddof=1) / len(long))
    z = (drawn.mean(0) - long.mean(0)) / error
    assert np.abs(z).max() < 5.2, z  # four bins
