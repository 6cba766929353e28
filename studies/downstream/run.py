"""Study "downstream", T5 of the MaRS paper: networks trained on every simulator's data, tested on gold-standard data.

A network for each simulator, ratio, target and seed; each leaves its result in a folder of its own, and a study that
was stopped goes on where it was.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Scene
from mars_lidar._base import checks
from studies import OtherRunsError, Request, Tell
from studies.common.report import save_whole
from studies.downstream.counts import count_bias
from studies.downstream.data import CONFIGS, SYSTEM, Config, Simulators, crop, rgbd_scenes, truths

TARGETS = ("reflectivity", "depth")
RESULT, SHOWN, CONFIG, COUNTS = "result.json", "shown.npz", "config.json", "counts.json"
# streams of the cubes: those of a test differ from those of the training, and gold from own
_TRAINING, _VALIDATION, _OWN, _GOLD, _MEASURED = range(5)


@dataclass(frozen=True)
class Run:
    """One network."""

    arm: str
    sbr: float
    target: str
    seed: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.arm}-sbr{self.sbr:g}-{self.target}-{self.seed}"


def runs(config: Config) -> list[Run]:
    """All of them, those of the same data together, the first seed of every arm before any second."""
    deepest = max(len(seeds) for seeds in config.arms.values())
    return [
        Run(arm, sbr, target, seeds[turn])
        for turn in range(deepest)
        for sbr in config.sbr
        for arm, seeds in config.arms.items()
        if turn < len(seeds)
        for target in TARGETS
    ]


def run(request: Request) -> list[Path]:
    """Make what is left of the runs, and write downstream.md, its CSV and its figures."""
    from studies.downstream.report import report

    name = "tiny" if request.quick else request.config
    config = CONFIGS[checks.choice("config", name, tuple(CONFIGS))]
    folder = request.out / f"downstream-{config.name}"
    fixed(folder, config)
    left = [one for one in runs(config) if not (folder / one.name / RESULT).exists()]
    request.tell(f"downstream: {len(left)} of {len(runs(config))} networks to train")
    data = Data(config, None if request.data is None else request.data / "rgbd")
    for done, one in enumerate(left):
        told = f"downstream: {one.name} ({len(left) - done} left)"
        train_and_test(one, config, data, folder / one.name, lambda text, told=told: request.tell(f"{told}: {text}"))  # type: ignore[misc]
    found = {one: json.loads((folder / one.name / RESULT).read_text()) for one in runs(config)}
    if not (folder / COUNTS).exists():
        request.tell("downstream: counts of every simulator on the test scenes")
        save_whole(folder / COUNTS, json.dumps(count_bias(config, data.test, data.simulators), indent=2) + "\n")
    return report(request, folder, config, found, json.loads((folder / COUNTS).read_text()))


def fixed(folder: Path, config: Config) -> None:
    """Write the configuration, or refuse a folder with runs of another."""
    folder.mkdir(parents=True, exist_ok=True)
    record = json.dumps(asdict(config) | {"system": SYSTEM.to_dict()}, indent=2) + "\n"
    path = folder / CONFIG
    if path.exists() and path.read_text() != record:
        raise OtherRunsError(f"{folder} holds runs of another configuration ({CONFIG}); give another --out")
    save_whole(path, record)


class Data:
    """Scenes, and the cubes of one arm and ratio at a time; those of the gold standard are kept."""

    def __init__(self, config: Config, measured: Path | None) -> None:
        self.config = config
        self.training, self.validation, self.test = (
            [crop(first + k, config) for k in range(number)]
            for first, number in (config.train, config.validation, config.test)
        )
        self.measured = {} if measured is None else rgbd_scenes(measured, config)
        self.simulators = Simulators(config)
        self._own: tuple[tuple[str, float], list[NDArray[Any]]] | None = None
        self._gold: dict[float, list[NDArray[Any]]] = {}

    def own(self, arm: str, sbr: float) -> list[NDArray[Any]]:
        """Cubes of training, validation and test by `arm`."""
        if self._own is None or self._own[0] != (arm, sbr):
            self._own = None  # frees them before others are made
            sets = (self.training, _TRAINING), (self.validation, _VALIDATION), (self.test, _OWN)
            self._own = ((arm, sbr), [self._cubes(arm, scenes, sbr, stream) for scenes, stream in sets])
        return self._own[1]

    def gold(self, sbr: float) -> list[NDArray[Any]]:
        """Cubes of the test scenes, and of measured ones if there are, by the gold standard."""
        if sbr not in self._gold:
            sets = [(self.test, _GOLD)] + ([(list(self.measured.values()), _MEASURED)] if self.measured else [])
            self._gold[sbr] = [self._cubes(self.config.gold, scenes, sbr, stream) for scenes, stream in sets]
        return self._gold[sbr]

    def _cubes(self, arm: str, scenes: list[Scene], sbr: float, stream: int) -> NDArray[Any]:
        return self.simulators.cubes(arm, scenes, sbr, (self.config.seed << 8) + stream)


def train_and_test(one: Run, config: Config, data: Data, folder: Path, tell: Tell) -> None:
    """Train a network, or go on with it, and leave its result in `folder`."""
    import torch

    from studies.downstream.fit import Examples, fit, predict
    from studies.downstream.unet import CubeUNet, Target

    target: Target = "depth" if one.target == "depth" else "reflectivity"
    torch.manual_seed(one.seed)
    network = CubeUNet(SYSTEM.bins, target, stem=config.stem, widths=config.widths, blocks=config.blocks)
    training, validation, test = data.own(one.arm, one.sbr)
    plan = config.plan(one.seed)
    fitted = fit(
        network,
        Examples(training, truths(data.training, target, config)),
        Examples(validation, truths(data.validation, target, config)),
        folder,
        plan,
        about=asdict(one),
        tell=tell,
    )
    gold = data.gold(one.sbr)
    own_maps, gold_maps = predict(network, test, plan.scale), predict(network, gold[0], plan.scale)
    result: dict[str, Any] = {
        "run": asdict(one),
        "training": asdict(fitted),
        "own": errors(own_maps, data.test, target, config),
        "gold": errors(gold_maps, data.test, target, config),
    }
    if data.measured:
        maps = predict(network, gold[1], plan.scale)
        result["measured"] = {
            name: errors(maps[k : k + 1], [scene], target, config)
            for k, (name, scene) in enumerate(data.measured.items())
        }
    np.savez_compressed(folder / SHOWN, own=own_maps[0], gold=gold_maps[0])
    save_whole(folder / RESULT, json.dumps(result, indent=2) + "\n")


def errors(maps: NDArray[np.float32], scenes: list[Scene], target: str, config: Config) -> dict[str, float]:
    """PSNR and SSIM, means over the scenes, and RMSE over all pixels; of depth in m, pixels without return left out."""
    from studies.downstream.metrics import psnr, rmse, ssim

    peak = config.depth_range_m if target == "depth" else 1.0
    found = maps.astype(np.float64) * peak
    true = np.stack([scene.depth_m if target == "depth" else scene.reflectivity for scene in scenes])
    filled = np.where(np.isfinite(true), true, found)
    return {
        "psnr": float(np.mean([psnr(a, b, peak) for a, b in zip(found, true, strict=True)])),
        "ssim": float(np.mean([ssim(a, b, peak) for a, b in zip(found, filled, strict=True)])),
        "rmse": rmse(found, true),
    }


def by_arm(found: Mapping[Run, Any]) -> Iterator[tuple[str, float, dict[str, list[Any]]]]:
    """Results by arm and ratio: of each target, one for each seed."""
    for sbr, arm in dict.fromkeys((one.sbr, one.arm) for one in found):
        here = {one: result for one, result in found.items() if (one.sbr, one.arm) == (sbr, arm)}
        yield arm, sbr, {target: [r for one, r in here.items() if one.target == target] for target in TARGETS}
