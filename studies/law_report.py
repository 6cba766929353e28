"""The report on the validity of the count laws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from studies import Request
from studies.law import FULL, LAWS, QUICK, Cell, Settings, exposure_map, flux_map, second_look
from studies.law_figures import draw_all
from studies.report import Row, configuration, save_csv, save_text, table

FEW, STILL, VISIBLE = 10.0, 1.0, 0.01  # E N below FEW, Var N below STILL, total variation above VISIBLE
MODERATE = 200.0  # E N from where a Poisson law is within VISIBLE of its Gaussian
# E |z^3 - 3 z| / 12, z standard normal: total variation of the first Edgeworth term per unit of skewness
_PER_SKEWNESS = (1.0 + 4.0 * float(np.exp(-1.5))) / (6.0 * float(np.sqrt(2.0 * np.pi)))

_SECOND_LOOK = (
    "Cells in which the exact law looked worst, its total variation beyond the limit or its G-test p below "
    "one in "
    "the number of cells, simulated again with another seed and four times the realizations. What was chance "
    "does not come back:"
)


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    flux, exposure = flux_map(settings, request.tell), exposure_map(settings, request.tell)
    again = second_look(settings, [*flux, *exposure], request.tell)
    shown = _shown([*flux, *exposure])
    figures = draw_all(request.out, settings, flux, exposure, shown)
    findings = _findings(settings, [*flux, *exposure])
    for line in findings:
        request.tell(line)
    text = save_text(request.out / "law.md", _text(settings, flux, exposure, again, findings, request.quick))
    rows = [_csv_row("flux", c) for c in flux] + [_csv_row("exposure", c) for c in exposure]
    return [text, *figures, save_csv(request.out / "law.csv", rows)]


_REGIMES: dict[str, Callable[[Cell], bool]] = {
    "few photons: E N < 10": lambda c: bool(c.cumulants[0] < FEW),
    "locked or saturated: E N >= 10, Var N < 1": lambda c: bool(c.cumulants[0] >= FEW and c.cumulants[1] < STILL),
    "sub-Poissonian: 1 <= Var N < E N / 4": lambda c: bool(
        c.cumulants[0] >= FEW and STILL <= c.cumulants[1] < 0.25 * c.cumulants[0]
    ),
    f"moderate: 10 <= E N < {MODERATE:g}, Var N >= E N / 4": lambda c: bool(
        FEW <= c.cumulants[0] < MODERATE and c.cumulants[1] >= max(STILL, 0.25 * c.cumulants[0])
    ),
    f"many: E N >= {MODERATE:g}, Var N >= E N / 4": lambda c: bool(
        c.cumulants[0] >= MODERATE and c.cumulants[1] >= 0.25 * c.cumulants[0]
    ),
}


def _shown(cells: Sequence[Cell]) -> list[Cell]:
    """Cells whose laws are drawn out: the worst for the Gaussian in each regime, at different dead times."""
    chosen: list[Cell] = []
    few, still, dull, moderate, _ = _REGIMES.values()
    # a cell with next to no counts at all is far from a Gaussian, but tells nothing
    told = [c for c in cells if 0.02 < c.laws["exact"].p.max() < 0.98]
    for regime, number in ((few, 2), (still, 2), (dull, 1), (moderate, 1)):
        by_error = sorted((c for c in told if regime(c)), key=lambda c: -c.to_exact["gaussian"])
        picked: list[Cell] = []
        for cell in by_error:
            if all(cell.dead != other.dead for other in picked):
                picked.append(cell)
            if len(picked) == number:
                break
        chosen += picked
    return chosen


def _text(
    settings: Settings,
    flux: list[Cell],
    exposure: list[Cell],
    again: list[tuple[Cell, Cell]],
    findings: list[str],
    quick: bool,
) -> list[str]:
    cells = [*flux, *exposure]
    size = settings.realizations
    return [
        "# Where each count law is valid",
        "_Quick form: a look, not for citing._" if quick else "",
        "Total variation between the law of the number N of registrations in one exposure and its "
        "simulation, over flux, "
        "exposure and dead time; beside it what sampling alone would give. Simulation: the exact engine, "
        "which knows no "
        "statistics of the count.",
        "## Configuration",
        f"Command: `python -m studies law{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "laser": "t_r = 133.33 ns, delay t_r / 2, armed start",
                "pulse": f"Gaussian, sigma = {settings.sigma_ns:g} ns",
                "dead times": ", ".join(f"{d:g}" for d in settings.dead) + " t_r",
                "map over flux": f"S x B = {len(settings.signal)} x {len(settings.background)}, log-spaced on "
                f"[{settings.signal[0]:g}, {settings.signal[-1]:g}] x [{settings.background[0]:g}, "
                f"{settings.background[-1]:g}] photons per period, "
                f"{settings.map_cycles} cycles: {len(flux)} cells",
                "map over exposure": f"S as before, B = S / {settings.ratio:g}, "
                f"cycles {', '.join(map(str, settings.cycles))}: {len(exposure)} cells",
                "simulation": f"{size} realizations a cell, seed {settings.seed}",
                "bootstrap": f"{settings.draws} samples of the exact law for each cell; *floor* is their mean, "
                "*limit* their 99.9 % quantile",
            }
        ),
        'Laws: *exact* `count_law(method="exact")`; *best Gaussian* has the exact mean and variance; '
        "*mars* "
        '`count_law(method="mars")` on 1024 bins, re-arming at the bin centre or edge; *renewal*, '
        "*Poisson*. A Gaussian on the integers "
        "is its integral from n - 1/2 to n + 1/2, what lies below 0 counted as 0.",
        "## Result",
        "\n".join(findings),
        table([_law_row(cells, name) for name in LAWS]),
        f"*within limit*: the law cannot be told from the simulation with {size} realizations; for the exact "
        "law 0.1 % of the cells "
        "are expected beyond it by chance. *to exact law* has no sampling noise.",
        _SECOND_LOOK if again else "",
        table([_again_row(first, second) for first, second in again]),
        "![Where the Gaussian breaks](law_gaussian.png)",
        f"Best Gaussian to exact law, without noise. Top: over S and B at {settings.map_cycles} cycles; "
        f"bottom: over S and cycles, B = S / {settings.ratio:g}. "
        "Dots: fewer than 10 registrations expected. Dashes: at least 10, but a variance below 1, the count "
        "all but fixed by mode "
        "locking or saturation.",
        table([_regime_row(cells, name) for name in _REGIMES]),
        "![Laws of some cells](law_cells.png)",
        "The worst cells of each of these kinds.",
        "## Maps to simulation",
        "![Total variation to simulation over S and B](law_flux.png)",
        "![Total variation to simulation over S and exposure](law_exposure.png)",
        "The first row is the sampling floor: a law is as good as this sample can tell where its map looks "
        "like the first.",
        "![Distance over the sampling floor](law_floor.png)",
        "## By dead time",
        table([_dead_row(cells, dead) for dead in settings.dead]),
        "Median and largest total variation to the exact law; mars with centre and with edge re-arming.",
    ]


def _law_row(cells: Sequence[Cell], name: str) -> Row:
    simulated = np.array([c.to_simulation[name] for c in cells])
    exact = np.array([c.to_exact[name] for c in cells])
    return {
        "law": LAWS[name],
        "median TV to simulation": f"{np.median(simulated):.4f}",
        "median floor": f"{np.median([c.floor for c in cells]):.4f}",
        "within limit": f"{sum(c.within(name) for c in cells)} of {len(cells)}",
        "median TV to exact law": f"{np.median(exact):.4f}" if name != "exact" else "-",
        "largest": f"{exact.max():.3f}" if name != "exact" else "-",
        "in the cell": cells[int(exact.argmax())].name() if name != "exact" else "-",
    }


def _again_row(first: Cell, second: Cell) -> Row:
    return {
        "cell": first.name(),
        "TV / limit": f"{first.to_simulation['exact'] / first.limit:.2f}",
        "G-test p": f"{first.p_value:.1e}",
        "second TV / limit": f"{second.to_simulation['exact'] / second.limit:.2f}",
        "second G-test p": f"{second.p_value:.2g}",
    }


def _regime_row(cells: Sequence[Cell], name: str) -> Row:
    here = [c for c in cells if _REGIMES[name](c)]
    row: dict[str, object] = {"regime": name, "cells": len(here)}
    for law in ("gaussian", "mars", "mars_edge"):
        value = [c.to_exact[law] for c in here] or [float("nan")]
        row[f"{LAWS[law]}: median"] = f"{np.median(value):.4f}"
        row[f"{LAWS[law]}: largest"] = f"{max(value):.3f}"
    row[f"best Gaussian > {VISIBLE:g}"] = sum(c.to_exact["gaussian"] > VISIBLE for c in here)
    return row


def _dead_row(cells: Sequence[Cell], dead: float) -> Row:
    here = [c for c in cells if c.dead == dead]
    row: dict[str, object] = {"t_d / t_r": f"{dead:g}", "cells": len(here)}
    for law in ("gaussian", "mars", "mars_edge", "renewal", "poisson"):
        value = [c.to_exact[law] for c in here]
        row[LAWS[law]] = f"{np.median(value):.4f}, {max(value):.3f}"
    return row


def _findings(settings: Settings, cells: Sequence[Cell]) -> list[str]:
    beyond = [c for c in cells if not c.within("exact")]
    least = min(c.p_value for c in cells)
    scores = np.array([c.mean_score for c in cells if c.cumulants[1] * settings.realizations > 20])
    broken = [c for c in cells if c.to_exact["gaussian"] > VISIBLE]
    causes = [f"{sum(regime(c) for c in broken)} {name.split(':')[0]}" for name, regime in _REGIMES.items()]
    plain = [c for c in cells if c.cumulants[0] >= FEW and c.cumulants[1] >= STILL]
    skewness = np.array([abs(c.cumulants[2]) / c.cumulants[1] ** 1.5 for c in plain])
    found = np.array([c.to_exact["gaussian"] for c in plain])
    ratio = found / (_PER_SKEWNESS * skewness)
    cost = [c.to_exact["mars"] - c.to_exact["gaussian"] for c in cells]
    return [
        f"- Exact law: {len(beyond)} of {len(cells)} cells beyond the 99.9 % limit (expected "
        f"{0.001 * len(cells):.1f}), least G-test p {least:.1e} "
        f"(expected about {1 / len(cells):.0e}), mean within {np.abs(scores).max():.1f} standard errors in "
        "all cells.",
        f"- Best Gaussian: further than {VISIBLE:g} from the exact law in {len(broken)} of {len(cells)} "
        f"cells: {', '.join(causes)}.",
        f"- Where E N >= {FEW:g} and Var N >= {STILL:g} ({len(plain)} cells) its distance is close to the "
        "first Edgeworth term, "
        f"{_PER_SKEWNESS:.3f} |skewness|: median ratio {np.median(ratio):.2f}, 5 to 95 % "
        f"{np.quantile(ratio, 0.05):.2f} to {np.quantile(ratio, 0.95):.2f}. "
        "`count_law(...).cumulants` tells it beforehand.",
        f"- mars, centre, is further from the exact law than the best Gaussian by more than {VISIBLE:g} in "
        f"{sum(c > VISIBLE for c in cost)} of {len(cells)} cells, at most by {max(cost):.3f} "
        f"({cells[int(np.argmax(cost))].name()}): start and end of the exposure, and the chain's grid.",
    ]


def _csv_row(name: str, cell: Cell) -> Row:
    return {
        "map": name,
        "signal": cell.signal,
        "background": cell.background,
        "dead_time_periods": cell.dead,
        "cycles": cell.cycles,
        **{f"cumulant_{k + 1}": float(cell.cumulants[k]) for k in range(4)},
        "floor": cell.floor,
        "limit": cell.limit,
        "g_test_p": cell.p_value,
        "z_mean": cell.mean_score,
        "z_variance": cell.variance_score,
        **{f"tv_simulation_{law}": cell.to_simulation[law] for law in LAWS},
        **{f"tv_exact_{law}": cell.to_exact[law] for law in LAWS if law != "exact"},
    }
