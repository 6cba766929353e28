"""``python -m studies neural``: train the network of a system, and say what is in a file."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from cyclopts.types import ExistingFile

from mars_lidar import System
from mars_lidar.cli.options import Integer, Number, OutPath, command
from studies.neural.model import NeuralMap, check_target
from studies.neural.pairs import Training
from studies.neural.training import save_curves
from studies.neural.training import train as train_map

_TRAINING = ("steps", "pairs", "seconds", "processor_seconds", "seed")  # of a network's record
_PLAN = Training()


def train(
    *,
    out: OutPath,
    system: ExistingFile | None = None,
    dead_time_ns: Number | None = None,
    steps: Integer = _PLAN.steps,
    pairs: Integer = _PLAN.pairs,
    overwrite: bool = False,
) -> None:
    """Train on the Markov chain of phases, and validate on held-out fluxes.

    Options
    -------
    out : FILE
        The network: .npz. Curves go beside it: .csv and .png.
    system : FILE
        YAML or JSON file (mars-lidar init writes one); else as example.npz.
    dead_time_ns
        Dead time after a registration, ns, in place of that of the system.
    steps
        Steps of the training. [default: 1750]
    pairs
        Pairs to learn from. [default: 6000]
    overwrite
        Replace an existing network.
    """
    check_target(out, overwrite)
    instrument = NeuralMap.example().system if system is None else System.load(system)
    if dead_time_ns is not None:
        instrument = instrument.replace(detector=replace(instrument.detector, dead_time_ns=dead_time_ns))
    tell = partial(print, file=sys.stderr, flush=True)
    trained = train_map(instrument, Training(steps=steps, pairs=pairs), tell=tell)
    trained.map.save(out, overwrite=overwrite)
    _show(out, trained.map)
    print(f"{'curves':<10}", *save_curves(trained, out.with_suffix("")))


def info(file: Path | None = None, /) -> None:
    """What a network was trained for, and how well it does.

    Arguments
    ---------
    file
        A network: .npz. Without it: the one of this folder.
    """
    _show(file, NeuralMap.example() if file is None else NeuralMap.load(file))


train_app, info_app = command(train), command(info)


def _show(path: Path | None, network: NeuralMap) -> None:
    """Print what a network is for and what its training found, name and value a line."""
    system, record = network.system, network.record
    lines = {
        "network": "example.npz" if path is None else f"{path} ({path.stat().st_size / 1e3:,.4g} kB)",
        "system": f"period {system.period_ns:.6g} ns, {system.bins} bins, {system.pulse!r}, dead time "
        f"{system.detector.dead_time_ns:.6g} ns",
        "fluxes": ", ".join(f"{name} {value}" for name, value in network.fluxes.to_dict().items()),
        "training": ", ".join(f"{name} {record[name]}" for name in _TRAINING),
        "held out": f"{record['held_out']} fluxes: total variation to the chain {record['tv_mean']:.4f} (95 % "
        f"{record['tv_95']:.4f}, largest {record['tv_max']:.4f}); the mean PDF alone: {record['tv_unconditional']:.4f}",
        "count": f"mean off by {record['mean_error']:.2g} of itself, on average",
    }
    for label, text in lines.items():
        print(f"{label:<10} {text}")
