"""Study "downstream", T5 of the MaRS paper: networks trained on every simulator's data, tested on gold-standard data.

MaRS has the right law of the count and the right mean histogram, and the wrong covariance of the bins. Two things
follow, which are one argument: estimates learned from its data weigh the bins wrongly and lose accuracy, and they state
wrong errors. Each network leaves its result in a file of its own, and a study that was stopped goes on with the next;
configurations share the networks that they have in common.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mars_lidar import Flux, System, cramer_rao, reconstruct
from mars_lidar._base.files import beside
from mars_lidar._base.imports import needed
from mars_lidar._base.types import FloatArray
from studies import Facts, OtherRunsError, Request, Tell
from studies.downstream import report
from studies.downstream.data import CONFIGS, MAIN, Config, Data, Run, instrument, runs, truths
from studies.downstream.networks import predicted, trained
from studies.downstream.prediction import of_scenes

METHODS = {  # that need no training
    "matched filter": "matched_filter",
    "generalised Coates": "generalised_coates",
    "maximum likelihood": "maximum_likelihood",
}
LIGHT_M_PER_NS = 0.299792458 / 2.0  # of depth
_GAUSSIAN: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}  # SSIM's window


FULL, QUICK = CONFIGS["small"], CONFIGS["tiny"]


def run(settings: Config, request: Request) -> Facts:
    """Train what has no result, and report all."""
    torch.set_num_threads(1)  # the networks are too small to gain from more
    config, tell = settings if request.quick else CONFIGS[request.config], request.tell
    folder = request.out / f"downstream-{config.sizes.name}"
    fixed(folder, asdict(config.sizes))
    data, every = Data(config.sizes), list(runs(config))
    tell(f"downstream: {sum(not (folder / job.file).exists() for job in every)} of {len(every)} networks to train")
    results = {job: once(folder / job.file, partial(train_and_test, job, data), tell) for job in every}
    places = [(MAIN, sbr) for sbr in config.sbr]
    bounds = {
        (dead, sbr): once(folder / f"methods-dead{dead:g}-sbr{sbr:g}.json", partial(methods, data, dead, sbr), tell)
        for dead, sbr in places
    }
    lines = {
        (dead, sbr): once(folder / f"law-dead{dead:g}-sbr{sbr:g}.json", partial(_law, data, dead, sbr), tell)
        for sbr in config.sbr
        for dead in sorted({*config.lines, MAIN, *(config.dead if sbr == 1.0 else ())})
    }
    return {"study": report} | report.facts(config, results, bounds, lines)


def _law(data: Data, dead: float, sbr: float) -> dict[str, float]:
    return of_scenes(data.fluxes(dead, sbr), instrument(dead), data.sizes.lights)


def train_and_test(job: Run, data: Data) -> dict[str, Any]:
    """A network on fresh pixels of its simulator, and what it says of the test scenes."""
    began, sizes = time.process_time(), data.sizes
    pixels = data.training(job.arm, job.dead, job.sbr, job.seed)
    which = int(job.kind == "spatial")
    network = trained(job.kind, pixels, steps=sizes.steps[which], batch=sizes.batch[which], seed=job.seed)
    result: dict[str, Any] = {"run": asdict(job), "seconds": time.process_time() - began}
    for where in ("own", "gold"):
        tested = data.tested(job.arm, job.dead, job.sbr, gold=where == "gold")
        result[where] = judged(*predicted(network, tested), data, instrument(job.dead))
    return result


def judged(mean: FloatArray, deviation: FloatArray | None, data: Data, system: System) -> dict[str, list[float]]:
    """Scene by scene: PSNR (range 1) and SSIM of reflectivity, mean squared error of depth (m^2), 90 % coverage.

    `mean` and `deviation` (N, H, W, 2) of reflectivity and the delay in bins. SSIM (Wang et al. 2004) has a Gaussian
    window of 1.5 pixels. Pixels without return have no depth to be judged by.
    """
    metrics = needed("skimage.metrics", "study 'downstream'", "estimate")
    metres = system.bin_ns * LIGHT_M_PER_NS
    out: dict[str, list[float]] = {}
    for k, (light, depth) in enumerate(zip(*truths(data.test), strict=True)):
        off = mean[k, ..., 1] - depth / metres
        away = metres * ((off + 0.5 * system.bins) % system.bins - 0.5 * system.bins)
        error = mean[k, ..., 0] - light
        row = {
            "psnr": -10.0 * np.log10(np.mean(error**2)),
            "ssim": metrics.structural_similarity(mean[k, ..., 0], light, data_range=1.0, **_GAUSSIAN),
            "depth_square": np.nanmean(away**2),
        }
        if deviation is not None:
            row["covered"] = np.mean(np.abs(error) <= 1.6448536 * deviation[k, ..., 0])
            inside = np.abs(away) <= 1.6448536 * metres * deviation[k, ..., 1]
            row["depth_covered"] = np.mean(inside[np.isfinite(away)])
        for name, value in row.items():
            out.setdefault(name, []).append(float(value))
    return out


def methods(data: Data, dead: float, sbr: float) -> dict[str, dict[str, list[float]]]:
    """`judged` of what needs no training on gold-standard cubes, and of the Cramer-Rao bound.

    A pixel without an estimate counts with no signal and the middle of the range.
    """
    system, photons = instrument(dead), data.sizes.photons
    cubes, out = data.gold(dead, sbr), {}
    for name, method in METHODS.items():
        estimate = reconstruct(cubes, system, method, threads=1)
        light = np.nan_to_num(estimate.signal / photons)
        delay = np.nan_to_num(estimate.delay_ns, nan=0.5 * system.period_ns) / system.bin_ns
        out[name] = judged(np.stack([light, delay], -1), None, data, system)
    psnr, depth = [], []
    for flux in data.fluxes(dead, sbr):
        lit = flux.signal > 0
        bound = cramer_rao(Flux(flux.signal[lit], flux.background[lit], flux.delay_ns[lit]), system)
        psnr.append(float(-10.0 * np.log10(np.mean((bound.signal / photons) ** 2))))
        depth.append(float(np.mean(bound.depth_m**2)))
    return out | {"Cramer-Rao bound": {"psnr": psnr, "depth_square": depth}}


def fixed(folder: Path, config: Mapping[str, Any]) -> None:
    """Write the configuration, or refuse a folder with runs of another."""
    folder.mkdir(parents=True, exist_ok=True)
    record, path = json.dumps(config, indent=2) + "\n", folder / "config.json"
    if path.exists() and path.read_text() != record:
        raise OtherRunsError(f"{folder} holds runs of another configuration ({path.name}); give another --out")
    _save_whole(path, record)


def once(path: Path, make: Callable[[], Any], tell: Tell) -> Any:
    """What the JSON file `path` holds, made and written first where it is not there."""
    if not path.exists():
        _save_whole(path, json.dumps(make()) + "\n")
        tell(f"{path.parent.name}: {path.stem}")
    return json.loads(path.read_text())


def _save_whole(path: Path, text: str) -> None:
    """Write a text that is whole or not there, whatever stops the process."""
    with beside(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
