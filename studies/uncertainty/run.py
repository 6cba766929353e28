"""Study "uncertainty": 90 % intervals of networks trained on every simulator's data, judged on gold-standard data.

MaRS has the right law of the count and the right mean histogram, and the wrong covariance of the bins: what networks
trained on its data say of their own errors is wrong by as much as the joint law predicts. Each network leaves its
result in a file of its own, and a study that was stopped goes on with the next.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from scipy import stats

from mars_lidar._base.types import FloatArray
from studies import Facts, Request
from studies.common.kept import chosen, fixed, kept
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
    instrument,
    light,
)
from studies.uncertainty.measured import measured
from studies.uncertainty.network import IntervalNetwork, told, trained
from studies.uncertainty.prediction import predict

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
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
    """Train what is left, and report all."""
    from studies.uncertainty import report

    torch.set_num_threads(1)  # the networks are too small to gain from more
    config, tell = chosen(CONFIGS, request), request.tell
    folder = request.out / f"uncertainty-{config.name}"
    fixed(folder, asdict(config))
    predicted = {
        dead: kept(folder / f"predicted-{dead:g}.json", partial(_predicted, dead, config.cells), tell)
        for dead in config.dead
    }
    data = _Data(config)
    found = {one: kept(folder / one.file, partial(_result, one, data, config), tell) for one in runs(config)}
    stream = None
    if request.stream is not None:
        stream = kept(folder / "measured.json", partial(measured, request.stream, config), tell)
    return {"study": report} | report.facts(config, found, predicted, stream)


def _predicted(dead: float, cells: int) -> list[dict[str, Any]]:
    """The closed form over the map."""
    made = predict(instrument(dead), cells)
    return [asdict(one) | {"loss": one.loss, "coverage": [one.coverage(level) for level in LEVELS]} for one in made]


def _result(one: Run, data: _Data, config: Config) -> dict[str, Any]:
    """One network, trained and judged."""
    training, gold = data.training(one.dead, one.name), data.test(one.dead, GOLD)
    began = time.process_time()
    torch.manual_seed(one.seed)
    network = IntervalNetwork(FEATURES, len(OUTPUTS))
    looks: dict[int, Any] = {}
    steps = config.steps[one.name]
    for step in trained(network, training.seen, training.wanted, steps=steps, batch=config.batch, seed=one.seed):
        if step in config.looks or step == steps:
            looks[step] = judged(network, gold, config.cells)
    seconds = time.process_time() - began
    tests = {"gold": looks.pop(steps)}
    for test, name in (("own", one.name), ("exact", "exact")):
        tests[test] = judged(network, data.test(one.dead, name))
    return {"run": asdict(one), "seconds": seconds, "tests": tests, "looks": looks}


class _Data:
    """Pixels of all simulators: at one dead time the same light for each, noise of its own."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._simulators = {dead: Simulators(instrument(dead), config) for dead in config.dead}
        # held are the last to train on, and the tests of one dead time
        self.training = lru_cache(1)(partial(self._pixels, _TRAINING))
        self.test = lru_cache(len(config.steps) + 1)(partial(self._pixels, _TEST))

    def _pixels(self, purpose: int, dead: float, name: str) -> Pixels:
        config = self._config
        number = config.pixels[name] if purpose == _TRAINING else config.test
        numbers = [config.seed, config.dead.index(dead), purpose]
        source = (*config.steps, GOLD).index(name)
        seed = int(np.random.default_rng([*numbers, source]).integers(2**62))
        return self._simulators[dead].pixels(name, light(number, np.random.default_rng(numbers)), seed)


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
