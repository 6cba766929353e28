"""What each simulator predicts of a pixel: the law of its count and the shape of its mean histogram.

The simulators are those of the MaRS paper (arXiv 2512.04924) and ours. Those with a count law in closed form are
asked for it; any other engine of the registry is asked for a sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar import CountLaw, Flux, System, count_law, registration_pdf
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import ENGINES
from mars_lidar.statistics import photons_per_bin
from mars_lidar.statistics.count_pmf import Pmf
from mars_lidar.statistics.matched import matched_pmf
from studies.common.sample import draw
from studies.neural.pairs import Training

if TYPE_CHECKING:
    from studies.neural import NeuralEngine


# engines whose count law is evaluated instead of sampled, and those that are the truth
_IN_CLOSED_FORM = ("poisson", "renewal", "mars", "exact", "sequential")


@dataclass(frozen=True, eq=False)
class Prediction:
    """Of cells (cells,): mean and variance of the count, its pmfs, and the shape (cells, bins).

    `sampled` counts the exposures behind it, 0 where it is evaluated.
    """

    mean: FloatArray
    variance: FloatArray
    pmfs: list[Pmf]
    shape: FloatArray
    sampled: int = 0


Shape = Callable[[Flux, System], FloatArray]
Predict = Callable[[FloatArray, FloatArray, System], Prediction]


@dataclass(frozen=True)
class Simulator:
    """A simulator by name, in words, and how it is asked."""

    name: str
    words: str
    predict: Predict


def simulators(sampled: int, seed: int, training: Training | None = None) -> list[Simulator]:
    """All simulators; engines without a law in closed form are asked for `sampled` exposures.

    The network of the neural stand-in is trained for each system as `training` says, once;
    it is left out where PyTorch is not installed.
    """
    plan = training or Training()
    chain, exposure = (partial(registration_pdf, method=method) for method in ("chain", "exposure"))
    edge = partial(registration_pdf, method="chain", rearm="edge")

    def matched(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        """What a table holds of the exact law, and an engine with a table draws: four cumulants."""
        flux = centred(signal, background, system)
        cumulants, shape = count_law(flux, system, "exact").cumulants, exposure(flux, system)
        return Prediction(cumulants[:, 0], cumulants[:, 1], matched_pmf(cumulants), shape)

    def neural(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        engine = _trained(system.replace(cycles=1, start="armed"), plan)
        flux = centred(signal, background, system)
        return _of_law(engine.count_law(flux, system), engine.registration_pdf(flux, system))

    evaluated = [
        Simulator("poisson", "Poisson", _by_law(arrival_shape, method="poisson")),
        Simulator("renewal", "renewal", _by_law(chain, method="renewal")),
        Simulator("mars_centre", "MaRS, paper's, centre", _by_law(chain, method="mars")),
        Simulator("mars_edge", "MaRS, paper's, edge", _by_law(edge, method="mars", rearm="edge")),
        Simulator("mars_exact", "MaRS, ours, exact law", _by_law(exposure, method="exact")),
        Simulator("mars_matched", "MaRS, ours, four cumulants", matched),
    ]
    if find_spec("torch") is not None:  # the extra "learn"
        evaluated.append(Simulator("neural", "neural, stand-in", neural))
    others = [name for name in ENGINES if name not in _IN_CLOSED_FORM]
    return evaluated + [Simulator(name, f"{name} (sampled)", _sampler(name, sampled, seed)) for name in others]


def _of_law(law: CountLaw, shape: FloatArray) -> Prediction:
    """The prediction of a batched count law (cells,)."""
    pmfs = [Pmf(int(first), p) for first, p in zip(law.support[:, 0], law.pmf, strict=True)]
    return Prediction(law.mean, law.variance, pmfs, shape)


def _by_law(shape: Shape, **law: Any) -> Predict:
    def predict(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        flux = centred(signal, background, system)
        return _of_law(count_law(flux, system, **law), shape(flux, system))

    return predict


def centred(signal: FloatArray, background: FloatArray, system: System) -> Flux:
    """Light whose return is in the middle of the period."""
    return Flux(signal, background, 0.5 * system.period_ns)


def arrival_shape(flux: Flux, system: System) -> FloatArray:
    """Shape (cells, bins) of the arrivals, which is that of the flux."""
    shape = photons_per_bin(flux, system, bins=system.bins)
    return np.asarray(shape / shape.sum(-1, keepdims=True), dtype=np.float64)


@lru_cache(maxsize=8)
def _trained(system: System, training: Training) -> NeuralEngine:
    from studies.neural import NeuralEngine, train

    return NeuralEngine(train(system, training).map)


def _sampler(engine: str, realizations: int, seed: int) -> Predict:
    def predict(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        result = draw(engine, signal, background, system, realizations=realizations, seed=seed)
        mean = result.counts.mean(0, dtype=np.float64)
        variance = result.counts.var(0, dtype=np.float64, ddof=1)
        pmfs = [Pmf.of_counts(column) for column in result.counts.T]
        return Prediction(mean, variance, pmfs, result.shape, realizations)

    return predict
