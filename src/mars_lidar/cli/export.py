"""`mars-lidar export`: a dataset as the files that networks of the field load."""

from __future__ import annotations

from pathlib import Path

from mars_lidar.cli.console import progress_bar, reported, table
from mars_lidar.cli.groups import argument, examples, option
from mars_lidar.cli.options import out as out_option

EXPORT_EPILOG = examples(
    "mars-lidar generate room --size 64 --scene-seeds 20 -o rooms.zarr",
    "mars-lidar export rooms.zarr --layout lindell --fill -o lindell",
    "docs/formats.md tells what is in each file.",
)


def export(
    dataset: Path = argument("A dataset that mars-lidar generate wrote."),
    out: Path = out_option("A new folder.", panel=None),
    layout: str = option(
        "Whose loader reads it: lindell, deepsensorfusion, sun, gutierrez or webdataset.", default=...
    ),
    fill: bool = option("Pixels without a return take depth and rates of the nearest with one.", default=False),
) -> None:
    """Write a dataset as the files that depth networks load: one .mat an exposure and their list, or tars."""
    with reported():
        from mars_lidar.dataset.network_files import export as exported

        with progress_bar("exporting") as progress:
            done = exported(dataset, out, layout=layout, fill=fill, progress=progress)
        rows = [("wrote", f"{done.files} exposures in {out}"), ("list", str(done.listed))]
        table(rows + [("note", text) for text in done.notes])
