"""The programs of the gallery and of the lessons run, and print what their texts state."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LESSONS = sorted(ROOT.glob("examples/lessons/lesson_*.py"))
GALLERY = sorted(ROOT.glob("examples/gallery/plot_*.py"))
_NEEDS = {"plot_10_endless_stream": "torch"}


@pytest.mark.full
@pytest.mark.parametrize("program", [*LESSONS, *GALLERY], ids=lambda path: path.stem)
def test_the_program_prints_what_its_text_states(program: Path, tmp_path: Path):
    if program.stem in _NEEDS:
        pytest.importorskip(_NEEDS[program.stem])
    run = subprocess.run(
        [sys.executable, program], cwd=tmp_path, capture_output=True, text=True, env={"MPLBACKEND": "Agg"}, check=False
    )
    assert run.returncode == 0, run.stderr[-2000:]
    printed = run.stdout.rstrip().splitlines()
    source = program.read_text(encoding="utf-8")
    prose = re.sub(r"\s*\n(?:# ?)?\s*", " ", source)
    stated = re.findall(r"print(?:s|ed is) ``([^`]+)``", prose)
    assert stated[-1] == printed[-1]
    assert set(stated) <= set(printed)
    assert all(re.search(r"\d|True", line) for line in stated)
