"""The light of a measured stream from short exposures of it, with intervals; the whole stream tells the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from mars_lidar import Calibration, Detector, Flux, GaussianPulse, System, Timestamps, calibrate, simulate
from mars_lidar._base.types import FloatArray
from studies.uncertainty.data import GOLD, Config
from studies.uncertainty.network import IntervalNetwork, told, trained

UNIT_NS = 0.064  # of the times in the stream
CYCLES, BINS, LEVELS = 100, 32, 64  # of an exposure; of light in the training, log-spaced
DARKEST, BRIGHTEST = 0.4, 2.5  # over the light of the whole stream
SIMULATORS = ("exact", "mars", "renewal", "poisson")


def measured(path: Path, config: Config) -> dict[str, Any]:
    """By simulator: what a network trained on its data says of exposures of the stream, and of simulated ones."""
    times = Timestamps.load(path, unit_ns=UNIT_NS)
    with h5py.File(path) as file:
        dead_ns = float(np.asarray(file["DT_electronics"])[0, 0]) * UNIT_NS
    whole = calibrate(times, {"dead_time_ns": dead_ns}, pulse="free")
    system = System(
        period_ns=times.period_ns,
        cycles=CYCLES,
        bins=BINS,
        pulse=GaussianPulse(sigma_ns=1.0),  # of no account: the light is a waveform
        detector=Detector(dead_time_ns=dead_ns),
        start="stationary",
    )
    exposures = _cut(times)
    steps, seed = config.steps["mars"], config.seed
    each = max(64, config.pixels["mars"] // (4 * LEVELS))
    lights = np.geomspace(DARKEST, BRIGHTEST, LEVELS)
    gold = _simulated(GOLD, np.ones(1), max(256, config.test // 8), whole, system, seed + 1)
    truth = float(np.log(whole.total))
    rows = {}
    for name in SIMULATORS:
        seen = _features(_simulated(name, lights, each, whole, system, seed))
        wanted = np.tile(np.log(whole.total * lights), each)[:, None].astype(np.float32)
        torch.manual_seed(seed)
        network = IntervalNetwork(seen.shape[1], 1, width=64)
        for _ in trained(network, seen, wanted, steps=steps, batch=min(1024, len(seen)), seed=seed):
            pass
        rows[name] = {
            where: _judged(network, counts, truth) for where, counts in (("stream", exposures), ("gold", gold))
        }
        mean, deviation = told(network, _features(exposures))
        rows[name] |= {"mean": mean[:, 0].tolist(), "deviation": deviation[:, 0].tolist()}
    about = {"photons": len(times), "exposures": len(exposures), "period_ns": times.period_ns, "dead_ns": dead_ns}
    about |= {
        "light": whole.total,
        "error": whole.estimates["light"].error,
        "trained": each * LEVELS,
        "steps": steps,
        "gold": len(gold),
    }
    return {"about": about, "rows": rows}


def _cut(times: Timestamps) -> NDArray[np.int64]:
    """Histograms (exposures, BINS) of `CYCLES` whole periods each, one after the other."""
    number = times.cycles // CYCLES
    cycle = np.floor(times.times_ns / times.period_ns).astype(np.int64)
    bins = np.clip((times.times_ns / times.period_ns - cycle) * BINS, 0, BINS - 1).astype(np.int64)
    place = (cycle // CYCLES) * BINS + bins
    return np.bincount(place[cycle < number * CYCLES], minlength=number * BINS).reshape(number, BINS)


def _simulated(name: str, lights: FloatArray, each: int, whole: Calibration, system: System, seed: int) -> NDArray[Any]:
    """Histograms (each x lights, BINS): the stream's light, brighter and darker."""
    shape = np.asarray(whole.waveform, dtype=np.float64)
    flux = Flux(waveform=lights[None, :, None] * (whole.total / shape.sum()) * shape)
    cube = simulate(flux, system, engine=name, realizations=each, seed=seed, threads=1)
    return cube.reshape(-1, system.bins)


def _features(counts: NDArray[Any]) -> NDArray[np.float32]:
    total = np.log1p(counts.sum(1, keepdims=True, dtype=np.float64))
    return np.concatenate([np.sqrt(counts), total], axis=1).astype(np.float32)


def _judged(network: IntervalNetwork, counts: NDArray[Any], truth: float) -> dict[str, float]:
    """Of log light: bias, RMSE, mean deviation told, share of 90 % intervals that hold the truth, and its error."""
    mean, deviation = told(network, _features(counts))
    inside = np.abs(mean - truth) <= stats.norm.ppf(0.95) * deviation
    return {
        "bias": float(np.mean(mean - truth)),
        "rmse": float(np.sqrt(np.mean((mean - truth) ** 2))),
        "told": float(np.mean(deviation)),
        "covered": float(inside.mean()),
        "chance": float(np.sqrt(0.09 / len(counts))),
    }
