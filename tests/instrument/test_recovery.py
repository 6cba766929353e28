"""Recovery of the sensitivity after the dead time: against every arrival in NumPy, closed forms, engines, bits."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from harness import EVERYTHING, check, draw, refused, require
from harness.cases import GATE, PERIOD_NS, WAVE, Case, case, two_lobes, waveform_flux
from instrument.effect_checks import bits_do_not_depend, exact_against_sequential, mean_is
from scipy import integrate, stats
from test_reproducibility import image

import mars_lidar as ml
from mars_lidar import statistics
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import Engine, Records, Task
from mars_lidar.instrument.effects import EFFECTS
from tests.domain import simulator
from tests.domain.systems import Case as Pixel

BOTH = ["exact", "sequential"]


class EveryArrival(Engine):
    """The definition in double precision: the simulator of the sweep, for one return or a waveform."""

    name = "every arrival"
    description = "an oracle of NumPy"
    modes = ("nonparalyzable", "gated")
    effects = EFFECTS

    def histogram(self, task: Task, out: Any) -> None:
        """Of the same draws as the timestamps."""
        item, time = self._registered(task)
        place = np.minimum((time % 1.0 * task.system.bins).astype(np.int64), task.system.bins - 1)
        out[:] = np.bincount(item * out.shape[1] + place, minlength=out.size).reshape(out.shape)

    def records(self, task: Task, expected: float) -> Records:
        """In order of the items."""
        item, time = self._registered(task)
        offsets = np.concatenate([[0], np.cumsum(np.bincount(item, minlength=task.items))])
        place = np.minimum((time % 1.0 * task.system.bins).astype(np.int32), task.system.bins - 1)
        return Records(offsets, time, np.floor(time).astype(np.int32), place)

    def _registered(self, task: Task) -> tuple[Any, Any]:
        """In blocks of 64 items, so that the first are the same however many follow."""
        light = task.flux.signal.flat[0], task.flux.delay_ns.flat[0] / PERIOD_NS, task.flux.background.flat[0]
        wave = None if task.flux.waveform is None else task.flux.waveform.reshape(-1, task.flux.waveform.shape[-1])[0]
        pixel = Pixel("by hand", "any", task.system, light[:1], light[1:2], light[2], wave)
        blocks = [
            (first, *simulator.registered(pixel, min(64, task.items - first), task.seed * 10**6 + first))
            for first in range(0, task.items, 64)
        ]
        item = np.concatenate([first + owner for first, owner, _ in blocks])
        time = np.concatenate([times for *_, times in blocks])
        order = np.lexsort((time, item))
        return item[order], time[order]


ARMED = [
    case(2.0, 1.0, dead_time_ns=0.0, recovery_ns=40.0),
    case(2.0, 1.0, dead_time_ns=75.0, recovery_ns=30.0),
    case(0.5, 0.2, dead_time_ns=75.0, recovery_ns=900.0),
    case(5.0, 0.5, dead_time_ns=300.0, recovery_ns=15.0),
    case(3.0, 2.0, dead_time_ns=512.5, recovery_ns=5000.0, cycles=120, items=2000),
    # bright: many arrivals in vain, within a narrow pulse
    case(
        400.0, 20.0, dead_time_ns=100.0, recovery_ns=60.0, cycles=10, items=2000, pulse=ml.GaussianPulse(sigma_ns=0.05)
    ),
    case(300.0, 0.0, dead_time_ns=0.0, recovery_ns=3.0, cycles=8, items=2000, pulse=ml.GaussianPulse(sigma_ns=0.01)),
    case(WAVE, 0.3, dead_time_ns=75.0, recovery_ns=50.0),
    case(WAVE, 2.0, dead_time_ns=0.0, recovery_ns=400.0),
    case(3.0, 0.5, dead_time_ns=40.0, recovery_ns=80.0, **GATE),
    case(3.0, 0.5, dead_time_ns=0.0, recovery_ns=20.0, **GATE),
    case(WAVE, 0.5, dead_time_ns=100.0, recovery_ns=70.0, **GATE),
]


@pytest.mark.full
@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("made", ARMED, ids=lambda made: made.name)
def test_against_every_arrival(engine: str, made: Case):
    check(ENGINES[engine], made, EveryArrival(), EVERYTHING)


TRAPS = ml.Afterpulsing(probability=0.4, delay_ns=60.0)
TOGETHER = [
    case(2.0, 1.0, "stationary", dead_time_ns=75.0, recovery_ns=30.0),
    case(2.0, 0.1, "stationary", dead_time_ns=0.0, recovery_ns=250.0),
    case(8.0, 0.3, "stationary", dead_time_ns=300.0, recovery_ns=15.0),
    case(1.0, 0.5, "stationary", dead_time_ns=99.5, recovery_ns=1000.0, items=800),
    case(WAVE, 0.3, "stationary", dead_time_ns=220.0, recovery_ns=90.0),
    case(3.0, 0.5, "stationary", dead_time_ns=100.0, recovery_ns=70.0, **GATE),
    case(3.0, 0.5, dead_time_ns=40.0, recovery_ns=70.0, gate_step_ns=7.0, **GATE),
    case([1.0, 0.5], 0.2, dead_time_ns=220.0, recovery_ns=45.0, delay=[0.1, 0.93]),
    case(1.0, 1.0, dead_time_ns=100.0, recovery_ns=45.0, pulse=ml.SampledPulse(two_lobes(), 0.5)),
    # with what else avalanches leave behind, and what becomes of registrations
    case(2.0, 1.0, dead_time_ns=75.0, recovery_ns=40.0, afterpulsing=TRAPS),
    case(2.0, 1.0, "stationary", dead_time_ns=120.0, recovery_ns=40.0, afterpulsing=TRAPS, twilight_ns=30.0),
    case(WAVE, 0.5, dead_time_ns=75.0, recovery_ns=40.0, afterpulsing=TRAPS, twilight_ns=31.0),
    case(
        3.0,
        0.5,
        dead_time_ns=60.0,
        recovery_ns=40.0,
        electronics_dead_time_ns=170.0,
        jitter=ml.Jitter(sigma_ns=1.5),
        max_events_per_exposure=21,
        code_density=(1.2, 0.8),
        detection_efficiency=0.7,
        dark_count_hz=1e5,
    ),
]


@pytest.mark.full
@pytest.mark.parametrize("made", TOGETHER, ids=lambda made: made.name)
def test_exact_against_sequential(made: Case):
    exact_against_sequential(made)


@pytest.mark.full
@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize(
    ("rate", "dead", "recovery"),
    [(3.0, 0.37, 0.7), (3.0, 0.0, 0.7), (0.2, 5.0, 30.0), (50.0, 2.25, 40.0), (3000.0, 0.5, 1.0), (4.0, 64.0, 1e5)],
)
@pytest.mark.parametrize("wave", [False, True], ids=["", "waveform"])
def test_waits_under_constant_light(engine: str, rate: float, dead: float, recovery: float, wave: bool):
    """Of hazard b (1 - e^(-u / r)) at u after the dead time: the cumulated hazard of waits is exponential.

    Krause and Walenta, arXiv 2507.10361. Waits are cut off by the end of the exposure: those that are seen are uniform
    in the share of what could have passed up to it.
    """
    wait = dead + integrate.quad(lambda u: np.exp(-rate * cumulated(u, recovery)), 0, np.inf, limit=500)[0]
    cycles = int(min(2e4, np.ceil(3000 * wait)))
    if engine == "sequential":  # it draws every arrival
        cycles = int(min(cycles, 1e6 / rate))
    made = case(0.0, rate, dead_time_ns=dead * PERIOD_NS, recovery_ns=recovery * PERIOD_NS, cycles=cycles, items=16)
    if wave:
        made = replace(made, flux=waveform_flux(np.full(16, rate / 16), 0.0))
    sample = draw(ENGINES[engine], made, 11, times=True)
    item, length = sample.intervals()
    passed = rate * cumulated(np.maximum(length - dead, 0.0), recovery)
    assert sample.records is not None
    begin = sample.records.times[np.flatnonzero(np.diff(np.repeat(np.arange(sample.counts.size), sample.counts)) == 0)]
    remaining = rate * cumulated(np.maximum(made.system.cycles - begin - dead, 0.0), recovery)
    uniform = np.expm1(-passed) / np.expm1(-np.maximum(remaining, 1e-300))
    assert item.size > 300
    selected = remaining > 0.0
    require(
        {"waits": float(stats.kstest(uniform[selected], "uniform").pvalue)}, f"{engine}, {rate}, {dead}, {recovery}"
    )


def cumulated(u: Any, recovery: float) -> Any:
    """The hazard in units of the light, from the end of the dead time on, without cancellation for small u."""
    x = np.asarray(u) / recovery
    small = x * x * (0.5 - x / 6.0 + x * x / 24.0)
    return recovery * np.where(x < 1e-3, small, x + np.expm1(-x))


@pytest.mark.parametrize("photons", [1e-12, 1e-3, 0.4, 30.0, 999.0, 1001.0, 1e6, 1e10])
@pytest.mark.parametrize("twilight", [0.0, 2.0])
def test_rate_under_constant_light(photons: float, twilight: float):
    """Against the integral of the survival e^(-H(u)), for so many photons in a time constant."""
    rate = min(photons / 8.0, 2.0)
    recovery = photons / rate
    detector = ml.Detector(dead_time_ns=5.0, recovery_ns=recovery, twilight_ns=twilight)
    scale = max(1.0 / rate, np.sqrt(recovery / rate))
    wait = integrate.quad(lambda x: scale * np.exp(-rate * cumulated(x * scale, recovery)), 0, 60, limit=500)[0]
    expected = 1e9 / (5.0 + np.exp(-rate * twilight) * wait)
    assert statistics.constant_light_rate(1e9 * rate, detector) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("engine", BOTH)
def test_mean_rate_of_the_engines(engine: str):
    made = case(0.0, 6.0, "stationary", dead_time_ns=24.0, recovery_ns=35.0, twilight_ns=4.0, cycles=300, items=1600)
    expected = statistics.constant_light_rate(6e9 / PERIOD_NS, made.system.detector) * 1e-9 * made.system.exposure_ns
    counts = draw(ENGINES[engine], made, 5).counts
    mean_is(counts, expected, engine)


def test_a_rested_pixel_is_fully_sensitive():
    """An armed start has no registration before it: the first one comes as it does without recovery."""
    made = case(0.0, 2.0, dead_time_ns=50.0, recovery_ns=500.0, cycles=40, items=4000)
    for k, engine in enumerate(BOTH):
        records = draw(ENGINES[engine], made, 5 + k, times=True).records
        assert records is not None
        first = records.times[records.offsets[:-1][np.diff(records.offsets) > 0]]
        require({"first": float(stats.kstest(first, "expon", args=(0.0, 0.5)).pvalue)}, engine)


@lru_cache
def plain_and(recovery_ns: float, kind: str) -> tuple[Any, Any]:
    flux, system = image(kind)
    on = system.replace(detector=replace(system.detector, recovery_ns=recovery_ns))
    return ml.simulate(flux, on, seed=3), ml.simulate(flux, system, seed=3)


@pytest.mark.parametrize("kind", ["gaussian", "waveform"])
def test_no_recovery_is_none_and_a_short_one_nearly(kind: str):
    """It takes no random number of the photons': what is over before the next one changes no bit."""
    assert image(kind)[1].dead_time_periods % 1.0  # with whole periods the photons' times are found by another way
    assert np.array_equal(*plain_and(0.0, kind))
    assert np.array_equal(*plain_and(1e-200, kind))
    assert not np.array_equal(*plain_and(5.0, kind))


@pytest.mark.full
@pytest.mark.parametrize("engine", BOTH)
def test_a_short_recovery_has_the_law_of_none(engine: str):
    """Of 1e-6 periods: with 30 photons a period it is missed by 3e-5 of them."""
    none = case(20.0, 10.0, dead_time_ns=75.0, cycles=30)
    short = case(20.0, 10.0, dead_time_ns=75.0, recovery_ns=1e-4, cycles=30)
    check(ENGINES[engine], short, ENGINES["exact"], EVERYTHING)
    law = statistics.mean_histogram(ml.Flux(20.0, 10.0, 37.0), none.system)
    sample = draw(ENGINES[engine], short, 9)
    mean_is(sample.counts, law.sum(), engine)


AVALANCHES = {"afterpulsing": ml.Afterpulsing(probability=0.3, delay_ns=50.0), "twilight_ns": 2.0}


@pytest.mark.parametrize(
    "kind", ["gaussian", "returns", "sampled", "long dead time", "waveform", "stationary waveform"]
)
@pytest.mark.parametrize("effects", [{"recovery_ns": 25.0}, AVALANCHES], ids=["recovery", "avalanches"])
def test_bits_are_those_of_every_level_thread_and_part(kind: str, effects: dict[str, Any]):
    flux, system = image(kind)
    bits_do_not_depend(flux, system.replace(detector=replace(system.detector, **effects)))


def test_what_has_no_law_says_so():
    system = case(1.0, 1.0, dead_time_ns=75.0, recovery_ns=5.0).system
    refused("cramer_rao does not do recovery_ns", ml.cramer_rao, ml.Flux(1.0, 1.0, 37.0), system)
    both = replace(system.detector, afterpulsing=TRAPS)
    with pytest.raises(ValueError, match="constant_light_rate treats recovery_ns or afterpulsing, not both, got 5 and"):
        statistics.constant_light_rate(1e6, both)
    with pytest.warns(UserWarning, match="no reconstruction method models recovery_ns"):
        ml.reconstruct(np.ones((1, 1, 64), np.uint16), system)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ml.Detector(dead_time_ns=1.0, recovery_ns=-1.0), r"recovery_ns must be a finite number.*got -1"),
        (lambda: ml.Detector(dead_time_ns=1.0, recovery_ns=1.0, mode="paralyzable"), "recovery_ns.*'paralyzable'"),
        (lambda: ml.Detector(dead_time_ns=1.0, recovery_ns=1.0, mode="synchronous"), "recovery_ns.*'synchronous'"),
        (lambda: case(1.0, 1.0, dead_time_ns=1.0, recovery_ns=1.1e8), r"recovery_ns must be at most 1e\+08 ns"),
        (
            lambda: ml.simulate(
                ml.Flux(1e5, 0.0, 0.0), case(1.0, 1.0, dead_time_ns=0.0, recovery_ns=1e8, cycles=10**6).system
            ),
            "arrivals after a dead time, those during recovery_ns included",
        ),
    ],
)
def test_refused(make: Any, message: str):
    refused(message, make, error=(ValueError, TypeError))
