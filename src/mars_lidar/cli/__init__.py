"""The command `mars-lidar`.

Exit codes: 0 done, 1 failed (disk full, a bug), 2 bad input, 3 the model does not fit, 130 interrupted.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence

from cyclopts import App, Group

from mars_lidar._version import __version__
from mars_lidar.cli.console import run
from mars_lidar.cli.options import COMMAND_LINE

_EXAMPLES = """\
A first run:
  mars-lidar simulate --scene room -o room.zarr
  mars-lidar info room.zarr
  mars-lidar view room.zarr --pixel 40,64 -o pixel.png

mars-lidar COMMAND --help describes a command.
Exit codes: 0 done, 1 failed, 2 bad input, 3 the model does not fit, 130 interrupted."""

app = App(
    name="mars-lidar",
    help="Exact, fast simulation of single-photon LiDAR histograms under SPAD dead time.",
    help_epilogue=_EXAMPLES,
    **COMMAND_LINE,
    version=f"mars-lidar {__version__}",
)
_COMMANDS = {  # heading: {command: (module, summary)}; the list of commands imports no module, a command only its own
    "Simulate": {
        "simulate": ("simulate", "Simulate the histograms of a scene: a cube and a picture of it."),
        "generate": ("dataset", "Simulate a dataset of many scenes, systems and levels of light."),
        "verify": ("dataset", "Simulate chunks of a dataset again and compare every count."),
        "export": ("dataset", "Write a dataset as the files that depth networks load."),
        "timestamps": ("convert", "Write the photons of a cube one by one, with their times."),
        "table": ("table", "Build, describe and clear lookup tables over signal and background."),
    },
    "Look at files": {
        "info": ("viewing", "Describe a cube, a dataset or a file of another program."),
        "view": ("viewing", "Draw depth, reflectivity, counts and a few histograms."),
        "explore": ("viewing", "Show pixels and their exact laws in a browser."),
    },
    "Reconstruct and calibrate": {
        "reconstruct": ("reconstruct", "Reconstruct depth and reflectivity from a cube."),
        "calibrate": ("calibrate", "Fit light and detector to a measured photon stream."),
    },
    "Write files": {
        "convert": ("convert", "Write a cube or a photon stream in another format."),
        "init": ("init", "Write a commented system file to start from."),
        "schema": ("init", "Write the JSON Schema of scene, recipe or system files, for editors."),
    },
}
for _heading, _commands in _COMMANDS.items():
    _group = Group.create_ordered(_heading)
    for _place, (_name, (_module, _summary)) in enumerate(_commands.items()):
        _command = f"mars_lidar.cli.{_module}:{_name}_command"
        app.command(_command, name=_name, help=_summary, group=_group, sort_key=_place)
app.register_install_completion_command(
    help="Install the completion of commands and options in bash, zsh, fish or PowerShell.",
    help_epilogue="",
    **COMMAND_LINE,
)
_group = Group.create_ordered("Options")
for _name in ("--help", "--version", "--install-completion"):
    app[_name].group = _group


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the command `mars-lidar`; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):  # a sign that a terminal or a pipe cannot show is no error
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    return run(app, sys.argv[1:] if arguments is None else arguments)
