"""``python -m studies neural``: train the network of a system, and say what is in a file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from mars_lidar import System
from studies.neural.model import NeuralMap, check_target
from studies.neural.pairs import Training
from studies.neural.training import save_curves, train

_TRAINING = ("steps", "pairs", "seconds", "processor_seconds", "seed")  # of a network's record


def main(arguments: Sequence[str], command: str) -> int:
    """Entry point; returns the exit code. `command` is what was called, for the help."""
    parser = _parser(command)
    given = parser.parse_args(arguments)
    try:
        if given.verb == "train":
            _train(given)
        else:
            _show(given.file, NeuralMap.example() if given.file is None else NeuralMap.load(given.file))
        return 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ValueError, TypeError, FileNotFoundError, FileExistsError) as error:
        print(f"{command}: {error}", file=sys.stderr)
        return 2


def _parser(command: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=command, description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="train|info")
    learn = verbs.add_parser(
        "train",
        help="train on the Markov chain of phases, and validate on held-out fluxes",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = learn.add_argument
    add("-o", "--out", type=Path, required=True, help="the network: .npz. Curves go beside it: .csv and .png")
    add(
        "--system",
        type=Path,
        metavar="FILE",
        help="YAML or JSON file (mars-lidar init writes one); else as example.npz",
    )
    add("--dead-time-ns", type=float, help="dead time after a registration, ns, in place of that of the system")
    plan = Training()
    add("--steps", type=int, default=plan.steps, help="steps of the training")
    add("--pairs", type=int, default=plan.pairs, help="pairs to learn from")
    add("--overwrite", action="store_true", help="replace an existing network")
    info = verbs.add_parser("info", help="what a network was trained for, and how well it does")
    info.add_argument("file", type=Path, nargs="?", help="a network: .npz. Without it: the one of this folder")
    return parser


def _train(given: argparse.Namespace) -> None:
    check_target(given.out, given.overwrite)
    system = NeuralMap.example().system if given.system is None else System.load(given.system)
    if given.dead_time_ns is not None:
        system = system.replace(detector=replace(system.detector, dead_time_ns=given.dead_time_ns))
    plan = Training(steps=given.steps, pairs=given.pairs)
    trained = train(system, plan, tell=partial(print, file=sys.stderr, flush=True))
    trained.map.save(given.out, overwrite=given.overwrite)
    _show(given.out, trained.map)
    print(f"{'curves':<10}", *save_curves(trained, given.out.with_suffix("")))


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
