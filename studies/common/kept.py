"""Results that a study keeps one by one in a folder, so that one that was stopped goes on with the next."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from mars_lidar._base.files import beside
from studies import OtherRunsError, Request, Tell

C = TypeVar("C")

CONFIG = "config.json"


def chosen(configs: Mapping[str, C], request: Request) -> C:
    """The configuration asked for; the quick form's is called tiny."""
    return configs["tiny" if request.quick else request.config]


def fixed(folder: Path, config: Mapping[str, Any]) -> None:
    """Write the configuration, or refuse a folder with runs of another."""
    folder.mkdir(parents=True, exist_ok=True)
    record, path = json.dumps(config, indent=2) + "\n", folder / CONFIG
    if path.exists() and path.read_text() != record:
        raise OtherRunsError(f"{folder} holds runs of another configuration ({CONFIG}); give another --out")
    _save_whole(path, record)


def once(path: Path, make: Callable[[], Any], tell: Tell) -> Any:
    """What the JSON file `path` holds, made and written first where it is not there."""
    if not path.exists():
        _save_whole(path, json.dumps(make()) + "\n")
        tell(f"{path.parent.name}: {path.stem}")
    return json.loads(path.read_text())


class Lines:
    """JSON records by number, one a line of a file that is only appended to: a study that was stopped goes on with it.

    The first line is the configuration; a file of another one is refused. A last line that was cut short is dropped.
    """

    def __init__(self, path: Path, config: Mapping[str, Any]) -> None:
        self.path, self.records, self._lock = path, dict[int, Any](), Lock()
        head = json.dumps(config)
        lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
        if lines and lines[0] != head:
            raise OtherRunsError(f"{path} holds runs of another configuration; give another --out, or delete it")
        self.records.update(json.loads(line) for line in lines[1:])
        _save_whole(path, "\n".join(lines or [head]) + "\n")

    def add(self, number: int, record: Any) -> None:
        """Keep a record; from any thread."""
        self.records[number] = record
        with self._lock, self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([number, record]) + "\n")


def _save_whole(path: Path, text: str) -> None:
    """Write a text that is whole or not there, whatever stops the process."""
    with beside(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def spread(values: Sequence[float], digits: int) -> str:
    """Mean, and the standard deviation between seeds where there are several."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"
