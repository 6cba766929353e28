"""Study "downstream-budget": what sizes of T5 cost: arithmetic of the networks, counted, processor time of their data.

Networks train on a GPU where PyTorch has one; data are simulated on one core, and the GPU waits for them: the hours
told are those of the one after the other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch.utils.flop_counter import FlopCounterMode

from studies import Facts, Request
from studies.common.intervals import Steps
from studies.common.windows import features
from studies.downstream.data import CONFIGS, SYSTEM, WORDS, Config, Data
from studies.downstream.networks import BinNetwork, WindowNetwork
from studies.downstream.run import MODELS, POLYNOMIAL_STEPS, Polynomial, runs

GPU_HOURS = 8.0  # that `full` may take
FLOP_RATE = 1e13  # a second, that a GPU is assumed to keep up on these networks; nothing was measured on one
STEP_S = 0.01  # assumed of each step beside its arithmetic: starting kernels, copying cubes


@dataclass(frozen=True)
class Budget:
    """Of all streams of a configuration: steps, operations of the networks, and processor time of their data, s."""

    config: str
    streams: int
    steps: int
    flop: float
    data_s: float

    @property
    def gpu_s(self) -> float:
        """Of the networks alone, as assumed."""
        return self.flop / FLOP_RATE + STEP_S * self.steps

    @property
    def hours(self) -> float:
        """That a GPU is held: its own arithmetic after the data of one core, none of it at the same time."""
        return (self.gpu_s + self.data_s) / 3600.0


def flop_of_a_step(config: Config) -> dict[str, float]:
    """Operations of one step by network, forward and backward: matrix products and convolutions, as PyTorch counts."""
    found = {}
    networks = {
        "window": (WindowNetwork(SYSTEM.bins), config.batch),
        "bins": (BinNetwork(SYSTEM.bins), max(1, config.batch // 2)),
    }
    for name, (network, crops) in networks.items():
        cube = torch.ones(crops, config.crop, config.crop, SYSTEM.bins, dtype=torch.int16)
        truth = torch.ones(crops * config.crop**2)
        with FlopCounterMode(display=False) as counted:
            Steps(network, 1).step(network(cube).loss(truth, truth))
        found[name] = float(counted.get_total_flops())
    return found


def seconds_of_data(config: Config, steps: int = 3) -> dict[str, dict[str, float]]:
    """Processor time by simulator, s: of a step's crops, of their features and the polynomial, of a test scene."""
    few = replace(config, train=(config.train[0], 8), table=(32, 16))
    data, found = Data(replace(few, test=(few.test[0], 1))), {}
    for arm in few.arms:
        stream = iter(data.stream(arm, few.sbr[-1], 0))
        next(stream)  # casts the rooms and builds the tables
        began = time.process_time()
        batches = [next(stream) for _ in range(steps)]
        drawn = time.process_time()
        cubes = [batch["cube"].numpy() for batch in batches]
        for cube in cubes:
            features(cube.reshape(-1, SYSTEM.bins))
        seen = time.process_time()
        for cube, batch in zip(cubes, batches, strict=True):
            Polynomial().take(cube, batch["flux"]["signal"].numpy())
        fitted = time.process_time()
        data.own(arm, few.sbr[-1])
        found[arm] = {
            "crops, s": (drawn - began) / steps,
            "features, s": (seen - drawn) / steps,
            "polynomial, s": (fitted - seen) / steps,
            "test scene, s": time.process_time() - fitted,
        }
    return found


def budget(config: Config, flop: Mapping[str, float], data: Mapping[str, Mapping[str, float]] | None = None) -> Budget:
    """Of all streams, from what a step costs; without `data` of the networks alone."""
    made, longest = runs(config), max(config.steps)
    fitted = min(longest, POLYNOMIAL_STEPS)
    return Budget(
        config.name,
        len(made),
        len(made) * longest,
        len(made) * sum(steps * flop[name] for steps, name in zip(config.steps, ("window", "bins"), strict=True)),
        sum(
            longest * (data[one.arm]["crops, s"] + data[one.arm]["features, s"])
            + fitted * data[one.arm]["polynomial, s"]
            + config.test[1] * data[one.arm]["test scene, s"]
            for one in made
            if data is not None
        ),
    )


def arithmetic(config: Config) -> str:
    """Steps of all streams, and operations of their networks, in words."""
    cost = budget(config, flop_of_a_step(config))
    return (
        f"{cost.streams} streams, {cost.steps:,} steps, {cost.flop / 1e15:.3g} PFLOP in the networks, counted: "
        f"{cost.gpu_s / 60:.2g} minutes of a GPU, "
        f"of which {FLOP_RATE / 1e12:g} TFLOP/s and {1e3 * STEP_S:g} ms a step are assumed"
    )


def run(request: Request) -> Facts:
    """Every size, measured here."""
    torch.set_num_threads(1)
    sizes = []
    for name in ("tiny",) if request.quick else ("small", "full"):
        config = CONFIGS[name]
        flop, data = flop_of_a_step(config), seconds_of_data(config)
        cost, rows = budget(config, flop, data), [{"data of": WORDS[arm]} | parts for arm, parts in data.items()]
        sizes.append({"config": name, "arithmetic": arithmetic(config), "flop": flop, "cost": cost, "rows": rows})
        request.tell(f"downstream-budget: {name}")
    return {"sizes": sizes, "fitted": POLYNOMIAL_STEPS, "models": MODELS}
