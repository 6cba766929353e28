"""`mars-lidar study`: run studies, as ``python -m mars_lidar.studies`` does."""

from __future__ import annotations

import typer


def study(context: typer.Context) -> None:
    """Run studies and write their reports; the list and the options: mars-lidar study --help."""
    from mars_lidar.studies.__main__ import main

    raise typer.Exit(main(context.args, "mars-lidar study"))


SETTINGS = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
