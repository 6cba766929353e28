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
_COMMANDS = {  # heading: {command: module}; a module is imported when its command is used, or all for the list of them
    "Simulate": {
        "simulate": "simulate",
        "generate": "dataset",
        "verify": "dataset",
        "export": "dataset",
        "timestamps": "convert",
        "table": "table",
    },
    "Look at files": {"info": "viewing", "view": "viewing", "explore": "viewing"},
    "Reconstruct and calibrate": {"reconstruct": "reconstruct", "calibrate": "calibrate"},
    "Write files": {"convert": "convert", "init": "init", "schema": "init"},
}
for _heading, _modules in _COMMANDS.items():
    _group = Group.create_ordered(_heading)
    for _place, (_name, _module) in enumerate(_modules.items()):
        _command = f"mars_lidar.cli.{_module}:{_name}_command"
        app.command(_command, name=_name, group=_group, sort_key=_place)
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
