"""The report of the downstream experiment: the paper's table beside ours, the loss by the joint law, one figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS
from studies import Facts
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.downstream import data
from studies.downstream.data import MAIN, PAIR, WORDS, Config, instrument
from studies.downstream.settings import Run

PAPER = {  # T5 of arXiv 2512.04924: by ratio and arm, own then gold; reflectivity PSNR in dB, depth RMSE in m
    (0.6, "poisson"): ((36.49, 0.072), (7.02, 1.654)),
    (0.6, "renewal"): ((29.72, 0.054), (12.12, 0.096)),
    (0.6, "neural"): ((22.74, 0.053), (22.54, 0.082)),
    (0.6, "nearest"): ((24.03, 0.053), (24.25, 0.074)),
    (1.0, "poisson"): ((33.68, 0.061), (7.25, 0.785)),
    (1.0, "renewal"): ((30.97, 0.051), (11.70, 0.097)),
    (1.0, "neural"): ((21.95, 0.051), (22.21, 0.119)),
    (1.0, "nearest"): ((24.28, 0.055), (23.58, 0.095)),
}
FROM_BOUND, OF_BEST = (
    0.5,
    1.1,
)  # dB from the bound, and times maximum likelihood's depth RMSE, of exact-trained networks
CLOSE, LEAST = 1.0, 1.5  # dB from the closed form, and lost at least at `MAIN` and ratio 1, by MaRS-trained ones
CALIBRATED = 0.01  # by which the coverage of exact-trained 90 % intervals may be wrong
_DRAWS = 2000  # of the bootstrap
KINDS = {"pixel": "pixel network", "spatial": "spatial network"}
ASSUMED = (
    "the scenes, the light (S = 4 x reflectivity) and the system, which the paper does not give in full",
    "the networks: small ones that use the bins, in place of the paper's U-Net of the kind of DDPMs",
    "the neural simulator, whose layers, loss and law of the count are not public: a stand-in, tabulated over (S, B)",
    "the second pair of columns at SBR 1.0, which one summary of the paper labels depth PSNR and depth RMSE; it is "
    "read here as the first pair is",
)

Found = Mapping[Run, Any]
Places = Mapping[tuple[float, float], Any]


def facts(config: Config, found: Found, methods: Places, lines: Places) -> Facts:
    """What the report states of the results by run, and the figure."""
    pairs = [_pair(found, kind, place, lines) for kind, place in _paired(found)]
    return {
        "c": config,
        "data": data,
        "system": instrument(MAIN),
        "minutes": sum(result["seconds"] for result in found.values()) / 60.0,
        "table_rows": [row for sbr in config.sbr for row in _rows(found, methods[MAIN, sbr], sbr)],
        "pairs": pairs,
        "findings": list(_findings(found, methods, pairs, config)),
        "rows": _csv(found, methods),
        "figures": {"": picture(found, lines, config)},
    }


def of(found: Found, kind: str, arm: str, dead: float, sbr: float, where: str, measure: str) -> FloatArray:
    """One measure (seeds, scenes); no rows where there is no such network."""
    runs = [one for one in found if (one.kind, one.arm, one.dead, one.sbr) == (kind, arm, dead, sbr)]
    return np.array([found[one][where][measure] for one in runs])


def scatter(values: FloatArray) -> float:
    """Standard deviation of the mean of `values` (seeds, scenes) by drawing both anew with replacement."""
    random = np.random.default_rng(0)
    seeds, scenes = values.shape
    rows = random.integers(0, seeds, (_DRAWS, seeds, 1))
    columns = random.integers(0, scenes, (_DRAWS, 1, scenes))
    return float(values[rows, columns].mean((1, 2)).std(ddof=1))


def rms(square: FloatArray) -> float:
    """Root of a mean of squares."""
    return float(np.sqrt(square.mean()))


def _rows(found: Found, methods: Mapping[str, Any], sbr: float) -> list[Row]:
    rows: list[Row] = []
    for kind, words in KINDS.items():
        for arm, name in WORDS.items():
            psnr, square, covered, depth_covered, ssim = (
                {where: of(found, kind, arm, MAIN, sbr, where, key) for where in ("own", "gold")}
                for key in ("psnr", "depth_square", "covered", "depth_covered", "ssim")
            )
            if not psnr["gold"].size:
                continue
            paper = PAPER.get((sbr, arm)) if kind == "pixel" else None
            rows.append(
                {
                    "SBR": f"{sbr:g}",
                    "estimate": f"{words}, {name}",
                    "reflectivity, own, dB": f"{psnr['own'].mean():.2f}",
                    "gold, dB": f"{psnr['gold'].mean():.2f} ± {scatter(psnr['gold']):.2f}",
                    "SSIM, gold": f"{ssim['gold'].mean():.3f}",
                    "depth, own, mm": f"{1e3 * rms(square['own']):.2f}",
                    "gold, mm": f"{1e3 * rms(square['gold']):.2f}",
                    "90 % intervals cover, own": f"{covered['own'].mean():.3f} / {depth_covered['own'].mean():.3f}",
                    "gold": f"{covered['gold'].mean():.3f} / {depth_covered['gold'].mean():.3f}",
                    "paper: own": f"{paper[0][0]:.2f} / {paper[0][1]:.3f}" if paper else "-",
                    "paper: gold": f"{paper[1][0]:.2f} / {paper[1][1]:.3f}" if paper else "-",
                }
            )
    for name, row in methods.items():
        values = np.array([row["psnr"]])
        blank = dict.fromkeys(("depth, own, mm", "gold, mm", "90 % intervals cover, own", "gold"), "-")
        rows.append(
            {"SBR": f"{sbr:g}", "estimate": f"_{name}_", "reflectivity, own, dB": "-"}
            | {"gold, dB": f"{values.mean():.2f} ± {scatter(values):.2f}"}
            | {"SSIM, gold": f"{np.mean(row['ssim']):.3f}" if "ssim" in row else "-"}
            | blank
            | {"gold, mm": f"{1e3 * rms(np.array(row['depth_square'])):.2f}", "paper: own": "-", "paper: gold": "-"}
        )
    return rows


def _paired(found: Found) -> list[tuple[str, tuple[float, float]]]:
    """Kinds and places (dead time, ratio) where both of the pair were trained, by equally many seeds."""
    places = sorted({(one.kind, (one.dead, one.sbr)) for one in found})

    def number(kind: str, place: tuple[float, float], arm: str) -> int:
        return len(of(found, kind, arm, *place, "gold", "psnr"))

    return [one for one in places if number(*one, PAIR[0]) == number(*one, PAIR[1]) > 0]


def _pair(found: Found, kind: str, place: tuple[float, float], lines: Places) -> dict[str, Any]:
    """Exact less MaRS on gold-standard data, scene by scene and seed by seed, beside the closed form."""
    exact, mars = (of(found, kind, arm, *place, "gold", "psnr") for arm in PAIR)
    sure, covered = (of(found, kind, arm, *place, "gold", "covered") for arm in PAIR)
    return {
        "kind": kind,
        "dead": place[0],
        "sbr": place[1],
        "seeds": len(exact),
        "lost": float((exact - mars).mean()),
        "lost_error": scatter(exact - mars),
        "lost_closed": lines[place]["lost"],
        "exact": float(sure.mean()),
        "exact_error": scatter(sure),
        "mars": float(covered.mean()),
        "mars_error": scatter(covered),
        "closed": lines[place]["covered"],
    }


def _findings(found: Found, methods: Places, pairs: list[dict[str, Any]], config: Config) -> Any:
    """What was expected, and whether it came so."""
    for sbr in config.sbr:
        own = methods[MAIN, sbr]
        gold = of(found, "pixel", "exact", MAIN, sbr, "gold", "psnr").mean()
        short = float(np.mean(own["Cramer-Rao bound"]["psnr"]) - gold)
        yield f"SBR {sbr:g}: exact-trained, {short:.2f} dB from the bound (at most {FROM_BOUND})", short <= FROM_BOUND
        depth = rms(of(found, "pixel", "exact", MAIN, sbr, "gold", "depth_square"))
        times = depth / rms(np.array(own["maximum likelihood"]["depth_square"]))
        yield (
            f"SBR {sbr:g}: its depth, {times:.2f} times maximum likelihood's RMSE (at most {OF_BEST})",
            times <= OF_BEST,
        )
    for one in pairs:
        where = f"{KINDS[one['kind']]}, t_d = {one['dead']:g} t_r, SBR {one['sbr']:g}"
        if (one["kind"], one["dead"], one["sbr"]) == ("pixel", MAIN, 1.0):
            yield f"{where}: {one['lost']:.2f} dB lost (at least {LEAST})", one["lost"] >= LEAST
        if one["kind"] == "pixel":
            off = one["lost"] - one["lost_closed"]
            yield f"{where}: {off:+.2f} dB from the closed form (within {CLOSE:g})", abs(off) <= CLOSE
        holds = abs(one["exact"] - 0.9) <= CALIBRATED
        covered = f"{one['exact']:.3f} ± {one['exact_error']:.3f}"
        yield f"{where}: exact-trained 90 % intervals cover {covered} (within {CALIBRATED} of 0.9)", holds


def _csv(found: Found, methods: Places) -> list[Row]:
    rows: list[Row] = []
    columns = ("psnr", "ssim", "depth_square", "covered", "depth_covered")

    def add(about: dict[str, Any], judged: Mapping[str, list[float]]) -> None:
        for scene in range(len(judged["psnr"])):
            measures = {name: judged[name][scene] if name in judged else "" for name in columns}
            rows.append(about | {"scene": scene} | measures)

    for one, result in found.items():
        about = {"estimate": one.kind, "trained": one.arm, "dead": one.dead, "sbr": one.sbr, "seed": one.seed}
        for where in ("own", "gold"):
            add(about | {"tested": where}, result[where])
    for (dead, sbr), named in methods.items():
        for name, judged in named.items():
            about = {"estimate": name, "trained": "", "dead": dead, "sbr": sbr, "seed": ""}
            add(about | {"tested": "gold"}, judged)
    return rows


def picture(found: Found, lines: Places, config: Config) -> Figure:
    """dB lost and coverage over the dead time: networks as dots, the closed form as lines."""
    figure, ((left, right),) = panels(3.2, 1, 2)
    looks = dict(zip(config.sbr, COLOURS, strict=False))
    for sbr, colour in looks.items():
        law = sorted((dead, row) for (dead, ratio), row in lines.items() if ratio == sbr)
        dead = [one for one, _ in law]
        left.plot(dead, [row["lost"] for _, row in law], color=colour, label=f"closed form, SBR {sbr:g}")
        right.plot(dead, [row["covered"] for _, row in law], color=colour, label=f"closed form, SBR {sbr:g}")
    for kind, place in _paired(found):
        one, colour = _pair(found, kind, place, lines), looks[place[1]]
        dot: dict[str, Any] = {"fmt": "o" if kind == "pixel" else "s", "color": colour, "capsize": 2, "ms": 4}
        label = f"{KINDS[kind]}s, SBR {place[1]:g}"
        left.errorbar(place[0], one["lost"], one["lost_error"], label=label, **dot)
        right.errorbar(place[0], one["mars"], one["mars_error"], label=label, **dot)
        sure = dot | {"mfc": "white"}
        right.errorbar(
            place[0], one["exact"], one["exact_error"], label="trained on exact", **(sure | {"color": "0.4"})
        )
    left.axhline(0.0, color="0.7", lw=0.8, zorder=0)
    right.axhline(0.9, color="0.7", lw=0.8, zorder=0)
    left.set(xlabel="$t_d / t_r$", ylabel="reflectivity lost by training on MaRS, dB")
    right.set(xlabel="$t_d / t_r$", ylabel="share of 90 % intervals that hold the truth")
    legend_below(figure, (left, right), 3)
    return figure
