"""`mars-lidar export`: a dataset as the files that networks of the field load."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mars_lidar.cli.console import progress_bar, reported, table

EXPORT_EPILOG = "\n\n".join(
    (
        "[bold]Examples[/bold]",
        "mars-lidar generate room --size 64 --scene-seeds 20 -o rooms.zarr",
        "mars-lidar export rooms.zarr --layout lindell --fill -o lindell",
        "docs/formats.md tells what is in each file.",
    )
)


def export(
    dataset: Annotated[Path, typer.Argument(help="A dataset that mars-lidar generate wrote.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="A new folder.", show_default=False)],
    layout: Annotated[
        str,
        typer.Option(
            "--layout", help="Whose loader reads it: lindell, deepsensorfusion, sun or gutierrez.", show_default=False
        ),
    ],
    fill: Annotated[
        bool, typer.Option("--fill", help="Pixels without a return take depth and rates of the nearest with one.")
    ] = False,
) -> None:
    """Write a dataset as the files that depth networks of the field load: one .mat an exposure, and their list."""
    with reported():
        from mars_lidar.dataset.network_files import export as exported

        with progress_bar("exporting") as progress:
            done = exported(dataset, out, layout=layout, fill=fill, progress=progress)
        rows = [("wrote", f"{done.files} exposures in {out}"), ("list", str(done.listed))]
        table(rows + [("note", text) for text in done.notes])
