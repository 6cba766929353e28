"""Mutations of one format, drawn by Hypothesis from a seed."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis
from hypothesis import HealthCheck, Phase, given, settings

from tests.fuzz.formats import LEAVES_OUT
from tests.fuzz.mutate import apply, edits
from tests.fuzz.server import Server

BAD = ("unnamed", "foreign", "crash", "hang", "memory")


def fuzz(
    name: str, good: Path, scratch: Path, server: Server, examples: int, seed: int, tell: Callable[..., Any]
) -> None:
    """Call ``tell(outcome, path)`` for so many mutations of the good file `name`."""
    top = name.partition("/")[0]

    @hypothesis.seed(seed)
    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(edits)
    def once(edit: dict[str, Any]) -> None:
        inside = scratch / "in"
        shutil.rmtree(inside, ignore_errors=True)
        inside.mkdir(parents=True)
        whole = (good / top).is_dir()
        (shutil.copytree if whole else shutil.copy)(good / top, inside / top)
        if name in ("recipe.yaml", "scene.yaml"):
            for other in ("system.yaml", "depth.png"):
                shutil.copy(good / other, inside / other)
        apply(inside / name, edit)
        result = server.read(name, inside / name)
        if name in LEAVES_OUT and result["kind"] == "refused":
            result["kind"] = "foreign"  # one damaged file stopped a folder
        tell(result, inside / name)

    once()
