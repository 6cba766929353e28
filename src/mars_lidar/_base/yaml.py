"""YAML as people write it: 1e-3 is a number, as in YAML 1.2 and in Python, which PyYAML (1.1) takes for text."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from mars_lidar._base.files import FileError, reading

_EXPONENT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
_MOST_BYTES, _MOST_NODES = 2**20, 2**17  # PyYAML reads a megabyte in 10 s


@lru_cache(maxsize=1)
def loader() -> Any:
    """PyYAML's safe loader with such numbers."""
    import yaml

    class Loader(yaml.SafeLoader):
        """A loader with resolvers of its own: adding one leaves those of `yaml.SafeLoader` alone."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))
    return Loader


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A loader and the root node of a YAML file, None where it is empty; errors are ``FILE:LINE: what is wrong``."""
    import yaml

    with reading(path, "YAML"):
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"{path}: a YAML file may have {_MOST_BYTES} bytes, got {path.stat().st_size}")
        made = loader()(path.read_text(encoding="utf-8-sig"))
        try:
            node = made.get_single_node()
            if _expanded(node, {}) > _MOST_NODES:
                raise ValueError(f"{path}: may have {_MOST_NODES} values, its aliases (*) counted where they stand")
            yield made, node
        except yaml.MarkedYAMLError as error:
            line = "" if error.problem_mark is None else f":{error.problem_mark.line + 1}"
            raise FileError(f"{path}{line}: {error.problem or error}") from error
        finally:
            made.dispose()


def _expanded(node: Any, known: dict[int, int]) -> int:
    """Nodes below this one, those behind aliases counted as often as they stand there."""
    if id(node) not in known:
        known[id(node)] = _MOST_NODES + 1  # of a node that contains itself
        inner = getattr(node, "value", None)
        children = inner if isinstance(inner, list) else []
        known[id(node)] = 1 + sum(
            sum(_expanded(part, known) for part in one) if isinstance(one, tuple) else _expanded(one, known)
            for one in children
        )
    return known[id(node)]
