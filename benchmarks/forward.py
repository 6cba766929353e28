"""The differentiable forward model: value and gradient of a pixel, from a table and by itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Section
from benchmarks.timing import in_turn
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
            _rows(section, bins, config, bandwidth)
            _coarse(section, bins, config)
    finally:
        torch.set_num_threads(threads)
    return section


def _rows(section: Section, bins: int, config: Config, bandwidth: Bandwidth) -> None:
    system = ml.System(
        period_ns=1e3 / 7.5,
        cycles=config.cycles,
        bins=bins,
        pulse=ml.GaussianPulse(sigma_ns=0.5),
        detector=ml.Detector(dead_time_ns=75.0),
        start="stationary",
    )
    random = np.random.default_rng(0)
    s, b = np.exp(random.uniform(np.log(0.05), np.log(2.0), (2, PIXELS)))
    tau = random.uniform(0.0, system.period_ns, PIXELS)
    table = HistogramTable(ml.Table.build(system, (0.04, 2.1, 6), (0.04, 2.1, 6), threads=1))
    counts = torch.from_numpy(ml.simulate(ml.Flux(s[None], b[None], tau[None]), system, seed=0)[0, 0].astype(float))
    armed = system.replace(start="armed")
    models: dict[str, tuple[Callable[..., torch.Tensor], torch.dtype]] = {
        "expected_histogram": (lambda *x: expected_histogram(*x, system), torch.float32),
        "expected_histogram, double": (lambda *x: expected_histogram(*x, system), torch.float64),
        "expected_histogram, armed start": (lambda *x: expected_histogram(*x, armed), torch.float32),
        "HistogramTable": (table, torch.float32),
        "histogram_log_likelihood": (lambda *x: histogram_log_likelihood(counts, *x, system), torch.float32),
    }
    cases: dict[str, Callable[[], object]] = {
        "mean_histogram": lambda: ml.statistics.mean_histogram(ml.Flux(s, b, tau), system, threads=1)
    }
    for name, (model, dtype) in models.items():
        at = [torch.tensor(one, dtype=dtype) for one in (s, b, tau)]
        cases[name] = lambda model=model, at=at: model(*at)
        cases[name + ", gradient"] = lambda model=model, at=at: _gradient(model, at)
    for case in cases.values():  # what PyTorch and SciPy load when they are first needed
        case()
    timings = in_turn(cases, config)
    floor = bandwidth.seconds(4 * PIXELS * bins, threads=1, fresh=False) / PIXELS
    for name in ("mean_histogram", *models):
        value, both = (timings.get(one) for one in (name, name + ", gradient"))
        assert value is not None
        section.rows.append(
            {
                "case": name,
                "bins": bins,
                "value, CPU us a pixel": 1e6 * min(value.cpu) / PIXELS,
                "value and gradient": None if both is None else 1e6 * min(both.cpu) / PIXELS,
                "write floor us": 1e6 * floor,
            }
        )


def _coarse(section: Section, bins: int, config: Config) -> None:
    """The likelihood where bins are cut, beside its plain form: by the width of a bin, and re-armed in the pulse."""
    random = np.random.default_rng(0)
    s, b = np.exp(random.uniform(np.log(0.05), np.log(2.0), (2, _MANY)))
    counts = torch.from_numpy(random.poisson(30.0, (_MANY, bins)).astype(float))
    cases: dict[str, Callable[[], object]] = {}
    for sigmas, dead, words in (
        (0.34, 50.0, " (not cut)"),
        *(
            (wide, dead, words)
            for wide in (1.0, 3.0)
            for dead, words in ((75.0, ""), (99.0, ", re-armed in the pulse"), (51.0, ", after two dead times"))
        ),
    ):
        system = ml.System(
            period_ns=100.0,
            cycles=config.cycles,
            bins=bins,
            pulse=ml.GaussianPulse(sigma_ns=100.0 / bins / sigmas),
            detector=ml.Detector(dead_time_ns=dead),
        )
        at = [torch.from_numpy(one) for one in (s, b, random.uniform(0.0, 100.0, _MANY))]
        name = f"histogram_log_likelihood, bins of {sigmas:g} sigma{words}"
        model = partial(histogram_log_likelihood, counts, system=system)
        cases[name], cases[name + ", gradient"] = partial(model, *at), partial(_gradient, model, at)
    timings = in_turn(cases, config)
    for name in list(cases)[::2]:
        value, both = timings[name], timings[name + ", gradient"]
        section.rows.append(
            {
                "case": name,
                "bins": bins,
                "value, CPU us a pixel": 1e6 * min(value.cpu) / _MANY,
                "value and gradient": 1e6 * min(both.cpu) / _MANY,
                "write floor us": None,
            }
        )


def _gradient(model: Callable[..., torch.Tensor], at: list[torch.Tensor]) -> list[torch.Tensor | None]:
    leaves = [one.clone().requires_grad_() for one in at]
    model(*leaves).square().sum().backward()
    return [one.grad for one in leaves]


_NOTE = (
    "{pixels} pixels, S and B log-uniform on [0.05, 2], any delay, sigma 0.5 ns, t_d = 75 ns, stationary start; one "
    "thread. "
    "mean_histogram: the native recursion through the exposure, without gradients (several pixels share a vector). "
    "Floor: to write the histogram in float32. Bins of so many sigma: double, t_d = 75 of 100 ns, or 99 ns."
)
