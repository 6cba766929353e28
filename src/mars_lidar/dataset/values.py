"""Values of a recipe, read and checked: every complaint is a `RecipeError` that says which key it is about."""

from __future__ import annotations

import math
from typing import Any

from mars_lidar._base import checks
from mars_lidar.dataset.yaml_lines import Key, RecipeError


def mapping(key: Key, data: Any, allowed: tuple[str, ...], needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """A mapping of known keys."""
    name = key_name(key) or "the recipe"
    known: dict[str, Any] = checked(key, checks.known_keys, name, data, allowed)
    for one in needed:
        if one not in known:
            raise RecipeError(key, f"{name} must give {one}")
    return known


def level(key: Key, name: str, value: Any) -> float:
    """A positive number; of sbr, inf too."""
    given = number(value)
    if name == "sbr" and isinstance(given, float) and math.isinf(given) and given > 0:
        return given
    return float(checked(key, lambda: checks.real(name, given, low=0.0, strict_low=True)))


def size(key: Key, value: Any) -> int | tuple[int, int] | None:
    """The longer side of an image, or (height, width)."""
    if value is None:
        return None
    if isinstance(value, list | tuple):
        if len(value) != 2:
            raise RecipeError(key, f"{key_name(key)} must be an integer or [height, width], got {value!r}")
        height, width = (integer(key, one, low=1, high=1 << 13) for one in value)
        return height, width
    return integer(key, value, low=1, high=1 << 13)


def listed(size: int | tuple[int, int] | None) -> Any:
    """A size as JSON has it."""
    return list(size) if isinstance(size, tuple) else size


def numbers(key: Key, value: Any, name: str = "seeds") -> Any:
    """A list of integers, or ``{first, count}``."""
    if isinstance(value, dict):
        known = mapping(key, value, ("first", "count"), needed=("count",))
        first = integer((*key, "first"), known.get("first", 0), low=0, high=2**63)
        return {"first": first, "count": integer((*key, "count"), known["count"], low=1, high=2**20)}
    if not isinstance(value, list) or not value:
        raise RecipeError(key, f"{name} must be a list of integers, or first and count, got {value!r}")
    found = [integer((*key, k), one, low=0, high=2**64 - 1, name=name) for k, one in enumerate(value)]
    if len(set(found)) < len(found):
        raise RecipeError(key, f"{name} must differ from each other, got {found}")
    return found


def listed_numbers(value: Any) -> list[int]:
    """The integers of ``[...]`` or ``{first, count}``."""
    if isinstance(value, dict):
        return list(range(value["first"], value["first"] + value["count"]))
    return list(value)


def key_name(key: Key) -> str:
    """``scenes[0].path``."""
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in key).lstrip(".")


def number(value: Any) -> Any:
    """YAML takes inf for a text."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def real(key: Key, value: Any, **limits: Any) -> float:
    """A number; `limits` as for `checks.real`."""
    return float(checked(key, lambda: checks.real(key_name(key), number(value), **limits)))


def integer(key: Key, value: Any, *, name: str | None = None, **limits: Any) -> int:
    """An integer; `limits` as for `checks.integer`."""
    return int(checked(key, lambda: checks.integer(name or key_name(key), value, **limits)))


def choice(key: Key, value: Any, allowed: tuple[str, ...]) -> str:
    """One of some words."""
    return str(checked(key, checks.choice, key_name(key), value, allowed))


def text(key: Key, value: Any) -> str:
    """A text that is not empty."""
    if not isinstance(value, str) or not value:
        raise RecipeError(key, f"{key[-1]} must be a text, got {value!r}")
    return value


def checked(key: Key, call: Any, *arguments: Any) -> Any:
    """The result of a call whose complaint is about `key`."""
    try:
        return call(*arguments)
    except RecipeError:
        raise
    except (ValueError, TypeError, OSError) as error:
        raise RecipeError(key, str(error)) from error
