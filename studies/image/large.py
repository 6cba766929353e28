"""Processor time and memory of method "image" on large images, each in a process of its own."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mars_lidar import System
from mars_lidar.reconstruction import Image, UntrainedImage
from mars_lidar.reconstruction.photons import Photons
from studies.common.report import Row

_ROWS = 64  # drawn at a time


def rows(sides: tuple[int, ...], system: System, photons: float, sbr: float) -> list[Row]:
    """Seconds of one processor and the memory at most, and before, for each size; without networks for the first."""
    out: list[Row] = []
    for side in sides:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "photons.npz"
            _alone(_draw, path, side, system, photons, sbr)
            for method in (Image(), UntrainedImage()) if side == sides[0] else (Image(),):
                out.append(_alone(_cost, path, side, system, method))
    return out


def _alone(step: Callable[..., Row], *arguments: Any) -> Row:
    """The result of a step in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        return alone.submit(step, *arguments).result()


def _draw(path: Path, side: int, system: System, photons: float, sbr: float) -> Row:
    given, delay = drawn(side, system, photons, sbr)
    np.savez(path, first=given.first, bin=given.bin, number=given.number, delay=delay)
    return {}


def _cost(path: Path, side: int, system: System, method: Image) -> Row:
    with np.load(path) as saved:
        given, delay = Photons(side, side, saved["first"], saved["bin"], saved["number"]), saved["delay"]
    before = _most_memory()
    began, at = time.process_time(), time.perf_counter()
    estimate = method.of_photons(given, system, 1)
    seconds, wall = time.process_time() - began, time.perf_counter() - at
    off = np.abs((estimate.delay - delay + 0.5) % 1.0 - 0.5) * system.period_ns
    return {
        "pixels": f"{side} x {side}",
        "method": method.name,
        "processor s": seconds,
        "wall s": wall,
        "memory at most, MB": _most_memory(),
        "before, MB": before,
        "off %": 100.0 * float((off > 3.0 * system.pulse.sigma_ns).mean()),  # type: ignore[attr-defined]
    }


def _most_memory() -> float:
    """Of this process so far, MB; on Linux by its own status, since rusage goes on from that of the parent."""
    status = Path("/proc/self/status")
    if status.exists():
        (kilobytes,) = (line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(kilobytes) / 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def drawn(side: int, system: System, photons: float, sbr: float, seed: int = 7) -> tuple[Photons, np.ndarray]:
    """Photons of slopes with steps of 25 pixels a side between them, without dead time, and true delays in periods."""
    rng = np.random.default_rng(seed)
    sigma = system.pulse.sigma_ns / system.period_ns  # type: ignore[attr-defined]
    level = rng.uniform(0.2, 0.8, (side // 25 + 1, side // 25 + 1))
    parts, delays = [], []
    for top in range(0, side, _ROWS):
        y, x = np.mgrid[top : min(top + _ROWS, side), :side]
        delay = (level[y // 25, x // 25] + 0.02 * sigma * (x % 25) + 0.1 * sigma * (y % 25)).ravel()
        signal, background = rng.poisson(photons, delay.size), rng.poisson(photons / sbr, delay.size)
        pixel = np.concatenate([np.repeat(np.arange(delay.size), n) for n in (signal, background)])
        late = rng.normal(0.0, sigma, signal.sum())
        at = np.concatenate([np.repeat(delay, signal) + late, rng.random(background.sum())])
        flat = pixel * system.bins + (at % 1.0 * system.bins).astype(np.int64) % system.bins
        entry, number = np.unique(flat, return_counts=True)
        first = np.searchsorted(entry // system.bins, np.arange(delay.size + 1))
        parts.append(Photons(len(y), side, first, (entry % system.bins).astype(np.int32), number.astype(np.float32)))
        delays.append(delay)
    return Photons.joined(parts), np.concatenate(delays)
