"""`mars-lidar explore`: the explorer's page in a browser, with a cube of the user's own."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mars_lidar.cli.console import reported, say, table
from mars_lidar.cli.foreign import ForeignOptions
from mars_lidar.cli.groups import argument, examples, option
from mars_lidar.cli.info import opened

EXPLORE_EPILOG = examples(
    "mars-lidar explore",
    "mars-lidar explore room.zarr",
    "mars-lidar explore room.zarr --no-browser --port 8000",
)


def explore(
    file: Path | None = argument(
        "A cube, a sample of a dataset, or histograms of others, as `view` takes them. "
        "[dim]Default: the page's own picture.[/dim]",
        None,
    ),
    *,
    foreign: ForeignOptions,
    sample: int | None = option("Of a dataset: which sample.", "0"),
    port: int = option("Port on the loopback address.", "0, one that is free", default=0, min=0, max=65535),
    browser: bool = option(
        "Open the page in the browser of this machine.", "yes", "--browser/--no-browser", default=True
    ),
) -> None:
    """Show pixels with their exact laws in a browser: what dead time does, with sliders; and a cube, pixel by pixel.

    The page is served on 127.0.0.1 alone, until Ctrl-C; parts of the cube are read as they are looked at.
    """
    from mars_lidar.explore import CubeServer

    with reported(), contextlib.ExitStack() as stack:
        cube = None if file is None else stack.enter_context(opened(file, sample, foreign))
        server = CubeServer(cube, "" if file is None else str(file), port=port)
        stack.callback(server.close)
        table([("page", server.url), ("end", "Ctrl-C")])
        if browser:
            import webbrowser

            if not webbrowser.open(server.url):
                say("no browser was found: open the page in one")
        with contextlib.suppress(KeyboardInterrupt):
            server.serve()
