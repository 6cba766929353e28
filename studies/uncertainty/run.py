"""Study "uncertainty": 90 % intervals of networks trained on every simulator's data, judged on gold-standard data.

MaRS has the right law of the count and the right mean histogram, and the wrong covariance of the bins: what networks
trained on its data say of their own errors is wrong by as much as the joint law predicts. Each network leaves its
result in a file of its own, and a study that was stopped goes on with the next.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from studies import Facts, OtherRunsError, Request, Tell
from studies.common.report import save_whole
from studies.common.windows import FEATURES
from studies.uncertainty.data import (
    BACKGROUND,
    CONFIGS,
    GOLD,
    OUTPUTS,
    SIGNAL,
    Config,
    Pixels,
    Simulators,
    light,
    system_of,
)
from studies.uncertainty.network import IntervalNetwork, told, trained
from studies.uncertainty.prediction import predict

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
CONFIG, PREDICTED = "config.json", "predicted-{dead:g}.json"
_TRAINING, _TEST = range(2)  # lights; the noise of a set has a seed of its own beside


@dataclass(frozen=True)
class Run:
    """One network: dead time in periods, the simulator of its data, its seed."""

    dead: float
    name: str
    seed: int

    @property
    def file(self) -> str:
        """Of its result."""
        return f"{self.name}-{self.dead:g}-{self.seed}.json"


def runs(config: Config) -> list[Run]:
    """All networks, those of the same data together."""
    return [
        Run(dead, name, seed) for dead in config.dead for name in config.steps for seed in range(config.seeds[name])
    ]


def run(request: Request) -> Facts:
    """Train what is left, and write uncertainty.md, its CSV and its figures."""
    from studies.uncertainty import report
    from studies.uncertainty.measured import measured

    torch.set_num_threads(1)  # the networks are too small to gain from more
    name = "tiny" if request.quick else request.config
    config = CONFIGS[checks.choice("config", name, tuple(CONFIGS))]
    folder = request.out / f"uncertainty-{config.name}"
    _fixed(folder, config)
    for dead in config.dead:
        _predictions(folder, config, dead, request.tell)
        _networks(folder, config, dead, request.tell)
    found = {one: json.loads((folder / one.file).read_text()) for one in runs(config)}
    predicted = {dead: json.loads((folder / PREDICTED.format(dead=dead)).read_text()) for dead in config.dead}
    stream = None if request.stream is None else measured(request.stream, folder, config, request.tell)
    return {"study": report} | report.facts(request, config, found, predicted, stream)


def _fixed(folder: Path, config: Config) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    record, path = json.dumps(asdict(config), indent=2) + "\n", folder / CONFIG
    if path.exists() and path.read_text() != record:
        raise OtherRunsError(f"{folder} holds runs of another configuration ({CONFIG}); give another --out")
    save_whole(path, record)


def _predictions(folder: Path, config: Config, dead: float, tell: Tell) -> None:
    path = folder / PREDICTED.format(dead=dead)
    if not path.exists():
        tell(f"uncertainty: closed form at t_d = {dead:g} t_r")
        made = predict(system_of(dead), config.cells)
        rows = [asdict(one) | {"loss": one.loss, "coverage": [one.coverage(level) for level in LEVELS]} for one in made]
        save_whole(path, json.dumps(rows) + "\n")


def _networks(folder: Path, config: Config, dead: float, tell: Tell) -> None:
    left = [one for one in runs(config) if one.dead == dead and not (folder / one.file).exists()]
    if not left:
        return
    data = _Data(config, dead)
    gold, exact = data.test(GOLD), data.test("exact")
    for name in dict.fromkeys(one.name for one in left):
        tell(f"uncertainty: {name} data at t_d = {dead:g} t_r")
        training, own = data.training(name), data.test(name)
        for one in (one for one in left if one.name == name):
            began = time.process_time()
            torch.manual_seed(one.seed)
            network = IntervalNetwork(FEATURES, len(OUTPUTS))
            looks: dict[int, Any] = {}
            steps = config.steps[name]
            for step in trained(
                network, training.seen, training.wanted, steps=steps, batch=config.batch, seed=one.seed
            ):
                if step in config.looks or step == steps:
                    looks[step] = judged(network, gold, config.cells)
            seconds = time.process_time() - began
            tests = {"gold": looks.pop(steps), "own": judged(network, own), "exact": judged(network, exact)}
            result = {"run": asdict(one), "seconds": seconds, "tests": tests, "looks": looks}
            save_whole(folder / one.file, json.dumps(result) + "\n")
            covered = tests["gold"]["log S"]["coverage"][LEVELS.index(0.9)]
            tell(f"uncertainty: {one.file}: 90 % intervals of log S cover {covered:.3f} of gold, {seconds:.0f} s")


class _Data:
    """Training and test pixels at one dead time: the same light for every simulator, noise of its own for each."""

    def __init__(self, config: Config, dead: float) -> None:
        self._config, self._dead = config, config.dead.index(dead)
        self._simulators = Simulators(system_of(dead), config)

    def training(self, name: str) -> Pixels:
        return self._pixels(name, self._config.pixels[name], _TRAINING)

    def test(self, name: str) -> Pixels:
        return self._pixels(name, self._config.test, _TEST)

    def _pixels(self, name: str, number: int, purpose: int) -> Pixels:
        source = (*self._config.steps, GOLD).index(name)
        numbers = [self._config.seed, self._dead, purpose]
        seed = int(np.random.default_rng([*numbers, source]).integers(2**62))
        return self._simulators.pixels(name, light(number, np.random.default_rng(numbers)), seed)


def judged(network: IntervalNetwork, pixels: Pixels, cells: int = 0) -> dict[str, Any]:
    """Loss, RMSE and coverage of each output; of log S over a map of the light, where `cells` is given.

    ``loss`` is the negative log-likelihood without log(2 pi) / 2, nats. In the map (cells, cells), the background
    fastest: coverage of the 90 % intervals, as they are (``map``) and with all of them stretched by the one factor
    (``factor``) that makes them cover 90 % of these pixels together (``stretched``).
    """
    mean, deviation = told(network, pixels.seen)
    wanted = pixels.wanted.astype(np.float64)
    score = (wanted - mean) / deviation
    limits = stats.norm.ppf(0.5 + 0.5 * np.array(LEVELS))
    out: dict[str, Any] = {
        name: {
            "loss": float(np.mean(np.log(deviation[:, k]) + 0.5 * score[:, k] ** 2)),
            "rmse": float(np.sqrt(np.mean((wanted[:, k] - mean[:, k]) ** 2))),
            "coverage": [float(np.mean(np.abs(score[:, k]) <= limit)) for limit in limits],
        }
        for k, name in enumerate(OUTPUTS)
    }
    if cells:
        limit = float(stats.norm.ppf(0.95))
        factor = float(np.quantile(np.abs(score[:, 0]), 0.9) / limit)
        out["factor"] = factor
        for name, stretch in (("map", 1.0), ("stretched", factor)):
            out[name] = _map(np.abs(score[:, 0]) <= stretch * limit, wanted, cells).tolist()
    return out


def _map(inside: Any, wanted: FloatArray, cells: int) -> FloatArray:
    """Share of pixels that are `inside`, in cells of log S and log B."""
    places = []
    for k, ends in enumerate((SIGNAL, BACKGROUND)):
        low, high = np.log(ends)
        places.append(np.clip((cells * (wanted[:, k] - low) / (high - low)).astype(int), 0, cells - 1))
    place = places[0] * cells + places[1]
    number = np.bincount(place, minlength=cells**2)
    share = np.bincount(place, weights=inside, minlength=cells**2) / np.maximum(number, 1)
    return np.asarray(share.reshape(cells, cells))


def by_simulator(found: Mapping[Run, Any], dead: float) -> Iterator[tuple[str, list[Any]]]:
    """Results at one dead time: those of all seeds of each simulator."""
    here = {one: result for one, result in found.items() if one.dead == dead}
    for name in dict.fromkeys(one.name for one in here):
        yield name, [result for one, result in here.items() if one.name == name]
