"""Late imports: of optional libraries, and of modules of higher layers.

`Timestamps.save`, `Timestamps.load` and `Scene.from_rgbd` call file formats, `Flux.in_fog` and `Flux.from_transient`
models of light, and `Cube.plot` the figures, all of which lie in higher layers than these classes. These are the only
calls into a higher layer: docs/architecture.md lists them, tests/test_package.py counts them.
"""

import importlib
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def late(name: str) -> Any:
    """The object called ``module:name`` in this package, such as ``"io.rgbd:read_rgbd"``."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(f"mars_lidar.{module}"), attribute)


def names_of(package: str, homes: dict[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package that imports the module of a name at its first use.

    All names of a module enter the package together, because one of them may have the name of the module.
    """

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(f"{package}.{homes[name]}")
        for each, home in homes.items():
            if home == homes[name]:
                setattr(sys.modules[package], each, getattr(module, each))
        return getattr(module, name)

    return get


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
