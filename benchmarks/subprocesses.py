"""Fresh interpreters, for what can only be measured from outside."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import mars_lidar

_ROOTS = (Path(mars_lidar.__file__).parents[1], Path(__file__).parents[1])


def run_python(*arguments: str, folder: Path | None = None) -> str:
    """Standard output of this interpreter with the same packages; an error shows what it wrote."""
    paths = [*map(str, _ROOTS), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        words = f"{done.stdout}{done.stderr}"
        raise RuntimeError(f"{' '.join(arguments)} exited with {done.returncode}:\n{words}")
    return done.stdout
