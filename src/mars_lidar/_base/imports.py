"""Late imports: of optional libraries, and of modules of higher layers.

`Timestamps.save`, `Timestamps.load` and `Scene.from_rgbd` call file formats, `Flux.in_fog` and `Flux.from_transient`
models of light, and `Cube.plot` the figures, all of which lie in higher layers than these classes. These are the only
calls into a higher layer: docs/architecture.md lists them, tests/test_package.py counts them.
"""

import importlib
from importlib import import_module
from typing import Any


def late(name: str) -> Any:
    """The object called ``module:name`` in this package, such as ``"io.rgbd:read_rgbd"``."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(f"mars_lidar.{module}"), attribute)


class MissingLibraryError(ImportError, ValueError):
    """A function needs an optional library that is not installed. The message names the extra that installs it.

    See Also
    --------
    load
    """


def needed(module: str, what: str, extra: str = "io") -> Any:
    """The module, or an error that names the extra which installs it; `what` is the format that needs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingLibraryError(
            f"{what} needs the library {module.partition('.')[0]}: pip install 'mars-lidar[{extra}]' ({error})"
        ) from error
