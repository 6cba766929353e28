"""Scenes and systems from which the networks of method "image" are trained: all of them this package's own."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, Flux, GaussianPulse, Pulse, SampledPulse, Scene, System, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.histogram_record import relative_width

PERIOD_NS = 100.0  # no length enters a network: only ratios to the pulse do
SIDE = 64  # pixels of a training image
# the ranges of the draws, from which the card's limits follow
SIGNAL = 0.5, 20.0  # photons a pixel, mean
SBR = 0.01, 5.0
SIGMA_NS = 0.15, 1.5
DEAD_TIME_NS = 2.0, 200.0
CYCLES = 100, 300, 1000, 3000
BINS = 128, 256, 600, 1500
HOT_SHARE = 0.005  # of the pixels of every fourth image
# of every third image the pulse has a tail: its decay, in rise times, and the share of a second lobe
DECAY = 1.0, 8.0
LOBE = 0.0, 0.5
CALIBRATION = 10**6  # number of the first image of those with other content, by which the intervals are calibrated


@dataclass(frozen=True, eq=False)
class Example:
    """A simulated image: counts (H, W, bins), its system; true delay, ns, signal photons, and where there is any."""

    counts: NDArray[np.generic]
    system: System
    delay_ns: FloatArray
    signal: FloatArray
    valid: NDArray[np.bool_]


def example(number: int, seed: int) -> Example:
    """One of the training images; the same number and seed give the same one.

    From number `CALIBRATION` on: of content and pulses that no image of a smaller number has.
    """
    rng = np.random.default_rng([seed, number])
    fresh = number >= CALIBRATION
    system = System(
        period_ns=PERIOD_NS,
        cycles=int(rng.choice(CYCLES)),
        bins=int(rng.choice(BINS)),
        pulse=_pulse(number, rng, fresh),
        detector=Detector(dead_time_ns=_between(rng, *DEAD_TIME_NS)),
    )
    scene = _folded(number, rng, system) if fresh else training_scene(number, rng, system)
    photons, sbr = _between(rng, *SIGNAL), _between(rng, *SBR)
    flux = light(scene, system, photons, sbr, "reflectivity" if rng.random() < 0.5 else "uniform")
    if number % 4 == 0:
        flux = _with_hot_pixels(flux, rng)
    counts = simulate(flux, system, seed=int(rng.integers(2**62)), threads=1)[0]
    signal = np.asarray(flux.signal) * system.cycles
    return Example(counts, system, flux.delay_ns, signal, np.isfinite(flux.delay_ns) & (signal > 0.0))


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _pulse(number: int, rng: np.random.Generator, fresh: bool) -> Pulse:
    """Gaussian; of every third image with an exponential tail, and a second lobe; `fresh`: skew, of a gamma density."""
    sigma = _between(rng, *SIGMA_NS)
    if number % 3 != 1:
        return GaussianPulse(sigma_ns=sigma)
    if fresh:
        shape = rng.uniform(1.5, 8.0)
        t = np.arange(0.0, 12.0, 0.02) * sigma
        values = (t / sigma) ** (shape - 1.0) * np.exp(-t / sigma * np.sqrt(shape))
    else:
        rise, decay, lobe = 0.3 * sigma, 0.3 * sigma * _between(rng, *DECAY), rng.uniform(*LOBE)
        t = np.arange(0.0, 12.0, 0.02) * sigma
        values = _tailed(t, rise, decay) + lobe * _tailed(t - rng.uniform(1.0, 3.0) * sigma, rise, decay)
    return SampledPulse(values, 0.02 * sigma)


def _tailed(t: FloatArray, rise: float, decay: float) -> FloatArray:
    after = np.maximum(t, 0.0)
    return np.asarray(np.where(t > 0.0, (1.0 - np.exp(-after / rise)) * np.exp(-after / decay), 0.0))


def light(scene: Scene, system: System, photons: float, sbr: float, ambient: str = "uniform") -> Flux:
    """The flux of a scene that gives so many signal photons a pixel on average in the whole exposure."""
    with warnings.catch_warnings():  # depths beyond the period wrap, and are learned from as well
        warnings.simplefilter("ignore", UserWarning)
        return scene.flux(system, signal=photons / system.cycles, sbr=sbr, ambient=ambient)  # type: ignore[arg-type]


def training_scene(number: int, rng: np.random.Generator, system: System) -> Scene:
    """A built-in scene, whole or a part of a larger one, or leaves; two of three made busier."""
    if number % 4 == 3:
        depth, reflectivity = _leaves(SIDE, rng)
    else:
        large = rng.random() < 0.4
        size = 3 * SIDE if large else SIDE
        scene = Scene.example("room" if number % 4 == 0 else "random", size=size, seed=int(rng.integers(2**31)))
        depth, reflectivity = np.array(scene.depth_m), np.array(scene.reflectivity)
        if large:
            y, x = rng.integers(0, size - SIDE, 2)
            depth, reflectivity = depth[y : y + SIDE, x : x + SIDE], reflectivity[y : y + SIDE, x : x + SIDE]
        depth = depth * _between(rng, 0.2, 2.0)
    if number % 3:
        depth, reflectivity = busier(depth, reflectivity, _width_m(system), rng)
    depth = np.clip(depth, 0.02 * np.nanmax(depth), None)
    return Scene(depth_m=depth, reflectivity=np.clip(reflectivity, 0.01, None) / max(1.0, float(reflectivity.max())))


def _width_m(system: System) -> float:
    """Width of the pulse, as a depth."""
    return float(system.depth_m(relative_width(system) * system.period_ns))


def _leaves(side: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Clutter: tilted and bowed ellipses one before the other, of sizes whose logarithm is uniform."""
    y, x = np.mgrid[:side, :side] - 0.5 * (side - 1)
    far, spread = rng.uniform(2.0, 12.0), _between(rng, 0.05, 1.0)
    depth = far * (1.0 + rng.normal(0.0, 0.1) * y / side + rng.normal(0.0, 0.1) * x / side)
    reflectivity = np.full((side, side), rng.uniform(0.1, 0.9))
    number = int(rng.integers(5, 80))
    for near in np.sort(rng.uniform(0.0, 1.0, number)):
        length, angle = _between(rng, 2.0, 0.5 * side), rng.uniform(0.0, np.pi)
        down, right = y - rng.uniform(-0.5, 0.5) * side, x - rng.uniform(-0.5, 0.5) * side
        along = (down * np.sin(angle) + right * np.cos(angle)) / length
        across = (down * np.cos(angle) - right * np.sin(angle)) / (length * _between(rng, 0.1, 1.0))
        inside = along**2 + across**2 < 1.0
        shape = rng.normal(0.0, 0.03) * along + rng.normal(0.0, 0.03) * across + rng.normal(0.0, 0.03) * along**2
        depth = np.where(inside, far * (1.0 - near * spread / (1.0 + spread) + shape), depth)
        reflectivity = np.where(inside, rng.uniform(0.05, 1.0), reflectivity)
    return depth, reflectivity


def _folded(number: int, rng: np.random.Generator, system: System) -> Scene:
    """Corrugated ground behind triangles, which no training image has; every third busier."""
    y, x = np.mgrid[:SIDE, :SIDE] - 0.5 * (SIDE - 1)
    angle, wave = rng.uniform(0.0, np.pi), _between(rng, 6.0, 60.0)
    along = x * np.cos(angle) + y * np.sin(angle)
    far = rng.uniform(2.0, 12.0)
    depth = far * (
        1.0 + _between(rng, 0.001, 0.1) * np.abs((along / wave) % 2.0 - 1.0) + rng.normal(0.0, 0.1) * y / SIDE
    )
    reflectivity = 0.5 + 0.35 * np.sin(2.0 * np.pi * along / _between(rng, 4.0, 60.0))
    for _ in range(rng.integers(1, 12)):
        inside = np.ones(y.shape, bool)
        right, down = rng.uniform(-0.5, 0.5, 2) * SIDE
        first = rng.uniform(0.0, 2.0 * np.pi)
        for k in range(3):
            turn = first + 2.0 * np.pi * k / 3.0 + rng.uniform(-0.5, 0.5)
            inside &= (x - right) * np.cos(turn) + (y - down) * np.sin(turn) < _between(rng, 1.0, 15.0)
        depth = np.where(inside, far * rng.uniform(0.4, 0.98), depth)
        reflectivity = np.where(inside, rng.uniform(0.05, 1.0), reflectivity)
    if number % 3 == 0:
        depth, reflectivity = busier(depth, reflectivity, _width_m(system), rng)
    return Scene(depth_m=np.clip(depth, 0.1, None), reflectivity=np.clip(reflectivity, 0.01, 1.0))


def busier(
    depth: FloatArray, reflectivity: FloatArray, width_m: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Relief, texture and thin things in front, which rooms of planes lack; `width_m`: of the pulse, as a depth."""
    shape = depth.shape
    if rng.random() < 0.7:
        relief = width_m * np.exp(rng.uniform(np.log(0.1), np.log(3.0)))
        depth = depth + relief * _clouds(shape, rng.uniform(1.0, 2.2), rng)
    if rng.random() < 0.7:
        reflectivity = reflectivity * np.exp(rng.uniform(0.1, 0.8) * _clouds(shape, rng.uniform(0.6, 1.8), rng))
    if rng.random() < 0.5:
        y, x = np.mgrid[: shape[0], : shape[1]]
        low, high = float(np.nanmin(depth)), float(np.nanmax(depth))
        for _ in range(rng.integers(1, 9)):
            angle, down, right = rng.uniform(0.0, np.pi), rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
            across = (x - right) * np.cos(angle) + (y - down) * np.sin(angle)
            along = (x - right) * np.sin(angle) - (y - down) * np.cos(angle)
            inside = (np.abs(across) < rng.uniform(0.7, 3.5)) & (np.abs(along) < rng.uniform(6.0, 45.0))
            depth = np.where(inside, rng.uniform(0.9 * low, high), depth)
            reflectivity = np.where(inside, rng.uniform(0.1, 1.0), reflectivity)
    return depth, reflectivity


def _clouds(shape: tuple[int, ...], slope: float, rng: np.random.Generator) -> FloatArray:
    """A random field of amplitudes f^-slope, of mean 0 and standard deviation 1."""
    f = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
    f[0, 0] = 1.0
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) / f**slope).real
    field -= field.mean()
    return np.asarray(field / field.std())


def _with_hot_pixels(flux: Flux, rng: np.random.Generator) -> Flux:
    hot = rng.random(flux.signal.shape) < HOT_SHARE
    factor = np.where(hot, np.exp(rng.uniform(np.log(5.0), np.log(200.0), hot.shape)), 1.0)
    return Flux(flux.signal, flux.background * factor, flux.delay_ns)
