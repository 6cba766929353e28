"""Libraries of extras: imported when they are first used."""

from __future__ import annotations

import importlib
from typing import Any


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
