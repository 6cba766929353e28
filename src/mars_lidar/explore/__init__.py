"""The explorer: a page that draws pixels and their exact laws in a browser, and a server that shows it own cubes.

`page.html` holds everything the page needs, the native sources compiled to WebAssembly with it; `explorer/build` in a
checkout makes it (docs/explorer.md).
"""

from mars_lidar.explore.server import CubeServer, page_text

__all__ = ["CubeServer", "page_text"]
