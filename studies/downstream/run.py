"""Study "downstream", T5 of the MaRS paper: networks trained on every simulator's data, tested on gold-standard data.

MaRS has the right law of the count and the right mean histogram, and the wrong covariance of the bins. Two things
follow, which are one argument: estimates learned from its data weigh the bins wrongly and lose accuracy, and they state
wrong errors. Each network leaves its result in a file of its own, and a study that was stopped goes on with the next;
configurations share the networks that they have in common.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from mars_lidar import Flux, System, cramer_rao, reconstruct
from mars_lidar._base.files import beside
from mars_lidar._base.imports import needed
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS
from studies import Facts, OtherRunsError, Request, Tell
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.downstream.data import CONFIGS, GOLD, MAIN, PAIR, WORDS, Config, Data, Run, instrument, runs, truths
from studies.downstream.networks import predicted, trained
from studies.downstream.prediction import of_scenes

METHODS = {  # that need no training
    "matched filter": "matched_filter",
    "generalised Coates": "generalised_coates",
    "maximum likelihood": "maximum_likelihood",
}
LIGHT_M_PER_NS = 0.299792458 / 2.0  # of depth
_GAUSSIAN: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}  # SSIM's window


FULL, QUICK = CONFIGS["small"], CONFIGS["tiny"]


def run(settings: Config, request: Request) -> Facts:
    """Train what has no result, and report all."""
    torch.set_num_threads(1)  # the networks are too small to gain from more
    config, tell = settings if request.quick else CONFIGS[request.config], request.tell
    folder = request.out / f"downstream-{config.sizes.name}"
    fixed(folder, asdict(config.sizes))
    data, every = Data(config.sizes), list(runs(config))
    tell(f"downstream: {sum(not (folder / job.file).exists() for job in every)} of {len(every)} networks to train")
    results = {job: once(folder / job.file, partial(train_and_test, job, data), tell) for job in every}
    places = [(MAIN, sbr) for sbr in config.sbr]
    bounds = {
        (dead, sbr): once(folder / f"methods-dead{dead:g}-sbr{sbr:g}.json", partial(methods, data, dead, sbr), tell)
        for dead, sbr in places
    }
    lines = {
        (dead, sbr): once(folder / f"law-dead{dead:g}-sbr{sbr:g}.json", partial(_law, data, dead, sbr), tell)
        for sbr in config.sbr
        for dead in sorted({*config.lines, MAIN, *(config.dead if sbr == 1.0 else ())})
    }
    return facts(config, results, bounds, lines)


def _law(data: Data, dead: float, sbr: float) -> dict[str, float]:
    return of_scenes(data.fluxes(dead, sbr), instrument(dead), data.sizes.lights)


def train_and_test(job: Run, data: Data) -> dict[str, Any]:
    """A network on fresh pixels of its simulator, and what it says of the test scenes."""
    began, sizes = time.process_time(), data.sizes
    pixels = data.training(job.arm, job.dead, job.sbr, job.seed)
    which = int(job.kind == "spatial")
    network = trained(job.kind, pixels, steps=sizes.steps[which], batch=sizes.batch[which], seed=job.seed)
    result: dict[str, Any] = {"run": asdict(job), "seconds": time.process_time() - began}
    for where in ("own", "gold"):
        tested = data.tested(job.arm, job.dead, job.sbr, gold=where == "gold")
        result[where] = judged(*predicted(network, tested), data, instrument(job.dead))
    return result


def judged(mean: FloatArray, deviation: FloatArray | None, data: Data, system: System) -> dict[str, list[float]]:
    """Scene by scene: PSNR (range 1) and SSIM of reflectivity, mean squared error of depth (m^2), 90 % coverage.

    `mean` and `deviation` (N, H, W, 2) of reflectivity and the delay in bins. SSIM (Wang et al. 2004) has a Gaussian
    window of 1.5 pixels. Pixels without return have no depth to be judged by.
    """
    metrics = needed("skimage.metrics", "study 'downstream'", "estimate")
    metres = system.bin_ns * LIGHT_M_PER_NS
    out: dict[str, list[float]] = {}
    for k, (light, depth) in enumerate(zip(*truths(data.test), strict=True)):
        off = mean[k, ..., 1] - depth / metres
        away = metres * ((off + 0.5 * system.bins) % system.bins - 0.5 * system.bins)
        error = mean[k, ..., 0] - light
        row = {
            "psnr": -10.0 * np.log10(np.mean(error**2)),
            "ssim": metrics.structural_similarity(mean[k, ..., 0], light, data_range=1.0, **_GAUSSIAN),
            "depth_square": np.nanmean(away**2),
        }
        if deviation is not None:
            row["covered"] = np.mean(np.abs(error) <= 1.6448536 * deviation[k, ..., 0])
            inside = np.abs(away) <= 1.6448536 * metres * deviation[k, ..., 1]
            row["depth_covered"] = np.mean(inside[np.isfinite(away)])
        for name, value in row.items():
            out.setdefault(name, []).append(float(value))
    return out


def methods(data: Data, dead: float, sbr: float) -> dict[str, dict[str, list[float]]]:
    """`judged` of what needs no training on gold-standard cubes, and of the Cramer-Rao bound.

    A pixel without an estimate counts with no signal and the middle of the range.
    """
    system, photons = instrument(dead), data.sizes.photons
    cubes, out = data.gold(dead, sbr), {}
    for name, method in METHODS.items():
        estimate = reconstruct(cubes, system, method, threads=1)
        light = np.nan_to_num(estimate.signal / photons)
        delay = np.nan_to_num(estimate.delay_ns, nan=0.5 * system.period_ns) / system.bin_ns
        out[name] = judged(np.stack([light, delay], -1), None, data, system)
    psnr, depth = [], []
    for flux in data.fluxes(dead, sbr):
        lit = flux.signal > 0
        bound = cramer_rao(Flux(flux.signal[lit], flux.background[lit], flux.delay_ns[lit]), system)
        psnr.append(float(-10.0 * np.log10(np.mean((bound.signal / photons) ** 2))))
        depth.append(float(np.mean(bound.depth_m**2)))
    return out | {"Cramer-Rao bound": {"psnr": psnr, "depth_square": depth}}


def fixed(folder: Path, config: Mapping[str, Any]) -> None:
    """Write the configuration, or refuse a folder with runs of another."""
    folder.mkdir(parents=True, exist_ok=True)
    record, path = json.dumps(config, indent=2) + "\n", folder / "config.json"
    if path.exists() and path.read_text() != record:
        raise OtherRunsError(f"{folder} holds runs of another configuration ({path.name}); give another --out")
    _save_whole(path, record)


def once(path: Path, make: Callable[[], Any], tell: Tell) -> Any:
    """What the JSON file `path` holds, made and written first where it is not there."""
    if not path.exists():
        _save_whole(path, json.dumps(make()) + "\n")
        tell(f"{path.parent.name}: {path.stem}")
    return json.loads(path.read_text())


def _save_whole(path: Path, text: str) -> None:
    """Write a text that is whole or not there, whatever stops the process."""
    with beside(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


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

Results = Mapping[Run, Any]
Places = Mapping[tuple[float, float], Any]


def facts(config: Config, results: Results, methods: Places, lines: Places) -> Facts:
    """What the report states of the results by run, and the figure."""
    pairs = [_pair(results, kind, place, lines) for kind, place in _paired(results)]
    return {
        "c": config,
        "gold": GOLD,
        "system": instrument(MAIN),
        "minutes": sum(result["seconds"] for result in results.values()) / 60.0,
        "table_rows": [row for sbr in config.sbr for row in _rows(results, methods[MAIN, sbr], sbr)],
        "pairs": pairs,
        "findings": list(_findings(results, methods, pairs, config)),
        "rows": _csv(results, methods),
        "figures": {"": picture(results, lines, config)},
    }


def of(results: Results, kind: str, arm: str, dead: float, sbr: float, where: str, measure: str) -> FloatArray:
    """One measure (seeds, scenes); no rows where there is no such network."""
    runs = [run for run in results if (run.kind, run.arm, run.dead, run.sbr) == (kind, arm, dead, sbr)]
    return np.array([results[run][where][measure] for run in runs])


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


def _rows(results: Results, methods: Mapping[str, Any], sbr: float) -> list[Row]:
    rows: list[Row] = []
    for kind, words in KINDS.items():
        for arm, name in WORDS.items():
            psnr, square, covered, depth_covered, ssim = (
                {where: of(results, kind, arm, MAIN, sbr, where, key) for where in ("own", "gold")}
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


def _paired(results: Results) -> list[tuple[str, tuple[float, float]]]:
    """Kinds and places (dead time, ratio) where both of the pair were trained, by equally many seeds."""
    places = sorted({(run.kind, (run.dead, run.sbr)) for run in results})

    def number(kind: str, place: tuple[float, float], arm: str) -> int:
        return len(of(results, kind, arm, *place, "gold", "psnr"))

    return [at for at in places if number(*at, PAIR[0]) == number(*at, PAIR[1]) > 0]


def _pair(results: Results, kind: str, place: tuple[float, float], lines: Places) -> dict[str, Any]:
    """Exact less MaRS on gold-standard data, scene by scene and seed by seed, beside the closed form."""
    exact, mars = (of(results, kind, arm, *place, "gold", "psnr") for arm in PAIR)
    sure, covered = (of(results, kind, arm, *place, "gold", "covered") for arm in PAIR)
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


def _findings(results: Results, methods: Places, pairs: list[dict[str, Any]], config: Config) -> Any:
    """What was expected, and whether it came so."""
    for sbr in config.sbr:
        own = methods[MAIN, sbr]
        gold = of(results, "pixel", "exact", MAIN, sbr, "gold", "psnr").mean()
        short = float(np.mean(own["Cramer-Rao bound"]["psnr"]) - gold)
        yield f"SBR {sbr:g}: exact-trained, {short:.2f} dB from the bound (at most {FROM_BOUND})", short <= FROM_BOUND
        depth = rms(of(results, "pixel", "exact", MAIN, sbr, "gold", "depth_square"))
        times = depth / rms(np.array(own["maximum likelihood"]["depth_square"]))
        yield (
            f"SBR {sbr:g}: its depth, {times:.2f} times maximum likelihood's RMSE (at most {OF_BEST})",
            times <= OF_BEST,
        )
    for pair in pairs:
        where = f"{KINDS[pair['kind']]}, t_d = {pair['dead']:g} t_r, SBR {pair['sbr']:g}"
        if (pair["kind"], pair["dead"], pair["sbr"]) == ("pixel", MAIN, 1.0):
            yield f"{where}: {pair['lost']:.2f} dB lost (at least {LEAST})", pair["lost"] >= LEAST
        if pair["kind"] == "pixel":
            off = pair["lost"] - pair["lost_closed"]
            yield f"{where}: {off:+.2f} dB from the closed form (within {CLOSE:g})", abs(off) <= CLOSE
        holds = abs(pair["exact"] - 0.9) <= CALIBRATED
        covered = f"{pair['exact']:.3f} ± {pair['exact_error']:.3f}"
        yield f"{where}: exact-trained 90 % intervals cover {covered} (within {CALIBRATED} of 0.9)", holds


def _csv(results: Results, methods: Places) -> list[Row]:
    rows: list[Row] = []
    columns = ("psnr", "ssim", "depth_square", "covered", "depth_covered")

    def add(about: dict[str, Any], judged: Mapping[str, list[float]]) -> None:
        for scene in range(len(judged["psnr"])):
            measures = {name: judged[name][scene] if name in judged else "" for name in columns}
            rows.append(about | {"scene": scene} | measures)

    for run, result in results.items():
        about = {"estimate": run.kind, "trained": run.arm, "dead": run.dead, "sbr": run.sbr, "seed": run.seed}
        for where in ("own", "gold"):
            add(about | {"tested": where}, result[where])
    for (dead, sbr), named in methods.items():
        for name, judged in named.items():
            about = {"estimate": name, "trained": "", "dead": dead, "sbr": sbr, "seed": ""}
            add(about | {"tested": "gold"}, judged)
    return rows


def picture(results: Results, lines: Places, config: Config) -> Figure:
    """dB lost and coverage over the dead time: networks as dots, the closed form as lines."""
    figure, ((lost, claimed),) = panels(3.2, 1, 2)
    looks = dict(zip(config.sbr, COLOURS, strict=False))
    for sbr, colour in looks.items():
        law = sorted((dead, row) for (dead, ratio), row in lines.items() if ratio == sbr)
        dead = [at for at, _ in law]
        lost.plot(dead, [row["lost"] for _, row in law], color=colour, label=f"closed form, SBR {sbr:g}")
        claimed.plot(dead, [row["covered"] for _, row in law], color=colour, label=f"closed form, SBR {sbr:g}")
    for kind, place in _paired(results):
        pair, colour = _pair(results, kind, place, lines), looks[place[1]]
        dot: dict[str, Any] = {"fmt": "o" if kind == "pixel" else "s", "color": colour, "capsize": 2, "ms": 4}
        label = f"{KINDS[kind]}s, SBR {place[1]:g}"
        lost.errorbar(place[0], pair["lost"], pair["lost_error"], label=label, **dot)
        claimed.errorbar(place[0], pair["mars"], pair["mars_error"], label=label, **dot)
        sure = dot | {"mfc": "white"}
        claimed.errorbar(
            place[0], pair["exact"], pair["exact_error"], label="trained on exact", **(sure | {"color": "0.4"})
        )
    lost.axhline(0.0, color="0.7", lw=0.8, zorder=0)
    claimed.axhline(0.9, color="0.7", lw=0.8, zorder=0)
    lost.set(xlabel="$t_d / t_r$", ylabel="reflectivity lost by training on MaRS, dB")
    claimed.set(xlabel="$t_d / t_r$", ylabel="share of 90 % intervals that hold the truth")
    legend_below(figure, (lost, claimed), 3)
    return figure
