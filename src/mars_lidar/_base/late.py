"""Methods of a lower layer whose work is done by a higher one: found by name, when they are called.

`Timestamps.save`, `Timestamps.load` and `Scene.from_rgbd` belong to classes that know of no file format, and
`Flux.in_fog` and `Flux.from_transient` to one that knows of no model of light. These are the only places where a
module calls one above it: docs/architecture.md lists them, tests/test_package.py counts them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def late(name: str) -> Any:
    """The object called ``module:name`` in this package, such as ``"io.rgbd:read_rgbd"``."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(f"mars_lidar.{module}"), attribute)
