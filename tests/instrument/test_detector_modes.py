"""Paralyzable, synchronous and gated pixels: both engines that do them, against each other and where no law knows them.

Their laws are compared with the engine "exact", and with closed forms, in tests/statistics/test_detector_statistics.py.
"""

from dataclasses import replace

import numpy as np
import pytest
from harness import COUNTS, EVERYTHING, JOINT, SHAPE, Law, check, draw, law_of
from harness.cases import PERIOD_NS, Case, flux_of, random_cases, two_lobes, waveform_flux
from scipy import stats

from mars_lidar import Detector, Flux, GaussianPulse, System
from mars_lidar.engines import ENGINES
from mars_lidar.instrument.detector import MODES

BOTH = ["exact", "sequential"]


def gate(start: float, width: float, dead: float, step: float = 0.0, cycles: int = 1) -> Detector:
    """A gated detector, all in periods."""
    return Detector(
        dead_time_ns=dead * PERIOD_NS,
        mode="gated",
        gate_start_ns=start * PERIOD_NS,
        gate_width_ns=width * PERIOD_NS,
        gate_step_ns=step * PERIOD_NS,
        gate_cycles=cycles,
    )


def detector(mode: str, dead: float) -> Detector:
    return gate(0.3, 0.25, dead) if mode == "gated" else Detector(dead_time_ns=dead * PERIOD_NS, mode=mode)


def pulsed(signal: float, background: float, pixel: Detector, *, items: int = 6000, **changes: object) -> Case:
    system = System(
        period_ns=PERIOD_NS, cycles=100, bins=64, pulse=GaussianPulse(sigma_ns=2.0), detector=pixel
    ).replace(**changes)
    name = f"{pixel.mode}, S {signal:g}, B {background:g}, t_d {system.dead_time_periods:g}, {system.start}"
    return Case(name, flux_of(signal, background, 0.37), system, items)


def open_share(system: System, parts: int) -> np.ndarray:
    """Share of the exposure's periods for which each of fine parts of the period lies in the gate, by brute force."""
    pixel, period = system.detector, system.period_ns
    phase = (np.arange(parts) + 0.5) / parts
    turns = np.arange(system.cycles) // pixel.gate_cycles
    start = (pixel.gate_start_ns + pixel.gate_step_ns * turns) / period
    return np.mean([(phase - s) % 1.0 < pixel.gate_width_ns / period for s in start], axis=0)


def gated_photons(case: Case) -> np.ndarray:
    """Photons per period and bin inside of the gate (bins,), on 640 parts of a bin: the gate's edges must fit them."""
    flux, system, fine = case.flux, case.system, 640
    parts = system.bins * fine
    if flux.waveform is not None:
        energy = np.repeat(flux.waveform[0, 0], parts // flux.waveform.shape[-1])
        energy = energy * flux.waveform.shape[-1] / parts
    else:
        energy = sum(
            s * system.pulse.bin_energy(tau, system.period_ns, parts)
            for s, tau in zip(flux.returns_signal[:, 0, 0], flux.returns_delay_ns[:, 0, 0], strict=True)
        )
    energy = (energy + flux.background[0, 0] / parts) * open_share(system, parts)
    return energy.reshape(system.bins, fine).sum(1)


@pytest.mark.full
@pytest.mark.parametrize(
    "case", random_cases(32, seed=31, photons=8e5, least=1000, most=4000, family="mode"), ids=lambda case: case.name
)
def test_random_system(case: Case):
    check(ENGINES["exact"], case, ENGINES["sequential"], EVERYTHING)


@pytest.mark.parametrize("mode", ["synchronous", "gated"])
def test_armed_at_the_middle_of_the_pulse(mode: str):
    """Clock or gate arm the pixel exactly there every period, where the sampler's tables jump: a width that rounds."""
    pixel, at = (gate(0.25, 0.25, 0.0), 0.25) if mode == "gated" else (detector(mode, 0.0), 0.0)
    case = pulsed(1.0, 0.5, pixel, pulse=GaussianPulse(sigma_ns=1.5))
    case = replace(case, name=f"{case.name}, armed at the pulse", flux=flux_of(1.0, 0.5, at))
    check(ENGINES["exact"], case, ENGINES["sequential"], EVERYTHING)


@pytest.mark.full
@pytest.mark.parametrize("mode", MODES[1:])
@pytest.mark.parametrize(
    ("signal", "dead", "cycles", "start"),
    [
        (10.0, 0.99, 100, "stationary"),  # locked to the laser
        (3.0, 2.0, 150, "stationary"),
        (8.0, 5.3, 60, "stationary"),
        (1.0, 30.7, 200, "stationary"),
        (1000.0, 0.6375, 4, "armed"),
        (30.0, 1e-3, 15, "armed"),
        (2.0, 40.2, 100, "armed"),
    ],
)
def test_hard_system(mode: str, signal: float, dead: float, cycles: int, start: str):
    """Bright, resonant, a dead time of many periods, many registrations in one pulse."""
    warm_up = 0 if start == "armed" else 300 * (1 + dead)
    items = int(min(4000, max(1000, 2e6 / (signal * (cycles + warm_up))))) // 4 * 4
    case = pulsed(signal, 0.05, detector(mode, dead), cycles=cycles, start=start, items=items)
    check(ENGINES["exact"], case, ENGINES["sequential"], EVERYTHING)


# Paralyzable


@pytest.mark.parametrize("engine", BOTH)
def test_paralyzable_under_blinding_light_goes_dark(engine: str):
    """Armed at the start, it sees the first photon and, with lambda t_d = 40, nothing ever after."""
    case = pulsed(0.0, 80.0, detector("paralyzable", 0.5), cycles=10, items=400)
    assert np.all(draw(ENGINES[engine], case, 1).counts == 1)


# Synchronous


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("dead", [0.9, 1.0, 2.5])
def test_synchronous_under_blinding_light(engine: str, dead: float):
    """It registers at once in each armed period, and skips those in which its dead time ends."""
    case = pulsed(0.0, 1e4, detector("synchronous", dead), cycles=12, items=8)
    each = {0.9: 1, 1.0: 2, 2.5: 3}[dead]  # a photon at x > 0 is followed by ceil(x + t_d) periods
    assert np.all(draw(ENGINES[engine], case, 1).counts == np.ceil(12 / each))


# Gated


GATED = {
    "inside": gate(0.3, 0.25, 0.0),
    "through the pulse": gate(0.37, 0.5, 0.0),
    "round the end": gate(0.9, 0.5, 0.0),
    "narrow": gate(0.375, 1 / 640, 0.0),
    "always open": gate(0.7, 1.0, 0.0),
}
FLUXES = {
    "gaussian": pulsed(1.5, 0.5, gate(0, 1, 0)),
    "wide": pulsed(1.5, 0.5, gate(0, 1, 0), pulse=GaussianPulse(sigma_ns=30.0)),
    "returns": replace(pulsed(0, 0, gate(0, 1, 0)), flux=flux_of([1.0, 0.4, 0.1], 0.5, [0.2, 0.41, 0.9])),
    "waveform": replace(pulsed(0, 0, gate(0, 1, 0)), flux=waveform_flux(two_lobes()[::3] / 5, 0.1)),
}


@pytest.mark.parametrize(
    ("kind", "flux"),
    [
        ("inside", "gaussian"),
        ("through the pulse", "gaussian"),
        ("round the end", "wide"),
        ("round the end", "returns"),
        ("narrow", "wide"),
        ("through the pulse", "waveform"),
        ("round the end", "waveform"),
        ("always open", "gaussian"),
    ],
)
@pytest.mark.parametrize("engine", [*BOTH, "poisson"])
def test_gate_without_dead_time_is_poisson(engine: str, kind: str, flux: str):
    case = replace(FLUXES[flux], items=3000)
    case = replace(case, system=case.system.replace(detector=GATED[kind]))
    mean = case.system.cycles * gated_photons(case)
    pmf = stats.poisson.pmf(np.arange(int(stats.poisson.isf(1e-12, mean.sum())) + 1), mean.sum())
    check(ENGINES[engine], case, Law(mean, pmf, independent_poisson=True), {COUNTS, SHAPE, JOINT})


@pytest.mark.parametrize(("step", "stay", "cycles"), [(0.05, 1, 37), (-0.11, 3, 40), (0.3, 7, 200), (1 / 640, 2, 300)])
@pytest.mark.parametrize("engine", BOTH)
def test_moving_gate_without_dead_time_is_poisson(engine: str, step: float, stay: int, cycles: int):
    case = pulsed(0.8, 0.5, gate(0.6, 0.2, 0.0, step, stay), cycles=cycles, items=4000)
    mean = cycles * gated_photons(case)
    check(ENGINES[engine], case, Law(mean, independent_poisson=True), {SHAPE, JOINT})


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead", [0.6375, 3.0, 12.4])
@pytest.mark.parametrize("engine", BOTH)
def test_a_gate_that_is_always_open_changes_nothing(engine: str, dead: float, start: str):
    """The exact law of a free-running pixel, whose statistics know no gate."""
    items = 1000 if engine == "sequential" and start == "stationary" else 4000
    case = pulsed(1.5, 0.5, gate(0.4, 1.0, dead), start=start, items=items, cycles=104)
    free = case.system.replace(detector=Detector(dead_time_ns=dead * PERIOD_NS))
    check(ENGINES[engine], case, law_of(Flux(1.5, 0.5, 37.0), free), {COUNTS, SHAPE})
