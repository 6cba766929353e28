"""Arguments checked by the annotations of the function they are given to, in one wording.

A caller may hand in None, a list of rows of different lengths or a mapping where a path, an array or a `System` is
wanted; without a check something deep inside would fail in words of its own. Numbers and choices have checks that know
their ranges (`checks`).
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from mars_lidar._base.checks import numbers, unmasked

P = ParamSpec("P")
R = TypeVar("R")
_CLASSES = ("System", "Flux", "Cube", "Recipe", "Dataset", "DatasetRecipe", "Table", "Cluster")
_WORDS = {"Path": "a path", "ArrayLike": "an array of real numbers", "str": "a text", "slice": "a slice"}


def checked(function: Callable[P, R], masks: bool = False) -> Callable[P, R]:
    """Refuse, by their names, arguments that cannot be what their annotations say.

    An annotation is looked at where all members of its union are paths, texts, arrays, slices, mappings, None or
    classes of the package. Arrays must hold real numbers, and nothing that is masked, but where `masks` mean something.
    """
    signature = inspect.signature(function)
    wanted = {name: _members(str(each.annotation)) for name, each in signature.parameters.items()}
    wanted = {name: members for name, members in wanted.items() if members}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:  # one too many, or too few: Python says which
            return function(*args, **kwargs)
        for name, members in wanted.items():
            if name in given:
                _require(name, given[name], members, masks)
        return function(*args, **kwargs)

    return call


def checked_with_masks(function: Callable[P, R]) -> Callable[P, R]:
    """As `checked`, for a function to which masked elements mean something."""
    return checked(function, masks=True)


def _members(annotation: str) -> tuple[str, ...]:
    """Members of the union, or none where one of them is not for this module to judge."""
    parts = [part.strip() for part in annotation.strip("'\"").split(" | ")]
    names = ["dict" if part.startswith("dict[") else part for part in parts]
    known = {"None", "dict", *_WORDS, *_CLASSES}
    return tuple(names) if known.issuperset(names) and names != ["None"] else ()


def _require(name: str, value: Any, members: tuple[str, ...], masks: bool) -> None:
    classes = {each.__name__ for each in type(value).__mro__}
    if (value is None and "None" in members) or classes & set(members) - {"str", "None"}:
        if "Path" in members and "\0" in str(value):
            raise ValueError(f"{name} must be a path, got {value!r}, which holds a null byte")
        return
    if "Path" in members and isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        if not isinstance(text, str) or not text or "\0" in text:
            raise ValueError(f"{name} must be a path, got {value!r}")
        return
    if "Path" not in members and "str" in members and isinstance(value, str):
        return
    if "ArrayLike" in members:
        numbers(name, value if masks else unmasked(name, value))
        return
    said = [_WORDS.get(each, f"a {each}") for each in members if each not in ("None", "str" * ("Path" in members))]
    shown = f"{value!r:.80}" if isinstance(value, str | float | int | None) else ""
    raise TypeError(f"{name} must be {' or '.join(said)}, got {shown}{' ' * bool(shown)}{type(value).__name__}")
