"""The example, shortened: it runs, learns, and measures itself."""

from __future__ import annotations

import runpy
from pathlib import Path

PATH = Path(__file__).parents[2] / "examples" / "train_depth.py"


def test_train_depth():
    example = runpy.run_path(str(PATH))
    net, losses = example["train"](30, 12)
    assert len(losses) == 30
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    shares = example["within_a_bin"](net, 12)
    assert set(shares) == {"network", "matched filter"}
    assert 0.3 < shares["matched filter"] <= 1.0  # chance is 0.03
    assert 0.1 < shares["network"] <= 1.0


def test_it_is_as_short_as_the_issue_wants():
    """The stream, the network and its training: code, without imports, blank lines and what measures and plots."""
    text = PATH.read_text()
    core = text[text.index("PULSE") : text.index("def within_a_bin")]
    assert len([line for line in core.splitlines() if line.strip()]) <= 22
