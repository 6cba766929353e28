"""The explorer: a page that shows pixels and their exact laws in a browser, and a server for cubes of the user.

`page.html` is self-contained, with the native sources compiled to WebAssembly; `explorer/build` in a checkout makes it
(docs/explorer.md).
"""

from mars_lidar.explore.server import CubeServer, page_text

__all__ = ["CubeServer", "page_text"]
