"""The studies by name: every module whose first line is ``Study "NAME": words``; nothing else registers one."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

from studies.request import Request


def _studies() -> dict[str, tuple[str, str]]:
    """Module and words by name."""
    results = {}
    for path in sorted(Path(__file__).parent.glob("*/*.py")):
        with path.open(encoding="utf-8") as file:
            named = re.match(r'"""Study "([a-z-]+)"[:,] (.*)', file.readline())
        if named:
            results[named[1]] = f"studies.{path.parent.name}.{path.stem}", named[2].rstrip('."')
    return results


STUDIES = _studies()


def run(name: str, request: Request) -> list[Path]:
    """Run a study, imported when it is asked for, and write its report; returns the paths written."""
    from studies.common.report import make

    return make(request, name, importlib.import_module(STUDIES[name][0]))
