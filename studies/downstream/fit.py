"""The training loop: checkpoints, resume, early stopping, a log; mixed precision where there is a GPU."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor, nn

from mars_lidar._base import checks
from mars_lidar._base.files import TemporarySibling
from studies.common.report import save_csv, save_whole

RECORD, LOG, LAST, BEST = "run.yaml", "log.csv", "last.pt", "best.pt"
_COLUMNS = ("step", "seconds", "rate", "loss", "validation")


@dataclass(frozen=True, kw_only=True)
class FitPlan:
    """How a network is fitted.

    Parameters
    ----------
    steps
        Most steps of AdamW.
    batch
        Exposures of a step, each flipped at random.
    rate
        Largest learning rate: reached after a twentieth of the steps, then a cosine to a hundredth.
    every
        Steps between validations, each of which writes a checkpoint.
    patience
        Validations in a row without improvement after which the training stops.
    scale
        Input normalisation, the same for every pixel: sqrt(counts / `scale`). Counts are not divided by a pixel's own
        total, which would hide what dead time does to it.
    seed
        Of weights, order and flips.
    """

    steps: int
    batch: int = 4
    rate: float = 2e-3
    every: int = 50
    patience: int = 6
    scale: float = 16.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "every", "patience"):
            checks.integer(name, getattr(self, name), low=1, high=10**9)
        for name in ("rate", "scale"):
            object.__setattr__(self, name, checks.real(name, getattr(self, name), low=0.0, strict_low=True))
        checks.integer("seed", self.seed, low=0, high=2**63 - 1)


@dataclass(frozen=True, eq=False)
class Examples:
    """Histogram cubes (N, H, W, bins) of any integer type, and their maps (N, H, W) in [0, 1]."""

    cubes: NDArray[Any]
    maps: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.cubes.ndim != 4 or self.cubes.shape[:3] != self.maps.shape:
            raise ValueError(
                f"cubes must be (N, H, W, bins) and maps (N, H, W), got {self.cubes.shape} and {self.maps.shape}"
            )

    def batch(
        self, index: NDArray[np.int64], scale: float, device: torch.device, flipped: tuple[bool, bool] = (False, False)
    ) -> tuple[Tensor, Tensor]:
        """Normalised cubes (n, bins, H, W) and maps (n, 1, H, W); `flipped` from top to bottom, from left to right."""
        side = tuple(slice(None, None, -1 if flip else 1) for flip in flipped)
        counts = np.empty((len(index), *self.cubes.shape[1:]), np.float32)
        for k, i in enumerate(index):
            np.multiply(self.cubes[i][side], np.float32(1.0 / scale), out=counts[k], casting="unsafe")
        np.sqrt(counts, out=counts)  # a tenth of the time of torch's
        cube = torch.from_numpy(counts).permute(0, 3, 1, 2)  # bins innermost: channels last, no copy
        maps = np.ascontiguousarray(self.maps[index][:, *side])
        return cube.to(device), torch.from_numpy(maps)[:, None].to(device)


@dataclass(frozen=True)
class Fitted:
    """What came of it: steps made, the best validation and its step, seconds in all, whether it stopped by itself."""

    steps: int
    best: float
    best_step: int
    seconds: float
    stopped: bool


def fit(
    network: nn.Module,
    training: Examples,
    validation: Examples,
    folder: str | Path,
    plan: FitPlan,
    *,
    about: Mapping[str, Any] | None = None,
    tell: Callable[[str], object] | None = None,
    device: str | None = None,
) -> Fitted:
    """Fit `network` to L1 loss, or go on from the folder's checkpoint; leaves the best weights in the network.

    The folder takes ``run.yaml`` (the plan and `about`), ``log.csv``, ``last.pt`` and ``best.pt``. A run that was
    stopped, at any time, goes on from its last validation, with the same steps as if it had not been; one of another
    plan in the same folder is an error. A complete one returns at once.
    """
    place = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    record = {"plan": asdict(plan), "about": dict(about or {})}
    _check_record(folder / RECORD, record)
    network.to(place)
    half = place.type == "cuda"
    scaler = torch.amp.GradScaler(place.type, enabled=half)
    optimizer = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=1e-4)
    state: dict[str, Any] = {"step": 0, "best": math.inf, "best_step": 0, "seconds": 0.0, "log": []}
    if (folder / LAST).exists():
        loaded = torch.load(folder / LAST, map_location=place, weights_only=True)
        network.load_state_dict(loaded["network"])
        optimizer.load_state_dict(loaded["optimizer"])
        scaler.load_state_dict(loaded["scaler"])
        state = {name: loaded[name] for name in state}
    began, before = time.monotonic(), float(state["seconds"])
    losses: list[float] = []
    while state["step"] < plan.steps and not _stale(state, plan):
        step = int(state["step"])
        rate = _rate(step, plan)
        for group in optimizer.param_groups:
            group["lr"] = rate
        # drawn from the number of the step: a run that goes on makes the same steps
        random = np.random.default_rng([plan.seed, step])
        index = random.integers(0, len(training.maps), plan.batch)
        flipped = (bool(random.random() < 0.5), bool(random.random() < 0.5))
        cube, wanted = training.batch(index, plan.scale, place, flipped)
        network.train()
        optimizer.zero_grad()
        with torch.autocast(place.type, enabled=half):
            loss = (network(cube) - wanted).abs().mean()
        scaler.scale(loss).backward()
        scaler.unscale_(optimizer)
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        scaler.step(optimizer)
        scaler.update()
        losses.append(float(loss.detach()))
        state["step"] = step + 1
        if (step + 1) % plan.every and step + 1 < plan.steps:
            continue
        found = float(np.abs(predict(network, validation.cubes, plan.scale) - validation.maps).mean())
        state["seconds"] = before + time.monotonic() - began
        better = found < state["best"]
        if better:
            state["best"], state["best_step"] = found, step + 1
            _write(folder / BEST, {"network": network.state_dict()})
        state["log"].append([step + 1, state["seconds"], rate, float(np.mean(losses)), found])
        losses.clear()
        parts: dict[str, Any] = {"network": network, "optimizer": optimizer, "scaler": scaler}
        _write(folder / LAST, {name: part.state_dict() for name, part in parts.items()} | state)
        with TemporarySibling(folder / LOG).writing() as log:
            save_csv(log, [dict(zip(_COLUMNS, row, strict=True)) for row in state["log"]])
        if tell is not None:
            tell(f"step {step + 1}: validation {found:.4f}{' *' if better else ''}, {state['seconds']:.0f} s")
    network.load_state_dict(torch.load(folder / BEST, map_location=place, weights_only=True)["network"])
    return Fitted(
        int(state["step"]), float(state["best"]), int(state["best_step"]), float(state["seconds"]), _stale(state, plan)
    )


def predict(network: nn.Module, cubes: NDArray[Any], scale: float, batch: int = 4) -> NDArray[np.float32]:
    """Maps (N, H, W) in (0, 1) of cubes (N, H, W, bins)."""
    place = next(network.parameters()).device
    examples = Examples(cubes, np.zeros(cubes.shape[:3], np.float32))
    network.eval()
    out = np.empty(cubes.shape[:3], np.float32)
    with torch.inference_mode():
        for first in range(0, len(cubes), batch):
            index = np.arange(first, min(first + batch, len(cubes)))
            cube, _ = examples.batch(index, scale, place)
            out[index] = network(cube)[:, 0].float().cpu().numpy()
    return out


def _rate(step: int, plan: FitPlan) -> float:
    warm = max(1, plan.steps // 20)
    if step < warm:
        return plan.rate * (step + 1) / warm
    share = (step - warm) / max(1, plan.steps - warm)
    return plan.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * share)))


def _stale(state: Mapping[str, Any], plan: FitPlan) -> bool:
    return bool(state["step"] - state["best_step"] >= plan.patience * plan.every and state["log"])


def _check_record(path: Path, record: dict[str, Any]) -> None:
    if not path.exists():
        save_whole(path, yaml.safe_dump(record, sort_keys=False))
    elif yaml.safe_load(path.read_text()) != record:
        raise ValueError(f"{path.parent} holds a run of another configuration ({path.name}); give another folder")


def _write(path: Path, content: dict[str, Any]) -> None:
    with TemporarySibling(path).writing() as unfinished:
        torch.save(content, unfinished)
