"""Study "downstream", T5 of the MaRS paper: what is trained on every simulator's data, tested on gold-standard data.

For each simulator, ratio and seed, one stream of fresh exposures trains a polynomial, a window network and a bin
network side by side. Each leaves its result in a file of its own, and a study that was stopped goes on where it was: at
the last hundred steps of the stream that it was at.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, Scene, cramer_rao, reconstruct
from mars_lidar._base.files import beside
from mars_lidar._base.optional import needed
from mars_lidar._base.types import FloatArray
from studies import Facts, Request
from studies.common.kept import chosen, fixed, kept
from studies.common.windows import features
from studies.downstream.data import CONFIGS, SYSTEM, Config, Data, count_bias, level, truths

TARGETS = ("reflectivity", "depth")
MODELS = {"polynomial": "polynomial", "window": "window network", "bins": "bin network"}
METHODS = ("peak", "matched_filter", "generalised_coates", "maximum_likelihood")  # that need no training
DEGREE = 4  # of the polynomial, in log(1 + total) and log(1 + counts of the window)
POLYNOMIAL_STEPS = 300  # that it is fitted to: its fifteen numbers gain nothing from more
KEPT_EVERY = 100  # steps after which a stream's training is put on disk, to go on from
LIGHT_M_PER_NS = 0.299792458 / 2.0  # of depth
_GAUSSIAN: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}  # SSIM's window


@dataclass(frozen=True)
class Run:
    """One simulator's data at one ratio, by one seed."""

    arm: str
    sbr: float
    seed: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.arm}-sbr{self.sbr:g}-{self.seed}"


def runs(config: Config) -> list[Run]:
    """All of them, the first seed of every arm before any second."""
    turns = range(max(map(len, config.arms.values())))
    return [
        Run(arm, sbr, seeds[turn])
        for turn in turns
        for sbr in config.sbr
        for arm, seeds in config.arms.items()
        if turn < len(seeds)
    ]


def run(request: Request) -> Facts:
    """Make what is left of the runs, and report all."""
    from studies.downstream import report

    config = chosen(CONFIGS, request)
    folder = request.out / f"downstream-{config.name}"
    fixed(folder, asdict(config) | {"system": SYSTEM.to_dict()})
    data = Data(config)
    files = {one: folder / f"{one.name}.json" for one in runs(config)}
    left = sum(not path.exists() for path in files.values())
    request.tell(f"downstream: {left} of {len(files)} streams to train on")
    found = {one: kept(path, partial(train_and_test, one, data, folder), request.tell) for one, path in files.items()}
    for made in folder.glob("*.partial"):  # of streams whose results are there
        made.unlink()
    unlearned = kept(folder / "references.json", partial(references, data), request.tell)
    counts = kept(folder / "counts.json", partial(count_bias, data), request.tell)
    return {"study": report} | report.facts(folder, config, found, unlearned, counts)


def references(data: Data) -> dict[str, dict[str, float]]:
    """By ratio: RMSE of depth, m, of each method on gold-standard cubes, and the Cramer-Rao bound's."""
    found: dict[str, dict[str, float]] = {}
    true, _ = truths(data.test)
    for sbr in data.config.sbr:
        rows: dict[str, float] = {}
        for method in METHODS:
            depth = reconstruct(data.gold(sbr), SYSTEM, method, threads=1).depth_m
            away = np.where(np.isfinite(depth), depth, 0.5 * SYSTEM.unambiguous_range_m)
            rows[method.replace("_", " ")] = rmse(away, true)
        bounds = []
        for scene in data.test:
            flux = scene.flux(SYSTEM, signal=level(scene, data.config), sbr=sbr)
            lit = flux.signal > 0
            bound = cramer_rao(Flux(flux.signal[lit], flux.background[lit], flux.delay_ns[lit]), SYSTEM)
            bounds.append(bound.depth_m)
        rows["Cramer-Rao bound"] = float(np.sqrt(np.mean(np.concatenate(bounds) ** 2)))
        found[f"{sbr:g}"] = rows
    return found


def train_and_test(one: Run, data: Data, folder: Path) -> dict[str, Any]:
    """Train on one stream and judge what the three tell of the test scenes; maps of the first are left in `folder`."""
    import torch

    from studies.common.intervals import Steps
    from studies.downstream.networks import BinNetwork, WindowNetwork

    torch.set_num_threads(1)  # the networks are too small to gain from more
    torch.manual_seed(one.seed)
    config, began = data.config, time.process_time()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    networks = {"window": WindowNetwork(SYSTEM.bins).to(device), "bins": BinNetwork(SYSTEM.bins).to(device)}
    steps = dict(zip(networks, config.steps, strict=True))
    crops = {"window": config.batch, "bins": max(1, config.batch // 2)}  # pixel by pixel, one crop tells enough
    optimizers = {name: Steps(network, steps[name]) for name, network in networks.items()}
    polynomial = Polynomial()
    stream = data.stream(one.arm, one.sbr, one.seed)
    halfway = folder / f"{one.name}.partial"
    first, before = 0, 0.0
    if halfway.exists():  # written below, by this program: whole objects, so that nothing of them is left out
        state = torch.load(halfway, map_location=device, weights_only=False)
        first, before, networks, optimizers, polynomial, place = state
        stream.load_state_dict(place)
    for step, batch in zip(range(first, max(config.steps)), stream, strict=False):
        delay = batch["flux"]["delay"].to(device) / SYSTEM.bin_ns
        light = batch["flux"]["signal"].to(device) / config.photons  # the reflectivity that gives these photons
        if step < POLYNOMIAL_STEPS:
            polynomial.take(batch["cube"].numpy(), light.cpu().numpy())
        for name, network in networks.items():
            if step < steps[name]:
                some = slice(crops[name])
                told = network(batch["cube"][some])
                optimizers[name].step(told.loss(delay[some].flatten(), light[some].flatten()))
        if (step + 1) % KEPT_EVERY == 0:
            spent = before + time.process_time() - began
            with beside(halfway) as unfinished:
                torch.save((step + 1, spent, networks, optimizers, polynomial, stream.state_dict()), unfinished)
    result: dict[str, Any] = {"run": asdict(one), "device": device.type}
    result["seconds"] = before + time.process_time() - began
    shown: dict[str, FloatArray] = {}
    for where, cubes in (("own", data.own(one.arm, one.sbr)), ("gold", data.gold(one.sbr))):
        result[where] = {"polynomial": tested({"reflectivity": polynomial.told(cubes)}, {}, data.test, config)}
        for name, network in networks.items():
            maps, spread = predicted(network, cubes)
            result[where][name] = tested(maps, spread, data.test, config)
            shown |= {f"{where}_{name}_{target}": maps[target][0] for target in TARGETS}
    np.savez_compressed(folder / f"{one.name}.npz", allow_pickle=False, **shown)
    return result


class Polynomial:
    """Reflectivity as a polynomial of two numbers of a pixel, by least squares."""

    def __init__(self) -> None:
        terms = (DEGREE + 1) * (DEGREE + 2) // 2
        self._square, self._product = np.zeros((terms, terms)), np.zeros(terms)

    def take(self, cubes: NDArray[Any], reflectivity: NDArray[Any]) -> None:
        """Add pixels to the fit."""
        terms = _terms(cubes)
        self._square += terms.T @ terms
        self._product += terms.T @ reflectivity.reshape(-1)

    def told(self, cubes: NDArray[Any]) -> FloatArray:
        """Maps (N, H, W) of cubes (N, H, W, bins)."""
        weights = np.linalg.lstsq(self._square, self._product, rcond=1e-14)[0]
        return np.concatenate([(_terms(cube) @ weights).reshape(1, *cube.shape[:2]) for cube in cubes])


def _terms(cubes: NDArray[Any]) -> FloatArray:
    """Monomials (pixels, terms), of numbers of the order of 1."""
    total, near = 0.2 * features(cubes.reshape(-1, cubes.shape[-1]))[0][:, -2:].T.astype(np.float64)
    return np.stack([total**i * near**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=-1)


def predicted(network: Any, cubes: NDArray[Any]) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Maps (N, H, W) of reflectivity and depth, m, and their standard deviations."""
    import torch

    parts: dict[str, list[FloatArray]] = {}
    with torch.inference_mode():
        for cube in cubes:
            told = network(torch.from_numpy(cube[None]))
            metres = SYSTEM.bin_ns * LIGHT_M_PER_NS
            for name, values in (
                ("reflectivity", told.reflectivity),
                ("depth", metres * torch.remainder(told.delay, told.bins)),
                ("reflectivity spread", torch.exp(0.5 * told.reflectivity_log_variance)),
                ("depth spread", metres * torch.exp(0.5 * told.delay_log_variance)),
            ):
                parts.setdefault(name, []).append(values.double().cpu().numpy().reshape(cube.shape[:2]))
    maps = {name: np.stack(values) for name, values in parts.items()}
    return {name: maps[name] for name in TARGETS}, {name: maps[f"{name} spread"] for name in TARGETS}


def tested(
    maps: Mapping[str, FloatArray], spread: Mapping[str, FloatArray], scenes: Sequence[Scene], config: Config
) -> dict[str, dict[str, float]]:
    """PSNR and SSIM, means over the scenes, and RMSE over all pixels; of depth in m, pixels without return left out.

    SSIM (Wang et al. 2004) has a Gaussian window of 1.5 pixels. ``covered``: the share of pixels inside their 90 %
    interval, where there are intervals.
    """
    metrics = needed("skimage.metrics", "study 'downstream'", "estimate")
    out: dict[str, dict[str, float]] = {}
    for target, found in maps.items():
        peak = config.depth_range_m if target == "depth" else 1.0
        true = truths(scenes)[0 if target == "depth" else 1]
        known = np.isfinite(true)
        measures = []
        for a, b, k in zip(found, true, known, strict=True):
            likeness = metrics.structural_similarity(a, np.where(k, b, a), data_range=peak, **_GAUSSIAN)
            measures.append((20.0 * np.log10(peak / rmse(a, b)), likeness))
        noise, likeness = np.mean(measures, axis=0).tolist()
        out[target] = {"psnr": noise, "ssim": likeness, "rmse": rmse(found, true)}
        if target in spread:
            inside = np.abs(found - true) <= 1.6448536 * spread[target]
            out[target]["covered"] = float(inside[known].mean())
    return out


def rmse(found: FloatArray, true: FloatArray) -> float:
    """Root of the mean squared error over the entries where `true` is finite."""
    return float(np.sqrt(np.nanmean((found - true) ** 2)))


def by_arm(found: Mapping[Run, Any]) -> Iterator[tuple[str, float, list[Any]]]:
    """Results by arm and ratio, one for each seed."""
    for sbr, arm in dict.fromkeys((one.sbr, one.arm) for one in found):
        yield arm, sbr, [result for one, result in found.items() if (one.sbr, one.arm) == (sbr, arm)]
