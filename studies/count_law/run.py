"""Study "count-law", T1 of the MaRS paper: every simulator's count law and shape against simulation.

The simulators are those of the MaRS paper (arXiv 2512.04924) and ours. Those with a count law in closed form are
asked for it; any other engine of the registry is asked for a sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mars_lidar import CountLaw, Flux, System, count_law, registration_pdf
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import ENGINES
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from mars_lidar.statistics import photons_per_bin
from mars_lidar.statistics.matched import matched_pmf
from mars_lidar.statistics.pmf import Pmf, kl_divergence
from mars_lidar.statistics.tolerances import TOL
from studies import Facts, Request, Tell
from studies.common.distance import wasserstein
from studies.common.draw import panels
from studies.common.report import Row, picked
from studies.common.sample import NEAR_NS, WIDE_NS, Grid, Sample, draw, paper_grids, system_of

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


_Shape = Callable[[Flux, System], FloatArray]
_Predict = Callable[[FloatArray, FloatArray, System], Prediction]


@dataclass(frozen=True)
class Simulator:
    """A simulator by name, in words, and how it is asked."""

    name: str
    words: str
    predict: _Predict


def simulators(sampled: int, seed: int, steps: int = 1750, pairs: int = 6000) -> list[Simulator]:
    """All simulators; engines without a law in closed form are asked for `sampled` exposures.

    The network of the neural stand-in is trained for each system, once, in so many `steps` on so many `pairs`; it is
    left out where PyTorch is not installed.
    """
    chain, exposure = (partial(registration_pdf, method=method) for method in ("chain", "exposure"))
    edge = partial(registration_pdf, method="chain", rearm="edge")

    def matched(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        """What a table holds of the exact law, and an engine with a table draws: four cumulants."""
        flux = centred(signal, background, system)
        cumulants, shape = count_law(flux, system, "exact").cumulants, exposure(flux, system)
        return Prediction(cumulants[:, 0], cumulants[:, 1], matched_pmf(cumulants), shape)

    def neural(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        engine = _trained(system.replace(cycles=1, start="armed"), steps, pairs)
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


def _by_law(shape: _Shape, **law: Any) -> _Predict:
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
def _trained(system: System, steps: int, pairs: int) -> Any:
    from studies.neural import NeuralEngine, Training, train

    return NeuralEngine(train(system, Training(steps=steps, pairs=pairs, held_out=min(500, pairs))).map)


def _sampler(engine: str, realizations: int, seed: int) -> _Predict:
    def predict(signal: FloatArray, background: FloatArray, system: System) -> Prediction:
        result = draw(engine, signal, background, system, realizations=realizations, seed=seed)
        mean = result.counts.mean(0, dtype=np.float64)
        variance = result.counts.var(0, dtype=np.float64, ddof=1)
        pmfs = [Pmf.of_counts(column) for column in result.counts.T]
        return Prediction(mean, variance, pmfs, result.shape, realizations)

    return predict


FIGURES = ("wasserstein", "kl", "mean", "variance")  # distances of a law to the truth, in this order
_NEGLIGIBLE = 1e-10  # probability of a count left out of a resampling, per exposure drawn


@dataclass(frozen=True)
class Settings:
    """Configuration of the study; `realizations` of the truth, `sampled` of engines without a law."""

    grids: tuple[Grid, ...]
    realizations: int
    resamplings: int
    sampled: int
    cycles: int = 1000
    bins: int = 1024
    sigma_ns: float = 0.5
    seed: int = 20266
    steps: int = 1750  # of the training of the neural stand-in, for each system
    pairs: int = 6000

    def system(self, period_ns: float, dead_ns: float) -> System:
        """System of a grid."""
        return system_of(dead_ns, self.cycles, period_ns=period_ns, bins=self.bins, sigma_ns=self.sigma_ns)


FULL = Settings(grids=paper_grids(8, WIDE_NS, NEAR_NS), realizations=100_000, resamplings=200, sampled=4_000)
QUICK = Settings(
    grids=paper_grids(2, (25.0, 75.0), (50.0,)),
    realizations=400,
    resamplings=50,
    sampled=40,
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
    asked = simulators(settings.sampled, seed + (1 << 40), settings.steps, settings.pairs)
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


PANELS = ((0.07, 0.07, 25.0), (0.5, 0.5, 50.0), (4.0, 0.5, 75.0), (10.0, 10.0, 100.0))  # nearest cells are drawn
_LINES = {
    "mars_exact": (INK, "-", 2.0),
    "mars_matched": (COLOURS[1], ":", 1.4),
    "mars_centre": (COLOURS[4], "-", 1.0),
    "mars_edge": (COLOURS[3], "--", 1.0),
    "renewal": (COLOURS[2], "-", 1.0),
    "neural": (COLOURS[5], "-", 1.4),
    "poisson": (COLOURS[0], "-", 1.0),
}
_LEGEND = {
    "poisson": "Poisson",
    "renewal": "renewal",
    "mars_centre": "MaRS, paper's, centre",
    "mars_edge": "MaRS, paper's, edge",
    "mars_exact": "MaRS, ours, exact",
    "mars_matched": "MaRS, ours, four cumulants",
    "neural": "neural, stand-in",
}
_REACH = 30.0  # standard deviations beyond which a law is named at the panel's side instead of drawn


def _colour(name: str) -> tuple[str, str, float]:
    return _LINES.get(name, (MUTED, "-.", 1.0))  # engines whose law is known by sampling


def law_panels(cells: Sequence[Cell]) -> Figure:
    """Four count laws beside the simulated frequencies; the inset compares KL with its floor."""
    grid = [cell for cell in cells if cell.grid == "wide"]
    figure, axes = panels(5.0, 2, 2)
    for ax, target in zip(axes.flat, PANELS, strict=True):
        near = (np.abs(np.log([c.signal / target[0], c.background / target[1]])).sum() for c in grid)
        apart = [float(flux) + abs(c.dead_ns - target[2]) / 25.0 for flux, c in zip(near, grid, strict=True)]
        _panel(ax, grid[int(np.argmin(apart))])
    for ax in axes[-1]:
        ax.set_xlabel("registrations N")
    for row in axes:
        row[0].set_ylabel("P(N)")
    handles = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if sampled := [name for name in grid[0].laws if name not in _LINES]:
        handles[f"{', '.join(sampled)}: KL only"] = Patch(color=MUTED)
    figure.legend(handles.values(), handles.keys(), frameon=False, loc="outside lower center", ncols=4)
    return figure


def _panel(ax: Axes, cell: Cell) -> None:
    spread = max(float(cell.exact[1]) ** 0.5, 0.5)
    low, high = cell.mean - 5.0 * spread, cell.mean + 5.0 * spread
    beyond = []
    drawn = {name: law for name, law in cell.laws.items() if name in _LINES}  # a sampled law is mostly noise
    for name, law in drawn.items():
        at = law.first + np.arange(law.p.size)
        centre = float((law.p * at).sum())
        own = float((law.p * (at - centre) ** 2).sum()) ** 0.5
        if abs(centre - cell.mean) > _REACH * spread:
            beyond.append(f"{_LEGEND.get(name, name)}: mean {centre:.0f} \N{RIGHTWARDS ARROW}")
            continue
        low, high = min(low, centre - 3.5 * own), max(high, centre + 3.5 * own)
    first, last = max(0, int(np.floor(low))), int(np.ceil(high))
    counts = np.arange(first, last + 1)
    ax.fill_between(
        counts, cell.truth.on(first, last), step="mid", color="#d0d0d0", lw=0.0, label="simulation", zorder=0
    )
    for name, law in drawn.items():
        colour, dash, width = _colour(name)
        above = 1 if name == "mars_exact" else 2  # thin lines over the thick one
        here = law.on(first, last)
        ax.plot(counts, here, ls=dash, lw=width, color=colour, label=_LEGEND.get(name, name), zorder=above)
    top = 1.15 * max(float(pmf.on(first, last).max()) for pmf in (cell.truth, *drawn.values()))
    # room at the right for the inset
    ax.set(xlim=(first, last + 0.55 * (last - first)), ylim=(0.0, top))
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.set_title(f"S = {cell.signal:.3g}, B = {cell.background:.3g}, $t_d$ = {cell.dead_ns:g} ns", loc="left")
    if beyond:
        ax.text(0.63, 0.08, "\n".join(beyond), transform=ax.transAxes, fontsize=6.0, color=MUTED)
    _inset(ax, cell)


def _inset(ax: Axes, cell: Cell) -> None:
    """Bars of KL(simulation || law), the sampling floor as a line."""
    names = list(cell.scores)
    at = FIGURES.index("kl")
    inset = ax.inset_axes((0.72, 0.42, 0.28, 0.52))
    values = [max(float(cell.scores[name].figures[at]), 1e-5) for name in names]
    inset.bar(np.arange(len(names)), values, color=[_colour(name)[0] for name in names], width=0.75)
    inset.axhline(float(cell.scores["mars_exact"].floors[:, at].mean()), color=INK, lw=0.6, ls=":")
    inset.set(yscale="log", ylim=(1e-5, 100.0), xticks=[], yticks=[1e-4, 1e-2, 1.0])
    inset.minorticks_off()
    inset.tick_params(labelsize=5.5)
    inset.set_title("KL, nats (dots: floor)", fontsize=6.0)


PAPER = {  # T1 of arXiv 2512.04924: Wasserstein, KL, mean difference, variance difference
    "poisson": (7966.130, 24.208, 7966.130, 9257.464),
    "renewal": (207.565, 18.821, 207.564, 45.927),
    "neural": (2.337, 0.409, 0.282, 64.558),
    "mars_centre": (0.309, 0.013, 0.269, 1.588),
    "mars_edge": (0.309, 0.013, 0.269, 1.588),
}
PAPER_ROWS = {"Poisson": "poisson", "renewal": "renewal", "Zhang et al.": "neural", "MaRS": "mars_centre"}
OURS = ("mars_exact", "mars_matched")
KL_ABOVE_FLOOR = 0.001  # what ours may have
_ONE_IN_1000 = 3.09  # standard deviations of the average's own noise

# right: in at least RIGHT_CELLS of the cells off by at most this, or by SCORES of the simulation's own errors
RIGHT_MEAN, RIGHT_VARIANCE, RIGHT_SHAPE = 0.01, 0.05, 0.01
RIGHT_CELLS, SCORES = 0.95, 4.0


def average(cells: Sequence[Cell], name: str) -> tuple[list[float], list[float], list[float]]:
    """Of one simulator over cells: figures, their sampling floors, and limits that chance exceeds once in 1000."""
    figures = np.mean([c.scores[name].figures for c in cells], axis=0)
    floors = np.mean([c.scores[name].floors for c in cells], axis=0)  # (resamplings, 4)
    floor = floors.mean(0)
    limit = floor + _ONE_IN_1000 * floors.std(0, ddof=1)
    return figures.tolist(), floor.tolist(), limit.tolist()


def right(cell: Cell, name: str) -> dict[str, bool]:
    """Whether a simulator has the cell's mean, variance and shape right, to the stated thresholds."""
    score = cell.scores[name]
    errors = SCORES * score.noise
    mean, variance = (float(score.figures[FIGURES.index(key)]) for key in ("mean", "variance"))
    return {
        "mean": mean <= max(RIGHT_MEAN * float(cell.exact[0]), errors * cell.mean_error),
        "variance": variance <= max(RIGHT_VARIANCE * float(cell.exact[1]), errors * cell.variance_error),
        "shape": score.shape <= max(RIGHT_SHAPE, 2.0 * score.shape_floor),
    }


def _row(name: str, words: str, cells: Sequence[Cell]) -> dict[str, Any]:
    """What the report says of one simulator on one grid."""
    figures, floor, limit = average(cells, name)
    judged = [right(cell, name) for cell in cells]
    kl, paper = FIGURES.index("kl"), PAPER.get(name, ())
    return {
        "name": name,
        "words": words,
        "figures": figures,
        "floor": floor,
        "limit": limit,
        "shape": float(np.mean([c.scores[name].shape for c in cells])),
        "shape_floor": float(np.mean([c.scores[name].shape_floor for c in cells])),
        "paper": paper,
        "worse": [key for key, own, his in zip(FIGURES, figures, paper, strict=False) if own > his],
        "ours": name in OURS,
        "excess": figures[kl] - floor[kl],
        "allowed": max(KL_ABOVE_FLOOR, limit[kl] - floor[kl]),
        "right": {key: float(np.mean([item[key] for item in judged])) for key in ("mean", "variance", "shape")},
    }


def run(settings: Settings, request: Request) -> Facts:
    """All cells and their figure."""
    cells = compute(settings, request.truth, request.tell)
    first = cells[0].scores
    words = {simulator.name: simulator.words for simulator in simulators(1, 0) if simulator.name in first}
    by_grid = {grid.name: [cell for cell in cells if cell.grid == grid.name] for grid in settings.grids}
    return {
        "truth": request.truth,
        "kl_floor": TOL.tail,
        "sampled": [name for name in first if first[name].noise > 1.0],
        "grids": {
            name: [_row(simulator, said, here) for simulator, said in words.items()] for name, here in by_grid.items()
        },
        "keys": FIGURES,
        "rows": [_csv_row(cell) for cell in cells],
        "figures": {"panels": law_panels(cells)},
    }


def _csv_row(cell: Cell) -> Row:
    row: dict[str, object] = {
        **picked(cell, "grid period_ns signal background dead_time_ns=dead_ns"),
        **picked(cell, "simulated_mean=mean simulated_variance=variance"),
        "exact_mean": float(cell.exact[0]),
        "exact_variance": float(cell.exact[1]),
    }
    floor = cell.scores["mars_exact"].floors.mean(0)
    row |= {f"floor_{key}": float(v) for key, v in zip(FIGURES, floor, strict=True)}
    row["floor_shape"] = cell.scores["mars_exact"].shape_floor
    for name, score in cell.scores.items():
        row |= {f"{name}_{key}": float(v) for key, v in zip(FIGURES, score.figures, strict=True)}
        row[f"{name}_shape"] = score.shape
    return row
