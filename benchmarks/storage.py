"""Storage of counts: codecs beside each other, and whole datasets beside the engine alone."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs import Blosc, Zstd
from numpy.typing import NDArray

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Row, Section
from benchmarks.subprocesses import run_python
from benchmarks.timing import in_turn
from benchmarks.workload import system
from mars_lidar import _core
from mars_lidar._base import manifest
from mars_lidar.dataset import Light
from mars_lidar.dataset.scenes import Rendered, Surfaces
from mars_lidar.light.fog import Fog
from mars_lidar.light.transient import Transient

SIDE, DEAD_TIME_NS = 64, 75.0
LEVELS = (10.0, 1.0, 0.1, 0.01)  # mean signal photons per period; SBR 1
_SUMS = "the checks of its files alone"
GOAL_SIZE, GOAL_MEMORY_GIB, GOAL_WORKERS, GOAL_SUMS = 0.2, 1.5, 1.7, 0.03


def _sparse_decoded(packed: bytes, size: int) -> NDArray[np.uint16]:
    out = np.empty(size, np.uint16)
    _core.unpack_counts(np.frombuffer(packed, np.uint8), out)
    return out


Codec = tuple[Callable[[Any], Any], Callable[[Any, int], Any]]  # of counts: packed, and unpacked to so many
_CODECS: dict[str, Codec] = {"sparse": (_core.pack_counts, _sparse_decoded)} | {
    name: (codec.encode, lambda packed, size, codec=codec: codec.decode(packed))
    for name, codec in (
        ("blosc lz4-5 bitshuffle", Blosc("lz4", 5, Blosc.BITSHUFFLE)),
        ("blosc zstd-1 bitshuffle", Blosc("zstd", 1, Blosc.BITSHUFFLE)),
        ("zstd-3", Zstd(3)),
    )
}


def codecs(config: Config, bandwidth: Bandwidth) -> Section:
    """One thread: pack and unpack an exposure, beside the time that the engine takes to simulate it."""
    del bandwidth
    from numcodecs import blosc

    blosc.use_threads = False
    section = Section("Codecs of counts, one thread", notes=[_CODEC_NOTE])
    for level in LEVELS:
        instrument = system(config, dead_time_ns=DEAD_TIME_NS)
        flux = ml.Scene.example("room", size=SIDE).flux(instrument, signal=level, sbr=1.0)
        out = np.empty((1, *flux.shape, instrument.bins), np.uint16)
        counts = out.reshape(-1)
        ml.simulate(flux, instrument, seed=0, threads=1, out=out)
        packed = {name: pack(counts) for name, (pack, _) in _CODECS.items()}
        cases: dict[str, Callable[[], object]] = {
            "engine": partial(ml.simulate, flux, instrument, seed=0, threads=1, out=out)
        }
        for name, (pack, unpack) in _CODECS.items():
            cases[f"pack {name}"] = partial(pack, counts)
            cases[f"unpack {name}"] = partial(unpack, packed[name], counts.size)
        timings = in_turn(cases, config)
        engine = min(timings["engine"].cpu)
        for name in _CODECS:
            packing, unpacking = (min(timings[f"{what} {name}"].cpu) for what in ("pack", "unpack"))
            size = len(packed[name])
            row: Row = {
                "S": level,
                "bins not zero": f"{100 * np.count_nonzero(counts) / counts.size:.1f} %",
                "codec": name,
                "engine ms": 1e3 * engine,
                "pack ms": 1e3 * packing,
                "unpack ms": 1e3 * unpacking,
                "bytes per pixel": size / SIDE**2,
                "of dense": size / counts.nbytes,
                "of engine speed": engine / (engine + packing),
            }
            section.rows.append(row)
            if name == "sparse" and level == 1.0:
                section.goals.append(
                    Goal("sparse counts over dense uint16, S = 1, 1000 cycles", row["of dense"], GOAL_SIZE, "")
                )
    return section


def datasets(config: Config, bandwidth: Bandwidth) -> Section:
    """`mars_lidar.generate` in fresh interpreters, beside the engine into one buffer."""
    del bandwidth
    section = Section("Datasets", notes=[_DATASET_NOTE])
    scenes = max(2, config.side // 2)
    threads = config.threads
    for level in (1.0, 0.1):
        alone = _child(config, "engine", level, scenes, threads)
        for layout in ("sparse", "dense"):
            measured = _child(config, layout, level, scenes, threads)
            section.rows.append(_dataset_row(f"{layout}, {threads} threads", level, measured, alone))
            if level == 1.0 and layout == "sparse":
                peak = measured["peak"] / 2**30
                section.goals.append(Goal("generate, peak memory", peak, GOAL_MEMORY_GIB, "GiB"))
        section.rows.append(_dataset_row(f"engine alone, {threads} threads", level, alone, alone))
    rates = {}
    for workers in (1, 2):
        measured = _child(config, "workers", 1.0, scenes, workers)
        rates[workers] = measured["rate"]
        section.rows.append(_dataset_row(f"sparse, {workers} worker{'s' * (workers > 1)}", 1.0, measured, None))
    section.goals.append(Goal("2 workers over 1, rate", rates[2] / rates[1], GOAL_WORKERS, "", True))
    return section


def epochs(config: Config, bandwidth: Bandwidth) -> Section:
    """Epochs of `StoredDataset` and of `CubeStream`, in turn; first epochs, and later ones, which compare no sums."""
    del bandwidth
    import torch

    from mars_lidar.learn import CubeStream, StoredDataset

    torch.set_num_threads(1)
    section = Section("Epochs over a store, one process", notes=[_EPOCH_NOTE])
    scenes, batch, instrument = max(2, config.side // 8), 4, system(config, dead_time_ns=DEAD_TIME_NS)
    for level in (1.0, 0.1):
        with tempfile.TemporaryDirectory(dir=os.environ.get("MARS_BENCH_TMP")) as folder:
            cases: dict[str, Any] = {}
            for layout in ("sparse", "dense"):
                store = Path(folder) / f"{layout}.zarr"
                recipe = {
                    "scenes": {"example": "room", "size": [SIDE, SIDE], "seeds": {"count": scenes}},
                    "systems": [instrument],
                    "light": {"signal": [level]},
                    "realizations": 4,
                    "store": {"layout": layout},
                }
                ml.generate(recipe, store)
                opened = StoredDataset(store, batch_size=batch)
                cases[f"{layout}, first epoch"] = lambda s=store: _iterated(StoredDataset(s, batch_size=batch))
                cases[f"{layout}, later epochs"] = partial(_iterated, opened)
                cases[f"{layout}, {_SUMS}"] = partial(_check, store)
                if layout == "sparse":
                    loader = torch.utils.data.DataLoader(StoredDataset(store), batch_size=batch)
                    cases["sparse, examples that the loader collates"] = partial(_iterated, loader)
            stream = CubeStream(
                instrument, "room", size=SIDE, epoch_size=4 * scenes, batch_size=batch, signal=level, sbr=1.0,
                threads=1, ahead=0,
            )  # fmt: skip
            cases["simulated (CubeStream)"] = partial(_iterated, stream)
            timings = in_turn(cases, config)
            rates = {name: 4 * scenes / min(timings[name].cpu) for name in cases}
            section.rows += [{"S": level, "epoch": name, "cubes per CPU s": rate} for name, rate in rates.items()]
            read, made = rates["sparse, later epochs"], rates["simulated (CubeStream)"]
            section.goals.append(Goal(f"sparse over simulated, S = {level:g}", read / made, 1.0, "", True))
            for layout in ("sparse", "dense"):
                share = rates[f"{layout}, first epoch"] / rates[f"{layout}, {_SUMS}"]
                section.goals.append(Goal(f"{layout}, checks of a first epoch, S = {level:g}", share, GOAL_SUMS, ""))
            if level == 1.0:
                section.goals.append(Goal("sparse cubes per CPU s, S = 1", read, 60.0, "", True))
    return section


def waveforms(config: Config, bandwidth: Bandwidth) -> Section:
    """One thread: waveforms of rendered light and of fog made from their scenes, and an exposure drawn from them."""
    del bandwidth
    instrument = system(config, dead_time_ns=DEAD_TIME_NS)
    room, nothing = ml.Scene.example("room", SIDE), np.full((SIDE, SIDE), np.nan)
    light = np.random.default_rng(0).exponential(size=(SIDE, SIDE, instrument.bins))
    kinds = {
        "rendered light": Rendered(Transient(light, instrument.bin_ns), nothing, nothing),
        "fog": Surfaces(room, Fog(extinction_per_m=0.05, backscatter=0.3, nearest_m=1.0)),
    }
    section = Section(f"Waveforms of {SIDE} × {SIDE} pixels")
    for name, content in kinds.items():
        flux = content.flux(instrument, Light(), 1.0, 1.0)
        draw = partial(ml.simulate, flux[:], instrument, seed=0, threads=1)
        spent = in_turn({"made": partial(flux.__getitem__, slice(None)), "drawn": draw}, config)
        seconds = {f"{what}, CPU s": min(timing.cpu) for what, timing in spent.items()}
        section.rows.append({"light": name, "parts": content.waveform_parts(instrument)} | seconds)
    return section


def _iterated(batches: Iterable[Any]) -> None:
    for _ in batches:
        pass


def _check(store: Path) -> None:
    """What a first epoch compares with the manifest: every file that it reads."""
    files = manifest.require(store)
    for name in files:
        files.check(name)


def _dataset_row(case: str, level: float, measured: dict[str, float], alone: dict[str, float] | None) -> Row:
    return {
        "case": case,
        "S": level,
        "pixel exposures": int(measured["exposures"]),
        "s": measured["wall"],
        "CPU s": measured["cpu"] if alone else None,
        "of engine speed, CPU": alone["cpu"] / measured["cpu"] if alone else None,
        "of engine speed, wall": alone["wall"] / measured["wall"] if alone else None,
        "exposures per s": measured["rate"],
        "MB on disk": measured["bytes"] / 1e6,
        "peak MiB": measured["peak"] / 2**20,
    }


def _child(config: Config, what: str, level: float, scenes: int, threads: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory(dir=os.environ.get("MARS_BENCH_TMP")) as folder:
        arguments = [what, level, scenes, threads, config.cycles, config.bins, Path(folder) / "set.zarr"]
        output = run_python("-m", "benchmarks.storage_child", *map(str, arguments))
    measured: dict[str, float] = json.loads(output.splitlines()[-1])
    return measured


_CODEC_NOTE = (
    f"One exposure of the built-in room, {SIDE} × {SIDE} pixels; processor time, the best turn. Of engine speed: "
    "engine / (engine + pack), what is left where a thread packs what it simulates. The sparse layout uses `sparse`, "
    "the dense one `blosc lz4-5 bitshuffle`: the smallest of those that keep 60 % at S = 1."
)
_EPOCH_NOTE = (
    "Rooms of 64 × 64 pixels, 4 realizations each, SBR 1, batches of 4 as float32. Processor time of all threads, the "
    "best turn. A first epoch opens the store and compares each shard with its XXH128; later ones compare the state "
    "of the files, and the CRC-32C of each chunk."
)
_DATASET_NOTE = (
    "Rooms of 64 × 64 pixels, 8 realizations each, 8 MiB a chunk, 64 MiB a shard. CPU s: of all threads of the "
    "process, without its imports; scenes are read (.npz) and stored in that time. The engine alone simulates the "
    "same exposures into one buffer. Workers: rate between the first and the last part, without the start of the "
    "cluster. 0.6 of the engine's speed was aimed at for sparse counts at S = 1 and is no longer: packing them alone "
    "leaves 0.64 (table before), and its share grew when the engine took a fifth less time."
)
