"""Study "joint-covariance": the histogram's covariance in closed form against simulation.

The systems are random, and those of reference cases (`reference`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mars_lidar import Flux, JointLaw, System, joint_law, simulate
from mars_lidar._base.types import FloatArray
from studies import Facts, Request, Tell
from studies.common import sample
from studies.common.report import Row, picked
from studies.joint.table import random_light

PERIOD_NS = 100.0
OFTEN = 500  # exposures that must differ from the rest before a z-score is as good as Gaussian
TOLERANCE = 1e-4
_SINGLE = tuple(f"{of}, {what}" for of in ("count", "window", "random weights") for what in ("mean", "variance"))
_WORST = 10  # systems listed


@dataclass(frozen=True)
class Settings:
    """How many random systems of how many exposures each."""

    systems: int
    exposures: int
    bins: int = 64
    cycles: tuple[float, float] = (1e3, 2e4)
    seed: int = 20264


FULL = Settings(systems=200, exposures=4000)
QUICK = Settings(systems=12, exposures=1000, cycles=(300.0, 1000.0))


@dataclass(frozen=True, eq=False)
class Outcome:
    """One system: its law, and simulation less law in standard errors.

    `single` holds one number each; `bins` and `lags` (few or none) the z of the variances of bins and of the
    covariances of neighbours, of all that vary often enough, with the bins' numbers.
    """

    name: str
    settings: dict[str, float | str]
    law: JointLaw
    single: dict[str, float]
    bins: FloatArray
    bin_index: NDArray[np.intp]
    lags: FloatArray
    lag_index: NDArray[np.intp]
    leading: dict[str, float] = field(default_factory=dict)
    inputs: tuple[float, float, float, System] | None = None

    def scores(self) -> dict[str, float]:
        """Every z by name."""
        bins = {f"variance of bin {j}": float(z) for z, j in zip(self.bins, self.bin_index, strict=True)}
        lags = {f"covariance at {j}": float(z) for z, j in zip(self.lags, self.lag_index, strict=True)}
        return self.single | bins | lags

    def chosen(self, kind: str, random: np.random.Generator) -> float | None:
        """z of one bin or lag at random: independent between systems, unlike those of one system."""
        values = self.bins if kind == "bins" else self.lags
        return float(values[random.integers(values.size)]) if values.size else None

    def worst(self) -> tuple[float, str]:
        """The largest |z| of all, and what it belongs to."""
        return max(((abs(z), name) for name, z in self.scores().items()), default=(0.0, "nothing varies"))


def system_of(sigma: float, dead: float, cycles: int, bins: int, start: str = "armed") -> System:
    """A system with times in periods."""
    return sample.system_of(
        dead * PERIOD_NS,
        cycles,
        period_ns=PERIOD_NS,
        bins=bins,
        sigma_ns=sigma * PERIOD_NS,
        start="stationary" if start == "stationary" else "armed",
    )


def random_systems(settings: Settings, tell: Tell) -> list[Outcome]:
    """Random systems, a third of them with dead times near whole periods, against the exact engine."""
    random = np.random.default_rng(settings.seed)
    found = []
    for k in range(settings.systems):
        signal, background, dead = random_light(random, k)
        sigma, delay = 10 ** random.uniform(-2.7, -1.5), random.uniform(0, 1)
        cycles = int(np.exp(random.uniform(*np.log(settings.cycles))))
        start = "stationary" if k % 2 else "armed"
        system = system_of(sigma, dead, cycles, settings.bins, start)
        found.append(_compare(k, signal, background, float(delay), system, settings))
        if k % 20 == 19:
            tell(f"joint-covariance: {k + 1} of {settings.systems} systems")
    return found


def second_look(o: Outcome, settings: Settings) -> float | None:
    """The worst z of a system again, from other and four times as many exposures: chance does not come back."""
    assert o.inputs is not None
    more = replace(settings, exposures=4 * settings.exposures, seed=settings.seed + 1_000_000)
    return _compare(int(o.name), *o.inputs, more, weights=settings.seed).scores().get(o.worst()[1])


def _compare(
    k: int,
    signal: float,
    background: float,
    delay: float,
    system: System,
    settings: Settings,
    weights: int | None = None,
) -> Outcome:
    """System number `k`; `weights` is the seed of the random weights, by default that of the settings."""
    random = np.random.default_rng([settings.seed if weights is None else weights, k])
    law = joint_law(signal, background, system, delay_ns=delay * PERIOD_NS, tolerance=TOLERANCE)
    flux = Flux(signal=signal, background=background, delay_ns=delay * PERIOD_NS)
    cube = simulate(flux, system, realizations=settings.exposures, seed=settings.seed + k)
    x = cube.reshape(settings.exposures, -1).astype(np.float64)
    centre = (np.arange(system.bins) + 0.5) / system.bins
    reach = max(3.0 * system.pulse.sigma_ns / PERIOD_NS, 1.0 / system.bins)  # type: ignore[attr-defined]
    window = (np.abs((centre - delay + 0.5) % 1.0 - 0.5) <= reach).astype(float)
    windows = {"count": np.ones(system.bins), "window": window, "random weights": random.normal(size=system.bins)}
    single = {}
    for name, w in windows.items():
        mean, variance = law.window(w)
        if name == "random weights" or variance * len(x) >= OFTEN:
            value = x @ w
            single[f"{name}, mean"] = float((value.mean() - mean) / np.sqrt(variance / len(x)))
            single[f"{name}, variance"] = float(variance_scores(value[:, None], np.array([variance]))[0])
    often = law.variance * len(x) >= OFTEN
    pairs = often & np.roll(often, -1)
    deviation = x - law.mean
    product = deviation * np.roll(deviation, -1, axis=1)
    error = product[:, pairs].std(0) / np.sqrt(len(x))
    return Outcome(
        name=str(k),
        settings={
            "S": signal,
            "B": background,
            "t_d": system.dead_time_periods,
            "cycles": float(system.cycles),
            "sigma": system.pulse.sigma_ns / PERIOD_NS,  # type: ignore[attr-defined]
            "start": system.start,
        },
        law=law,
        single=single,
        bins=variance_scores(x[:, often], law.variance[often]),
        bin_index=np.flatnonzero(often),
        lags=np.asarray((product[:, pairs].mean(0) - law.lag(1)[pairs]) / error),
        lag_index=np.flatnonzero(pairs),
        inputs=(signal, background, delay, system),
    )


def variance_scores(x: FloatArray, variance: FloatArray) -> FloatArray:
    """z (k,) of the sample variances of x (n, k) against known ones, by logarithm; error from the fourth moment."""
    square = (x - x.mean(0)) ** 2
    second = square.mean(0)
    spread = np.sqrt(((square**2).mean(0) / second**2 - 1.0) / len(x))
    return np.asarray(np.log(second * len(x) / (len(x) - 1) / variance) / spread)


def run(request: Request) -> Facts:
    """Random systems and the reference cases, compared with the closed form."""
    from studies.joint.covariance_figures import figure
    from studies.joint.reference import reference_case

    settings = QUICK if request.quick else FULL
    systems = random_systems(settings, request.tell)
    cases = [reference_case(path) for path in sorted(request.data.glob("*.json"))] if request.data else []
    scores = _scores(systems, settings)
    numbers = sum(len(o.single) + o.bins.size + o.lags.size for o in systems)
    by_z = sorted(systems, key=lambda o: -o.worst()[0])
    return {
        "s": settings,
        "laws": [
            (name, z, stats.kstest(z, "norm").pvalue, stats.chi2.sf(float(np.sum(z**2)), z.size))
            for name, z in scores.items()
        ],
        "numbers": numbers,
        "rms": _rms(np.concatenate([np.concatenate([list(o.single.values()), o.bins, o.lags]) for o in systems])),
        "rms_of": _rms,
        "largest": by_z[0].worst()[0],
        "expected": stats.norm.isf(0.5 / numbers),
        "settled": sum(o.law.settled >= 0 for o in systems),
        "systems": len(systems),
        "worst": [_worst_row(o, second_look(o, settings)) for o in by_z[:_WORST]],
        "cases": cases,
        "rows": [_row(o) for o in [*cases, *systems]],
        "figures": {"": figure(scores, 4000 if request.quick else 40_000)},
    }


def _scores(systems: Sequence[Outcome], settings: Settings) -> dict[str, FloatArray]:
    """z of each kind, one number from each system: independent of each other."""
    random = np.random.default_rng(settings.seed + 1)
    found = {name: [o.single[name] for o in systems if name in o.single] for name in _SINGLE}
    for kind, words in (("bins", "variance of a bin at random"), ("lags", "lag-1 covariance at random")):
        drawn = [o.chosen(kind, random) for o in systems]
        found[words] = [z for z in drawn if z is not None]
    return {name: np.array(z) for name, z in found.items()}


def _rms(z: FloatArray) -> float:
    return float(np.sqrt(np.mean(z**2)))


def _worst_row(o: Outcome, again: float | None) -> Row:
    z, what = o.worst()
    given = {k: v if isinstance(v, str) else f"{v:.4g}" for k, v in o.settings.items()}
    numbers = len(o.single) + o.bins.size + o.lags.size
    return {
        "system": o.name,
        **given,
        "z": f"{o.scores()[what]:+.2f}" if numbers else "",
        "of": what,
        "among": numbers,
        "p, Bonferroni": f"{min(1.0, 2 * numbers * stats.norm.sf(z)):.2g}",
        "again": "" if again is None else f"{again:+.2f}",
    }


def _row(o: Outcome) -> Row:
    given = {k: o.settings.get(k, "") for k in ("S", "B", "t_d", "cycles", "sigma", "start")}
    worst, what = o.worst()
    return {
        "name": o.name,
        **given,
        **picked(o.law, "count_mean count_variance"),
        **{"z_" + name.replace(", ", "_").replace(" ", "_"): o.single.get(name, "") for name in _SINGLE},
        "bins": o.bins.size,
        "rms_z_bins": _rms(o.bins) if o.bins.size else "",
        "lags": o.lags.size,
        "rms_z_lags": _rms(o.lags) if o.lags.size else "",
        "worst_z": worst,
        "worst_of": what,
        **picked(o.law, "grid_bins movement sweeps settled"),
    }
