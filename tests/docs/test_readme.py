"""What README promises runs as written."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import readme

ROOT = Path(__file__).resolve().parents[2]
README = ROOT.joinpath("README.md").read_text()


def test_python():
    own, *more = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    space: dict[str, object] = {}
    exec(own, space)
    assert space["cube"].shape == (1, 48, 64, 1024)
    assert np.nanmedian(np.abs(space["estimate"].depth_m - space["depth_m"])) < 0.02
    for code in more:  # each goes on where the one before ended
        exec(code, space)


def test_commands_that_the_checks_run_are_there():
    for name in ("main", "tests"):
        result = subprocess.run(
            [sys.executable, ROOT / ".ci" / "readme_command.py", name], capture_output=True, text=True, check=True
        )
        assert ".venv/bin/" in result.stdout


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+?)\)", README):
        assert target.startswith("https://") or ROOT.joinpath(target).exists(), target


@pytest.mark.parametrize("name", readme.TABLES)
def test_tables_of_figures_are_those_of_the_saved_run(name: str):
    text, wanted = readme.filled(name)
    assert text == wanted
