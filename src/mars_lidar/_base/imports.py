"""Modules that are imported when they are needed: of optional libraries, and of higher layers.

`Timestamps.save`, `Timestamps.load` and `Scene.from_rgbd` belong to classes that know of no file format, `Flux.in_fog`
and `Flux.from_transient` to one that knows of no model of light, `Cube.plot` to one that draws nothing. These are the
only places where a module calls one above it: docs/architecture.md lists them, tests/test_package.py counts them.
"""

from __future__ import annotations

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
    """The ``__getattr__`` of a package: names by the modules of it that have them, each loaded when it is asked for.

    All names of a module are put into the package at once, for one of them may be called like the module.
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
    """What was asked for needs a library that is not installed.

    See Also
    --------
    load
    """


def needed(module: str, what: str, extra: str = "io") -> Any:
    """The module, or an error that says how to install it, by which extra; `what` names the format."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingLibraryError(
            f"{what} needs the library {module.partition('.')[0]}: pip install 'mars-lidar[{extra}]' ({error})"
        ) from error
