"""Cells of the study "count-law": every simulator's law and shape against simulation, on declared grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar import Flux, System, count_law, registration_pdf
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.count_pmf import Pmf, kl_divergence
from studies import Tell
from studies.common.distance import wasserstein
from studies.common.sample import (
    NEAR_NS,
    PERIOD_NS,
    WIDE_NS,
    Grid,
    Sample,
    draw,
    linear_points,
    log_points,
    paper_grids,
    system_of,
)
from studies.neural.pairs import Training
from studies.neural.simulators import Prediction, arrival_shape, centred, simulators

FIGURES = ("wasserstein", "kl", "mean", "variance")  # distances of a law to the truth, in this order
_NEGLIGIBLE = 1e-10  # probability of a count left out of a resampling, per exposure drawn
SHAPES = {
    "poisson": "Poisson",
    "renewal": "renewal and MaRS, paper's, centre",
    "mars_edge": "MaRS, paper's, edge",
}


@dataclass(frozen=True)
class Settings:
    """Configuration of the study; `realizations` of the truth, `sampled` of engines without a law."""

    grids: tuple[Grid, ...]
    realizations: int
    resamplings: int
    sampled: int
    dead_sweep: tuple[float, ...]  # dead times in periods at which shapes are compared
    sweep_flux: tuple[float, ...]
    cycles: int = 1000
    bins: int = 1024
    sigma_ns: float = 0.5
    seed: int = 20266
    steps: int = 1750  # of the training of the neural stand-in, for each system
    pairs: int = 6000

    def system(self, period_ns: float, dead_ns: float) -> System:
        """System of a grid."""
        return system_of(dead_ns, self.cycles, period_ns=period_ns, bins=self.bins, sigma_ns=self.sigma_ns)


FULL = Settings(
    grids=paper_grids(8, WIDE_NS, NEAR_NS),
    realizations=100_000,
    resamplings=200,
    sampled=4_000,
    dead_sweep=linear_points(40, 0.05, 2.0),
    sweep_flux=log_points(8),
)
QUICK = Settings(
    grids=paper_grids(2, (25.0, 75.0), (50.0,)),
    realizations=400,
    resamplings=50,
    sampled=40,
    dead_sweep=(0.1875, 0.6375, 1.3),
    sweep_flux=(0.1, 5.0),
    cycles=100,
    bins=256,
    steps=60,
    pairs=200,
)


@dataclass(frozen=True, eq=False)
class Score:
    """One simulator in one cell: its distances, what sampling alone makes of them, and how its shape differs.

    `figures` (4,) in the order of `FIGURES`; `floors` (resamplings, 4) the same figures of samples of the exact
    law; `shape` and `shape_floor` total variations of the mean histogram; `noise` the standard error of a difference
    in units of the truth's own, above 1 for a simulator that is sampled itself.
    """

    figures: FloatArray
    floors: FloatArray
    shape: float
    shape_floor: float
    noise: float


@dataclass(frozen=True, eq=False)
class Cell:
    """One pixel: the truth and the score of every simulator."""

    grid: str
    period_ns: float
    signal: float
    background: float
    dead_ns: float
    mean: float
    variance: float
    exact: FloatArray  # (4,) cumulants
    realizations: int
    scores: dict[str, Score]
    truth: Pmf
    laws: dict[str, Pmf]

    def name(self) -> str:
        """The cell in words."""
        flux = f"S = {self.signal:.3g}, B = {self.background:.3g}"
        return f"{flux}, t_d = {self.dead_ns:g} ns, t_r = {self.period_ns:.4g} ns"

    @property
    def mean_error(self) -> float:
        """Standard error of the simulated mean."""
        return float(np.sqrt(self.exact[1] / self.realizations))

    @property
    def variance_error(self) -> float:
        """Standard error of the simulated variance."""
        return float(np.sqrt(max(self.exact[3] + 2.0 * self.exact[1] ** 2, 0.0) / self.realizations))


def compute(settings: Settings, truth: str, tell: Tell) -> list[Cell]:
    """All cells of all grids against simulation by engine `truth`."""
    cells: list[Cell] = []
    number = 0
    for grid in settings.grids:
        for dead_ns in grid.dead_ns:
            cells += _system_cells(settings, grid, dead_ns, truth, number)
            number += 1
            tell(f"count-law: {grid.name}, t_d = {dead_ns:g} ns, {len(grid.flux) ** 2} cells")
    return cells


def _system_cells(settings: Settings, grid: Grid, dead_ns: float, truth: str, number: int) -> list[Cell]:
    system = settings.system(grid.period_ns, dead_ns)
    signal, background = grid.cells
    seed, size = (settings.seed << 16) + number, settings.realizations
    sample = draw(truth, signal, background, system, realizations=size, seed=seed)
    # another seed: an engine must not share random numbers with the truth
    training = Training(steps=settings.steps, pairs=settings.pairs, held_out=min(500, settings.pairs))
    asked = simulators(settings.sampled, seed + (1 << 40), training)
    predictions = {item.name: item.predict(signal, background, system) for item in asked}
    cumulants = count_law(Flux(signal, background, 0.5 * system.period_ns), system, "exact").cumulants
    random = np.random.default_rng([settings.seed, number])
    cells = []
    for k in range(signal.size):
        counts = sample.counts[:, k].astype(np.float64)
        cells.append(
            Cell(
                grid.name,
                grid.period_ns,
                float(signal[k]),
                float(background[k]),
                dead_ns,
                float(counts.mean()),
                float(counts.var(ddof=1)),
                cumulants[k],
                size,
                _scores(settings, sample, predictions, k, random),
                Pmf.of_counts(sample.counts[:, k]),
                {name: prediction.pmfs[k] for name, prediction in predictions.items()},
            )
        )
    return cells


def _scores(
    settings: Settings, sample: Sample, predictions: dict[str, Prediction], k: int, random: np.random.Generator
) -> dict[str, Score]:
    """Scores of every simulator in cell `k`."""
    exact, size, result = predictions["mars_exact"], settings.realizations, Pmf.of_counts(sample.counts[:, k])
    noise: dict[int, FloatArray] = {}
    scores = {}
    for name, prediction in predictions.items():
        if prediction.sampled not in noise:
            noise[prediction.sampled] = resampled_figures(
                exact.pmfs[k], size, prediction.sampled, settings.resamplings, random
            )
        shape = 0.5 * float(np.abs(sample.shape[k] - prediction.shape[k]).sum())
        # a sample has its own noise as well, as much as the truth's for the same number of exposures
        own = float(np.sqrt(1.0 + size / prediction.sampled)) if prediction.sampled else 1.0
        figures = law_figures(
            result, prediction.pmfs[k], float(prediction.mean[k]), float(prediction.variance[k]), size
        )
        scores[name] = Score(figures, noise[prediction.sampled], shape, own * float(sample.shape_floor[k]), own)
    return scores


def law_figures(sample: Pmf, law: Pmf, mean: float, variance: float, size: int) -> FloatArray:
    """`FIGURES` (4,) of a law with its own mean and variance, against frequencies of `size` simulated counts."""
    low, high = min(sample.first, law.first), max(sample.last, law.last)
    result = _figures(sample.on(low, high)[None], law.on(low, high), low, mean, variance, size)
    return np.asarray(result[0], dtype=np.float64)


def resampled_figures(law: Pmf, size: int, sampled: int, number: int, random: np.random.Generator) -> FloatArray:
    """`FIGURES` (number, 4) of samples of `size` counts drawn from `law` against the law itself.

    With `sampled` > 0 against other samples of that many counts instead: the floor of a law known by sampling.
    """
    selected = np.flatnonzero(law.p > _NEGLIGIBLE / size)
    first, p = law.first + int(selected[0]), law.p[selected[0] : selected[-1] + 1]
    p = p / p.sum()
    counts = first + np.arange(p.size)
    mean = float((p * counts).sum())
    variance = float((p * (counts - mean) ** 2).sum())
    drawn = random.multinomial(size, p, number) / size
    if not sampled:
        return _figures(drawn, p, first, mean, variance, size)
    others = random.multinomial(sampled, p, number) / sampled
    rows = []
    for frequency, other in zip(drawn, others, strict=True):
        own = float((other * counts).sum())
        spread = float((other * (counts - own) ** 2).sum()) * sampled / (sampled - 1)
        rows.append(_figures(frequency[None], other, first, own, spread, size)[0])
    return np.array(rows)


def _figures(sample: FloatArray, law: FloatArray, first: int, mean: float, variance: float, size: int) -> FloatArray:
    """`FIGURES` (n, 4) of frequencies `sample` (n, w) of `size` counts against `law` (w,), counts from `first`."""
    offset = first + np.arange(law.size) - mean
    shift = sample @ offset
    spread = (sample @ offset**2 - shift**2) * size / (size - 1)
    return np.stack(
        [wasserstein(sample, law), kl_divergence(sample, law), np.abs(shift), np.abs(spread - variance)], axis=-1
    )


def shape_sweep(settings: Settings, tell: Tell) -> dict[str, FloatArray]:
    """Total variation (dead times, cells) of each of `SHAPES` to the exposure's exact mean histogram."""
    signal, background = (g.ravel() for g in np.meshgrid(settings.sweep_flux, settings.sweep_flux, indexing="ij"))
    results: dict[str, list[FloatArray]] = {name: [] for name in SHAPES}
    for dead in settings.dead_sweep:
        system = settings.system(PERIOD_NS, dead * PERIOD_NS)
        flux = centred(signal, background, system)
        truth = registration_pdf(flux, system, "exposure")
        shapes = {
            "poisson": arrival_shape(flux, system),
            "renewal": registration_pdf(flux, system, "chain"),
            "mars_edge": registration_pdf(flux, system, "chain", rearm="edge"),
        }
        for name, shape in shapes.items():
            results[name].append(0.5 * np.abs(shape - truth).sum(-1))
    tell(f"count-law: shapes at {len(settings.dead_sweep)} dead times, {signal.size} cells each")
    return {name: np.array(rows) for name, rows in results.items()}
