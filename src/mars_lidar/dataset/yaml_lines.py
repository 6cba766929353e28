"""YAML with the line of every key, so that an error in a recipe can point at it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mars_lidar._base.files import FileError
from mars_lidar._base.yaml import opened

Key = tuple[str | int, ...]  # ("scenes", 0, "path")


class RecipeError(ValueError):
    """A value of a recipe that cannot be; `key` is where it stands."""

    def __init__(self, key: Key, message: str) -> None:
        super().__init__(message)
        self.key = key


def read_yaml(path: Path) -> tuple[Any, dict[Key, int]]:
    """The data of a YAML file and the line (from 1) of each key, numbers of list entries among them."""
    with opened(path) as (loader, node):
        try:
            lines: dict[Key, int] = {}
            return (None if node is None else _plain(loader, node, (), lines)), lines
        except RecipeError as error:
            raise FileError(f"{path}:{error.key[-1]}: {error}") from error


def line_of(key: Key, message: str, lines: dict[Key, int]) -> int | None:
    """Line of a key, or of what stands nearest above it; a key below it that `message` names comes first."""
    unknown = re.search(r"unknown key '(.*?)'", message)
    for word in [unknown[1]] if unknown else re.findall(r"\w+", message):
        if (*key, word) in lines:
            return lines[(*key, word)]
    while key and key not in lines:
        key = key[:-1]
    return lines.get(key)


def _plain(loader: Any, node: Any, key: Key, lines: dict[Key, int]) -> Any:
    import yaml

    lines.setdefault(key, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        return [_plain(loader, child, (*key, k), lines) for k, child in enumerate(node.value)]
    if not isinstance(node, yaml.MappingNode):
        return loader.construct_object(node, deep=True)
    out: dict[Any, Any] = {}
    for name_node, child in node.value:
        name, line = loader.construct_object(name_node, deep=True), name_node.start_mark.line + 1
        if not isinstance(name, str):
            raise RecipeError((*key, line), f"keys must be words, got {name!r}")
        if name in out:
            raise RecipeError((*key, line), f"{name} is given twice")
        lines[(*key, name)] = line
        out[name] = _plain(loader, child, (*key, name), lines)
    return out
