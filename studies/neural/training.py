"""Training of a neural map, with validation on held-out fluxes as it goes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mars_lidar import System
from mars_lidar._base import checks
from mars_lidar.plot.style import style
from mars_lidar.statistics.cells import require_mode
from studies.common.draw import panels
from studies.common.report import save_csv, save_figure
from studies.neural.model import NeuralMap
from studies.neural.network import PdfAutoencoder, canonical, one_thread, rolled
from studies.neural.pairs import Pairs, Training

_RATE, _WARM_UP, _CLIP = 4e-3, 0.1, 1.0
_MIN_BINS = 128


@dataclass(frozen=True)
class Point:
    """One validation: loss of the steps before it; total variation to the chain and error of the mean count."""

    step: int
    seconds: float
    loss: float
    tv_mean: float
    tv_95: float
    tv_max: float
    mean_error: float


@dataclass(frozen=True, eq=False)
class Trained:
    """A map, its validation curve, and the total variation of the mean PDF, which ignores the flux."""

    map: NeuralMap
    curve: list[Point]
    unconditional: float


class _Tensors:
    """Pairs in the frame of the network; waits relative to their mean: the PDF of a right mean count gives 1."""

    def __init__(self, pairs: Pairs) -> None:
        arrays = pairs.photons, pairs.pdf, pairs.wait / pairs.mean_wait[:, None]
        photons, pdf, wait = (torch.from_numpy(x).to(torch.float32) for x in arrays)
        self.photons, shift = canonical(photons)
        self.pdf, self.wait = rolled(pdf, shift), rolled(wait, shift)


@one_thread()
def train(
    system: System, training: Training | None = None, *, tell: Callable[[Point], object] | None = None
) -> Trained:
    """Train the map of a system; the loss is the total variation to the chain plus the relative error of the mean.

    Parameters
    ----------
    system
        Mode ``"nonparalyzable"``, at least 128 bins, a multiple of 64. Cycles and start do not matter.
    training
        Default: under two minutes on one core for 1024 bins.
    tell
        Called after each validation.
    """
    chosen = Training() if training is None else training
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    require_mode("the neural map", system)
    system = system.detected()
    checks.integer("bins of the neural map", system.bins, low=_MIN_BINS, high=2**16)
    torch.manual_seed(chosen.seed)
    network = PdfAutoencoder(system.bins, system.dead_time_periods, chosen.width, chosen.code)
    began, used = time.monotonic(), time.process_time()
    learn_on, held_out = (
        _Tensors(Pairs.of(chosen.fluxes.draw(system, n, np.random.default_rng([chosen.seed, k])), system))
        for k, n in ((1, chosen.pairs), (2, chosen.held_out))
    )
    mean_pdf = learn_on.pdf.mean(0)
    unconditional = float(0.5 * (held_out.pdf - mean_pdf).abs().sum(-1).mean())
    optimizer = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, total_steps=chosen.steps, pct_start=_WARM_UP)
    order = torch.Generator().manual_seed(chosen.seed)
    curve, losses = [_validate_on(network, held_out, 0, 0.0, float("nan"))], []
    for step in range(1, chosen.steps + 1):
        some = torch.randint(0, chosen.pairs, (chosen.batch,), generator=order)
        variation, error = _errors(network(learn_on.photons[some]), learn_on.pdf[some], learn_on.wait[some])
        loss = variation.mean() + error.mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), _CLIP)
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % chosen.every == 0 or step == chosen.steps:
            point = _validate_on(network, held_out, step, time.monotonic() - began, float(np.mean(losses)))
            curve.append(point)
            losses.clear()
            if tell is not None:
                tell(point)
    network.eval().requires_grad_(False)
    last = curve[-1]
    record: dict[str, Any] = {name: getattr(chosen, name) for name in ("steps", "pairs", "held_out", "seed")}
    record |= {
        "seconds": round(last.seconds, 1),
        "processor_seconds": round(time.process_time() - used, 1),
        **{name: getattr(last, name) for name in ("tv_mean", "tv_95", "tv_max", "mean_error")},
        "tv_unconditional": unconditional,
    }
    return Trained(NeuralMap(system, chosen.fluxes, network, record), curve, unconditional)


def _errors(log_pdf: Tensor, pdf: Tensor, wait: Tensor) -> tuple[Tensor, Tensor]:
    """Total variation, and relative error of the mean holding time, (P,) each."""
    result = log_pdf.exp()
    return 0.5 * (result - pdf).abs().sum(-1), ((result * wait).sum(-1) - 1.0).abs()


def _validate_on(network: PdfAutoencoder, held_out: _Tensors, step: int, seconds: float, loss: float) -> Point:
    network.eval()
    with torch.no_grad():
        variation, error = _errors(network(held_out.photons), held_out.pdf, held_out.wait)
    network.train()
    return Point(
        step,
        seconds,
        loss,
        float(variation.mean()),
        float(variation.quantile(0.95)),
        float(variation.max()),
        float(error.mean()),
    )


def save_curves(trained: Trained, stem: Path) -> list[Path]:
    """Write the validation curve as `stem`.csv and `stem`.png; returns the paths."""
    with style():
        figure, ((axes,),) = panels(3.2, 1, 1)
        steps = [p.step for p in trained.curve]
        for name, words in (("tv_mean", "mean"), ("tv_95", "95 %"), ("tv_max", "largest")):
            axes.plot(steps, [getattr(p, name) for p in trained.curve], label=f"total variation, {words}")
        axes.plot(steps, [p.mean_error for p in trained.curve], ":", label="relative error of the mean count, mean")
        axes.axhline(trained.unconditional, color="0.5", lw=1.0, ls="--", label="total variation, flux ignored")
        axes.set(yscale="log", xlabel="step of the training", ylabel="error on held-out fluxes", ylim=(1e-5, 1.0))
        axes.legend(ncols=2, loc="lower left")
    rows = [vars(point) for point in trained.curve]
    return [save_csv(stem.with_suffix(".csv"), rows), save_figure(stem.with_suffix(".png"), figure)]
