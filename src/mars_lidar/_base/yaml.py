"""YAML 1.2 with the line number of every key, for error messages.

Scalars follow the core schema of YAML 1.2: 1e-3 is a number, 1:30 and 2026-11-23 are texts, 010 is ten, and only true
and false are booleans. PyYAML, which parses the structure, follows YAML 1.1, where these are a text, 90, a date and 8.
"""

import contextlib
import re
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from mars_lidar._base.files import FileError, reading
from mars_lidar._base.tolerances import TOL

Key = tuple[str | int, ...]  # ("scenes", 0, "path")
Lines = dict[Key, int]

_SCALARS = {  # of the core schema, YAML 1.2.2, 10.3.2, with the characters that they may begin with
    "null": (re.compile(r"(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    "bool": (re.compile(r"(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    "int": (re.compile(r"(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$"), list("-+0123456789")),
    "float": (
        re.compile(
            r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        list("-+.0123456789"),
    ),
}


class RecipeError(ValueError):
    """An invalid value of a description; `key` is its place."""

    def __init__(self, key: Key, message: str) -> None:
        super().__init__(message)
        self.key = key


@lru_cache(maxsize=1)
def loader() -> Any:
    """PyYAML's safe loader with the scalars of YAML 1.2."""
    import yaml

    class Loader(yaml.SafeLoader):
        """A loader with resolvers and constructors of its own."""

        yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  # as PyYAML has it

    for name, (pattern, first) in _SCALARS.items():
        Loader.add_implicit_resolver(f"tag:yaml.org,2002:{name}", pattern, first)
    Loader.add_constructor("tag:yaml.org,2002:int", _integer)
    return Loader


def _integer(reader: Any, node: Any) -> int:
    text = reader.construct_scalar(node)
    base = {"0o": 8, "0x": 16}.get(text[:2], 10)
    return int(text if base == 10 else text[2:], base)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A loader and the root node of a YAML file, None where it is empty; errors are ``FILE:LINE: what is wrong``."""
    import yaml

    with reading(path, "YAML"):
        if path.stat().st_size > TOL.yaml_bytes:
            raise ValueError(f"{path}: a YAML file may have {TOL.yaml_bytes} bytes, got {path.stat().st_size}")
        made = loader()(path.read_text(encoding="utf-8-sig"))
        try:
            node = made.get_single_node()
            if _expanded(node, {}) > TOL.yaml_nodes:
                raise ValueError(f"{path}: may have {TOL.yaml_nodes} values, its aliases (*) counted where they stand")
            yield made, node
        except yaml.MarkedYAMLError as error:
            line = "" if error.problem_mark is None else f":{error.problem_mark.line + 1}"
            raise FileError(f"{path}{line}: {error.problem or error}") from error
        finally:
            made.dispose()


def _expanded(node: Any, known: dict[int, int]) -> int:
    """Number of nodes below this one; those of an alias count each time it is used."""
    if id(node) not in known:
        known[id(node)] = TOL.yaml_nodes + 1  # of a node that contains itself
        inner = getattr(node, "value", None)
        children = inner if isinstance(inner, list) else []
        known[id(node)] = 1 + sum(
            sum(_expanded(part, known) for part in child) if isinstance(child, tuple) else _expanded(child, known)
            for child in children
        )
    return known[id(node)]


def read_yaml(path: Path) -> tuple[Any, Lines]:
    """The data of a YAML file and the line (from 1) of each key, numbers of list entries among them."""
    with opened(path) as (reader, node):
        try:
            lines: Lines = {}
            return (None if node is None else _plain(reader, node, (), lines)), lines
        except RecipeError as error:
            raise FileError(f"{path}:{error.key[-1]}: {error}") from error


@contextlib.contextmanager
def located(path: Path, lines: Lines, overridden: Callable[[Key], bool] = lambda key: False) -> Iterator[None]:
    """Raise errors in the data of a file as ``FILE:LINE: message``, without a line for keys that are `overridden`."""
    try:
        yield
    except (ValueError, TypeError) as error:
        key = error.key if isinstance(error, RecipeError) else ()
        line = None if overridden(key) else line_of(key, str(error), lines)
        raise FileError(f"{path}{'' if line is None else f':{line}'}: {error}") from error


def line_of(key: Key, message: str, lines: Lines) -> int | None:
    """Line of a key, of a key below it that `message` names, or else of the nearest parent."""
    unknown = re.search(r"unknown key '(.*?)'", message)
    words = [unknown[1]] if unknown else re.findall(r"\w+", message)
    for word in words:
        if (*key, word) in lines:
            return lines[(*key, word)]
    for word in words[:1]:  # the argument that a message begins with, deeper down
        deeper = [line for place, line in lines.items() if place[: len(key)] == key and place[-1:] == (word,)]
        if deeper:
            return deeper[0]
    while key and key not in lines:
        key = key[:-1]
    return lines.get(key)


def _plain(loader: Any, node: Any, key: Key, lines: Lines) -> Any:
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
