"""Trains the networks of method "image" on exact simulations of built-in scenes, and writes their weights and card.

``python -m studies image --train --out DIR``: `image_weights.npz` and `image_card.json`, which lie in the package's
folder ``reconstruct``. Needs PyTorch (extra ``learn``); one thread, so that the same machine gives the same bits.
"""

from __future__ import annotations

import json
import os
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from mars_lidar import __version__
from mars_lidar._base.imports import needed
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.image import solver_of
from mars_lidar.reconstruction.image_network import CARD, LIMITS, WEIGHTS, networks_of
from mars_lidar.reconstruction.image_pulse import CELLS_PER_SIGMA, settings_of
from mars_lidar.reconstruction.photons import Photons
from studies import Tell
from studies.image import scenes

SIZES = _core.IMAGE_SIZES
LEVEL, OUTLIER_SIGMA = _core.IMAGE_LEVEL, _core.IMAGE_OUTLIER_SIGMA
Floats = NDArray[np.float32]
_REACHED = 6.0  # sigma, up to which an error counts
_HELD_OUT = 12  # every so many-th image
# of the pulse: the sampled pulses have 1.9 to 9.8, nine of ten of them more than 2.5. Of flatter ones, from a rectangle
# to a raised cosine, 48 to 85 % of the intervals contain the truth (3 photons, ratio 1), of 2.6 and 2.8 88 to 92 %
KURTOSIS = 2.5, 1e6
UNCALIBRATED = {
    "interval_factor": 1.0,
    "interval_exponent": 0.0,
    "holds_for": dict.fromkeys(LIMITS, (0.0, 1e9)),
}  # of networks in training


@dataclass(frozen=True)
class Plan:
    """How much is trained, and from which seed."""

    images: int = 400
    calibration: int = 192  # images, of other content and pulses, by which the intervals are calibrated
    choose_steps: int = 2000
    weigh_steps: int = 4000
    seed: int = 20261123


FULL = Plan()
QUICK = Plan(images=24, calibration=4, choose_steps=40, weigh_steps=40)


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A training image after its first round."""

    solver: _core.ImageSolver
    cells: int
    sigma: float  # cells
    truth: Floats  # (pixels,) delay in cells
    signal: Floats  # (H, W)
    valid: np.ndarray


def train(out: Path, plan: Plan = FULL, tell: Tell = str) -> list[Path]:
    """Draw, train both networks, and write weights and card; returns their paths."""
    torch = needed("torch", "the training of the networks of method 'image'", "learn")
    torch.manual_seed(plan.seed)
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    began = time.process_time()
    images = [_prepared(scenes.example(k, plan.seed)) for k in range(plan.images)]
    tell(f"image: {len(images)} images drawn, {time.process_time() - began:.0f} s of processor time")
    choose, facts = _train_choose(torch, images, plan, tell)
    first = networks_of(_flat(choose), UNCALIBRATED)
    prepared = [_weighed(torch, image, first) for image in images]
    weigh, more = _train_weigh(torch, prepared, plan, tell)
    _round(torch, weigh)
    intervals, others = _calibrated(torch, weigh, first, plan, tell)
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / WEIGHTS.name, np.concatenate([_flat(choose), _layers(weigh)]).astype(np.float16))
    card = _card(plan, intervals, facts | more | others, time.process_time() - began, torch.__version__)
    (out / CARD.name).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    return [out / WEIGHTS.name, out / CARD.name]


def _prepared(example: scenes.Example) -> _Prepared:
    height, width, bins = example.counts.shape
    solver = solver_of(Photons.of(example.counts.reshape(-1, bins), height, width), 1)
    setting = settings_of(example.system)[-1]
    solver.begin(setting)
    truth = np.nan_to_num(example.delay_ns).ravel() / example.system.period_ns % 1.0 * setting.cells
    signal = np.log(np.maximum(example.signal, 0.02)).astype(np.float32)
    return _Prepared(solver, setting.cells, setting.sigma, truth.astype(np.float32), signal, example.valid)


def _round(torch: Any, net: Any) -> None:
    """Weights as they are stored, of 16 bits."""
    with torch.no_grad():
        for values in net.parameters():
            values.copy_(values.half().float())


def gap(a: Any, b: Any, cells: int) -> Any:
    """a - b modulo the period, cells."""
    return (a - b + 0.5 * cells) % cells - 0.5 * cells


def _train_choose(torch: Any, images: list[_Prepared], plan: Plan, tell: Tell) -> tuple[Any, dict[str, float]]:
    """The network that chooses among the peaks, from the pixels whose largest peak is not sure."""
    rng = np.random.default_rng(plan.seed)
    features, labels, lost, wrong = [], [], [], []
    for k, image in enumerate(images):
        volumes = image.solver.volumes()
        mass = np.asarray(volumes.mass)
        off = np.abs(gap(volumes.place, image.truth[:, None], image.cells)) / image.sigma
        label = np.where(off.min(1) < OUTLIER_SIGMA, off.argmin(1), SIZES["peaks"])
        open_pixels = np.flatnonzero(image.valid.ravel() & (mass[:, 0] < _core.IMAGE_SETTLED))
        lost.append((label[open_pixels] == SIZES["peaks"]).mean() if open_pixels.size else 0.0)
        wrong.append((off[open_pixels, 0] >= OUTLIER_SIGMA).mean() if open_pixels.size else 0.0)
        if k % _HELD_OUT == 0 or open_pixels.size == 0:
            continue
        pixel = np.sort(rng.permutation(open_pixels)[:700])
        features.append(np.asarray(image.solver.candidate_features(volumes, pixel)).astype(np.float16))
        labels.append(label[pixel])
    tell(f"image: of unsure pixels {np.mean(wrong):.1%} have a wrong first peak, {np.mean(lost):.1%} no right one")
    x = torch.from_numpy(np.concatenate(features))
    y = torch.from_numpy(np.concatenate(labels))
    orders = torch.from_numpy(_symmetries())
    net = _choose_net(torch)
    optimiser = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=1e-3)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=plan.choose_steps)
    mean = 0.0
    for step in range(plan.choose_steps):
        pick = torch.from_numpy(rng.integers(0, len(x), 1024))
        loss = torch.nn.functional.cross_entropy(net(x[pick].float()[:, :, orders[step % 8]]), y[pick])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        rate.step()
        mean = loss.item() if step == 0 else 0.99 * mean + 0.01 * loss.item()
        if step % 500 == 499:
            tell(f"image: choosing, step {step + 1}, cross entropy {mean:.4f}")
    _round(torch, net)
    return net, {"wrong_first_peak": float(np.mean(wrong)), "cross_entropy": mean}


def _choose_net(torch: Any) -> Any:
    class Choose(torch.nn.Module):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            linear, relu, hidden = torch.nn.Linear, torch.nn.ReLU, SIZES["hidden"]
            self.layers = torch.nn.Sequential(
                linear(SIZES["features"], hidden), relu(), linear(hidden, hidden), relu(), linear(hidden, 1)
            )
            self.none = linear(2, 1)

        def forward(self, x: Any) -> Any:
            mass, signal = 3.0 * x[..., -3], 3.0 * x[:, 0, -1]
            value = self.layers(x)[..., 0] + mass
            return torch.cat([value, self.none(torch.stack([mass[:, 0], signal], -1))], -1)

    return Choose()


def _symmetries() -> np.ndarray:
    """(8, features) orders of the features by the flips and the transposition of the offsets."""
    orders = []
    for turned in (False, True):
        for down in (1, -1):
            for right in (1, -1):
                order = []
                for y, x in _core.IMAGE_OFFSETS:
                    k = _core.IMAGE_OFFSETS.index((down * (x if turned else y), right * (y if turned else x)))
                    order += [3 * k, 3 * k + 1, 3 * k + 2]
                orders.append([*order, *range(SIZES["features"] - 3, SIZES["features"])])
    return np.array(orders)


def _weighed(torch: Any, image: _Prepared, first: _core.ImageNetworks) -> dict[str, Any]:
    """What the second network reads and mixes of an image, and the truth."""
    delay, _ = image.solver.choose(first)
    maps = image.solver.plane_features()
    off = gap(image.truth, delay, image.cells) / image.sigma
    of_network = {name: torch.from_numpy(values) for name, values in zip(("x", "delays", "signals"), maps, strict=True)}
    mean = float(np.exp(image.signal)[image.valid].mean()) if image.valid.any() else 1.0
    return of_network | {
        "off": torch.from_numpy(off.reshape(image.valid.shape).astype(np.float32)),
        "valid": torch.from_numpy(image.valid),
        "signal": torch.from_numpy(image.signal),
        "mean": torch.full(image.valid.shape, mean),
    }


def _train_weigh(torch: Any, prepared: list[dict[str, Any]], plan: Plan, tell: Tell) -> tuple[Any, dict[str, float]]:
    """The network that weighs planes and signals, and says how far off it is."""
    rng = np.random.default_rng(plan.seed + 1)
    test = list(range(0, len(prepared), _HELD_OUT))
    rest = [k for k in range(len(prepared)) if k % _HELD_OUT]
    net = _weigh_net(torch)
    optimiser = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=1e-3)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 5e-3, total_steps=plan.weigh_steps)
    for step in range(plan.weigh_steps):
        loss, _ = _weigh_loss(torch, net, [prepared[k] for k in rng.choice(rest, 4)], step % 8)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        rate.step()
        if step % 400 == 399 or step == plan.weigh_steps - 1:
            with torch.no_grad():
                judged, of = _weigh_loss(torch, net, [prepared[k] for k in test], 0)
            facts = {"loss_held_out": float(judged), **_facts(of)}
            tell(f"image: weighing, step {step + 1}, held-out images: {facts}")
    return net, facts


def _facts(of: dict[str, Any]) -> dict[str, float]:
    """Of images that no network was trained on."""
    error, half = of["error"][of["valid"]], of["half"][of["valid"]]
    stated = (half < OUTLIER_SIGMA) & (of["doubt"][of["valid"]] < 1.0 - LEVEL)
    off = ((of["estimate"].exp() - of["signal"].exp()) / of["mean"])[of["valid"]]
    return {
        "median_sigma_held_out": float(error.median()),
        "outliers_held_out": float((error > OUTLIER_SIGMA).float().mean()),
        "coverage_held_out": float((error < half)[stated].float().mean()),
        "answered_held_out": float(stated.float().mean()),
        "signal_error_held_out": float((off**2).mean().sqrt()),
    }


def _calibrated(
    torch: Any, net: Any, first: _core.ImageNetworks, plan: Plan, tell: Tell
) -> tuple[dict[str, float], dict[str, float]]:
    """Factor (1 + background photons about the delay)^exponent of the intervals: least quantile score in new images."""
    prepared, near = [], []
    for k in range(plan.calibration):
        image = _prepared(scenes.example(scenes.CALIBRATION + k, plan.seed))
        prepared.append(_weighed(torch, image, first))
        near.append(np.asarray(image.solver.background_near()).reshape(image.valid.shape))
    with torch.no_grad():
        _, of = _weigh_loss(torch, net, prepared, 0)
    stated = (of["valid"] & (of["half"] < OUTLIER_SIGMA) & (of["doubt"] < 1.0 - LEVEL)).numpy()
    ratio = np.log(np.maximum(of["error"].numpy()[stated].astype(np.float64), 1e-6) / of["half"].numpy()[stated])
    background = np.log1p(np.stack(near)[stated].astype(np.float64))
    exponent = _slope(background, ratio)
    factor = float(np.exp(np.quantile(ratio - exponent * background, LEVEL)))
    facts = {name.replace("held_out", "calibration"): value for name, value in _facts(of).items()}
    tell(f"image: calibration, factor {factor:.4f}, exponent {exponent:.4f}, without them {facts}")
    return {"interval_factor": factor, "interval_exponent": exponent}, facts


def _slope(x: FloatArray, y: FloatArray) -> float:
    """Of the straight line in x below which `LEVEL` of y lie: least quantile score, which is convex in it."""

    def score(slope: float) -> float:
        rest = y - slope * x
        beyond = rest - np.quantile(rest, LEVEL)
        return float(np.maximum(LEVEL * beyond, (LEVEL - 1.0) * beyond).mean())

    return float(minimize_scalar(score, bounds=(-1.0, 1.0), method="bounded").x)


def _weigh_net(torch: Any) -> Any:
    nn = torch.nn

    class Weigh(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            around, channels = {"padding": 1, "padding_mode": "replicate"}, SIZES["channels"]
            self.enter = nn.Conv2d(SIZES["plane_features"], channels, 1)
            self.first = nn.Conv2d(channels, channels, 3, **around)
            self.second = nn.Conv2d(channels, channels, 3, **around)
            self.leave = nn.Conv2d(channels, SIZES["outputs"], 1)
            nn.init.zeros_(self.leave.weight)
            nn.init.zeros_(self.leave.bias)

        def forward(self, x: Any) -> Any:
            f = self.enter(x)
            f = f + self.first(nn.functional.relu(f))
            f = f + self.second(nn.functional.relu(f))
            return self.leave(nn.functional.relu(f))

    return Weigh()


def _weigh_loss(torch: Any, net: Any, images: list[dict[str, Any]], turn: int) -> tuple[Any, dict[str, Any]]:
    """Proper scores of what is stated, and the maps that they judge.

    Laplace likelihood of delays and log signals, squared error of signals, cross entropy of outliers, and of the half
    width the quantile's loss, on its logarithm.
    """

    def stacked(name: str) -> Any:
        values = torch.stack([image[name] for image in images])
        values = values.transpose(-1, -2) if turn & 4 else values
        return values.flip([axis for axis, bit in ((-1, 1), (-2, 2)) if turn & bit])

    names = "x", "delays", "signals", "off", "valid", "signal", "mean"
    x, delays, signals, off, valid, signal, mean = map(stacked, names)
    weight, share, rest = net(x).split([SIZES["delays"], SIZES["signals"], 5], 1)
    rest = rest.unbind(1)
    delay = (torch.softmax(weight, 1) * delays).sum(1) + 0.3 * rest[3].clamp(-3.0, 3.0)
    log_scale, logit = rest[0].clamp(-4.0, 3.0) - 1.5, rest[1] - 2.0
    signal_scale, log_half = rest[2].clamp(-4.0, 3.0) - 1.0, rest[4].clamp(-4.0, 3.0) - 0.7
    estimate = torch.logsumexp(torch.log_softmax(share, 1) + signals, 1)
    error = (delay - off).abs()
    outlier = (error.detach() > OUTLIER_SIGMA).float()
    near = error.clamp(max=_REACHED)
    depth = (near * torch.exp(-log_scale) + log_scale) * (1.0 - outlier) + 0.05 * near
    doubt = torch.nn.functional.binary_cross_entropy_with_logits(logit, outlier, reduction="none")
    beyond = torch.log(error.detach().clamp(1e-3, 100.0)) - log_half
    interval = torch.maximum(LEVEL * beyond, (LEVEL - 1.0) * beyond)
    light = (estimate.detach() - signal).abs() * torch.exp(-signal_scale) + signal_scale
    photometry = ((estimate.exp() - signal.exp()) / mean).clamp(-3.0, 3.0) ** 2
    inside = valid & (outlier < 1.0)
    loss = (depth + doubt + interval)[valid].mean() + 0.1 * light[inside].mean() + 2.0 * photometry[valid].mean()
    maps = {"error": error, "half": log_half.exp(), "doubt": torch.sigmoid(logit), "estimate": estimate}
    return loss, maps | {"signal": signal, "valid": valid, "mean": mean}


def _flat(net: Any) -> np.ndarray:
    """Weights of the network that chooses, in the order of native/image/solver.h."""
    parts = []
    for layer in (*(net.layers[k] for k in (0, 2, 4)), net.none):
        parts += [layer.weight.detach().numpy().T.ravel(), layer.bias.detach().numpy()]
    return np.ascontiguousarray(np.concatenate(parts), np.float32)


def _layers(net: Any) -> np.ndarray:
    """Weights (inputs, rows, columns, outputs) and bias of each layer of the network that weighs, likewise."""
    parts = []
    for layer in (net.enter, net.first, net.second, net.leave):
        parts += [layer.weight.detach().numpy().transpose(1, 2, 3, 0).ravel(), layer.bias.detach().numpy()]
    return np.ascontiguousarray(np.concatenate(parts), np.float32)


def _card(
    plan: Plan, intervals: dict[str, float], facts: dict[str, float], seconds: float, torch: str
) -> dict[str, Any]:
    cells = [CELLS_PER_SIGMA * scenes.PERIOD_NS / sigma for sigma in scenes.SIGMA_NS]
    return {
        "what": "weights of the two networks of reconstruct(method='image')",
        "trained_on": f"{plan.images} images of {scenes.SIDE} x {scenes.SIDE} pixels: this package's scenes 'room' and "
        "'random', and clutter; two of three with relief, texture and thin things added; photons by its engine 'exact'",
        "calibrated_on": f"{plan.calibration} images of other content, folds and triangles, and other pulses; "
        "every third with relief, texture and thin things added",
        **intervals,
        "ranges": {
            "signal photons a pixel, mean": scenes.SIGNAL,
            "signal to background": scenes.SBR,
            "pulse sigma, laser periods": [sigma / scenes.PERIOD_NS for sigma in scenes.SIGMA_NS],
            "pulses": "Gaussian; of every third image with an exponential tail and a second lobe",
            "dead time, laser periods": [dead / scenes.PERIOD_NS for dead in scenes.DEAD_TIME_NS],
            "cycles": scenes.CYCLES,
            "bins": scenes.BINS,
            "hot pixels": f"{scenes.HOT_SHARE:.1%} of every fourth image",
        },
        # a factor of 1.5 beyond the draws; elsewhere the untrained method runs
        "holds_for": {
            "signal": [scenes.SIGNAL[0] / 1.5, scenes.SIGNAL[1] * 1.5],
            "sbr": [scenes.SBR[0] / 1.5, scenes.SBR[1] * 1.5],
            "cells": [0.5 * min(cells), 2.0 * max(cells)],
            "side": [17, 1000000],
            "kurtosis": KURTOSIS,
        },
        "limits": "one surface a pixel",
        "command": "python -m studies image --train --out src/mars_lidar/reconstruction",
        "seed": plan.seed,
        "steps": [plan.choose_steps, plan.weigh_steps],
        "processor_seconds": round(seconds),
        "held_out": {name: round(value, 4) for name, value in facts.items()},
        "versions": {
            "mars-lidar": __version__,
            "numpy": np.__version__,
            "torch": torch,
            "python": platform.python_version(),
            "machine": f"{platform.machine()}, {os.uname().sysname}",
        },
        "licence": "MIT, as the package",
    }
