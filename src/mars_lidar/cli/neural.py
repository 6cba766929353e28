"""`mars-lidar neural`: train the network of the engine "neural" for a system, and say what is in a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mars_lidar.cli import options
from mars_lidar.cli.console import progress_bar, reported, say, table
from mars_lidar.cli.groups import grouped
from mars_lidar.cli.pulse_options import PulseOptions
from mars_lidar.cli.system_options import SystemChanges

if TYPE_CHECKING:
    from mars_lidar.learn.neural import NeuralMap

app = typer.Typer(no_args_is_help=True, rich_markup_mode="rich", help="The network of the engine neural.")

_FLUX, _TRAINING = "Fluxes", "Training"


def _range(name: str) -> typer.models.OptionInfo:
    what = "signal, all returns together" if name == "--signal" else "background"
    option: typer.models.OptionInfo = typer.Option(
        name, metavar="LOW,HIGH", rich_help_panel=_FLUX, help=f"Range of the {what}, photons per period."
    )
    return option


@app.command()
@grouped
def train(
    *,
    out: Annotated[Path, typer.Option("-o", "--out", help="The network: .npz. Curves go beside it: .csv and .png.")],
    system: options.System = None,
    period_ns: options.PeriodNs = None,
    dead_time_ns: options.DeadTimeNs = None,
    bins: options.Bins = None,
    pulse: PulseOptions,
    signal: Annotated[str, _range("--signal")] = "0.002,12",
    background: Annotated[str, _range("--background")] = "0.002,12",
    returns: Annotated[int, typer.Option(help="Most returns of a flux, 1 or 2.", rich_help_panel=_FLUX)] = 2,
    steps: Annotated[int, typer.Option(help="Steps.", rich_help_panel=_TRAINING)] = 1750,
    pairs: Annotated[int, typer.Option(help="Pairs to learn from.", rich_help_panel=_TRAINING)] = 6000,
    seed: Annotated[int, typer.Option(help="Of pairs, weights and order.", rich_help_panel=_TRAINING)] = 0,
    overwrite: options.Overwrite = False,
) -> None:
    """Train the network of a system on the Markov chain of phases, and validate it on held-out fluxes."""
    with reported():
        given = SystemChanges(period_ns=period_ns, dead_time_ns=dead_time_ns, bins=bins, pulse=pulse)
        instrument = given.of(system)
        from mars_lidar.learn.neural import FluxRange, Training
        from mars_lidar.learn.neural.model import check_target
        from mars_lidar.learn.neural.training import Point, save_curves
        from mars_lidar.learn.neural.training import train as train_map

        check_target(out, overwrite)
        fluxes = FluxRange(
            signal=_pair("--signal", signal), background=_pair("--background", background), returns=returns
        )
        chosen = Training(fluxes=fluxes, steps=steps, pairs=pairs, seed=seed)

        def tell(point: Point) -> None:
            say(
                f"step {point.step}: total variation {point.tv_mean:.4f}, 95 % {point.tv_95:.4f}, largest "
                f"{point.tv_max:.4f}; {point.seconds:.0f} s"
            )

        with progress_bar("training") as progress:
            trained = train_map(instrument, chosen, progress=progress, tell=None if progress else tell)
        trained.map.save(out, overwrite=overwrite)
        curves = save_curves(trained, out.with_suffix(""))
        table([*_rows(out, trained.map), ("curves", ", ".join(map(str, curves)))])


@app.command()
def info(
    file: Annotated[
        Path | None, typer.Argument(help="A network: .npz. Without it: the package's own.", show_default=False)
    ] = None,
) -> None:
    """Say what a network was trained for, and how well it does."""
    with reported():
        from mars_lidar.learn.neural import NeuralMap

        found = NeuralMap.example() if file is None else NeuralMap.load(file)
        table(_rows(file, found))


def _pair(name: str, text: str) -> tuple[float, float]:
    try:
        low, high = text.split(",")
        return float(low), float(high)
    except ValueError:
        raise ValueError(f"{name} must be LOW,HIGH, such as 0.002,12, got {text!r}") from None


def _rows(path: Path | None, found: NeuralMap) -> list[tuple[str, str]]:
    system, told, fluxes = found.system, found.record, found.fluxes
    return [
        ("network", "of the package" if path is None else f"{path} ({path.stat().st_size / 1e3:,.4g} kB)"),
        (
            "system",
            f"period {system.period_ns:.6g} ns, {system.bins} bins, {system.pulse!r}, dead time "
            f"{system.detector.dead_time_ns:.6g} ns",
        ),
        (
            "fluxes",
            f"S up to {fluxes.signal[1]:g}, B {fluxes.background[0]:g} to {fluxes.background[1]:g} photons per period, "
            f"up to {fluxes.returns} returns",
        ),
        (
            "training",
            f"{told['steps']} steps on {told['pairs']} pairs, {told['seconds']:.4g} s "
            f"({told['processor_seconds']:.4g} s of processor time), seed {told['seed']}",
        ),
        (
            "held out",
            f"{told['held_out']} fluxes: total variation to the chain {told['tv_mean']:.4f} (95 % "
            f"{told['tv_95']:.4f}, largest {told['tv_max']:.4f}); the mean PDF alone: {told['tv_unconditional']:.4f}",
        ),
        ("count", f"mean off by {told['mean_error']:.2g} of itself, on average"),
    ]
