"""The differentiable forward model: value and gradient of a pixel, from a table and by itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Section
from benchmarks.timing import in_turn
from benchmarks.workload import system as canonical_system
from mars_lidar.learn import HistogramTable, expected_histogram, histogram_log_likelihood

PIXELS = 64
_MANY = 512  # where calls of PyTorch would count otherwise


def forward(config: Config, bandwidth: Bandwidth) -> Section:
    """One thread; the exact mean histogram, which has no gradient, beside them."""
    section = Section("Differentiable forward model", notes=[_NOTE.format(pixels=PIXELS)])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for bins in sorted({64, config.bins}):
            floor = bandwidth.seconds(4 * bins, threads=1, fresh=False)
            _timed(section, bins, config, _models(bins, config), PIXELS, floor)
            _timed(section, bins, config, _coarse(bins, config), _MANY, None)
    finally:
        torch.set_num_threads(threads)
    return section


Cases = dict[str, tuple[Callable[..., Any], list[torch.Tensor] | None]]  # functions and where their gradients are taken


def _timed(section: Section, bins: int, config: Config, models: Cases, pixels: int, floor: float | None) -> None:
    cases: dict[str, Callable[[], object]] = {}
    for name, (model, at) in models.items():
        cases[name] = partial(model, *(at or ()))
        if at is not None:
            cases[name + ", gradient"] = partial(_gradient, model, at)
    for case in cases.values():  # what PyTorch and SciPy load when they are first needed
        case()
    cost = {name: 1e6 * min(timing.cpu) / pixels for name, timing in in_turn(cases, config).items()}
    section.rows += [
        {
            "case": name,
            "bins": bins,
            "value, CPU us a pixel": cost[name],
            "value and gradient": cost.get(name + ", gradient"),
            "write floor us": None if floor is None else 1e6 * floor,
        }
        for name in models
    ]


def _light(random: np.random.Generator, pixels: int, period_ns: float) -> list[NDArray[np.float64]]:
    """S, B and delays."""
    s, b = np.exp(random.uniform(np.log(0.05), np.log(2.0), (2, pixels)))
    return [s, b, random.uniform(0.0, period_ns, pixels)]


def _models(bins: int, config: Config) -> Cases:
    system = canonical_system(config, dead_time_ns=75.0, bins=bins, start="stationary")
    s, b, tau = _light(np.random.default_rng(0), PIXELS, system.period_ns)
    table = HistogramTable(ml.Table.build(system, (0.04, 2.1, 6), (0.04, 2.1, 6), threads=1))
    counts = torch.from_numpy(ml.simulate(ml.Flux(s[None], b[None], tau[None]), system, seed=0)[0, 0].astype(float))
    at, double = (
        [torch.tensor(values, dtype=dtype) for values in (s, b, tau)] for dtype in (torch.float32, torch.float64)
    )
    armed = system.replace(start="armed")
    return {
        "mean_histogram": (lambda: ml.mean_histogram(ml.Flux(s, b, tau), system, threads=1), None),
        "expected_histogram": (partial(expected_histogram, system=system), at),
        "expected_histogram, double": (partial(expected_histogram, system=system), double),
        "expected_histogram, armed start": (partial(expected_histogram, system=armed), at),
        "HistogramTable": (table, at),
        "histogram_log_likelihood": (partial(histogram_log_likelihood, counts, system=system), at),
    }


def _coarse(bins: int, config: Config) -> Cases:
    """The likelihood by the width of a bin, and re-armed in the pulse."""
    light = _light(np.random.default_rng(0), _MANY, 100.0)
    at = [torch.from_numpy(values) for values in light]
    cases: Cases = {}
    again, twice = ", re-armed in the pulse", ", re-armed after two dead times"
    for sigmas, dead, words in (
        (0.34, 50.0, ""),
        *((wide, dead, words) for wide in (1.0, 3.0) for dead, words in ((75.0, ""), (99.0, again), (51.0, twice))),
    ):
        system = ml.System(
            period_ns=100.0,
            cycles=config.cycles,
            bins=bins,
            pulse=ml.GaussianPulse(sigma_ns=100.0 / bins / sigmas),
            detector=ml.Detector(dead_time_ns=dead),
        )
        flux = ml.Flux(*(values[None] for values in light))
        counts = torch.from_numpy(ml.simulate(flux, system, seed=0, threads=1)[0, 0].astype(float))
        name = f"histogram_log_likelihood, bins of {sigmas:g} sigma{words}"
        cases[name] = partial(histogram_log_likelihood, counts, system=system), at
    return cases


def _gradient(model: Callable[..., torch.Tensor], at: list[torch.Tensor]) -> list[torch.Tensor | None]:
    leaves = [values.clone().requires_grad_() for values in at]
    model(*leaves).square().sum().backward()
    return [leaf.grad for leaf in leaves]


_NOTE = (
    "{pixels} pixels, S and B log-uniform on [0.05, 2], any delay, sigma 0.5 ns, t_d = 75 ns, stationary start; one "
    "thread. "
    "mean_histogram: the native recursion through the exposure, without gradients (several pixels share a vector). "
    "Floor: to write the histogram in float32. Bins of so many sigma: double, t_d = 75 of 100 ns, or 99 ns."
)
