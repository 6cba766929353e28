"""Study "image": depth and signal of images from 1 to 10 photons a pixel, and the coverage of the intervals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mars_lidar import Detector, Flux, GaussianPulse, SampledPulse, Scene, System, reconstruct, simulate
from mars_lidar._base.imports import MissingLibraryError
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.figures import _draw_map, _limits
from mars_lidar.reconstruction import Reconstruction
from mars_lidar.reconstruction.histogram_record import relative_width
from mars_lidar.reconstruction.image_network import card
from studies import Facts, Request
from studies.common.draw import panels
from studies.common.report import Row
from studies.image import captures, large, priors
from studies.image.scenes import busier, light

SEED = 41
OUTLIER_SIGMA = _core.IMAGE_OUTLIER_SIGMA
POOLED = 5  # pixels a side, whose histograms the pooled matched filter adds up
SYSTEM = System(
    period_ns=100.0, cycles=1000, bins=1000, pulse=GaussianPulse(sigma_ns=0.6), detector=Detector(dead_time_ns=75.0)
)
# seeds of scenes "random" which nobody looked at, nor any of their results, before the code and the weights were frozen
FROZEN = (20261227, 20261228, 20261229, 20261230, 20261231)
PICTURED = "random", 1.0, 1.0  # scene, photons and ratio of the picture
# by name: what makes delays of a cube, or None for methods of the package
Methods = dict[str, Callable[[np.ndarray, System], FloatArray] | None]
METHODS: Methods = {
    "maximum_likelihood": None,
    "pooled matched filter": None,
    "total variation": priors.by_variation,
    "image_untrained": None,
    "image": None,
}
DRUNET = "DRUNet prior"
# scenes for the coverage alone, as many of each kind, which were drawn for the first time after it was settled how they
# are drawn, how many, and what is reported of them
FURTHER_SEED = 20261127
FURTHER = ", further scenes"  # appended to the part that they belong to
LEAST, MOST = 87.0, 93.0  # per cent: the coverage aimed at in every cell
Results = dict[str, Reconstruction | FloatArray]  # of a method, or of a prior and of "truth" depths in m


@dataclass(frozen=True)
class Settings:
    """Side of the images, mean photons of signal of a pixel, signal to background, and sizes of the other parts.

    `further`: scenes of each kind for the coverage in the table's cells, and in other systems; `drunet`: steps and
    images of its training.
    """

    size: int
    photons: tuple[float, ...]
    sbr: tuple[float, ...]
    frozen: int
    two: int
    large: tuple[int, ...]
    further: tuple[int, int]
    drunet: tuple[int, int]


FULL = Settings(64, (1.0, 2.0, 5.0, 10.0), (0.03, 0.3, 1.0, 3.0), len(FROZEN), 48, (256, 2048), (12, 4), (1500, 300))
QUICK = Settings(16, (2.0,), (1.0,), 0, 16, (64,), (2, 2), (20, 8))  # no frozen scene: a quick look is a look


def systems() -> dict[str, System]:
    """Five that no network was trained on: longer, coarser, gated, clocked, and of a pulse with a tail."""
    t = np.arange(0.0, 4.0, 0.02)
    tail = np.exp(-t / 0.6) * (1.0 - np.exp(-t / 0.1))
    gate = Detector(dead_time_ns=30.0, mode="gated", gate_start_ns=8.0, gate_width_ns=60.0)
    return {
        "500 ns, sigma 0.4 ns, 4096 bins": replace(
            SYSTEM, period_ns=500.0, bins=4096, pulse=GaussianPulse(sigma_ns=0.4)
        ),
        "64 bins, sigma 1 ns": replace(SYSTEM, bins=64, pulse=GaussianPulse(sigma_ns=1.0)),
        "gated, 60 of 100 ns": replace(SYSTEM, detector=gate),
        "synchronous, 50 cycles": replace(SYSTEM, cycles=50, detector=Detector(dead_time_ns=0.0, mode="synchronous")),
        "pulse with a tail of 0.6 ns": replace(SYSTEM, pulse=SampledPulse(tail, 0.02)),
    }


def often_dead() -> dict[str, System]:
    """Dead times of 0 to 2 periods in an exposure of 50."""
    times = (0.0, 50.0, 100.0, 200.0)
    return {f"50 cycles, {t:g} ns": replace(SYSTEM, cycles=50, detector=Detector(dead_time_ns=t)) for t in times}


def scenes(size: int) -> dict[str, Scene]:
    """Simulated scenes: the built-in ones, rough ground, and sticks of 1 to 2 pixels before a wall."""
    return {
        "room": Scene.example("room", size),
        "random": Scene.example("random", size, seed=901),
        "rough ground": _ground(size, np.random.default_rng(SEED)),
        "sticks": _sticks(size, 3, 6, 4.0),
    }


def further_scenes(size: int, pairs: dict[str, Scene], each: int, seed: int) -> dict[str, Scene]:
    """By kind and number, `each` other scenes of the kinds of `scenes`, and as many parts of the `pairs`."""
    out = {}
    for place, kind in enumerate([*scenes(size), *pairs]):
        for k in range(each):
            rng = np.random.default_rng([seed, place, k])
            if kind in pairs:
                scene = _part(pairs[kind], size, rng)
            elif kind == "rough ground":
                scene = _ground(size, rng)
            elif kind == "sticks":
                scene = _sticks(size, int(rng.integers(8)), int(rng.integers(3, 13)), 7.0 - rng.uniform(0.5, 5.0))
            else:
                scene = Scene.example(kind, size, seed=int(rng.integers(2**62)))
            out[f"{kind} {k}"] = scene
    return out


def _ground(size: int, rng: np.random.Generator) -> Scene:
    """Sloping ground with relief, texture and thin things in front."""
    slope = 4.0 + 3.0 * np.mgrid[:size, :size][0] / size
    rough, grass = busier(slope, np.full((size, size), 0.5), 0.09, rng)
    return Scene(depth_m=rough, reflectivity=np.clip(grass, 0.02, 1.0))


def _sticks(size: int, first: int, rise: int, depth_m: float) -> Scene:
    """Sticks of 1 and 2 pixels, 8 pixels apart, that lean by a pixel every `rise` rows, before a wall at 7 m."""
    y, x = np.mgrid[:size, :size]
    depth, bright = np.full((size, size), 7.0), np.full((size, size), 0.4)
    for k in range(size // 8):
        across = x - 8 * k - first - y // rise
        stick = (across >= 0) & (across < 1 + k % 2)
        depth, bright = np.where(stick, depth_m, depth), np.where(stick, 0.8, bright)
    return Scene(depth_m=depth, reflectivity=bright)


def _part(pair: Scene, size: int, rng: np.random.Generator) -> Scene:
    """Half to all of the sides of a scene, at random, mirrored or not."""
    share = rng.uniform(0.5, 1.0)
    sides = [round(share * side) for side in pair.shape]
    row, column = (int(rng.integers(whole - side + 1)) for whole, side in zip(pair.shape, sides, strict=True))
    part = pair[row : row + sides[0], column : column + sides[1]].resize(size)
    step = int(rng.choice((-1, 1)))
    return Scene(depth_m=part.depth_m[:, ::step], reflectivity=part.reflectivity[:, ::step])


def rgbd(folder: Path) -> dict[str, Scene]:
    """The RGB-D pairs of a folder, NAME_depth.png beside NAME_colors.png, and Middlebury folders."""
    pairs = {}
    for path in sorted(folder.glob("*_depth.png")):
        name = path.name.removesuffix("_depth.png")
        pairs[name] = Scene.from_rgbd(path, path.with_name(f"{name}_colors.png"))
    for path in sorted(folder.glob("middlebury_*")):
        pairs[path.name] = Scene.from_rgbd(path)
    return pairs


def run(settings: Settings, request: Request) -> Facts:
    """Every scene, system and brightness by every method."""
    every = scenes(settings.size)
    pairs = {} if request.rgbd is None else rgbd(request.rgbd)
    every |= {name: pair.resize(settings.size) for name, pair in pairs.items()}
    rows: list[Row] = []
    thin: list[Row] = []
    maps: Results = {}
    methods, about_drunet = _methods(request, settings)

    def add(part: str, name: str, scene: Scene, system: System, photons: float, sbr: float, words: str) -> None:
        nonlocal maps
        request.tell(f"image: {part}, {name}, {words}, {photons:g} photons, signal to background {sbr:g}")
        at = {"scene": name, "system": words, "photons": photons, "sbr": sbr}
        lines, results = case(scene, system, photons, sbr, methods)
        rows.extend({"part": part} | at | x for x in lines)
        if part == "scenes" and (name, photons, sbr) == (PICTURED[0], *_nearest(settings)):
            maps = results
        if name == "sticks" and sbr == _nearest(settings)[1]:
            thin.append(_thin(scene, system, photons, results))

    for name, scene in every.items():
        for photons in settings.photons:
            for sbr in settings.sbr:
                add("scenes", name, scene, SYSTEM, photons, sbr, "100 ns")
    for words, system in systems().items():
        for name in ("room", "random"):
            for photons in _two(settings):
                add("systems", name, every[name], system, photons, 1.0, words)
    for words, system in often_dead().items():
        for name in ("room", "random"):
            add("dead time", name, every[name], system, 5.0, 1.0, words)
    for seed in FROZEN[: settings.frozen]:
        frozen = Scene.example("random", settings.size, seed=seed)
        for photons in settings.photons[:3]:
            add("frozen", f"random {seed}", frozen, SYSTEM, photons, 1.0, "100 ns")
    for each in captures.captures(request.captures) if request.captures is not None else ():
        for photons in settings.photons[:3]:
            request.tell(f"image: capture {each.name}, {photons:g} photons")
            at = {"part": "captures", "scene": each.name, "system": "measured", "photons": photons, "sbr": "-"}
            rows.extend(at | x for x in thinned(each, photons, methods))
    if request.captures is None:
        request.tell("image: no folder of real captures was given (--captures): left out")
    bright = replace(SYSTEM, cycles=20_000)
    add("bright", "room", every["room"], bright, 500.0, 1.0, "20,000 cycles")
    rows.extend(further_rows(request, settings, pairs))
    cells = coverage(rows, "scenes", ("photons", "sbr"))
    request.tell("image: two returns, large images")
    return {
        "tv_weight": priors.TV_WEIGHT,
        "drunet": about_drunet,
        "fewest": captures.FEWEST,
        "card": card(),
        "by_light": _table(rows, "scenes", ("photons", "sbr")),
        "by_scene": _table(rows, "scenes", ("scene",)),
        "unseen": _table(rows, "systems", ("system",)),
        "blind": _table(rows, "dead time", ("system",)),
        "frozen": _table(rows, "frozen", ("photons",)),
        "bright": _table(rows, "bright", ("photons",)),
        "captures": _table(rows, "captures", ("scene", "photons")),
        "two": two_returns(settings.two, SYSTEM, SEED),
        "large": large.rows(settings.large, SYSTEM, 2.0, 1.0),
        "further_seed": further_seed(request),
        "coverage": cells,
        "unsure": [x for x in cells if LEAST <= x["mean %"] <= MOST and not _surely_inside(x)],
        "coverage_by_kind": coverage(rows, "scenes", ("kind",)),
        "coverage_unseen": coverage(rows, "systems", ("system",)),
        "coverage_blind": coverage(rows, "dead time", ("system",)),
        "thin": thin,
        "rows": rows,
        "figures": {"": _figure(maps, settings)},
    }


def further_seed(request: Request) -> int:
    """Of the further scenes: that of the request, or `FURTHER_SEED`."""
    return FURTHER_SEED if request.seed is None else request.seed


def further_rows(request: Request, settings: Settings, pairs: dict[str, Scene]) -> list[Row]:
    """The method, with and without networks, in one exposure of each further scene, in each cell and other system."""
    methods: Methods = {"image_untrained": None, "image": None}
    cells = [(SYSTEM, "100 ns", photons, sbr) for photons in settings.photons for sbr in settings.sbr]
    others = [(system, words, photons, 1.0) for words, system in systems().items() for photons in _two(settings)]
    dead = [(system, words, 5.0, 1.0) for words, system in often_dead().items()]
    out: list[Row] = []
    seed, (most, fewer) = further_seed(request), settings.further
    for part, at, each in ("scenes", cells, most), ("systems", others, fewer), ("dead time", dead, fewer):
        alike = further_scenes(settings.size, pairs, each, seed)
        for system, words, photons, sbr in at:
            request.tell(f"image: {part}{FURTHER}, {words}, {photons:g} photons, signal to background {sbr:g}")
            for number, (name, scene) in enumerate(alike.items()):
                line = {"part": part + FURTHER, "scene": name, "system": words, "photons": photons, "sbr": sbr}
                out.extend(line | x for x in case(scene, system, photons, sbr, methods, seed + number)[0])
    return out


def _two(settings: Settings) -> tuple[float, ...]:
    """Photons of the systems outside the training set."""
    return settings.photons[:3:2] or settings.photons


def _methods(request: Request, settings: Settings) -> tuple[Methods, str]:
    """The methods that are compared, with DRUNet's prior where deepinv is installed; and what its network is."""
    steps, images = settings.drunet
    try:
        request.tell("image: the prior DRUNet")
        prior = priors.drunet(request.drunet, steps, images, SEED)
    except MissingLibraryError as error:
        if request.drunet is not None:
            raise
        request.tell(f"image: {DRUNET} was skipped: {error}")
        return METHODS, f"skipped: {error}"
    before = dict(list(METHODS.items())[:3])
    return before | {DRUNET: partial(priors.by_denoiser, denoise=prior)} | METHODS, prior.weights


def _thin(scene: Scene, system: System, photons: float, results: Results) -> dict[str, float]:
    """Of the pixels of the sticks, and of those that maximum likelihood sees: how many are off by each method."""
    most = OUTLIER_SIGMA * float(system.depth_m(relative_width(system) * system.period_ns))
    sticks = scene.depth_m < 5.0
    off = {}
    for name, each in results.items():
        if isinstance(each, Reconstruction):
            off[name] = ~(np.abs(each.depth_m - scene.depth_m) < most)
    single = results["maximum_likelihood"]
    assert isinstance(single, Reconstruction)
    alone = sticks & single.detected & ~off["maximum_likelihood"]
    line = {"photons": photons}
    line |= {f"{name}, off %": 100.0 * float(x[sticks].mean()) for name, x in off.items()}
    return line | {
        "seen alone %": 100.0 * float(alone.sum() / sticks.sum()),
        "of these off, image %": 100.0 * float(off["image"][alone].mean()) if alone.any() else float("nan"),
    }


def _nearest(settings: Settings) -> tuple[float, float]:
    """Photons and ratio of the picture that these settings hold."""
    return (
        min(settings.photons, key=lambda x: abs(np.log(x / PICTURED[1]))),
        min(settings.sbr, key=lambda x: abs(np.log(x / PICTURED[2]))),
    )


def case(
    scene: Scene, system: System, photons: float, sbr: float, methods: Methods, seed: int = SEED
) -> tuple[list[dict[str, Any]], Results]:
    """A line for each method; and the reconstructions, with the truth, m, under "truth"."""
    flux = light(scene, system, photons, sbr)
    cube = simulate(flux, system, seed=seed, threads=1)[0]
    truth = np.asarray(flux.delay_ns)
    signal = np.asarray(flux.signal) * system.detector.detection_efficiency
    valid = np.isfinite(truth) & (signal > 0.0)
    lines, results = compared(cube, system, truth, signal, valid, methods)
    return lines, {"truth": np.asarray(system.depth_m(truth))} | results


def thinned(capture: captures.Capture, photons: float, methods: Methods) -> list[dict[str, Any]]:
    """A line for each method, of a real capture of which so many signal photons a pixel were left."""
    counts, share = capture.thinned(photons, SEED)
    signal = capture.signal * share / (capture.system.cycles * capture.system.detector.detection_efficiency)
    return compared(counts.astype(np.uint16), capture.system, capture.delay_ns, signal, capture.valid, methods)[0]


def compared(
    cube: np.ndarray, system: System, truth: FloatArray, signal: FloatArray, valid: np.ndarray, methods: Methods
) -> tuple[list[dict[str, Any]], Results]:
    """A line for each method, and the reconstructions, of a cube whose true delays, ns, and signals are known."""
    lines: list[dict[str, Any]] = []
    results: Results = {}
    for method, prior in methods.items():
        began = time.process_time()
        delay, width, light_found = truth, None, None
        if prior is not None:
            delay = prior(cube, system)
            results[method] = np.asarray(system.depth_m(delay))
        else:
            pooled = method == "pooled matched filter"
            estimate = reconstruct(
                *((_pooled(cube), system, "matched_filter") if pooled else (cube, system, method)), threads=1
            )
            delay, width, results[method] = estimate.delay_ns, estimate.delay_half_width_ns, estimate
            if width is None and estimate.delay_error_ns is not None:
                width = 1.645 * estimate.delay_error_ns
            light_found = estimate.signal / (POOLED**2 if pooled else 1)
        seconds = time.process_time() - began
        judgement = judged(delay, width, light_found, system, truth, signal, valid)
        lines.append({"method": method} | judgement | {"s": seconds})
    return lines, results


def _pooled(cube: np.ndarray) -> np.ndarray:
    """Sums of the histograms of `POOLED` x `POOLED` pixels about each; at the borders those beyond are mirrored."""
    reach = POOLED // 2
    padded = np.pad(cube.astype(np.uint32), ((reach, reach), (reach, reach), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (POOLED, POOLED), axis=(0, 1))
    return np.asarray(windows.sum((-1, -2)), np.uint32)


def judged(
    delay: FloatArray,
    width: FloatArray | None,
    signal: FloatArray | None,
    system: System,
    true_delay: FloatArray,
    true_signal: FloatArray,
    valid: np.ndarray,
) -> dict[str, float]:
    """Errors of delays, ns, and signals where `valid`; coverage of 90 % intervals and the share that has one."""
    period = system.period_ns
    off = (delay - true_delay + 0.5 * period) % period - 0.5 * period
    near = np.abs(off) < OUTLIER_SIGMA * relative_width(system) * period
    off_mm = 1e3 * np.asarray(system.depth_m(np.abs(off)))
    stated = valid & np.isfinite(off) & (np.isfinite(width) if width is not None else False)
    light_off = float("nan")
    if signal is not None:
        light_off = float(np.sqrt(np.nanmean((signal - true_signal)[valid] ** 2)) / true_signal[valid].mean())
    return {
        "off %": 100.0 * float((valid & ~near).sum() / valid.sum()),
        "median mm": float(np.nanmedian(off_mm[valid])),
        "RMSE m": float(np.sqrt(np.nanmean(off_mm[valid] ** 2)) / 1e3),
        "in 90 %": 100.0 * float((np.abs(off) <= width)[stated].mean()) if stated.any() else float("nan"),
        "answered %": 100.0 * float(stated.sum() / valid.sum()),
        "signal RMSE": light_off,
    }


def coverage(rows: Iterable[Row], part: str, keys: tuple[str, ...]) -> list[Row]:
    """Share of the intervals of method "image" that contain the truth in the further scenes: all kinds weigh the same.

    Its standard error for other scenes of these kinds is from the scatter between the scenes of a kind.
    """
    groups: dict[tuple[Any, ...], dict[str, dict[str, dict[str, list[tuple[float, float]]]]]] = {}
    for row in rows:
        if row["part"] == part + FURTHER:
            kind = row["scene"].rsplit(" ", 1)[0]
            at = tuple(kind if key == "kind" else row[key] for key in keys)
            of_kind = groups.setdefault(at, {}).setdefault(row["method"], {}).setdefault(kind, {})
            of_kind.setdefault(row["scene"], []).append((row["in 90 %"], row["answered %"]))
    out: list[Row] = []
    for at, methods in groups.items():
        of_scenes = {  # (scenes, 2): coverage and share answered, of each kind
            method: [np.array([np.mean(x, 0) for x in of_kind.values()]) for of_kind in kinds.values()]
            for method, kinds in methods.items()
        }
        inside = [x[:, 0] for x in of_scenes["image"]]
        means = [float(x.mean()) for x in inside]
        variance = sum(x.var(ddof=1) / len(x) for x in inside) / len(inside) ** 2
        line: dict[str, Any] = dict(zip(keys, at, strict=True)) | {"scenes": sum(map(len, inside))}
        line |= {"mean %": float(np.mean(means)), "error %": float(np.sqrt(variance))}
        line |= {"lowest kind %": min(means), "highest kind %": max(means)} if "kind" not in keys else {}
        line |= {"lowest scene %": float(np.concatenate(inside).min())}
        line |= {"highest scene %": float(np.concatenate(inside).max())}
        line |= {"answered %": float(np.mean([x[:, 1].mean() for x in of_scenes["image"]]))}
        out.append(line | {"untrained, mean %": float(np.mean([x[:, 0].mean() for x in of_scenes["image_untrained"]]))})
    return out


def _surely_inside(line: Row) -> bool:
    """Whether two standard errors lie between the mean and the ends of the range."""
    return bool(LEAST + 2.0 * line["error %"] <= line["mean %"] <= MOST - 2.0 * line["error %"])


def _table(rows: Iterable[Row], part: str, keys: tuple[str, ...]) -> list[Row]:
    """Means over the other keys, by method."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row["part"] == part:
            groups.setdefault((*(row[key] for key in keys), row["method"]), []).append(row)
    values = ("off %", "median mm", "RMSE m", "in 90 %", "answered %", "signal RMSE", "s")
    out: list[Row] = []
    for at, lines in groups.items():
        line: dict[str, Any] = dict(zip((*keys, "method"), at, strict=True))
        for value in values:
            numbers = np.array([x[value] for x in lines], np.float64)
            line[value] = float(np.nanmean(numbers)) if np.isfinite(numbers).any() else "-"
        out.append(line)
    return out


RETURN_PHOTONS = 1.0, 2.0, 5.0, 10.0, 20.0  # of each of two returns, a pixel
_TWO_METHODS = "maximum_likelihood", "image"


def two_returns(size: int, system: System, seed: int, photons: tuple[float, ...] = RETURN_PHOTONS) -> list[Row]:
    """Shares of the pixels with both surfaces where there are two, and with a second return where there is one."""
    x, half = np.arange(size), size // 2
    pane = 10.0 + (3.0 * x + 2.0 * x[:, None]) / size  # ns: a pane of glass in front of the room
    wall = np.asarray(Scene.example("room", size).flux(system, signal=1.0, sbr=1.0).delay_ns)
    out: list[Row] = []
    for each in photons:
        level = np.full((size, size), each / system.cycles)
        of_wall = Flux(level, level, wall)
        scenes = {
            "whole": Flux.multi(of_wall, Flux(level, 0.0, pane)),
            "half": Flux.multi(of_wall, Flux(np.where(x < half, level, 0.0), 0.0, pane)),
            "none": Flux(2.0 * level, level, wall),
        }
        cubes = {name: simulate(flux, system, seed=seed, threads=1)[0] for name, flux in scenes.items()}
        for method in _TWO_METHODS:
            delays = {name: _delays(cube, system, method) for name, cube in cubes.items()}
            both = {name: _both(delays[name], wall, pane, system) for name in ("whole", "half")}
            two = {name: np.asarray(np.isfinite(delays[name]).all(-1)) for name in ("half", "none")}
            line = {"photons of each return": each, "method": method, "both, whole pane %": both["whole"]}
            line |= {"both, half a pane %": both["half"][:, :half], "two beside it %": two["half"][:, half:]}
            line |= {"two without a pane %": two["none"]}
            out.append({k: 100.0 * float(v.mean()) if isinstance(v, np.ndarray) else v for k, v in line.items()})
    return out


def _delays(cube: np.ndarray, system: System, method: str) -> FloatArray:
    """Of both returns (H, W, 2), ns."""
    returns = reconstruct(cube, system, method, returns=2, threads=1).returns
    assert returns is not None
    return returns.delay_ns


def _both(delays: FloatArray, wall: FloatArray, pane: FloatArray, system: System) -> np.ndarray:
    """Whether the returns (H, W, 2) of a pixel are within 3 sigma of pane and wall, or of wall and pane."""
    period, most = system.period_ns, OUTLIER_SIGMA * relative_width(system) * system.period_ns
    near = [np.abs((delays - each[..., None] + 0.5 * period) % period - 0.5 * period) < most for each in (wall, pane)]
    return np.asarray((near[0] & near[1][..., ::-1]).any(-1))


def _figure(maps: Results, settings: Settings) -> Figure:
    """Depth: the truth and each method."""
    figure, axes = panels(1.35, 1, len(maps))
    truth = np.asarray(maps["truth"])
    for ax, (name, each) in zip(axes[0], maps.items(), strict=True):
        depth = each.depth_m if isinstance(each, Reconstruction) else each
        last = "depth (m)" if ax is axes[0, -1] else ""
        _draw_map(ax, depth, last, "viridis", _limits(truth), name.replace("_", " ").replace(" ", "\n", 1))
        ax.images[0].set_interpolation("nearest")
    return figure
