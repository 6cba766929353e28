"""Scenes and systems from which the networks of method "image" are trained: all of them this package's own."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, Flux, GaussianPulse, Scene, System, simulate
from mars_lidar._base.types import FloatArray

PERIOD_NS = 100.0  # no length enters a network: only ratios to the pulse do
SIDE = 64  # pixels of a training image
# the ranges of the draws, from which the card's limits follow
SIGNAL = 0.5, 20.0  # photons a pixel, mean
SBR = 0.03, 5.0
SIGMA_NS = 0.15, 1.5
DEAD_TIME_NS = 2.0, 200.0
CYCLES = 100, 300, 1000, 3000
BINS = 128, 256, 600, 1500
HOT_SHARE = 0.005  # of the pixels of every fourth image


@dataclass(frozen=True, eq=False)
class Example:
    """A simulated image: counts (H, W, bins), its system; true delay, ns, signal photons, and where there is any."""

    counts: NDArray[np.generic]
    system: System
    delay_ns: FloatArray
    signal: FloatArray
    valid: NDArray[np.bool_]


def example(number: int, seed: int) -> Example:
    """One of the training images; the same number and seed give the same one."""
    rng = np.random.default_rng([seed, number])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    system = System(
        period_ns=PERIOD_NS,
        cycles=int(rng.choice(CYCLES)),
        bins=int(rng.choice(BINS)),
        pulse=GaussianPulse(sigma_ns=between(*SIGMA_NS)),
        detector=Detector(dead_time_ns=between(*DEAD_TIME_NS)),
    )
    scene = _scene(number, rng, system)
    photons, sbr = between(*SIGNAL), between(*SBR)
    flux = light(scene, system, photons, sbr, "reflectivity" if rng.random() < 0.5 else "uniform")
    if number % 4 == 0:
        flux = _with_hot_pixels(flux, rng)
    counts = simulate(flux, system, seed=int(rng.integers(2**62)), threads=1)[0]
    signal = np.asarray(flux.signal) * system.cycles
    return Example(counts, system, flux.delay_ns, signal, np.isfinite(flux.delay_ns) & (signal > 0.0))


def light(scene: Scene, system: System, photons: float, sbr: float, ambient: str = "uniform") -> Flux:
    """The flux of a scene that gives so many signal photons a pixel on average in the whole exposure."""
    with warnings.catch_warnings():  # depths beyond the period wrap, and are learned from as well
        warnings.simplefilter("ignore", UserWarning)
        return scene.flux(system, signal=photons / system.cycles, sbr=sbr, ambient=ambient)  # type: ignore[arg-type]


def _scene(number: int, rng: np.random.Generator, system: System) -> Scene:
    """A built-in scene, whole or a part of a larger one; two of three with relief, texture and thin things besides."""
    large = rng.random() < 0.4
    size = 3 * SIDE if large else SIDE
    kind = "room" if number % 3 == 0 else "random"
    scene = Scene.example(kind, size=size, seed=int(rng.integers(2**31)))
    depth, reflectivity = np.array(scene.depth_m), np.array(scene.reflectivity)
    if large:
        y, x = rng.integers(0, size - SIDE, 2)
        depth, reflectivity = depth[y : y + SIDE, x : x + SIDE], reflectivity[y : y + SIDE, x : x + SIDE]
    depth = depth * np.exp(rng.uniform(np.log(0.2), np.log(2.0)))
    if number % 3:
        width_m = float(system.depth_m(system.pulse.sigma_ns))  # type: ignore[attr-defined]
        depth, reflectivity = busier(depth, reflectivity, width_m, rng)
    depth = np.clip(depth, 0.02 * np.nanmax(depth), None)
    return Scene(depth_m=depth, reflectivity=np.clip(reflectivity, 0.01, None) / max(1.0, float(reflectivity.max())))


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
