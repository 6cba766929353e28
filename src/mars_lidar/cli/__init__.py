"""The command `mars-lidar`.

Exit codes: 0 done, 1 failed (disk full, a bug), 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from mars_lidar.cli.convert import CONVERT_EPILOG, TIMESTAMPS_EPILOG, convert, timestamps
from mars_lidar.cli.explore import EXPLORE_EPILOG, explore
from mars_lidar.cli.export import EXPORT_EPILOG, export
from mars_lidar.cli.generate import GENERATE_EPILOG, generate, verify
from mars_lidar.cli.groups import flowing_help, grouped
from mars_lidar.cli.info import info, view
from mars_lidar.cli.init import init, schema
from mars_lidar.cli.measured import CALIBRATE_EPILOG, calibrate
from mars_lidar.cli.reconstruct import RECONSTRUCT_EPILOG, reconstruct
from mars_lidar.cli.simulate import EPILOG, simulate
from mars_lidar.cli.table import app as table_app

app = typer.Typer(
    name="mars-lidar",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,  # a traceback means a bug, and is wanted whole in a report
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _add(command: Callable[..., None], epilog: str | None = None, **more: Any) -> None:
    app.command(help=flowing_help(command), epilog=epilog, **more)(grouped(command))


for _command, _epilog in (
    (simulate, EPILOG),
    (generate, GENERATE_EPILOG),
    (verify, None),
    (export, EXPORT_EPILOG),
    (info, None),
    (view, None),
    (convert, CONVERT_EPILOG),
    (timestamps, TIMESTAMPS_EPILOG),
    (calibrate, CALIBRATE_EPILOG),
    (reconstruct, RECONSTRUCT_EPILOG),
):
    _add(_command, _epilog, no_args_is_help=True)
_add(explore, EXPLORE_EPILOG)
_add(init)
_add(schema)
app.add_typer(table_app, name="table")


_EPILOG = "\n\n".join(
    (
        "[bold]A first run[/bold]",
        "mars-lidar simulate --scene room -o room.zarr",
        "mars-lidar info room.zarr",
        "mars-lidar view room.zarr --pixel 40,64 -o pixel.png",
        "Exit codes: 0 done, 1 failed, 2 bad input, 3 a model that does not fit, 130 interrupted. "
        "[bold]mars-lidar COMMAND --help[/bold] says more.",
    )
)


def _version(asked: bool) -> None:
    if asked:
        from mars_lidar._version import __version__

        print(f"mars-lidar {__version__}")
        raise typer.Exit


@app.callback(epilog=_EPILOG)
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and stop.", is_eager=True, callback=_version)
    ] = False,
) -> None:
    """Exact, fast simulation of single-photon LiDAR histograms under SPAD dead time."""


def main() -> None:
    """Entry point of the command `mars-lidar`."""
    for stream in (sys.stdout, sys.stderr):  # a sign that a terminal or a pipe cannot show is no error
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    app()
